//! Attention over segments, from packed projections, without permuted copies and without stored probabilities.
//!
//! Scores exist one tile at a time, some queries by some keys, however long the rows are. Forward carries each row's largest
//! score and sum from tile to tile and keeps the logarithm of its normaliser, from which backward recomputes the
//! probabilities of a tile. One task is a block of queries of one head (forward) or all segments that share keys, of one head
//! (backward).
#![allow(unsafe_code)]

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::super::super::{Segment, Segments};
use super::super::gemm::{Matrix, Shared, Threads, gemm, gemm_into};
use super::{Array, Kernel, Saved, vector};

/// Queries and keys of one tile: its scores fit into the second-level cache with the keys and values beside them.
const TILE_QUERIES: usize = 128;
const TILE_KEYS: usize = 768;

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

    fn keys(&self, rows: &Range<usize>, head: usize) -> Matrix<'a> {
        self.keys_or_values(rows, self.key_start + head * self.head)
    }

    fn values(&self, rows: &Range<usize>, head: usize) -> Matrix<'a> {
        self.keys_or_values(rows, self.value_start + head * self.head)
    }

    fn keys_or_values(&self, rows: &Range<usize>, column: usize) -> Matrix<'a> {
        Matrix::strided(
            &self.kv[rows.start * self.kv_stride + column..],
            rows.len(),
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

/// `range` in pieces of `step`; the last may be shorter.
fn tiles(range: &Range<usize>, step: usize) -> impl Iterator<Item = Range<usize>> + use<> {
    let end = range.end;
    range
        .clone()
        .step_by(step)
        .map(move |start| start..end.min(start + step))
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
        let tasks: Vec<(&Segment, Range<usize>, usize)> = self
            .segments
            .list()
            .iter()
            .filter(|segment| !segment.keys.is_empty())
            .flat_map(|segment| {
                tiles(&segment.queries, TILE_QUERIES).flat_map(move |block| {
                    (0..self.heads).map(move |head| (segment, block.clone(), head))
                })
            })
            .collect();
        let (out, logs) = (Shared::new(&mut output), Shared::new(&mut normalisers));
        tasks.into_par_iter().for_each_init(
            RunningSoftmax::default,
            |running, (segment, block, head)| {
                let queries = layout.queries(block.start, block.len(), head);
                running.start(block.len(), layout.head);
                for keys in tiles(&segment.keys, TILE_KEYS) {
                    let (k, v) = (layout.keys(&keys, head), layout.values(&keys, head));
                    running.add(queries, k, v, layout.scale);
                }
                for (i, row) in block.enumerate() {
                    let start = row * layout.width + head * layout.head;
                    // SAFETY: query rows are in one segment and one block only, and heads have columns of their own.
                    let (out, log) = unsafe {
                        (
                            out.part(start, layout.head),
                            logs.part(head * rows + row, 1),
                        )
                    };
                    log[0] = running.finish(i, out);
                }
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
                    let blocks = tiles(&segment.queries, TILE_QUERIES).flat_map(|block| {
                        tiles(&segment.keys, TILE_KEYS).map(move |keys| (block.clone(), keys))
                    });
                    for (block, keys) in blocks {
                        let (row, count) = (block.start, block.len());
                        p.resize(count * keys.len(), 0.0);
                        dp.resize(count * keys.len(), 0.0);
                        let (k, v) = (layout.keys(&keys, head), layout.values(&keys, head));
                        let queries = layout.queries(row, count, head);
                        let d = layout.own(dy.values(), row, count, head);
                        gemm_scores(p, queries, k, layout.scale);
                        gemm(dp, d, v.transposed());
                        let logs = &saved.numbers[head * rows + row..][..count];
                        let start = row * layout.width + head * layout.head;
                        softmax_backward(
                            p,
                            dp,
                            keys.len(),
                            logs,
                            layout.scale,
                            #[inline(always)]
                            |i| {
                                let row = start + i * layout.width;
                                let own = row..row + layout.head;
                                vector::dot(&dy.values()[own.clone()], &output[own])
                            },
                        );
                        let p = Matrix::rows(p, count, keys.len());
                        let dp = Matrix::rows(dp, count, keys.len());
                        let stride = layout.kv_stride;
                        let first = keys.start * stride + head * layout.head;
                        let place = row * layout.q_stride + head * layout.head;
                        // SAFETY: this task alone writes the columns of its head, in the rows of its group: groups have no key in
                        // common, query rows are in one segment only, and queries, keys and values have columns of their own.
                        unsafe {
                            let add = |to: Shared<'_>, place, stride, a, b| {
                                to.gemm(place, stride, a, b, 1.0, true, Threads::One);
                            };
                            add(
                                dkv_place,
                                first + layout.value_start,
                                stride,
                                p.transposed(),
                                d,
                            );
                            add(
                                dkv_place,
                                first + layout.key_start,
                                stride,
                                dp.transposed(),
                                queries,
                            );
                            add(dq_place, place, layout.q_stride, dp, k);
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

/// Attention of a block of queries over keys that come a tile at a time.
#[derive(Default)]
struct RunningSoftmax {
    /// Of the tile, `[rows, its keys]`.
    scores: Vec<f32>,
    /// Per row, over the tiles so far: the largest score, and the sum of the exponentials of scores less the largest.
    tops: Vec<f32>,
    sums: Vec<f32>,
    /// Values weighted by the same exponentials, `[rows, head]`.
    weighted: Vec<f32>,
    head: usize,
}

impl RunningSoftmax {
    fn start(&mut self, rows: usize, head: usize) {
        self.head = head;
        for (array, length, value) in [
            (&mut self.tops, rows, f32::NEG_INFINITY),
            (&mut self.sums, rows, 0.0),
            (&mut self.weighted, rows * head, 0.0),
        ] {
            array.clear();
            array.resize(length, value);
        }
    }

    fn add(&mut self, queries: Matrix<'_>, keys: Matrix<'_>, values: Matrix<'_>, scale: f32) {
        let (rows, columns) = (self.tops.len(), keys.transposed().columns());
        self.scores.resize(rows * columns, 0.0);
        gemm_scores(&mut self.scores, queries, keys, scale);
        vector::vectorised(
            #[inline(always)]
            || {
                let state = self.tops.iter_mut().zip(&mut self.sums);
                let weighted = self.weighted.chunks_exact_mut(self.head);
                let scores = self.scores.chunks_exact_mut(columns);
                for ((row, (top, sum)), weighted) in scores.zip(state).zip(weighted) {
                    let higher = vector::largest(row).max(*top);
                    let before = vector::exp(*top - higher);
                    for value in row.iter_mut() {
                        *value = vector::exp(*value - higher);
                    }
                    for value in weighted {
                        *value *= before;
                    }
                    *sum = *sum * before + vector::sum(row);
                    *top = higher;
                }
            },
        );
        let p = Matrix::rows(&self.scores, rows, columns);
        gemm_into(
            &mut self.weighted,
            self.head,
            p,
            values,
            1.0,
            true,
            Threads::One,
        );
    }

    /// Writes what row `i` attends to, and gives the logarithm of its normaliser.
    fn finish(&self, i: usize, out: &mut [f32]) -> f32 {
        let scale = 1.0 / self.sums[i];
        for (out, value) in out.iter_mut().zip(&self.weighted[i * self.head..]) {
            *out = value * scale;
        }
        self.tops[i] + self.sums[i].ln()
    }
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
