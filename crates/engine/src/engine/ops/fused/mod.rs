//! Each operation as one kernel with a hand-written backward, for the CPU.
//!
//! A [`Kernel`] computes on host slices; this file hangs kernels into the tensor library's dispatch and tape. Results do not
//! depend on the number of threads: work is cut into blocks whose size depends on shapes alone, each number is written by one
//! block, and partial sums are added in the order of blocks.

mod activation;
mod attention;
mod convolution;
mod cross_entropy;
mod flat;
mod frame_norm;
mod layer_norm;
mod linear;
mod muon;
mod resize;
mod slope;

use std::mem::MaybeUninit;
use std::sync::Arc;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::{DType, Device, Tensor, TensorData};
use burn_autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn_autodiff::grads::Gradients;
use burn_autodiff::ops::{Backward, Ops, OpsKind};
use burn_flex::FlexTensor;

pub use flat::{adamw, sum_of_squares};
pub use muon::muon;

use super::super::Segments;
use super::{ConvWindow, Resize, vector};

/// An array on the host: dense, row-major, f32.
#[derive(Debug, Clone)]
pub struct Array(FlexTensor);

impl Array {
    fn new(values: Vec<f32>, shape: &[usize]) -> Self {
        Self(FlexTensor::from_data(TensorData::new(
            values,
            shape.to_vec(),
        )))
    }

    fn dense(tensor: &FlexTensor) -> Self {
        Self(tensor.to_contiguous())
    }

    fn values(&self) -> &[f32] {
        self.0
            .as_slice::<f32>()
            .expect("made dense, and the front door lets only f32 in")
    }

    fn shape(&self) -> Vec<usize> {
        self.0.layout().shape().to_vec()
    }

    /// The length of the last axis.
    fn width(&self) -> usize {
        self.shape().last().copied().unwrap_or(1)
    }

    fn is_empty(&self) -> bool {
        self.values().is_empty()
    }
}

/// `length` values that `write` writes, without clearing them first.
///
/// # Safety
/// `write` writes every one.
#[allow(unsafe_code)]
unsafe fn written(length: usize, write: impl FnOnce(&mut [MaybeUninit<f32>])) -> Vec<f32> {
    let mut values = Vec::with_capacity(length);
    write(&mut values.spare_capacity_mut()[..length]);
    // SAFETY: all are written, as the caller promises.
    unsafe { values.set_len(length) };
    values
}

/// What a forward pass leaves for backward, besides its inputs.
#[derive(Debug, Clone, Default)]
pub struct Saved {
    numbers: Arc<Vec<f32>>,
    output: Option<Array>,
}

/// One fused operation of up to three inputs; absent ones are empty.
trait Kernel {
    fn forward(&self, inputs: [&Array; 3]) -> (Array, Saved);
    /// Gradients of the inputs given that of the output; those not `wanted` may be `None`.
    fn backward(
        &self,
        inputs: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        wanted: [bool; 3],
    ) -> [Option<Array>; 3];
}

/// Which kernel runs.
#[derive(Debug, Clone)]
pub enum Fused {
    Linear,
    LayerNorm { epsilon: f32 },
    Attention { heads: usize, segments: Segments },
    Gelu,
    Tanh,
    SwiGlu,
    CrossEntropy { targets: Arc<[u32]> },
    TiedCrossEntropy { targets: Arc<[u32]> },
    Convolution { taps: ConvWindow },
    FrameNorm { frames: usize, silu: bool },
    Resize { resize: Resize },
    Slope,
}

impl Fused {
    fn with<R>(&self, run: impl FnOnce(&dyn Kernel) -> R) -> R {
        match self {
            Self::Linear => run(&linear::Linear),
            Self::LayerNorm { epsilon } => run(&layer_norm::LayerNorm { epsilon: *epsilon }),
            Self::Attention { heads, segments } => run(&attention::Attention {
                heads: *heads,
                segments,
            }),
            Self::Gelu => run(&activation::Gelu),
            Self::Tanh => run(&activation::Tanh),
            Self::SwiGlu => run(&activation::SwiGlu),
            Self::CrossEntropy { targets } => run(&cross_entropy::CrossEntropy { targets }),
            Self::TiedCrossEntropy { targets } => run(&cross_entropy::TiedCrossEntropy { targets }),
            Self::Convolution { taps } => run(&convolution::Convolution { taps: *taps }),
            Self::FrameNorm { frames, silu } => run(&frame_norm::FrameNorm {
                frames: *frames,
                silu: *silu,
            }),
            Self::Resize { resize } => run(&resize::Bilinear { resize: *resize }),
            Self::Slope => run(&slope::Slope),
        }
    }
}

/// The door into the tensor library's run-time dispatch.
#[backend_extension(Flex, Autodiff)]
pub trait FusedOps: Backend {
    fn fused(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        operation: Fused,
    ) -> FloatTensor<Self>;
}

impl FusedOps for Flex {
    fn fused(a: FlexTensor, b: FlexTensor, c: FlexTensor, operation: Fused) -> FlexTensor {
        let [a, b, c] = [a, b, c].map(|tensor| Array::dense(&tensor));
        operation.with(|kernel| kernel.forward([&a, &b, &c])).0.0
    }
}

impl<C: CheckpointStrategy> FusedOps for Autodiff<Flex, C> {
    fn fused(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        operation: Fused,
    ) -> FloatTensor<Self> {
        let tensors = [a, b, c];
        let inputs = tensors
            .each_ref()
            .map(|tensor| Array::dense(tensor.primitive()));
        let (output, saved) = operation.with(|kernel| kernel.forward(inputs.each_ref()));
        #[allow(clippy::redundant_closure_for_method_calls)]
        // the method's type cannot be named from here
        let nodes = tensors.each_ref().map(|tensor| tensor.node());
        match Tape(operation)
            .prepare::<C>(nodes)
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(tape) => tape.finish((inputs, saved), output.0),
            OpsKind::UnTracked(tape) => tape.finish(output.0),
        }
    }
}

/// The backward step of any kernel.
#[derive(Debug)]
struct Tape(Fused);

impl Backward<Flex, 3> for Tape {
    type State = ([Array; 3], Saved);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = Array::dense(&grads.consume::<Flex>(&ops.node));
        let (inputs, saved) = ops.state;
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let found = self
            .0
            .with(|kernel| kernel.backward(inputs.each_ref(), &saved, &dy, wanted));
        for (parent, gradient) in ops.parents.into_iter().zip(found) {
            if let (Some(node), Some(gradient)) = (parent, gradient) {
                grads.register::<Flex>(node.id, gradient.0);
            }
        }
    }
}

/// Whether the fused kernels can take `x`: on the CPU and in f32.
pub fn takes<const D: usize>(x: &Tensor<D>) -> bool {
    x.dtype() == DType::F32 && x.device() == Device::flex()
}

/// Runs one kernel.
pub fn run<const A: usize, const B: usize, const C: usize, const OUT: usize>(
    operation: Fused,
    a: Tensor<A>,
    b: Option<Tensor<B>>,
    c: Option<Tensor<C>>,
) -> Tensor<OUT> {
    let nothing = || Tensor::<1>::zeros([0], &Device::flex()).into_dispatch();
    let b = b.map_or_else(nothing, Tensor::into_dispatch);
    let c = c.map_or_else(nothing, Tensor::into_dispatch);
    Tensor::from_dispatch(Dispatch::fused(a.into_dispatch(), b, c, operation))
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Tensor, TensorData};

    use super::super::{self as ops, unfused};
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{Precision, Segment};

    fn wave(shape: [usize; 2], phase: f32) -> Tensor<2> {
        let length = shape[0] * shape[1];
        let values: Vec<f32> = (0..length)
            .map(|i| (i as f32 * 0.618 + phase).sin() * 1.3)
            .collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex())
    }

    /// The output of `operation` and the gradients of all inputs, for an uneven weighting of the output.
    fn results(
        inputs: &[Tensor<2>],
        operation: &dyn Fn(&[Tensor<2>]) -> Tensor<2>,
    ) -> Vec<Vec<f32>> {
        let inputs: Vec<Tensor<2>> = inputs
            .iter()
            .map(|x| x.clone().autodiff().require_grad())
            .collect();
        let y = operation(&inputs);
        let weighting = wave(y.dims(), 0.3);
        let mut tape = (y.clone() * weighting).sum().backward();
        let gradients = inputs
            .iter()
            .map(|x| to_host(x.grad_remove(&mut tape).unwrap()));
        std::iter::once(to_host(y)).chain(gradients).collect()
    }

    fn assert_close(found: &[Vec<f32>], expected: &[Vec<f32>]) {
        for (index, (found, expected)) in found.iter().zip(expected).enumerate() {
            let off: f64 = found
                .iter()
                .zip(expected)
                .map(|(a, b)| f64::from(a - b).powi(2))
                .sum();
            let size: f64 = expected.iter().map(|b| f64::from(*b).powi(2)).sum();
            let error = off.sqrt() / size.sqrt().max(1e-6);
            assert!(error < 2e-6, "result {index}: relative error {error}");
        }
    }

    type Case = (
        &'static str,
        Vec<Tensor<2>>,
        fn(&[Tensor<2>]) -> Tensor<2>,
        fn(&[Tensor<2>]) -> Tensor<2>,
    );

    fn ragged() -> Segments {
        let segment = |q: std::ops::Range<usize>, k: std::ops::Range<usize>| Segment {
            queries: q,
            keys: k,
        };
        let list = vec![
            segment(0..150, 0..40),
            segment(151..160, 40..41),
            segment(160..170, 30..60),
            segment(170..171, 0..0),
        ];
        Segments::new(list, 173, 70).unwrap()
    }

    fn targets(rows: usize, classes: u32) -> Vec<u32> {
        (0..rows as u32).map(|i| i * 7 % classes).collect()
    }

    fn flat(x: &Tensor<2>) -> Tensor<1> {
        x.clone().reshape([-1])
    }

    fn row(x: Tensor<1>) -> Tensor<2> {
        x.unsqueeze()
    }

    /// ConvWindow with several blocks of rows and several units, and with a stride.
    const TAPS: [ConvWindow; 4] = [
        ConvWindow::Space {
            frames: 3,
            height: 13,
            width: 14,
            stride: 1,
        },
        ConvWindow::Space {
            frames: 3,
            height: 4,
            width: 6,
            stride: 2,
        },
        ConvWindow::Time {
            samples: 1,
            frames: 3,
            pixels: 260,
            stride: 1,
        },
        ConvWindow::Time {
            samples: 2,
            frames: 6,
            pixels: 5,
            stride: 2,
        },
    ];

    type Convolve = fn(Tensor<2>, Tensor<2>, Tensor<1>, ConvWindow) -> Tensor<2>;

    fn convolved(x: &[Tensor<2>], convolve: Convolve, taps: ConvWindow) -> Tensor<2> {
        convolve(x[0].clone(), x[1].clone(), flat(&x[2]), taps)
    }

    fn video(taps: ConvWindow) -> Vec<Tensor<2>> {
        vec![
            wave([taps.rows_in(), 3], 0.0),
            wave([5, 3 * taps.count()], 1.0),
            wave([1, 5], 2.0),
        ]
    }

    fn video_cases() -> Vec<Case> {
        vec![
            (
                "convolution in space",
                video(TAPS[0]),
                |x| convolved(x, ops::convolve, TAPS[0]),
                |x| convolved(x, unfused::convolve, TAPS[0]),
            ),
            (
                "convolution in space with a stride",
                video(TAPS[1]),
                |x| convolved(x, ops::convolve, TAPS[1]),
                |x| convolved(x, unfused::convolve, TAPS[1]),
            ),
            (
                "convolution in time",
                video(TAPS[2]),
                |x| convolved(x, ops::convolve, TAPS[2]),
                |x| convolved(x, unfused::convolve, TAPS[2]),
            ),
            (
                "convolution in time with a stride",
                video(TAPS[3]),
                |x| convolved(x, ops::convolve, TAPS[3]),
                |x| convolved(x, unfused::convolve, TAPS[3]),
            ),
            (
                "frame norm",
                vec![
                    wave([280, 20], 0.0) + 0.3,
                    wave([1, 20], 1.0),
                    wave([1, 20], 2.0),
                ],
                |x| ops::frame_norm(x[0].clone(), flat(&x[1]), flat(&x[2]), 2, false),
                |x| unfused::frame_norm(x[0].clone(), flat(&x[1]), flat(&x[2]), 2, false),
            ),
            (
                "frame norm with SiLU",
                vec![
                    wave([280, 20], 0.0) + 0.3,
                    wave([1, 20], 1.0),
                    wave([1, 20], 2.0),
                ],
                |x| ops::frame_norm(x[0].clone(), flat(&x[1]), flat(&x[2]), 2, true),
                |x| unfused::frame_norm(x[0].clone(), flat(&x[1]), flat(&x[2]), 2, true),
            ),
        ]
    }

    const LARGER: Resize = Resize {
        frames: 3,
        from: [5, 4],
        to: [9, 11],
    };
    const SMALLER: Resize = Resize {
        frames: 2,
        from: [7, 6],
        to: [1, 4],
    };

    fn resize_cases() -> Vec<Case> {
        vec![
            (
                "a larger picture",
                vec![wave([60, 3], 0.0)],
                |x| ops::resize(x[0].clone(), LARGER),
                |x| unfused::resize(x[0].clone(), LARGER),
            ),
            (
                "a smaller picture",
                vec![wave([84, 5], 0.0)],
                |x| ops::resize(x[0].clone(), SMALLER),
                |x| unfused::resize(x[0].clone(), SMALLER),
            ),
        ]
    }

    fn cases() -> Vec<Case> {
        let mut cases = token_cases();
        cases.extend(resize_cases());
        cases.extend(video_cases());
        cases
    }

    fn token_cases() -> Vec<Case> {
        vec![
            (
                "linear",
                vec![
                    wave([300, 19], 0.0),
                    wave([33, 19], 1.0),
                    wave([1, 33], 2.0),
                ],
                |x| ops::linear(x[0].clone(), x[1].clone(), Some(flat(&x[2]))),
                |x| unfused::linear(x[0].clone(), x[1].clone(), Some(flat(&x[2]))),
            ),
            (
                "linear without bias",
                vec![wave([5, 19], 0.0), wave([33, 19], 1.0)],
                |x| ops::linear(x[0].clone(), x[1].clone(), None),
                |x| unfused::linear(x[0].clone(), x[1].clone(), None),
            ),
            (
                "layer norm",
                vec![wave([150, 37], 0.0), wave([1, 37], 1.0), wave([1, 37], 2.0)],
                |x| ops::layer_norm(x[0].clone(), flat(&x[1]), Some(flat(&x[2])), 1e-6),
                |x| unfused::layer_norm(x[0].clone(), flat(&x[1]), Some(flat(&x[2])), 1e-6),
            ),
            (
                "layer norm without bias",
                vec![wave([3, 48], 0.0), wave([1, 48], 1.0)],
                |x| ops::layer_norm(x[0].clone(), flat(&x[1]), None, 1e-6),
                |x| unfused::layer_norm(x[0].clone(), flat(&x[1]), None, 1e-6),
            ),
            (
                "attention over ragged segments",
                vec![wave([305, 36], 0.0)],
                |x| ops::self_attention(x[0].clone(), 3, &Segments::within(&[290, 4, 11])),
                |x| unfused::self_attention(x[0].clone(), 3, &Segments::within(&[290, 4, 11])),
            ),
            (
                "attention over a batch",
                vec![wave([60, 24], 0.0)],
                |x| ops::self_attention(x[0].clone(), 2, &Segments::batch(3, 20)),
                |x| unfused::self_attention(x[0].clone(), 2, &Segments::batch(3, 20)),
            ),
            (
                "attention over several tiles of queries and keys",
                vec![wave([140, 8], 0.0) * 2.0, wave([1700, 16], 0.5) * 2.0],
                |x| {
                    let segments = Segments::across(&[140], &[1700]);
                    ops::cross_attention(x[0].clone(), x[1].clone(), 2, &segments)
                },
                |x| {
                    let segments = Segments::across(&[140], &[1700]);
                    unfused::cross_attention(x[0].clone(), x[1].clone(), 2, &segments)
                },
            ),
            (
                "cross-attention with gaps and shared keys",
                vec![wave([173, 8], 0.0), wave([70, 16], 0.5)],
                |x| ops::cross_attention(x[0].clone(), x[1].clone(), 2, &ragged()),
                |x| unfused::cross_attention(x[0].clone(), x[1].clone(), 2, &ragged()),
            ),
            (
                "gelu",
                vec![wave([130, 70], 0.0) * 3.0],
                |x| ops::gelu(x[0].clone()),
                |x| burn::tensor::activation::gelu(x[0].clone()),
            ),
            (
                "tanh",
                vec![wave([130, 70], 0.0) * 3.0],
                |x| ops::tanh(x[0].clone()),
                |x| x[0].clone().tanh(),
            ),
            (
                "swiglu",
                vec![wave([130, 70], 0.0) * 3.0, wave([130, 70], 1.0)],
                |x| ops::swiglu(x[0].clone(), x[1].clone()),
                |x| burn::tensor::activation::silu(x[0].clone()) * x[1].clone(),
            ),
            (
                "cross-entropy",
                vec![wave([37, 101], 0.0) * 5.0],
                |x| row(ops::cross_entropy(x[0].clone(), &targets(37, 101))),
                |x| row(unfused::cross_entropy(x[0].clone(), &targets(37, 101))),
            ),
            (
                "tied cross-entropy",
                vec![wave([37, 12], 0.0), wave([101, 12], 1.0)],
                |x| {
                    row(ops::tied_cross_entropy(
                        Precision::F32,
                        x[0].clone(),
                        x[1].clone(),
                        &targets(37, 101),
                    ))
                },
                |x| {
                    let logits = unfused::linear(x[0].clone(), x[1].clone(), None);
                    row(unfused::cross_entropy(logits, &targets(37, 101)))
                },
            ),
        ]
    }

    #[test]
    fn every_kernel_and_its_gradients_agree_with_the_composed_operation() {
        for (name, inputs, fused, unfused) in cases() {
            println!("{name}");
            assert_close(&results(&inputs, &fused), &results(&inputs, &unfused));
        }
    }

    #[test]
    fn every_kernel_gives_the_same_bits_on_any_number_of_threads() {
        for (name, inputs, fused, _) in cases() {
            let on = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()
                    .unwrap();
                pool.install(|| results(&inputs, &fused))
            };
            let one = on(1);
            for threads in [2, 5] {
                assert!(on(threads) == one, "{name} on {threads} threads");
            }
        }
    }

    #[test]
    fn attention_without_any_key_gives_zeros() {
        let y = ops::cross_attention(
            wave([3, 8], 0.0),
            Tensor::zeros([0, 16], &Device::flex()),
            2,
            &Segments::across(&[3], &[0]),
        );
        assert_eq!(to_host(y), vec![0.0; 24]);
    }
}
