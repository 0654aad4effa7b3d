//! Factorised causal convolutions over video, on packed rows `[samples * frames * height * width, channels]`.
//!
//! A convolution is a gather of each output row's taps followed by one matrix product. On the CPU this is one custom operation
//! with a hand-written backward that keeps no gathered rows; elsewhere it is composed of the library's own operations.

use burn::backend::{Autodiff, Dispatch, Flex, backend_extension, tensor::FloatTensor};
use burn::tensor::{Int, Tensor, TensorData};
use burn_autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn_autodiff::grads::Gradients;
use burn_autodiff::ops::{Backward, Ops, OpsKind};
use burn_flex::FlexTensor;
use rayon::prelude::*;

use super::gemm::{Matrix, Threads, gemm, gemm_into};

/// Which input rows an output row is computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taps {
    /// 3 x 3 within each frame. Stride 1: zeros around the frame. Stride 2: zeros to the right and below only.
    Space {
        frames: usize,
        height: usize,
        width: usize,
        stride: usize,
    },
    /// 3 along time, ending at the present: the first frame is repeated in front, `3 - stride` times.
    Time {
        samples: usize,
        frames: usize,
        pixels: usize,
        stride: usize,
    },
}

/// Output rows per task: fixed, so results do not depend on the number of threads.
const ROWS: usize = 512;
/// Partial sums of weight gradients: fixed for the same reason.
const GROUPS: usize = 8;

impl Taps {
    /// How many input rows make one output row.
    #[must_use]
    pub fn count(self) -> usize {
        match self {
            Self::Space { .. } => 9,
            Self::Time { .. } => 3,
        }
    }

    /// Frames, height and width (or samples, frames and pixels) of the output.
    fn outputs(self) -> [usize; 3] {
        match self {
            Self::Space {
                frames,
                height,
                width,
                stride,
            } => [frames, height / stride, width / stride],
            Self::Time {
                samples,
                frames,
                pixels,
                stride,
            } => [samples, (frames - stride) / stride + 1, pixels],
        }
    }

    /// How many rows come in.
    #[must_use]
    pub fn rows_in(self) -> usize {
        match self {
            Self::Space {
                frames,
                height,
                width,
                ..
            } => frames * height * width,
            Self::Time {
                samples,
                frames,
                pixels,
                ..
            } => samples * frames * pixels,
        }
    }

    /// How many rows come out.
    #[must_use]
    pub fn rows_out(self) -> usize {
        self.outputs().iter().product()
    }

    /// The input row of one tap of an output row; `None` where zeros are.
    fn source(self, row: usize, tap: usize) -> Option<usize> {
        let [_, middle, last] = self.outputs();
        let (a, b, c) = (row / (middle * last), row / last % middle, row % last);
        match self {
            Self::Space {
                height,
                width,
                stride,
                ..
            } => {
                let pad = usize::from(stride == 1);
                let y = (b * stride + tap / 3)
                    .checked_sub(pad)
                    .filter(|y| *y < height)?;
                let x = (c * stride + tap % 3)
                    .checked_sub(pad)
                    .filter(|x| *x < width)?;
                Some((a * height + y) * width + x)
            }
            Self::Time {
                frames,
                pixels,
                stride,
                ..
            } => {
                let time = (b * stride + tap).saturating_sub(3 - stride);
                Some((a * frames + time) * pixels + c)
            }
        }
    }

    /// Fills `columns` with the taps of the output rows from `first` on, `[rows, taps, channels]`.
    fn gather(self, x: &[f32], channels: usize, first: usize, columns: &mut [f32]) {
        let taps = self.count();
        for (i, row) in columns.chunks_exact_mut(taps * channels).enumerate() {
            for (tap, to) in row.chunks_exact_mut(channels).enumerate() {
                match self.source(first + i, tap) {
                    Some(from) => to.copy_from_slice(&x[from * channels..][..channels]),
                    None => to.fill(0.0),
                }
            }
        }
    }

    /// Output rows that share no input row with those of another unit.
    fn units(self) -> Vec<Vec<usize>> {
        const PIXELS: usize = 256;
        let [a, b, c] = self.outputs();
        match self {
            Self::Space { .. } => (0..a)
                .map(|f| (f * b * c..(f + 1) * b * c).collect())
                .collect(),
            Self::Time { .. } => (0..a)
                .flat_map(|sample| {
                    (0..c).step_by(PIXELS).map(move |start| {
                        (0..b)
                            .flat_map(|t| {
                                let base = (sample * b + t) * c;
                                base + start..base + (start + PIXELS).min(c)
                            })
                            .collect()
                    })
                })
                .collect(),
        }
    }
}

/// A convolution of `x` `[N, C]` by `weight` `[O, C * taps]` (channel by tap, as in checkpoints) plus `bias` `[O]`: `[N', O]`.
///
/// # Panics
/// When `x` does not have the rows that `taps` speaks of.
#[must_use]
pub fn convolve(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, taps: Taps) -> Tensor<2> {
    assert_eq!(x.dims()[0], taps.rows_in(), "{taps:?}");
    assert_eq!(weight.dims()[1], x.dims()[1] * taps.count(), "{taps:?}");
    if x.device() == burn::tensor::Device::flex() {
        Tensor::from_dispatch(Dispatch::reviv_convolve(
            x.into_dispatch(),
            weight.into_dispatch(),
            bias.into_dispatch(),
            taps,
        ))
    } else {
        composed(x, weight, bias, taps)
    }
}

/// The same from the library's own operations.
fn composed(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, taps: Taps) -> Tensor<2> {
    let ([rows, channels], outputs) = (x.dims(), weight.dims()[0]);
    let device = x.device();
    let sources: Vec<i64> = (0..taps.rows_out())
        .flat_map(|row| {
            (0..taps.count()).map(move |tap| taps.source(row, tap).unwrap_or(rows) as i64)
        })
        .collect();
    let length = sources.len();
    let sources: Tensor<1, Int> = Tensor::from_data(
        TensorData::new(sources, [length]),
        &device.clone().without_autodiff(),
    );
    let padded = Tensor::cat(vec![x, Tensor::zeros([1, channels], &device)], 0);
    let columns = padded
        .select(0, sources)
        .reshape([taps.rows_out(), taps.count() * channels]);
    let weight = weight
        .reshape([outputs, channels, taps.count()])
        .swap_dims(1, 2)
        .reshape([outputs, taps.count() * channels]);
    columns.matmul(weight.transpose()) + bias.reshape([1, outputs])
}

#[backend_extension(Flex, Autodiff)]
trait Convolution: burn::backend::Backend {
    fn reviv_convolve(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        taps: Taps,
    ) -> FloatTensor<Self>;
}

impl Convolution for Flex {
    fn reviv_convolve(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        taps: Taps,
    ) -> FloatTensor<Self> {
        Held::new(&x, &weight, taps).forward(&bias)
    }
}

impl<C: CheckpointStrategy> Convolution for Autodiff<Flex, C> {
    fn reviv_convolve(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        taps: Taps,
    ) -> FloatTensor<Self> {
        let held = Held::new(x.primitive(), weight.primitive(), taps);
        let y = held.forward(bias.primitive());
        match ConvolveBackward
            .prepare::<C>([x.node(), weight.node(), bias.node()])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(prepared) => prepared.finish(held, y),
            OpsKind::UnTracked(prepared) => prepared.finish(y),
        }
    }
}

#[derive(Debug)]
struct ConvolveBackward;

impl Backward<Flex, 3> for ConvolveBackward {
    type State = Held;

    fn backward(self, ops: Ops<Held, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let [x, weight, bias] = ops.parents;
        let dy = grads.consume::<Flex>(&ops.node).to_contiguous();
        let (held, dy) = (ops.state, dy.storage::<f32>());
        if let Some(node) = x {
            grads.register::<Flex>(node.id, held.input_gradient(dy));
        }
        if let Some(node) = weight {
            grads.register::<Flex>(node.id, held.weight_gradient(dy));
        }
        if let Some(node) = bias {
            grads.register::<Flex>(node.id, held.bias_gradient(dy));
        }
    }
}

/// The inputs that backward needs.
#[derive(Debug, Clone)]
struct Held {
    x: FlexTensor,
    weight: FlexTensor,
    taps: Taps,
    channels: usize,
    outputs: usize,
}

fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

impl Held {
    fn new(x: &FlexTensor, weight: &FlexTensor, taps: Taps) -> Self {
        let channels = x.layout().shape()[1];
        let outputs = weight.layout().shape()[0];
        Self {
            x: x.to_contiguous(),
            weight: weight.to_contiguous(),
            taps,
            channels,
            outputs,
        }
    }

    /// Values of one output row's taps.
    fn inner(&self) -> usize {
        self.channels * self.taps.count()
    }

    fn values(&self) -> &[f32] {
        &self.x.storage::<f32>()[..self.taps.rows_in() * self.channels]
    }

    /// The weight as `[O, taps, C]`, the order in which taps are gathered.
    fn by_tap(&self) -> Vec<f32> {
        let (taps, channels) = (self.taps.count(), self.channels);
        let weight = &self.weight.storage::<f32>()[..self.outputs * self.inner()];
        let mut out = vec![0.0; weight.len()];
        out.par_chunks_mut(self.inner())
            .zip(weight.par_chunks(self.inner()))
            .for_each(|(out, weight)| {
                for (tap, out) in out.chunks_exact_mut(channels).enumerate() {
                    for (out, value) in out.iter_mut().zip(weight.iter().skip(tap).step_by(taps)) {
                        *out = *value;
                    }
                }
            });
        out
    }

    fn forward(&self, bias: &FlexTensor) -> FlexTensor {
        let (inner, outputs, rows) = (self.inner(), self.outputs, self.taps.rows_out());
        let (x, weight, bias) = (self.values(), self.by_tap(), bias.to_contiguous());
        let bias = &bias.storage::<f32>()[..outputs];
        let mut y = vec![0.0; rows * outputs];
        y.par_chunks_mut(ROWS * outputs).enumerate().for_each_init(
            Vec::new,
            |columns: &mut Vec<f32>, (block, y)| {
                let count = y.len() / outputs;
                columns.resize(count * inner, 0.0);
                self.taps.gather(x, self.channels, block * ROWS, columns);
                gemm(
                    y,
                    Matrix::rows(columns, count, inner),
                    Matrix::rows(&weight, outputs, inner).transposed(),
                );
                for row in y.chunks_exact_mut(outputs) {
                    for (y, bias) in row.iter_mut().zip(bias) {
                        *y += bias;
                    }
                }
            },
        );
        tensor(y, &[rows, outputs])
    }

    fn input_gradient(&self, dy: &[f32]) -> FlexTensor {
        let (inner, outputs, channels) = (self.inner(), self.outputs, self.channels);
        let weight = self.by_tap();
        let parts: Vec<Vec<(usize, Vec<f32>)>> = self
            .taps
            .units()
            .into_par_iter()
            .map(|rows| {
                // Gradients of the input rows this unit touches, by row number.
                let mut touched: std::collections::BTreeMap<usize, Vec<f32>> =
                    std::collections::BTreeMap::new();
                let mut gathered = Vec::new();
                let mut columns = Vec::new();
                for rows in rows.chunks(ROWS) {
                    gathered.clear();
                    for row in rows {
                        gathered.extend_from_slice(&dy[row * outputs..][..outputs]);
                    }
                    columns.resize(rows.len() * inner, 0.0);
                    gemm(
                        &mut columns,
                        Matrix::rows(&gathered, rows.len(), outputs),
                        Matrix::rows(&weight, outputs, inner),
                    );
                    for (row, columns) in rows.iter().zip(columns.chunks_exact(inner)) {
                        for (tap, part) in columns.chunks_exact(channels).enumerate() {
                            if let Some(source) = self.taps.source(*row, tap) {
                                let sum =
                                    touched.entry(source).or_insert_with(|| vec![0.0; channels]);
                                for (sum, value) in sum.iter_mut().zip(part) {
                                    *sum += value;
                                }
                            }
                        }
                    }
                }
                touched.into_iter().collect()
            })
            .collect();
        let mut dx = vec![0.0; self.taps.rows_in() * channels];
        for (row, values) in parts.into_iter().flatten() {
            dx[row * channels..][..channels].copy_from_slice(&values);
        }
        tensor(dx, &[self.taps.rows_in(), channels])
    }

    fn weight_gradient(&self, dy: &[f32]) -> FlexTensor {
        let (inner, outputs, taps) = (self.inner(), self.outputs, self.taps.count());
        let rows = self.taps.rows_out();
        let each = rows.div_ceil(GROUPS).max(1);
        let x = self.values();
        let parts: Vec<Vec<f32>> = (0..rows.div_ceil(each))
            .into_par_iter()
            .map(|group| {
                let mut sum = vec![0.0; outputs * inner];
                let mut columns = Vec::new();
                let end = ((group + 1) * each).min(rows);
                let mut first = group * each;
                while first < end {
                    let count = ROWS.min(end - first);
                    columns.resize(count * inner, 0.0);
                    self.taps.gather(x, self.channels, first, &mut columns);
                    let dy = Matrix::rows(&dy[first * outputs..], count, outputs);
                    let columns = Matrix::rows(&columns, count, inner);
                    gemm_into(
                        &mut sum,
                        inner,
                        dy.transposed(),
                        columns,
                        1.0,
                        true,
                        Threads::One,
                    );
                    first += count;
                }
                sum
            })
            .collect();
        let mut by_tap = vec![0.0; outputs * inner];
        for part in parts {
            for (sum, value) in by_tap.iter_mut().zip(part) {
                *sum += value;
            }
        }
        let mut dw = vec![0.0; outputs * inner];
        for (dw, by_tap) in dw.chunks_exact_mut(inner).zip(by_tap.chunks_exact(inner)) {
            for (tap, part) in by_tap.chunks_exact(self.channels).enumerate() {
                for (channel, value) in part.iter().enumerate() {
                    dw[channel * taps + tap] = *value;
                }
            }
        }
        tensor(dw, &[outputs, inner])
    }

    fn bias_gradient(&self, dy: &[f32]) -> FlexTensor {
        let mut sum = vec![0.0_f64; self.outputs];
        for row in dy[..self.taps.rows_out() * self.outputs].chunks_exact(self.outputs) {
            for (sum, value) in sum.iter_mut().zip(row) {
                *sum += f64::from(*value);
            }
        }
        let sum = sum.into_iter().map(|value| value as f32).collect();
        tensor(sum, &[self.outputs])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::parameters::to_host;

    fn wave<const D: usize>(shape: [usize; D], speed: f32) -> Tensor<D> {
        let length: usize = shape.iter().product();
        let values: Vec<f32> = (0..length).map(|i| (i as f32 * speed).sin()).collect();
        Tensor::from_data(
            TensorData::new(values, shape),
            &burn::tensor::Device::flex(),
        )
    }

    fn shapes() -> [Taps; 4] {
        [
            Taps::Space {
                frames: 2,
                height: 4,
                width: 6,
                stride: 1,
            },
            Taps::Space {
                frames: 3,
                height: 4,
                width: 6,
                stride: 2,
            },
            Taps::Time {
                samples: 2,
                frames: 4,
                pixels: 6,
                stride: 1,
            },
            Taps::Time {
                samples: 2,
                frames: 6,
                pixels: 5,
                stride: 2,
            },
        ]
    }

    #[test]
    fn the_custom_operation_equals_the_composed_one_with_all_gradients() {
        for taps in shapes() {
            let run = |custom: bool| {
                let x = wave([taps.rows_in(), 3], 0.7).autodiff().require_grad();
                let w = wave([5, 3 * taps.count()], 1.3).autodiff().require_grad();
                let b = wave([5], 2.1).autodiff().require_grad();
                let (xc, wc, bc) = (x.clone(), w.clone(), b.clone());
                let y = if custom {
                    convolve(xc, wc, bc, taps)
                } else {
                    composed(xc, wc, bc, taps)
                };
                assert_eq!(y.dims(), [taps.rows_out(), 5]);
                let mut tape = (y.clone() * wave([taps.rows_out(), 5], 0.31))
                    .sum()
                    .backward();
                let mut all = to_host(y);
                all.extend(to_host(x.grad_remove(&mut tape).unwrap()));
                all.extend(to_host(w.grad_remove(&mut tape).unwrap()));
                all.extend(to_host(b.grad_remove(&mut tape).unwrap()));
                all
            };
            for (a, b) in run(true).iter().zip(run(false)) {
                assert!((a - b).abs() < 1e-4, "{taps:?}: {a} {b}");
            }
        }
    }

    #[test]
    fn convolutions_in_time_see_no_future() {
        let taps = Taps::Time {
            samples: 1,
            frames: 4,
            pixels: 1,
            stride: 1,
        };
        for row in 0..4 {
            for tap in 0..3 {
                assert!(taps.source(row, tap).unwrap() <= row);
            }
        }
    }
}
