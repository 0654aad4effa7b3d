//! `x W^T + b`: the bias is where the product is accumulated onto.

use rayon::prelude::*;

use super::super::gemm::{Matrix, Threads, gemm_into};
use super::{Array, Kernel, Saved, vector};

/// Rows per partial sum of the bias gradient.
const ROWS: usize = 256;

#[derive(Debug)]
pub struct Linear;

impl Kernel for Linear {
    fn forward(&self, [x, weight, bias]: [&Array; 3]) -> (Array, Saved) {
        let inputs = x.width();
        let outputs = weight.shape()[0];
        let rows = x.values().len() / inputs;
        let mut y = vec![0.0; rows * outputs];
        if !bias.is_empty() {
            y.par_chunks_mut(ROWS * outputs).for_each(|chunk| {
                for row in chunk.chunks_exact_mut(outputs) {
                    row.copy_from_slice(bias.values());
                }
            });
        }
        let a = Matrix::rows(x.values(), rows, inputs);
        let b = Matrix::rows(weight.values(), outputs, inputs).transposed();
        gemm_into(&mut y, outputs, a, b, 1.0, !bias.is_empty(), Threads::All);
        (Array::new(y, &[rows, outputs]), Saved::default())
    }

    fn backward(
        &self,
        [x, weight, bias]: [&Array; 3],
        _: &Saved,
        dy: &Array,
        [want_x, want_weight, want_bias]: [bool; 3],
    ) -> [Option<Array>; 3] {
        let (inputs, outputs) = (x.width(), dy.width());
        let rows = dy.values().len() / outputs;
        let d = Matrix::rows(dy.values(), rows, outputs);
        let dx = want_x.then(|| {
            let mut dx = vec![0.0; rows * inputs];
            let w = Matrix::rows(weight.values(), outputs, inputs);
            gemm_into(&mut dx, inputs, d, w, 1.0, false, Threads::All);
            Array::new(dx, &[rows, inputs])
        });
        let dw = want_weight.then(|| {
            let mut dw = vec![0.0; outputs * inputs];
            let x = Matrix::rows(x.values(), rows, inputs);
            gemm_into(&mut dw, inputs, d.transposed(), x, 1.0, false, Threads::All);
            Array::new(dw, &[outputs, inputs])
        });
        let db = (want_bias && !bias.is_empty())
            .then(|| Array::new(column_sums(dy.values(), outputs), &[outputs]));
        [dx, dw, db]
    }
}

/// The sum of each column of row-major `x`.
fn column_sums(x: &[f32], width: usize) -> Vec<f32> {
    let partial: Vec<Vec<f32>> = x
        .par_chunks(ROWS * width)
        .map(|chunk| {
            let mut sums = vec![0.0; width];
            vector::vectorised(
                #[inline(always)]
                || {
                    for row in chunk.chunks_exact(width) {
                        for (sum, value) in sums.iter_mut().zip(row) {
                            *sum += value;
                        }
                    }
                },
            );
            sums
        })
        .collect();
    in_order(&partial, width)
}

/// Partial sums added in order.
pub fn in_order(partial: &[Vec<f32>], width: usize) -> Vec<f32> {
    let mut total = vec![0.0; width];
    for sums in partial {
        for (sum, value) in total.iter_mut().zip(sums) {
            *sum += value;
        }
    }
    total
}
