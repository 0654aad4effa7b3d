//! Layer norm over rows: statistics and output in one pass, all three gradients in one more.

#![allow(unsafe_code)]

use std::sync::Arc;

use rayon::prelude::*;

use super::linear::in_order;
use super::{Array, Kernel, Saved, vector, written};

/// Rows per task.
const ROWS: usize = 64;

#[derive(Debug)]
pub struct LayerNorm {
    pub epsilon: f32,
}

impl Kernel for LayerNorm {
    /// Saves mean and reciprocal deviation of each row.
    fn forward(&self, [x, weight, bias]: [&Array; 3]) -> (Array, Saved) {
        let width = x.width();
        let rows = x.values().len() / width;
        let weight = weight.values();
        let zeros = if bias.is_empty() {
            vec![0.0; width]
        } else {
            Vec::new()
        };
        let bias = if bias.is_empty() {
            &zeros
        } else {
            bias.values()
        };
        let mut statistics = vec![0.0; rows * 2];
        let values = x.values();
        // SAFETY: the tasks are all of `y`, and each writes all values of all its rows.
        let y = unsafe {
            written(rows * width, |y| {
                y.par_chunks_mut(ROWS * width)
                    .zip(statistics.par_chunks_mut(ROWS * 2))
                    .zip(values.par_chunks(ROWS * width))
                    .for_each(|((y, statistics), x)| {
                        vector::vectorised(
                            #[inline(always)]
                            || {
                                let (weight, bias) = (&weight[..width], &bias[..width]);
                                let rows = y.chunks_exact_mut(width).zip(x.chunks_exact(width));
                                for ((y, x), statistics) in rows.zip(statistics.chunks_exact_mut(2))
                                {
                                    let mean = vector::sum(x) / width as f32;
                                    let variance = vector::squares_about(x, mean) / width as f32;
                                    let scale = 1.0 / (variance + self.epsilon).sqrt();
                                    statistics.copy_from_slice(&[mean, scale]);
                                    for i in 0..width {
                                        y[i].write((x[i] - mean) * scale * weight[i] + bias[i]);
                                    }
                                }
                            },
                        );
                    });
            })
        };
        let saved = Saved {
            numbers: Arc::new(statistics),
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
        let width = x.width();
        let weight = weight.values();
        let mut dx = vec![0.0; x.values().len()];
        let partial: (Vec<Vec<f32>>, Vec<Vec<f32>>) = dx
            .par_chunks_mut(ROWS * width)
            .zip(saved.numbers.par_chunks(ROWS * 2))
            .zip(x.values().par_chunks(ROWS * width))
            .zip(dy.values().par_chunks(ROWS * width))
            .map(|(((dx, statistics), x), dy)| {
                let (mut dweight, mut dbias) = (vec![0.0; width], vec![0.0; width]);
                vector::vectorised(
                    #[inline(always)]
                    || {
                        let weight = &weight[..width];
                        let (dweight, dbias) = (&mut dweight[..width], &mut dbias[..width]);
                        let mut hat = vec![0.0_f32; width];
                        let mut slope = vec![0.0_f32; width];
                        let rows = dx.chunks_exact_mut(width).zip(x.chunks_exact(width));
                        let rows = rows
                            .zip(dy.chunks_exact(width))
                            .zip(statistics.chunks_exact(2));
                        for (((dx, x), dy), statistics) in rows {
                            let (mean, scale) = (statistics[0], statistics[1]);
                            for i in 0..width {
                                hat[i] = (x[i] - mean) * scale;
                                slope[i] = dy[i] * weight[i];
                                dweight[i] += dy[i] * hat[i];
                                dbias[i] += dy[i];
                            }
                            let along = vector::dot(&slope, &hat) / width as f32;
                            let average = vector::sum(&slope) / width as f32;
                            for i in 0..width {
                                dx[i] = scale * (slope[i] - average - hat[i] * along);
                            }
                        }
                    },
                );
                (dweight, dbias)
            })
            .unzip();
        let dbias = (!bias.is_empty()).then(|| Array::new(in_order(&partial.1, width), &[width]));
        let dweight = Array::new(in_order(&partial.0, width), &[width]);
        [Some(Array::new(dx, &x.shape())), Some(dweight), dbias]
    }
}
