//! Normalisation of each frame over all its pixels and channels (group norm with one group), with SiLU if wanted, on packed rows
//! `[frames * pixels, channels]`.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use std::sync::Arc;

use rayon::prelude::*;

use super::super::FRAME_NORM_EPSILON;
use super::{Array, Kernel, Saved, vector};

/// Rows per task: fixed, so that sums do not depend on the number of threads.
const ROWS: usize = 64;

#[derive(Debug)]
pub struct FrameNorm {
    pub frames: usize,
    pub silu: bool,
}

impl FrameNorm {
    /// Mean and inverse deviation of each frame, `[frames, 2]`.
    fn moments(&self, x: &Array) -> Vec<f32> {
        let channels = x.width();
        let frame = x.values().len() / self.frames;
        x.values()
            .par_chunks(frame)
            .flat_map_iter(|frame| {
                let sums: Vec<[f64; 2]> = frame.par_chunks(ROWS * channels).map(sums).collect();
                let count = frame.len() as f64;
                let total = sums
                    .iter()
                    .fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
                let mean = total[0] / count;
                let variance = (total[1] / count - mean * mean).max(0.0);
                let scale = 1.0 / (variance + f64::from(FRAME_NORM_EPSILON)).sqrt();
                [mean as f32, scale as f32]
            })
            .collect()
    }
}

impl Kernel for FrameNorm {
    /// Saves mean and inverse deviation of each frame.
    fn forward(&self, [x, weight, bias]: [&Array; 3]) -> (Array, Saved) {
        let channels = x.width();
        let (values, weight, bias) = (x.values(), weight.values(), bias.values());
        let frame = values.len() / self.frames;
        let moments = self.moments(x);
        let (moment_pairs, _) = moments.as_chunks::<2>();
        let mut y = vec![0.0; values.len()];
        for ((y, x), [mean, scale]) in y
            .chunks_exact_mut(frame)
            .zip(values.chunks_exact(frame))
            .zip(moment_pairs)
        {
            y.par_chunks_mut(ROWS * channels)
                .zip(x.par_chunks(ROWS * channels))
                .for_each(|(y, x)| {
                    vector::vectorised(
                        #[inline(always)]
                        || {
                            let rows = y.chunks_exact_mut(channels);
                            for (y, x) in rows.zip(x.chunks_exact(channels)) {
                                for (((y, x), w), b) in y.iter_mut().zip(x).zip(weight).zip(bias) {
                                    *y = (x - mean) * scale * w + b;
                                }
                                if self.silu {
                                    for y in y {
                                        *y *= vector::sigmoid(*y);
                                    }
                                }
                            }
                        },
                    );
                });
        }
        let saved = Saved {
            numbers: Arc::new(moments),
            output: None,
        };
        (Array::new(y, &x.shape()), saved)
    }

    fn backward(
        &self,
        [x, weight, bias]: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let (channels, shape) = (x.width(), x.shape());
        let (values, weight, bias, dy) = (x.values(), weight.values(), bias.values(), dy.values());
        let frame = values.len() / self.frames;
        let (moments, _) = saved.numbers.as_chunks::<2>();
        let mut dx = vec![0.0; values.len()];
        let parts: Vec<Vec<f64>> = dx
            .par_chunks_mut(frame)
            .zip(values.par_chunks(frame))
            .zip(dy.par_chunks(frame))
            .zip(moments)
            .map(|(((dx, x), dy), [mean, scale])| {
                // First the gradients of weight and bias, and the two means that the input's gradient needs; `dx` holds the
                // gradient of the normalised values meanwhile.
                let mut affine = vec![0.0_f64; 2 * channels];
                vector::vectorised(
                    #[inline(always)]
                    || {
                        let (weight, bias) = (&weight[..channels], &bias[..channels]);
                        let (dweight, dbias) = affine.split_at_mut(channels);
                        let (dweight, dbias) = (&mut dweight[..channels], &mut dbias[..channels]);
                        let mut normal = vec![0.0_f32; channels];
                        let (mut sum, mut product) = (0.0_f64, 0.0_f64);
                        for ((dx, x), dy) in dx
                            .chunks_exact_mut(channels)
                            .zip(x.chunks_exact(channels))
                            .zip(dy.chunks_exact(channels))
                        {
                            for c in 0..channels {
                                normal[c] = (x[c] - mean) * scale;
                                let mut d = dy[c];
                                if self.silu {
                                    let y = normal[c] * weight[c] + bias[c];
                                    let s = vector::sigmoid(y);
                                    d *= s * (1.0 + y * (1.0 - s));
                                }
                                dweight[c] += f64::from(d * normal[c]);
                                dbias[c] += f64::from(d);
                                dx[c] = d * weight[c];
                            }
                            sum += f64::from(vector::sum(dx));
                            product += f64::from(vector::dot(dx, &normal));
                        }
                        let count = x.len() as f64;
                        let (sum, product) = ((sum / count) as f32, (product / count) as f32);
                        for (dx, x) in dx.iter_mut().zip(x) {
                            let normal = (x - mean) * scale;
                            *dx = scale * (*dx - sum - normal * product);
                        }
                    },
                );
                affine
            })
            .collect();
        let mut affine = vec![0.0_f64; 2 * channels];
        for part in parts {
            for (sum, value) in affine.iter_mut().zip(part) {
                *sum += value;
            }
        }
        let affine: Vec<f32> = affine.into_iter().map(|value| value as f32).collect();
        [
            Some(Array::new(dx, &shape)),
            Some(Array::new(affine[..channels].to_vec(), &[channels])),
            Some(Array::new(affine[channels..].to_vec(), &[channels])),
        ]
    }
}

/// Sum and sum of squares.
fn sums(block: &[f32]) -> [f64; 2] {
    vector::vectorised(
        #[inline(always)]
        || sums_of_parts(block),
    )
}

#[inline(always)]
fn sums_of_parts(block: &[f32]) -> [f64; 2] {
    const LANES: usize = 16;
    let (mut sum, mut square) = (0.0, 0.0);
    for part in block.chunks(1024) {
        let (mut a, mut b) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        let (chunks, rest) = part.as_chunks::<LANES>();
        for chunk in chunks {
            for i in 0..LANES {
                a[i] += chunk[i];
                b[i] += chunk[i] * chunk[i];
            }
        }
        for i in 0..LANES {
            sum += f64::from(a[i]);
            square += f64::from(b[i]);
        }
        for value in rest {
            sum += f64::from(*value);
            square += f64::from(*value) * f64::from(*value);
        }
    }
    [sum, square]
}
