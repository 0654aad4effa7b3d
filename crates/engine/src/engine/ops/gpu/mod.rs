//! Operations as kernels for GPUs, written once for all of them and compiled for the device at run time.
//!
//! What is here has no good form in the library's own operations: attention over segments of any length, without a loop on the
//! host and without stored scores; cross-entropy over a large vocabulary without stored logits; the gradient of an embedding; the
//! optimizer's step. Every sum has one writer and a fixed order, so the same device gives the same bits.

mod activation;
mod adamw;
mod attention;
mod cross_entropy;
mod embedding;
mod norm;
mod standardise;
mod tables;

use std::sync::Arc;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, DispatchDevice, backend_extension};
use burn::tensor::{DType, Device, Tensor};
use burn_autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn_autodiff::grads::Gradients;
use burn_autodiff::ops::{Backward, Ops, OpsKind};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;

use super::super::{Precision, Segments};
pub use adamw::adamw;
pub use norm::sum_of_squares;

/// Units of a cube, where each works for itself.
const UNITS: u32 = 64;

/// What a forward pass leaves for backward, besides its inputs.
#[derive(Debug, Clone)]
struct Saved {
    output: CubeTensor,
    /// Logarithms of normalisers.
    normalisers: Option<CubeTensor>,
}

impl Saved {
    fn output(output: CubeTensor) -> Self {
        Self {
            output,
            normalisers: None,
        }
    }
}

/// One operation of two inputs; where it has one, the second is the first again.
trait Kernel {
    fn forward(&self, inputs: [&CubeTensor; 2]) -> Saved;
    /// Gradients of the inputs given that of the output; those not `wanted` may be `None`.
    fn backward(
        &self,
        inputs: [&CubeTensor; 2],
        saved: &Saved,
        dy: CubeTensor,
        wanted: [bool; 2],
    ) -> [Option<CubeTensor>; 2];
}

/// Which kernel runs.
#[derive(Debug, Clone)]
pub enum Operation {
    /// Of packed projections `[N, 3 D]`.
    SelfAttention { heads: usize, segments: Segments },
    /// Of queries `[N, D]` and packed keys and values `[M, 2 D]`.
    CrossAttention { heads: usize, segments: Segments },
    /// Of rows `[N, D]` and the table `[V, D]`.
    TiedCrossEntropy {
        targets: Arc<[u32]>,
        precision: Precision,
    },
    /// Of a table `[V, D]`.
    Embedding { ids: Arc<[u32]> },
    /// Of rows `[N, D]`.
    Standardise { epsilon: f32 },
    /// Of any array.
    Gelu,
    /// Of a gate and values, alike.
    SwiGlu,
}

impl Operation {
    fn with<R>(&self, run: impl FnOnce(&dyn Kernel) -> R) -> R {
        match self {
            Self::SelfAttention { heads, segments } => run(&attention::Attention {
                heads: *heads,
                segments,
                packed: true,
            }),
            Self::CrossAttention { heads, segments } => run(&attention::Attention {
                heads: *heads,
                segments,
                packed: false,
            }),
            Self::TiedCrossEntropy { targets, precision } => {
                run(&cross_entropy::TiedCrossEntropy {
                    targets,
                    precision: *precision,
                })
            }
            Self::Embedding { ids } => run(&embedding::Embedding { ids }),
            Self::Standardise { epsilon } => run(&standardise::Standardise { epsilon: *epsilon }),
            Self::Gelu => run(&activation::Gelu),
            Self::SwiGlu => run(&activation::SwiGlu),
        }
    }
}

/// The door into the tensor library's run-time dispatch.
#[backend_extension(Cube, Autodiff)]
pub trait GpuOps: Backend {
    fn gpu(a: FloatTensor<Self>, b: FloatTensor<Self>, operation: Operation) -> FloatTensor<Self>;
}

impl GpuOps for CubeBackend {
    fn gpu(a: CubeTensor, b: CubeTensor, operation: Operation) -> CubeTensor {
        let [a, b] = [a, b].map(dense);
        operation.with(|kernel| kernel.forward([&a, &b])).output
    }
}

impl<C: CheckpointStrategy> GpuOps for Autodiff<CubeBackend, C> {
    fn gpu(a: FloatTensor<Self>, b: FloatTensor<Self>, operation: Operation) -> FloatTensor<Self> {
        let tensors = [a, b];
        let inputs = tensors
            .each_ref()
            .map(|tensor| dense(tensor.primitive().clone()));
        let saved = operation.with(|kernel| kernel.forward(inputs.each_ref()));
        let output = saved.output.clone();
        #[allow(clippy::redundant_closure_for_method_calls)]
        // the method's type cannot be named from here
        let nodes = tensors.each_ref().map(|tensor| tensor.node());
        match Tape(operation)
            .prepare::<C>(nodes)
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(tape) => tape.finish((inputs, saved), output),
            OpsKind::UnTracked(tape) => tape.finish(output),
        }
    }
}

/// The backward step of any kernel.
#[derive(Debug)]
struct Tape(Operation);

impl Backward<CubeBackend, 2> for Tape {
    type State = ([CubeTensor; 2], Saved);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = dense(grads.consume::<CubeBackend>(&ops.node));
        let (inputs, saved) = ops.state;
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let found = self
            .0
            .with(|kernel| kernel.backward(inputs.each_ref(), &saved, dy, wanted));
        for (parent, gradient) in ops.parents.into_iter().zip(found) {
            if let (Some(node), Some(gradient)) = (parent, gradient) {
                grads.register::<CubeBackend>(node.id, gradient);
            }
        }
    }
}

fn primitive(tensor: Tensor<1>) -> CubeTensor {
    let primitive = tensor
        .try_into_primitive::<CubeBackend>()
        .expect("the front door lets only arrays of a GPU in");
    dense(primitive)
}

/// Rows one after the other, without gaps.
fn dense(tensor: CubeTensor) -> CubeTensor {
    burn_cubecl::kernel::into_contiguous(tensor)
}

/// An array nobody has written.
fn empty(like: &CubeTensor, shape: &[usize]) -> CubeTensor {
    burn_cubecl::ops::numeric::empty_device_contiguous_dtype(
        like.client.clone(),
        like.device.clone(),
        shape.to_vec().into(),
        DType::F32,
    )
}

fn zeros(like: &CubeTensor, shape: &[usize]) -> CubeTensor {
    burn_cubecl::ops::numeric::zeros(like.device.clone(), shape.to_vec().into(), DType::F32)
}

/// `[rows, columns]`.
fn sides(tensor: &CubeTensor) -> [usize; 2] {
    let shape = tensor.meta.shape();
    [shape[0], shape[1]]
}

/// Cubes of [`UNITS`] for `units`, in a grid that every device takes.
fn cubes(units: usize) -> cubecl::prelude::CubeCount {
    let cubes = units.div_ceil(UNITS as usize) as u32;
    let across = cubes.clamp(1, 32_768);
    cubecl::prelude::CubeCount::Static(across, cubes.div_ceil(across).max(1), 1)
}

/// Whether the kernels can take `x`: on a GPU and in f32.
pub fn takes<const D: usize>(x: &Tensor<D>) -> bool {
    x.dtype() == DType::F32 && is_gpu(&x.device())
}

fn is_gpu(device: &Device) -> bool {
    match device.as_dispatch() {
        DispatchDevice::Cube(_) => true,
        DispatchDevice::Autodiff(device) => matches!(**device, DispatchDevice::Cube(_)),
        _ => false,
    }
}

/// Runs one kernel.
pub fn run<const A: usize, const OUT: usize>(
    operation: Operation,
    a: Tensor<A>,
    b: Option<Tensor<2>>,
) -> Tensor<OUT> {
    let a = a.into_dispatch();
    let b = b.map_or_else(|| a.clone(), Tensor::into_dispatch);
    Tensor::from_dispatch(Dispatch::gpu(a, b, operation))
}

#[cfg(test)]
mod tests {
    //! Every kernel against what the processor computes, on whatever GPU there is; Mesa's lavapipe plays one.

    use burn::tensor::{Tensor, TensorData};

    use super::super::{self as ops, AdamWStep, MuonParameter, Norm};
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{Compute, DeviceChoice, DeviceKind, Precision, Segment};

    /// A GPU, in hardware or played; says so where there is none.
    fn gpu() -> Option<Device> {
        let kinds = [
            DeviceKind::Wgpu,
            DeviceKind::Cuda,
            DeviceKind::Vulkan,
            DeviceKind::Metal,
        ];
        let found = kinds
            .into_iter()
            .find_map(|kind| Compute::new(DeviceChoice::first(kind), Precision::F32).ok());
        if found.is_none() {
            eprintln!("skipped: there is no GPU here, and no driver that plays one");
        }
        Some(found?.device().clone())
    }

    fn wave(shape: [usize; 2], phase: f32, device: &Device) -> Tensor<2> {
        let length = shape[0] * shape[1];
        let values: Vec<f32> = (0..length)
            .map(|i| (i as f32 * 0.618 + phase).sin() * 1.3)
            .collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    type Apply = dyn Fn(&[Tensor<2>]) -> Tensor<2>;

    /// The output of `apply` and the gradients of all inputs, for an uneven weighting of the output.
    fn results(shapes: &[[usize; 2]], apply: &Apply, device: &Device) -> Vec<Vec<f32>> {
        let inputs: Vec<Tensor<2>> = shapes
            .iter()
            .enumerate()
            .map(|(i, shape)| wave(*shape, i as f32, device).autodiff().require_grad())
            .collect();
        let y = apply(&inputs);
        let weighting = wave(y.dims(), 0.3, device);
        let mut tape = (y.clone() * weighting.autodiff()).sum().backward();
        let gradients = inputs
            .iter()
            .map(|x| to_host(x.grad_remove(&mut tape).unwrap()));
        std::iter::once(to_host(y)).chain(gradients).collect()
    }

    fn assert_alike(name: &str, shapes: &[[usize; 2]], apply: &Apply) {
        assert_within(1e-5, name, shapes, apply);
    }

    fn assert_within(tolerance: f64, name: &str, shapes: &[[usize; 2]], apply: &Apply) {
        let Some(gpu) = gpu() else { return };
        let expected = results(shapes, apply, &Device::flex());
        let found = results(shapes, apply, &gpu);
        assert!(
            found == results(shapes, apply, &gpu),
            "{name}: other bits the second time"
        );
        for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
            assert_eq!(found.len(), expected.len());
            let off: f64 = found
                .iter()
                .zip(expected)
                .map(|(a, b)| f64::from(a - b).powi(2))
                .sum();
            let size: f64 = expected.iter().map(|b| f64::from(*b).powi(2)).sum();
            let error = off.sqrt() / size.sqrt().max(1e-6);
            assert!(
                error < tolerance,
                "{name}, result {index}: relative error {error}"
            );
        }
    }

    fn segments(list: &[[usize; 4]], queries: usize, keys: usize) -> Segments {
        let segment = |[a, b, c, d]: &[usize; 4]| Segment {
            queries: *a..*b,
            keys: *c..*d,
        };
        Segments::new(list.iter().map(segment).collect(), queries, keys).unwrap()
    }

    #[test]
    fn attention_within_ragged_runs_agrees_with_the_processor() {
        let runs = Segments::within(&[5, 0, 31, 1, 40]);
        assert_alike("self-attention", &[[77, 3 * 24]], &move |x| {
            ops::self_attention(x[0].clone(), 3, &runs)
        });
    }

    #[test]
    fn attention_to_shared_and_to_no_keys_agrees_with_the_processor() {
        // Keys of two segments, a query row in none, a segment without keys, keys that nobody sees.
        let segments = segments(
            &[
                [0, 20, 0, 9],
                [21, 25, 9, 10],
                [25, 33, 4, 16],
                [33, 34, 0, 0],
            ],
            36,
            18,
        );
        assert_alike("cross-attention", &[[36, 16], [18, 32]], &move |x| {
            ops::cross_attention(x[0].clone(), x[1].clone(), 2, &segments)
        });
    }

    #[test]
    fn cross_entropy_in_parts_agrees_with_the_processor() {
        let targets: Vec<u32> = (0..300).map(|i| i * 7919 % 64_000).collect();
        // A gradient of rows is a sum of 64 000 terms that cancel.
        assert_within(1e-4, "cross-entropy", &[[300, 8], [64_000, 8]], &move |x| {
            ops::tied_cross_entropy(Precision::F32, x[0].clone(), x[1].clone(), &targets)
                .unsqueeze()
        });
    }

    #[test]
    fn an_embedding_adds_up_the_gradients_of_a_row() {
        let ids = [3_u32, 0, 3, 3, 6, 0, 1];
        assert_alike("embedding", &[[9, 20]], &move |x| {
            ops::embedding(x[0].clone(), &ids)
        });
    }

    #[test]
    fn layer_norm_agrees_with_the_processor() {
        for shape in [[150, 37], [3, 768]] {
            assert_alike("layer norm", &[shape, [1, shape[1]], [1, shape[1]]], &|x| {
                let row = |x: &Tensor<2>| x.clone().reshape([-1]);
                ops::layer_norm(x[0].clone() + 0.3, row(&x[1]), Some(row(&x[2])), 1e-6)
            });
        }
    }

    #[test]
    fn activations_agree_with_the_processor() {
        assert_alike("gelu", &[[300, 37]], &|x| ops::gelu(x[0].clone() * 2.0));
        assert_alike("swiglu", &[[300, 37], [300, 37]], &|x| {
            ops::swiglu(x[0].clone() * 2.0, x[1].clone())
        });
    }

    fn flat(values: &[f32], device: &Device) -> Tensor<1> {
        Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), device)
    }

    /// Values, means and squares after a step with these gradients.
    fn stepped(gradient: &[f32], clip: Option<f64>, device: &Device) -> Vec<Vec<f32>> {
        let values: Vec<f32> = (0..gradient.len())
            .map(|i| (i as f32 * 0.3).cos())
            .collect();
        let step = AdamWStep {
            clip,
            betas: [0.9, 0.95],
            epsilon: 1e-8,
            decay: 0.001,
            rate: 0.02,
            square_correction: 1.3,
        };
        let gradient = flat(gradient, device);
        let norm = Norm::of(std::iter::once(&gradient));
        let moments = |scale: f32| {
            flat(
                &values.iter().map(|v| v * v * scale).collect::<Vec<_>>(),
                device,
            )
        };
        let (a, b, c) = ops::adamw(
            flat(&values, device),
            gradient,
            moments(0.1),
            moments(0.2),
            &norm,
            step,
        );
        [a, b, c].map(to_host).to_vec()
    }

    #[test]
    fn a_step_of_the_optimizer_agrees_with_the_processor() {
        let Some(gpu) = gpu() else { return };
        let gradient: Vec<f32> = (0..70_000).map(|i| (i as f32 * 0.7).sin()).collect();
        for clip in [None, Some(1.0), Some(1e9)] {
            let expected = stepped(&gradient, clip, &Device::flex());
            for (found, expected) in stepped(&gradient, clip, &gpu).iter().zip(&expected) {
                let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
                let worst = worst.fold(0.0, f32::max);
                assert!(worst < 1e-6, "{clip:?}: {worst}");
            }
        }
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing_on_the_device() {
        let Some(gpu) = gpu() else { return };
        let still = stepped(&[0.0; 8], Some(1.0), &gpu);
        for bad in [f32::NAN, f32::INFINITY] {
            let mut gradient = [0.5; 8];
            gradient[3] = bad;
            let values: Vec<f32> = (0..8).map(|i| (i as f32 * 0.3).cos()).collect();
            let found = stepped(&gradient, Some(1.0), &gpu);
            assert_eq!(found[0], values, "{bad}");
            assert_ne!(still[0], values);
        }
    }

    /// Values and momentum of a matrix after a step of Muon.
    fn muon_stepped(gradient: &[f32; 96], device: &Device) -> [Vec<f32>; 2] {
        let gradient = flat(gradient, device);
        let norm = Norm::of(std::iter::once(&gradient));
        let parameter = MuonParameter {
            values: wave([1, 96], 0.2, device).reshape([-1]),
            gradient,
            momentum: wave([1, 96], 0.9, device).reshape([-1]),
            shape: [12, 8],
            matrices: 2,
            decay: 0.01,
        };
        let (values, momentum) = ops::muon(vec![parameter], 0.02, &norm).remove(0);
        [values, momentum].map(to_host)
    }

    #[test]
    fn a_step_of_muon_agrees_with_the_processor_and_one_that_is_not_finite_changes_nothing() {
        let Some(gpu) = gpu() else { return };
        let mut gradient = [0.0; 96];
        for (at, value) in gradient.iter_mut().enumerate() {
            *value = (at as f32 * 0.7).sin();
        }
        let (here, there) = (
            muon_stepped(&gradient, &Device::flex()),
            muon_stepped(&gradient, &gpu),
        );
        for (found, expected) in there.iter().zip(&here) {
            let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1e-5);
        }
        for bad in [f32::NAN, f32::INFINITY] {
            gradient[17] = bad;
            let before = [0.2, 0.9].map(|phase| to_host(wave([1, 96], phase, &gpu)));
            assert_eq!(muon_stepped(&gradient, &gpu), before, "{bad}");
        }
    }

    #[test]
    fn a_sum_has_the_same_bits_each_time_and_gradients_of_ones() {
        for length in [1, 1024, 1025, 3_000_001] {
            assert_alike("sum", &[[1, length]], &|x| {
                ops::sum(x[0].clone() + 0.5).unsqueeze()
            });
        }
    }

    #[test]
    fn the_norm_of_arrays_on_the_device_is_that_of_the_processor() {
        let Some(gpu) = gpu() else { return };
        let arrays = |device: &Device| {
            [1, 100, 4097, 300_000].map(|length| wave([1, length], 0.1, device).reshape([-1]))
        };
        let (here, there): ([Tensor<1>; 4], [Tensor<1>; 4]) =
            (arrays(&Device::flex()), arrays(&gpu));
        let (here, there) = (Norm::of(here.iter()), Norm::of(there.iter()));
        assert!(there.known().is_none());
        assert!((here.read() / there.read() - 1.0).abs() < 1e-6);
    }
}
