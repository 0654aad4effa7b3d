//! Softmax cross-entropy with class indices; with a tied output matrix it goes over the logits in blocks of rows.

use std::sync::Arc;

use rayon::prelude::*;

use super::super::gemm::{Matrix, Threads, gemm_into};
use super::{Array, Kernel, Saved, vector};

/// Logits of one block: 64 MiB.
const BLOCK: usize = 16 * 1024 * 1024;

/// Logits that are kept for backward rather than computed again: 256 MiB.
const KEEP: usize = 64 * 1024 * 1024;

/// Rows per task.
const ROWS: usize = 16;

/// Losses of rows of logits, and their log normalisers into `logs`.
fn losses(logits: &[f32], classes: usize, targets: &[u32], losses: &mut [f32], logs: &mut [f32]) {
    losses
        .par_chunks_mut(ROWS)
        .zip(logs.par_chunks_mut(ROWS))
        .zip(logits.par_chunks(ROWS * classes))
        .zip(targets.par_chunks(ROWS))
        .for_each(|(((losses, logs), logits), targets)| {
            vector::vectorised(
                #[inline(always)]
                || {
                    let rows = logits.chunks_exact(classes).zip(targets);
                    for ((row, target), (loss, log)) in rows.zip(losses.iter_mut().zip(logs)) {
                        let top = vector::largest(row);
                        let sum = vector::sum_of_exp(row, top);
                        *log = top + sum.ln();
                        *loss = *log - row[*target as usize];
                    }
                },
            );
        });
}

/// Logits to their gradients, in place: `(softmax - one hot) * dy`.
fn slopes(logits: &mut [f32], classes: usize, targets: &[u32], logs: &[f32], dy: &[f32]) {
    logits
        .par_chunks_mut(ROWS * classes)
        .zip(targets.par_chunks(ROWS))
        .zip(logs.par_chunks(ROWS))
        .zip(dy.par_chunks(ROWS))
        .for_each(|(((logits, targets), logs), dy)| {
            vector::vectorised(
                #[inline(always)]
                || {
                    let rows = logits.chunks_exact_mut(classes).zip(targets);
                    for ((row, target), (log, dy)) in rows.zip(logs.iter().zip(dy)) {
                        for value in row.iter_mut() {
                            *value = vector::exp(*value - log) * dy;
                        }
                        row[*target as usize] -= dy;
                    }
                },
            );
        });
}

#[derive(Debug)]
pub struct CrossEntropy<'a> {
    pub targets: &'a [u32],
}

impl Kernel for CrossEntropy<'_> {
    /// Saves the log normalisers.
    fn forward(&self, [logits, _, _]: [&Array; 3]) -> (Array, Saved) {
        let rows = self.targets.len();
        let (mut found, mut logs) = (vec![0.0; rows], vec![0.0; rows]);
        losses(
            logits.values(),
            logits.width(),
            self.targets,
            &mut found,
            &mut logs,
        );
        let saved = Saved {
            numbers: Arc::new(logs),
            output: None,
        };
        (Array::new(found, &[rows]), saved)
    }

    fn backward(
        &self,
        [logits, _, _]: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let mut slope = logits.values().to_vec();
        slopes(
            &mut slope,
            logits.width(),
            self.targets,
            &saved.numbers,
            dy.values(),
        );
        [Some(Array::new(slope, &logits.shape())), None, None]
    }
}

#[derive(Debug)]
pub struct TiedCrossEntropy<'a> {
    pub targets: &'a [u32],
}

impl TiedCrossEntropy<'_> {
    /// Rows per block, so that results do not depend on what is kept.
    fn block_rows(classes: usize) -> usize {
        (BLOCK / classes.max(1)).max(ROWS)
    }
}

impl Kernel for TiedCrossEntropy<'_> {
    /// Saves the log normalisers and, if they are few, the logits.
    fn forward(&self, [x, table, _]: [&Array; 3]) -> (Array, Saved) {
        let (rows, width, classes) = (self.targets.len(), x.width(), table.shape()[0]);
        let block = Self::block_rows(classes);
        let keep = rows * classes <= KEEP;
        let (mut found, mut logs) = (vec![0.0; rows], vec![0.0; rows]);
        let mut logits = vec![0.0; if keep { rows } else { block.min(rows) } * classes];
        let matrix = Matrix::rows(table.values(), classes, width).transposed();
        for start in (0..rows).step_by(block) {
            let count = block.min(rows - start);
            let place = if keep { start * classes } else { 0 };
            let logits = &mut logits[place..][..count * classes];
            let x = Matrix::rows(&x.values()[start * width..], count, width);
            gemm_into(logits, classes, x, matrix, 1.0, false, Threads::All);
            let range = start..start + count;
            losses(
                logits,
                classes,
                &self.targets[range.clone()],
                &mut found[range.clone()],
                &mut logs[range],
            );
        }
        let saved = Saved {
            numbers: Arc::new(logs),
            output: keep.then(|| Array::new(logits, &[rows, classes])),
        };
        (Array::new(found, &[rows]), saved)
    }

    fn backward(
        &self,
        [x, table, _]: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        [want_x, want_table, _]: [bool; 3],
    ) -> [Option<Array>; 3] {
        let (rows, width, classes) = (self.targets.len(), x.width(), table.shape()[0]);
        let block = Self::block_rows(classes);
        let mut dx = want_x.then(|| vec![0.0; rows * width]);
        let mut dtable = want_table.then(|| vec![0.0; classes * width]);
        let mut slope = vec![0.0; block.min(rows) * classes];
        let matrix = Matrix::rows(table.values(), classes, width);
        for start in (0..rows).step_by(block) {
            let count = block.min(rows - start);
            let slope = &mut slope[..count * classes];
            let x = Matrix::rows(&x.values()[start * width..], count, width);
            match &saved.output {
                Some(logits) => {
                    slope.copy_from_slice(&logits.values()[start * classes..][..count * classes]);
                }
                None => gemm_into(
                    slope,
                    classes,
                    x,
                    matrix.transposed(),
                    1.0,
                    false,
                    Threads::All,
                ),
            }
            let range = start..start + count;
            slopes(
                slope,
                classes,
                &self.targets[range.clone()],
                &saved.numbers[range.clone()],
                &dy.values()[range],
            );
            let d = Matrix::rows(slope, count, classes);
            if let Some(dx) = &mut dx {
                let dx = &mut dx[start * width..][..count * width];
                gemm_into(dx, width, d, matrix, 1.0, false, Threads::All);
            }
            if let Some(dtable) = &mut dtable {
                gemm_into(
                    dtable,
                    width,
                    d.transposed(),
                    x,
                    1.0,
                    start > 0,
                    Threads::All,
                );
            }
        }
        let dx = dx.map(|dx| Array::new(dx, &x.shape()));
        let dtable = dtable.map(|dtable| Array::new(dtable, &table.shape()));
        [dx, dtable, None]
    }
}
