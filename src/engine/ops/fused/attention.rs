//! Attention over segments, from packed projections, without permuted copies and without stored probabilities.
//!
//! Forward works on blocks of queries and keeps the logarithm of each row's normaliser; backward recomputes the probabilities
//! of one block at a time. One task is a block of one head (forward) or all segments that share keys, of one head (backward).
#![allow(unsafe_code)]

use std::sync::Arc;

use rayon::prelude::*;

use super::super::super::{Segment, Segments};
use super::super::gemm::{Matrix, Shared, Threads, gemm, gemm_into};
use super::{Array, Kernel, Saved, vector};

/// Scores of one block: what fits into the second-level cache with the keys and values beside it.
const BLOCK_SCORES: usize = 96 * 1024;

#[derive(Debug)]
pub struct Attention<'a> {
    pub heads: usize,
    pub segments: &'a Segments,
}

/// Where queries, keys and values lie: `q` is `[N, D]` and `kv` `[M, 2 D]`, or `q` is all three, `[N, 3 D]`.
struct Layout<'a> {
    q: &'a [f32],
    kv: &'a [f32],
    q_stride: usize,
    kv_stride: usize,
    key_start: usize,
    value_start: usize,
    width: usize,
    head: usize,
    scale: f32,
}

impl<'a> Layout<'a> {
    fn new(q: &'a Array, kv: &'a Array, heads: usize) -> Self {
        let packed = kv.is_empty();
        let width = if packed { q.width() / 3 } else { q.width() };
        let head = width / heads;
        Self {
            q: q.values(),
            kv: if packed { q.values() } else { kv.values() },
            q_stride: q.width(),
            kv_stride: if packed { 3 * width } else { 2 * width },
            key_start: if packed { width } else { 0 },
            value_start: if packed { 2 * width } else { width },
            width,
            head,
            scale: 1.0 / (head as f32).sqrt(),
        }
    }

    fn queries(&self, row: usize, rows: usize, head: usize) -> Matrix<'a> {
        Matrix::strided(
            &self.q[row * self.q_stride + head * self.head..],
            rows,
            self.head,
            self.q_stride,
        )
    }

    fn keys(&self, segment: &Segment, head: usize) -> Matrix<'a> {
        let start = segment.keys.start * self.kv_stride + self.key_start + head * self.head;
        Matrix::strided(
            &self.kv[start..],
            segment.keys.len(),
            self.head,
            self.kv_stride,
        )
    }

    fn values(&self, segment: &Segment, head: usize) -> Matrix<'a> {
        let start = segment.keys.start * self.kv_stride + self.value_start + head * self.head;
        Matrix::strided(
            &self.kv[start..],
            segment.keys.len(),
            self.head,
            self.kv_stride,
        )
    }

    /// The columns of `head` of `rows` rows of a `[N, D]` array.
    fn own<'b>(&self, array: &'b [f32], row: usize, rows: usize, head: usize) -> Matrix<'b> {
        Matrix::strided(
            &array[row * self.width + head * self.head..],
            rows,
            self.head,
            self.width,
        )
    }
}

/// Queries per block for so many keys.
fn block_rows(keys: usize) -> usize {
    (BLOCK_SCORES / keys.max(1)).clamp(16, 256) / 16 * 16
}

/// `(first row, rows)` of the blocks of a segment's queries.
fn blocks(segment: &Segment) -> impl Iterator<Item = (usize, usize)> + use<> {
    let (end, step) = (segment.queries.end, block_rows(segment.keys.len()));
    segment
        .queries
        .clone()
        .step_by(step)
        .map(move |row| (row, step.min(end - row)))
}

/// Segments whose keys overlap, together: their gradients in keys and values add up.
fn groups(segments: &Segments) -> Vec<Vec<&Segment>> {
    let mut sorted: Vec<&Segment> = segments
        .list()
        .iter()
        .filter(|s| !s.queries.is_empty() && !s.keys.is_empty())
        .collect();
    sorted.sort_by_key(|segment| (segment.keys.start, segment.queries.start));
    let mut groups: Vec<Vec<&Segment>> = Vec::new();
    let mut end = 0;
    for segment in sorted {
        match groups.last_mut() {
            Some(group) if segment.keys.start < end => group.push(segment),
            _ => groups.push(vec![segment]),
        }
        end = end.max(segment.keys.end);
    }
    groups
}

impl Kernel for Attention<'_> {
    /// Saves the log normaliser of each row and head, `[heads, N]`, and the output.
    fn forward(&self, [q, kv, _]: [&Array; 3]) -> (Array, Saved) {
        let layout = Layout::new(q, kv, self.heads);
        let rows = self.segments.queries();
        let mut output = vec![0.0; rows * layout.width];
        let mut normalisers = vec![0.0; rows * self.heads];
        let tasks: Vec<(&Segment, usize, usize, usize)> = self
            .segments
            .list()
            .iter()
            .filter(|segment| !segment.keys.is_empty())
            .flat_map(|segment| {
                blocks(segment).flat_map(move |(row, rows)| {
                    (0..self.heads).map(move |head| (segment, row, rows, head))
                })
            })
            .collect();
        let (out, logs) = (Shared::new(&mut output), Shared::new(&mut normalisers));
        tasks.into_par_iter().for_each_init(
            Vec::new,
            |scores: &mut Vec<f32>, (segment, row, count, head)| {
                let keys = segment.keys.len();
                scores.resize(count * keys, 0.0);
                gemm_scores(
                    scores,
                    layout.queries(row, count, head),
                    layout.keys(segment, head),
                    layout.scale,
                );
                // SAFETY: query rows are in one segment and one block only, and heads have columns of their own.
                let logs = unsafe { logs.part(head * rows + row, count) };
                softmax(scores, keys, logs);
                let start = row * layout.width + head * layout.head;
                let p = Matrix::rows(scores, count, keys);
                // SAFETY: as above.
                unsafe {
                    out.gemm(
                        start,
                        layout.width,
                        p,
                        layout.values(segment, head),
                        1.0,
                        false,
                        Threads::One,
                    );
                };
            },
        );
        let output = Array::new(output, &[rows, layout.width]);
        let saved = Saved {
            numbers: Arc::new(normalisers),
            output: Some(output.clone()),
        };
        (output, saved)
    }

    fn backward(
        &self,
        [q, kv, _]: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let layout = Layout::new(q, kv, self.heads);
        let rows = self.segments.queries();
        let output = saved.output.as_ref().expect("forward saves it").values();
        let mut dq = vec![0.0; q.values().len()];
        let mut dkv = vec![0.0; kv.values().len()];
        let dq_place = Shared::new(&mut dq);
        let dkv_place = if kv.is_empty() {
            dq_place
        } else {
            Shared::new(&mut dkv)
        };
        let groups = groups(self.segments);
        let tasks: Vec<(&[&Segment], usize)> = groups
            .iter()
            .flat_map(|group| (0..self.heads).map(move |head| (group.as_slice(), head)))
            .collect();
        let scratch = || (Vec::new(), Vec::new());
        tasks.into_par_iter().for_each_init(
            scratch,
            |(p, dp): &mut (Vec<f32>, Vec<f32>), (group, head)| {
                for segment in group {
                    let keys = segment.keys.len();
                    let (k, v) = (layout.keys(segment, head), layout.values(segment, head));
                    let first = segment.keys.start * layout.kv_stride + head * layout.head;
                    for (row, count) in blocks(segment) {
                        p.resize(count * keys, 0.0);
                        dp.resize(count * keys, 0.0);
                        let queries = layout.queries(row, count, head);
                        let d = layout.own(dy.values(), row, count, head);
                        gemm_scores(p, queries, k, layout.scale);
                        gemm(dp, d, v.transposed());
                        let logs = &saved.numbers[head * rows + row..][..count];
                        let start = row * layout.width + head * layout.head;
                        softmax_backward(
                            p,
                            dp,
                            keys,
                            logs,
                            layout.scale,
                            #[inline(always)]
                            |i| {
                                let row = start + i * layout.width;
                                let own = row..row + layout.head;
                                vector::dot(&dy.values()[own.clone()], &output[own])
                            },
                        );
                        let (p, dp) = (Matrix::rows(p, count, keys), Matrix::rows(dp, count, keys));
                        let stride = layout.kv_stride;
                        // SAFETY: this task alone writes the columns of its head, in the rows of its group: groups have no key in
                        // common, query rows are in one segment only, and queries, keys and values have columns of their own.
                        unsafe {
                            let place = first + layout.value_start;
                            dkv_place.gemm(
                                place,
                                stride,
                                p.transposed(),
                                d,
                                1.0,
                                true,
                                Threads::One,
                            );
                            let place = first + layout.key_start;
                            dkv_place.gemm(
                                place,
                                stride,
                                dp.transposed(),
                                queries,
                                1.0,
                                true,
                                Threads::One,
                            );
                            let place = row * layout.q_stride + head * layout.head;
                            dq_place.gemm(place, layout.q_stride, dp, k, 1.0, false, Threads::One);
                        }
                    }
                }
            },
        );
        let dkv = (!kv.is_empty()).then(|| Array::new(dkv, &kv.shape()));
        [Some(Array::new(dq, &q.shape())), dkv, None]
    }
}

fn gemm_scores(scores: &mut [f32], queries: Matrix<'_>, keys: Matrix<'_>, scale: f32) {
    let keys = keys.transposed();
    let columns = keys.columns();
    gemm_into(scores, columns, queries, keys, scale, false, Threads::One);
}

/// Rows of scores to probabilities, in place; the log normaliser of each into `logs`.
fn softmax(scores: &mut [f32], keys: usize, logs: &mut [f32]) {
    vector::vectorised(
        #[inline(always)]
        || {
            for (row, log) in scores.chunks_exact_mut(keys).zip(logs) {
                let top = vector::largest(row);
                for value in row.iter_mut() {
                    *value = vector::exp(*value - top);
                }
                let sum = vector::sum(row);
                let scale = 1.0 / sum;
                for value in row.iter_mut() {
                    *value *= scale;
                }
                *log = top + sum.ln();
            }
        },
    );
}

/// Scores in `p` to probabilities, and gradients of probabilities in `dp` to gradients of unscaled scores, in place.
/// `along(i)` is the inner product of row `i` of the output and its gradient.
fn softmax_backward(
    p: &mut [f32],
    dp: &mut [f32],
    keys: usize,
    logs: &[f32],
    scale: f32,
    along: impl Fn(usize) -> f32,
) {
    vector::vectorised(
        #[inline(always)]
        || {
            let rows = p.chunks_exact_mut(keys).zip(dp.chunks_exact_mut(keys));
            for (i, ((p, dp), log)) in rows.zip(logs).enumerate() {
                let along = along(i);
                for (p, dp) in p.iter_mut().zip(dp) {
                    *p = vector::exp(*p - log);
                    *dp = *p * (*dp - along) * scale;
                }
            }
        },
    );
}
