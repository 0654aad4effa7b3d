//! Bilinear resize of frames with aligned corners: lines first, then pixels within a line.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use rayon::prelude::*;

use super::super::resize::{Resize, Step, steps};
use super::{Array, Kernel, Saved, vector};

#[derive(Debug)]
pub struct Bilinear {
    pub resize: Resize,
}

impl Kernel for Bilinear {
    fn forward(&self, [x, _, _]: [&Array; 3]) -> (Array, Saved) {
        let Resize { from, to, .. } = self.resize;
        let (channels, values) = (x.width(), x.values());
        let (lines, pixels) = (steps(from[0], to[0]), steps(from[1], to[1]));
        let (line_in, line_out) = (from[1] * channels, to[1] * channels);
        let mut y = vec![0.0; self.resize.rows_out() * channels];
        y.par_chunks_mut(line_out).enumerate().for_each_init(
            || vec![0.0; line_in],
            |mixed, (line, y)| {
                let (frame, step) = (line / to[0], &lines[line % to[0]]);
                let line = |at: usize| &values[(frame * from[0] + at) * line_in..][..line_in];
                vector::vectorised(
                    #[inline(always)]
                    || {
                        mix(mixed, line(step.lower), line(step.upper), step.weight);
                        for (y, step) in y.chunks_exact_mut(channels).zip(&pixels) {
                            let pixel = |at: usize| &mixed[at * channels..][..channels];
                            mix(y, pixel(step.lower), pixel(step.upper), step.weight);
                        }
                    },
                );
            },
        );
        (
            Array::new(y, &[self.resize.rows_out(), channels]),
            Saved::default(),
        )
    }

    fn backward(
        &self,
        [x, _, _]: [&Array; 3],
        _: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let Resize { from, to, .. } = self.resize;
        let channels = x.width();
        let (lines, pixels) = (steps(from[0], to[0]), steps(from[1], to[1]));
        let (frame_in, frame_out) = (from[0] * from[1] * channels, to[0] * to[1] * channels);
        let mut dx = vec![0.0; x.values().len()];
        dx.par_chunks_mut(frame_in)
            .zip(dy.values().par_chunks(frame_out))
            .for_each(|(dx, dy)| {
                let mut mixed = vec![0.0; from[1] * channels];
                for (line, dy) in lines.iter().zip(dy.chunks_exact(to[1] * channels)) {
                    mixed.fill(0.0);
                    for (dy, step) in dy.chunks_exact(channels).zip(&pixels) {
                        spread(&mut mixed, dy, channels, step);
                    }
                    spread(dx, &mixed, from[1] * channels, line);
                }
            });
        [Some(Array::new(dx, &x.shape())), None, None]
    }
}

/// `y = a + (b - a) weight`.
#[inline(always)]
fn mix(y: &mut [f32], a: &[f32], b: &[f32], weight: f32) {
    let (a, b) = (&a[..y.len()], &b[..y.len()]);
    for (i, y) in y.iter_mut().enumerate() {
        *y = a[i] * (1.0 - weight) + b[i] * weight;
    }
}

/// Adds `dy` to the two pieces of `length` values that `step` mixes.
fn spread(sums: &mut [f32], dy: &[f32], length: usize, step: &Step) {
    for (at, weight) in [(step.lower, 1.0 - step.weight), (step.upper, step.weight)] {
        for (sum, value) in sums[at * length..][..length].iter_mut().zip(dy) {
            *sum += value * weight;
        }
    }
}
