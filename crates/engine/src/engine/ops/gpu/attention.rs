//! Attention over segments, from packed projections: no scores are stored, and rows are as long as they are.
//!
//! Forward and the gradient of queries have a unit for every query and head, the gradient of keys and values one for every key and
//! head. Forward carries the largest score and the sum from key to key and keeps the logarithm of the normaliser, from which
//! backward recomputes probabilities.
#![allow(unsafe_code)]

use burn::backend::ops::FloatTensorOps;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::super::super::Segments;
use super::tables::{lists, upload};
use super::{Kernel, Saved, UNITS, cubes, empty, sides};

#[derive(Debug)]
pub struct Attention<'a> {
    pub heads: usize,
    pub segments: &'a Segments,
    /// Queries, keys and values are columns of one array.
    pub packed: bool,
}

/// Where queries, keys and values lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Layout {
    q_stride: usize,
    kv_stride: usize,
    key_start: usize,
    value_start: usize,
    width: usize,
    heads: usize,
    /// Columns of a head.
    head: usize,
}

#[cube(launch_unchecked)]
fn mix(
    q: &Tensor<f32>,
    kv: &Tensor<f32>,
    spans: &Tensor<u32>,
    y: &mut Tensor<f32>,
    normalisers: &mut Tensor<f32>,
    rows: u32,
    scale: f32,
    #[comptime] layout: Layout,
) {
    let rows = rows as usize;
    if ABSOLUTE_POS >= rows * comptime!(layout.heads) {
        terminate!();
    }
    let size = comptime!(layout.head);
    let row = ABSOLUTE_POS % rows;
    let column = ABSOLUTE_POS / rows * size;
    let own = row * comptime!(layout.q_stride) + column;
    let mut query = Array::<f32>::new(size);
    let mut mixed = Array::<f32>::new(size);
    for d in 0..size {
        query[d] = q[own + d] * scale;
        mixed[d] = f32::new(0.0);
    }
    // Smaller than any score; WGSL has no infinity.
    let mut most = f32::new(-3.0e38);
    let mut sum = f32::new(0.0);
    let first = spans[2 * row] as usize;
    let last = spans[2 * row + 1] as usize;
    for key in first..last {
        let at = key * comptime!(layout.kv_stride) + column;
        let mut score = f32::new(0.0);
        for d in 0..size {
            score += query[d] * kv[at + comptime!(layout.key_start) + d];
        }
        if score > most {
            let shrink = (most - score).exp();
            sum *= shrink;
            for d in 0..size {
                mixed[d] *= shrink;
            }
            most = score;
        }
        let weight = (score - most).exp();
        sum += weight;
        for d in 0..size {
            mixed[d] += weight * kv[at + comptime!(layout.value_start) + d];
        }
    }
    let mut shrink = f32::new(0.0);
    if sum > 0.0 {
        shrink = 1.0 / sum;
        normalisers[ABSOLUTE_POS] = most + sum.ln();
    } else {
        normalisers[ABSOLUTE_POS] = f32::new(0.0);
    }
    let out = row * comptime!(layout.width) + column;
    for d in 0..size {
        y[out + d] = mixed[d] * shrink;
    }
}

/// The gradient of queries; `dots` holds the product of each row of `y` and `dy` by head, `[rows, heads]`.
#[cube(launch_unchecked)]
fn query_gradient(
    q: &Tensor<f32>,
    kv: &Tensor<f32>,
    spans: &Tensor<u32>,
    dy: &Tensor<f32>,
    normalisers: &Tensor<f32>,
    dots: &Tensor<f32>,
    dq: &mut Tensor<f32>,
    rows: u32,
    scale: f32,
    #[comptime] layout: Layout,
) {
    let rows = rows as usize;
    if ABSOLUTE_POS >= rows * comptime!(layout.heads) {
        terminate!();
    }
    let size = comptime!(layout.head);
    let row = ABSOLUTE_POS % rows;
    let head = ABSOLUTE_POS / rows;
    let column = head * size;
    let own = row * comptime!(layout.q_stride) + column;
    let out = row * comptime!(layout.width) + column;
    let mut query = Array::<f32>::new(size);
    let mut above = Array::<f32>::new(size);
    let mut sum = Array::<f32>::new(size);
    for d in 0..size {
        query[d] = q[own + d] * scale;
        above[d] = dy[out + d];
        sum[d] = f32::new(0.0);
    }
    let normaliser = normalisers[ABSOLUTE_POS];
    let dot = dots[row * comptime!(layout.heads) + head];
    let first = spans[2 * row] as usize;
    let last = spans[2 * row + 1] as usize;
    for key in first..last {
        let at = key * comptime!(layout.kv_stride) + column;
        let mut score = f32::new(0.0);
        let mut change = f32::new(0.0);
        for d in 0..size {
            score += query[d] * kv[at + comptime!(layout.key_start) + d];
            change += above[d] * kv[at + comptime!(layout.value_start) + d];
        }
        let slope = (score - normaliser).exp() * (change - dot);
        for d in 0..size {
            sum[d] += slope * kv[at + comptime!(layout.key_start) + d];
        }
    }
    for d in 0..size {
        dq[own + d] = sum[d] * scale;
    }
}

/// The gradients of keys and values. `seen` lists the ranges of queries that see each key, as [`lists`] lays them out.
#[cube(launch_unchecked)]
fn key_gradient(
    q: &Tensor<f32>,
    kv: &Tensor<f32>,
    seen: &Tensor<u32>,
    dy: &Tensor<f32>,
    normalisers: &Tensor<f32>,
    dots: &Tensor<f32>,
    dkv: &mut Tensor<f32>,
    rows: u32,
    keys: u32,
    scale: f32,
    #[comptime] layout: Layout,
) {
    let rows = rows as usize;
    let keys = keys as usize;
    if ABSOLUTE_POS >= keys * comptime!(layout.heads) {
        terminate!();
    }
    let size = comptime!(layout.head);
    let key = ABSOLUTE_POS % keys;
    let head = ABSOLUTE_POS / keys;
    let column = head * size;
    let at = key * comptime!(layout.kv_stride) + column;
    let mut own = Array::<f32>::new(size);
    let mut value = Array::<f32>::new(size);
    let mut key_sum = Array::<f32>::new(size);
    let mut value_sum = Array::<f32>::new(size);
    for d in 0..size {
        own[d] = kv[at + comptime!(layout.key_start) + d] * scale;
        value[d] = kv[at + comptime!(layout.value_start) + d];
        key_sum[d] = f32::new(0.0);
        value_sum[d] = f32::new(0.0);
    }
    let start = seen[key] as usize;
    let pairs = (seen[key + 1] as usize - start) / 2;
    for pair in 0..pairs {
        let first = seen[start + 2 * pair] as usize;
        let last = seen[start + 2 * pair + 1] as usize;
        for row in first..last {
            let query = row * comptime!(layout.q_stride) + column;
            let out = row * comptime!(layout.width) + column;
            let mut score = f32::new(0.0);
            let mut change = f32::new(0.0);
            for d in 0..size {
                score += q[query + d] * own[d];
                change += dy[out + d] * value[d];
            }
            let weight = (score - normalisers[head * rows + row]).exp();
            let slope = weight * (change - dots[row * comptime!(layout.heads) + head]);
            for d in 0..size {
                value_sum[d] += weight * dy[out + d];
                key_sum[d] += slope * q[query + d];
            }
        }
    }
    for d in 0..size {
        dkv[at + comptime!(layout.key_start) + d] = key_sum[d] * scale;
        dkv[at + comptime!(layout.value_start) + d] = value_sum[d];
    }
}

impl Attention<'_> {
    fn layout(&self, [q, kv]: [&CubeTensor; 2]) -> Layout {
        let ([rows, q_width], [keys, kv_width]) = (sides(q), sides(kv));
        assert_eq!(
            [rows, keys],
            [self.segments.queries(), self.segments.keys()]
        );
        let width = if self.packed { q_width / 3 } else { q_width };
        let packed = if self.packed { 3 * width } else { 2 * width };
        assert_eq!(kv_width, packed, "keys and values lie side by side");
        assert_eq!(width % self.heads, 0, "heads share the width");
        Layout {
            q_stride: q_width,
            kv_stride: kv_width,
            key_start: packed - 2 * width,
            value_start: packed - width,
            width,
            heads: self.heads,
            head: width / self.heads,
        }
    }

    fn scale(layout: Layout) -> f32 {
        1.0 / (layout.head as f32).sqrt()
    }

    /// The first key and the one behind the last, of every query.
    fn spans(&self) -> Vec<u32> {
        let mut spans = vec![0; 2 * self.segments.queries()];
        for segment in self.segments.list() {
            for row in segment.queries.clone() {
                spans[2 * row] = segment.keys.start as u32;
                spans[2 * row + 1] = segment.keys.end as u32;
            }
        }
        spans
    }

    /// The queries that see each key, as pairs of the first and the one behind the last.
    fn seen(&self) -> Vec<u32> {
        let mut seen = vec![Vec::new(); self.segments.keys()];
        for segment in self.segments.list() {
            for key in segment.keys.clone() {
                seen[key].extend([segment.queries.start as u32, segment.queries.end as u32]);
            }
        }
        lists(&seen)
    }
}

impl Kernel for Attention<'_> {
    fn forward(&self, inputs: [&CubeTensor; 2]) -> Saved {
        let layout = self.layout(inputs);
        let [q, kv] = inputs;
        let rows = self.segments.queries();
        let y = empty(q, &[rows, layout.width]);
        let normalisers = empty(q, &[layout.heads * rows]);
        // SAFETY: units stay below rows x heads, spans are rows of `kv` as `Segments` has checked, and `layout` is that of the
        // arrays' shapes.
        unsafe {
            mix::launch_unchecked(
                &q.client,
                cubes(rows * layout.heads),
                CubeDim::new_1d(UNITS),
                q.clone().into_tensor_arg(),
                kv.clone().into_tensor_arg(),
                upload(&self.spans(), q).into_tensor_arg(),
                y.clone().into_tensor_arg(),
                normalisers.clone().into_tensor_arg(),
                rows as u32,
                Self::scale(layout),
                layout,
            );
        }
        Saved {
            output: y,
            normalisers: Some(normalisers),
        }
    }

    fn backward(
        &self,
        inputs: [&CubeTensor; 2],
        saved: &Saved,
        dy: CubeTensor,
        _: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let layout = self.layout(inputs);
        let [q, kv] = inputs;
        let (rows, keys) = (self.segments.queries(), self.segments.keys());
        let normalisers = saved
            .normalisers
            .as_ref()
            .expect("forward of attention leaves them");
        let by_head = [rows * layout.heads, layout.head];
        let dots = CubeBackend::float_mul(saved.output.clone(), dy.clone());
        let dots = CubeBackend::float_reshape(dots, by_head.into());
        let dots = super::dense(CubeBackend::float_sum_dim(dots, 1));
        let dq = empty(q, &[rows, layout.q_stride]);
        // Of packed projections, the gradient is one array too.
        let dkv = if self.packed {
            dq.clone()
        } else {
            empty(kv, &[keys, layout.kv_stride])
        };
        // SAFETY: as in `forward`; every element of `dq` and `dkv` is written by one unit of one of the two.
        unsafe {
            query_gradient::launch_unchecked(
                &q.client,
                cubes(rows * layout.heads),
                CubeDim::new_1d(UNITS),
                q.clone().into_tensor_arg(),
                kv.clone().into_tensor_arg(),
                upload(&self.spans(), q).into_tensor_arg(),
                dy.clone().into_tensor_arg(),
                normalisers.clone().into_tensor_arg(),
                dots.clone().into_tensor_arg(),
                dq.clone().into_tensor_arg(),
                rows as u32,
                Self::scale(layout),
                layout,
            );
            key_gradient::launch_unchecked(
                &q.client,
                cubes(keys * layout.heads),
                CubeDim::new_1d(UNITS),
                q.clone().into_tensor_arg(),
                kv.clone().into_tensor_arg(),
                upload(&self.seen(), q).into_tensor_arg(),
                dy.into_tensor_arg(),
                normalisers.clone().into_tensor_arg(),
                dots.into_tensor_arg(),
                dkv.clone().into_tensor_arg(),
                rows as u32,
                keys as u32,
                Self::scale(layout),
                layout,
            );
        }
        [Some(dq), (!self.packed).then_some(dkv)]
    }
}
