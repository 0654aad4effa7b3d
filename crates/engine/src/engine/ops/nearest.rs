//! The nearest code of every vector, on the host: the look-up of a codebook.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use rayon::prelude::*;

use super::gemm::{Matrix, gemm};
use super::vector;

/// Vectors per task: fixed, so results do not depend on the number of threads.
const ROWS: usize = 128;

/// For each row of `x` `[rows, width]` the index of the row of `codes` `[codes, width]` with the largest inner product; the
/// first of several.
#[must_use]
pub fn nearest(x: &[f32], codes: &[f32], width: usize) -> Vec<u32> {
    let count = codes.len() / width;
    let mut ids = vec![0_u32; x.len() / width];
    ids.par_chunks_mut(ROWS)
        .zip(x.par_chunks(ROWS * width))
        .for_each_init(Vec::new, |scores: &mut Vec<f32>, (ids, x)| {
            scores.resize(ids.len() * count, 0.0);
            gemm(
                scores,
                Matrix::rows(x, ids.len(), width),
                Matrix::rows(codes, count, width).transposed(),
            );
            for (id, row) in ids.iter_mut().zip(scores.chunks_exact(count)) {
                *id = largest(row);
            }
        });
    ids
}

/// The index of the largest value, the first of several.
fn largest(row: &[f32]) -> u32 {
    let top = vector::vectorised(
        #[inline(always)]
        || vector::largest(row),
    );
    row.iter()
        .position(|value| *value == top)
        .map_or(0, |index| index as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_equal_codes_wins() {
        let codes = [1.0, 0.0, 0.0, 1.0, 1.0, 0.0];
        assert_eq!(nearest(&[2.0, 1.0, -1.0, 3.0], &codes, 2), [0, 1]);
    }
}
