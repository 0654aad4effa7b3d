//! Normalisation of each frame over all its pixels and channels (group norm with one group), with SiLU if wanted, as one
//! operation on packed rows `[frames * pixels, channels]`.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use burn::backend::{Autodiff, Dispatch, Flex, backend_extension, tensor::FloatTensor};
use burn::tensor::{Tensor, TensorData};
use burn_autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn_autodiff::grads::Gradients;
use burn_autodiff::ops::{Backward, Ops, OpsKind};
use burn_flex::FlexTensor;
use rayon::prelude::*;
use std::sync::Arc;

use super::vector;

/// Added to the variance.
const EPSILON: f32 = 1e-6;
/// Rows per task: fixed, so that sums do not depend on the number of threads.
const ROWS: usize = 64;

/// Each frame to mean 0 and variance 1, times `weight` plus `bias` (per channel), then SiLU if `silu`.
///
/// # Panics
/// When the rows do not divide into `frames`.
#[must_use]
pub fn frame_norm(
    x: Tensor<2>,
    weight: Tensor<1>,
    bias: Tensor<1>,
    frames: usize,
    silu: bool,
) -> Tensor<2> {
    assert!(frames > 0 && x.dims()[0].is_multiple_of(frames), "{frames}");
    if x.device() == burn::tensor::Device::flex() {
        Tensor::from_dispatch(Dispatch::reviv_frame_norm(
            x.into_dispatch(),
            weight.into_dispatch(),
            bias.into_dispatch(),
            frames,
            silu,
        ))
    } else {
        composed(x, weight, bias, frames, silu)
    }
}

/// The same from the library's own operations.
fn composed(
    x: Tensor<2>,
    weight: Tensor<1>,
    bias: Tensor<1>,
    frames: usize,
    silu: bool,
) -> Tensor<2> {
    let [rows, channels] = x.dims();
    let x = x.reshape([frames, rows / frames * channels]);
    let centred = x.clone() - x.mean_dim(1);
    let variance = centred.clone().square().mean_dim(1);
    let y = (centred / (variance + EPSILON).sqrt()).reshape([rows, channels])
        * weight.reshape([1, channels])
        + bias.reshape([1, channels]);
    if silu {
        burn::tensor::activation::silu(y)
    } else {
        y
    }
}

#[backend_extension(Flex, Autodiff)]
trait FrameNorm: burn::backend::Backend {
    fn reviv_frame_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        frames: usize,
        silu: bool,
    ) -> FloatTensor<Self>;
}

impl FrameNorm for Flex {
    fn reviv_frame_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        frames: usize,
        silu: bool,
    ) -> FloatTensor<Self> {
        Held::new(&x, &weight, &bias, frames, silu).forward()
    }
}

impl<C: CheckpointStrategy> FrameNorm for Autodiff<Flex, C> {
    fn reviv_frame_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        frames: usize,
        silu: bool,
    ) -> FloatTensor<Self> {
        let held = Held::new(
            x.primitive(),
            weight.primitive(),
            bias.primitive(),
            frames,
            silu,
        );
        let y = held.forward();
        match FrameNormBackward
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
struct FrameNormBackward;

impl Backward<Flex, 3> for FrameNormBackward {
    type State = Held;

    fn backward(self, ops: Ops<Held, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let [x, weight, bias] = ops.parents;
        let dy = grads.consume::<Flex>(&ops.node).to_contiguous();
        let [dx, dw, db] = ops.state.backward(dy.storage::<f32>());
        for (node, gradient) in [(x, dx), (weight, dw), (bias, db)] {
            if let Some(node) = node {
                grads.register::<Flex>(node.id, gradient);
            }
        }
    }
}

/// The inputs, and each frame's mean and inverse deviation.
#[derive(Debug, Clone)]
struct Held {
    x: FlexTensor,
    weight: FlexTensor,
    bias: FlexTensor,
    /// Per frame.
    moments: Arc<Vec<[f32; 2]>>,
    pixels: usize,
    channels: usize,
    silu: bool,
}

fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

impl Held {
    fn new(
        x: &FlexTensor,
        weight: &FlexTensor,
        bias: &FlexTensor,
        frames: usize,
        silu: bool,
    ) -> Self {
        let (rows, channels) = (x.layout().shape()[0], x.layout().shape()[1]);
        let pixels = rows / frames;
        let x = x.to_contiguous();
        let values = &x.storage::<f32>()[..rows * channels];
        let moments = values
            .par_chunks(pixels * channels)
            .map(|frame| {
                let sums: Vec<[f64; 2]> = frame.par_chunks(ROWS * channels).map(sums).collect();
                let count = frame.len() as f64;
                let total = sums
                    .iter()
                    .fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
                let mean = total[0] / count;
                let variance = (total[1] / count - mean * mean).max(0.0);
                [
                    mean as f32,
                    (1.0 / (variance + f64::from(EPSILON)).sqrt()) as f32,
                ]
            })
            .collect();
        Self {
            x,
            weight: weight.to_contiguous(),
            bias: bias.to_contiguous(),
            moments: Arc::new(moments),
            pixels,
            channels,
            silu,
        }
    }

    fn rows(&self) -> usize {
        self.moments.len() * self.pixels
    }

    fn affine(&self) -> [&[f32]; 2] {
        [
            &self.weight.storage::<f32>()[..self.channels],
            &self.bias.storage::<f32>()[..self.channels],
        ]
    }

    fn forward(&self) -> FlexTensor {
        let [weight, bias] = self.affine();
        let values = &self.x.storage::<f32>()[..self.rows() * self.channels];
        let mut y = vec![0.0; values.len()];
        let frame = self.pixels * self.channels;
        for ((y, x), [mean, scale]) in y
            .chunks_exact_mut(frame)
            .zip(values.chunks_exact(frame))
            .zip(self.moments.iter())
        {
            y.par_chunks_mut(ROWS * self.channels)
                .zip(x.par_chunks(ROWS * self.channels))
                .for_each(|(y, x)| {
                    vector::vectorised(
                        #[inline(always)]
                        || {
                            let rows = y.chunks_exact_mut(self.channels);
                            for (y, x) in rows.zip(x.chunks_exact(self.channels)) {
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
        tensor(y, &[self.rows(), self.channels])
    }

    /// Gradients of input, weight and bias.
    fn backward(&self, dy: &[f32]) -> [FlexTensor; 3] {
        let [weight, bias] = self.affine();
        let channels = self.channels;
        let frame = self.pixels * channels;
        let values = &self.x.storage::<f32>()[..self.rows() * channels];
        let mut dx = vec![0.0; values.len()];
        let parts: Vec<Vec<f64>> = dx
            .par_chunks_mut(frame)
            .zip(values.par_chunks(frame))
            .zip(dy.par_chunks(frame))
            .zip(self.moments.par_iter())
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
            tensor(dx, &[self.rows(), channels]),
            tensor(affine[..channels].to_vec(), &[channels]),
            tensor(affine[channels..].to_vec(), &[channels]),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::parameters::to_host;

    fn wave<const D: usize>(shape: [usize; D], speed: f32) -> Tensor<D> {
        let length: usize = shape.iter().product();
        let values: Vec<f32> = (0..length)
            .map(|i| 0.3 + (i as f32 * speed).sin())
            .collect();
        Tensor::from_data(
            TensorData::new(values, shape),
            &burn::tensor::Device::flex(),
        )
    }

    #[test]
    fn the_custom_operation_equals_the_composed_one_with_all_gradients() {
        for silu in [false, true] {
            let run = |custom: bool| {
                let x = wave([140, 20], 0.7).autodiff().require_grad();
                let w = wave([20], 1.3).autodiff().require_grad();
                let b = wave([20], 2.1).autodiff().require_grad();
                let norm = if custom { frame_norm } else { composed };
                let y = norm(x.clone(), w.clone(), b.clone(), 2, silu);
                let mut tape = (y.clone() * wave([140, 20], 0.31)).sum().backward();
                let mut all = to_host(y);
                all.extend(to_host(x.grad_remove(&mut tape).unwrap()));
                all.extend(to_host(w.grad_remove(&mut tape).unwrap()));
                all.extend(to_host(b.grad_remove(&mut tape).unwrap()));
                all
            };
            for (a, b) in run(true).iter().zip(run(false)) {
                assert!((a - b).abs() < 1e-4 * b.abs().max(1.0), "{a} {b}");
            }
        }
    }
}
