//! `x W^T + b`.

use rayon::prelude::*;

use super::super::gemm::{Matrix, Threads, product};
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
        let a = Matrix::rows(x.values(), rows, inputs);
        let b = Matrix::rows(weight.values(), outputs, inputs).transposed();
        let bias = (!bias.is_empty()).then(|| bias.values());
        let y = product(a, b, bias, Threads::All);
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
            let w = Matrix::rows(weight.values(), outputs, inputs);
            Array::new(product(d, w, None, Threads::All), &[rows, inputs])
        });
        let dw = want_weight.then(|| {
            let x = Matrix::rows(x.values(), rows, inputs);
            let dw = product(d.transposed(), x, None, Threads::All);
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
