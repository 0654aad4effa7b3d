//! The operations models are made of, on packed tokens: `[tokens, width]` without padding, samples one after the other.
//!
//! Shape suffixes: `N` tokens, `D` width, `V` vocabulary, `H` heads. All values f32. Weights are `[out, in]`, as in
//! checkpoints.

mod conv_window;
mod fused;
#[cfg(feature = "kernels")]
mod gpu;
mod muon;
mod nearest;
mod resize;
mod unfused;
mod vector;

pub use conv_window::ConvWindow;
pub use muon::{MuonParameter, muon};
pub use nearest::nearest;
pub use resize::{Resize, Step, steps};
/// Matrix products on slices of the host.
pub use reviv_gemm as gemm;

use burn::tensor::{DType, Int, Tensor, TensorData};

use super::{Precision, Segments};
use fused::Fused;

/// Added to the variance of a frame.
const FRAME_NORM_EPSILON: f32 = 1e-6;

/// An input that an operation does not have.
const NONE: Option<Tensor<1>> = None;

/// Whether `x` is on the processor, where its values are known at once.
#[must_use]
pub fn on_processor<const D: usize>(x: &Tensor<D>) -> bool {
    fused::takes(x)
}

fn check_segments(segments: &Segments, queries: &Tensor<2>, keys: &Tensor<2>) {
    assert_eq!(
        segments.queries(),
        queries.dims()[0],
        "segments are made for as many queries"
    );
    assert_eq!(
        segments.keys(),
        keys.dims()[0],
        "segments are made for as many keys"
    );
}

fn check_targets(targets: &[u32], [rows, classes]: [usize; 2]) {
    assert_eq!(targets.len(), rows, "one target per row");
    assert!(
        targets.iter().all(|target| (*target as usize) < classes),
        "targets are classes"
    );
}

/// A number from which backward begins in the middle of a graph: its gradient in `output` is `slope`, an array of the same shape that
/// has no gradient. What the number is does not matter.
#[must_use]
pub fn slope(output: Tensor<2>, slope: Tensor<2>) -> Tensor<1> {
    if fused::takes(&output) {
        return fused::run(Fused::Slope, output, Some(slope), NONE);
    }
    (output * slope).sum()
}

/// `x W^T + b`; `x` is `[N, in]`, `weight` `[out, in]`.
#[must_use]
pub fn linear(x: Tensor<2>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<2> {
    if fused::takes(&x) {
        return fused::run(Fused::Linear, x, Some(weight), bias);
    }
    unfused::linear(x, weight, bias)
}

/// [`linear`] with operands rounded to `precision`; sums are f32, and so is what comes out.
#[must_use]
pub fn linear_in(
    precision: Precision,
    x: Tensor<2>,
    weight: Tensor<2>,
    bias: Option<Tensor<1>>,
) -> Tensor<2> {
    match precision {
        Precision::F32 => linear(x, weight, bias),
        Precision::Bf16 if fused::takes(&x) => linear(rounded(x), rounded(weight), bias),
        Precision::Bf16 => unfused::linear_bf16(x, weight, bias),
    }
}

/// To the next bfloat16, held in f32.
fn rounded(x: Tensor<2>) -> Tensor<2> {
    x.cast(DType::BF16).cast(DType::F32)
}

/// Each row to mean 0 and variance 1 (biased, plus `epsilon`), times `weight`, plus `bias`.
#[must_use]
pub fn layer_norm(
    x: Tensor<2>,
    weight: Tensor<1>,
    bias: Option<Tensor<1>>,
    epsilon: f64,
) -> Tensor<2> {
    if fused::takes(&x) {
        let epsilon = epsilon as f32;
        return fused::run(Fused::LayerNorm { epsilon }, x, Some(weight), bias);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&x) && x.dims()[0] > 0 {
        let epsilon = epsilon as f32;
        let y: Tensor<2> = gpu::run(gpu::Operation::Standardise { epsilon }, x, None);
        let y = y * weight.unsqueeze();
        return match bias {
            Some(bias) => y + bias.unsqueeze(),
            None => y,
        };
    }
    unfused::layer_norm(x, weight, bias, epsilon)
}

/// Self-attention within segments. `qkv` is `[N, 3 D]` in the layout `[3][heads][D / heads]`; scores are scaled by
/// `(D / heads)^-0.5`. Gives `[N, D]`, `[heads][D / heads]`.
#[must_use]
pub fn self_attention(qkv: Tensor<2>, heads: usize, segments: &Segments) -> Tensor<2> {
    check_segments(segments, &qkv, &qkv);
    if fused::takes(&qkv) {
        let segments = segments.clone();
        return fused::run(Fused::Attention { heads, segments }, qkv, NONE, NONE);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&qkv) && segments.queries() > 0 {
        let segments = segments.clone();
        return gpu::run(gpu::Operation::SelfAttention { heads, segments }, qkv, None);
    }
    unfused::self_attention(qkv, heads, segments)
}

/// Cross-attention within segments. `q` is `[N, D]`, `kv` `[M, 2 D]` in the layout `[2][heads][D / heads]`. A segment without
/// keys gives zeros.
#[must_use]
pub fn cross_attention(
    q: Tensor<2>,
    kv: Tensor<2>,
    heads: usize,
    segments: &Segments,
) -> Tensor<2> {
    check_segments(segments, &q, &kv);
    // Without any key there is no gradient to hand back; the unfused form gives the zeros.
    if fused::takes(&q) && segments.keys() > 0 {
        let segments = segments.clone();
        return fused::run(Fused::Attention { heads, segments }, q, Some(kv), NONE);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&q) && segments.queries() > 0 && segments.keys() > 0 {
        let segments = segments.clone();
        return gpu::run(
            gpu::Operation::CrossAttention { heads, segments },
            q,
            Some(kv),
        );
    }
    unfused::cross_attention(q, kv, heads, segments)
}

/// `x Phi(x)` with the exact (erf) normal distribution function.
#[must_use]
pub fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    if fused::takes(&x) {
        return fused::run(Fused::Gelu, x, NONE, NONE);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&x) && x.shape().num_elements() > 0 {
        return gpu::run(gpu::Operation::Gelu, x, None);
    }
    burn::tensor::activation::gelu(x)
}

/// The hyperbolic tangent, element by element.
#[must_use]
pub fn tanh<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    if fused::takes(&x) {
        return fused::run(Fused::Tanh, x, NONE, NONE);
    }
    x.tanh()
}

/// `silu(gate) * value`, element by element.
#[must_use]
pub fn swiglu(gate: Tensor<2>, value: Tensor<2>) -> Tensor<2> {
    if fused::takes(&gate) {
        return fused::run(Fused::SwiGlu, gate, Some(value), NONE);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&gate) && gate.dims()[0] > 0 {
        return gpu::run(gpu::Operation::SwiGlu, gate, Some(value));
    }
    burn::tensor::activation::silu(gate) * value
}

/// `-log softmax(logits)[target]` of each row: `[N]`. `logits` is `[N, V]`.
#[must_use]
pub fn cross_entropy(logits: Tensor<2>, targets: &[u32]) -> Tensor<1> {
    check_targets(targets, logits.dims());
    if fused::takes(&logits) {
        let targets = targets.into();
        return fused::run(Fused::CrossEntropy { targets }, logits, NONE, NONE);
    }
    unfused::cross_entropy(logits, targets)
}

/// [`cross_entropy`] of the logits `x table^T`, without keeping all of them: `x` is `[N, D]`, `table` `[V, D]`. Gives `[N]`. The
/// operands of the product are rounded to `precision`.
#[must_use]
pub fn tied_cross_entropy(
    precision: Precision,
    x: Tensor<2>,
    table: Tensor<2>,
    targets: &[u32],
) -> Tensor<1> {
    check_targets(targets, [x.dims()[0], table.dims()[0]]);
    if fused::takes(&x) {
        let (x, table) = match precision {
            Precision::F32 => (x, table),
            Precision::Bf16 => (rounded(x), rounded(table)),
        };
        let targets = targets.into();
        return fused::run(Fused::TiedCrossEntropy { targets }, x, Some(table), NONE);
    }
    #[cfg(feature = "kernels")]
    if gpu::takes(&x) && !targets.is_empty() {
        let targets = targets.into();
        let operation = gpu::Operation::TiedCrossEntropy { targets, precision };
        return gpu::run(operation, x, Some(table));
    }
    unfused::cross_entropy(linear_in(precision, x, table, None), targets)
}

/// A factorised causal convolution over video on packed rows: `x` `[N, C]`, one row per pixel of
/// `[samples, frames, height, width]`, by `weight` `[O, C * taps]` (channel by tap, as in checkpoints) plus `bias` `[O]`:
/// `[N', O]`.
///
/// # Panics
/// When `x` does not have the rows that `taps` speaks of.
#[must_use]
pub fn convolve(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, taps: ConvWindow) -> Tensor<2> {
    assert_eq!(x.dims()[0], taps.rows_in(), "{taps:?}");
    assert_eq!(weight.dims()[1], x.dims()[1] * taps.count(), "{taps:?}");
    if fused::takes(&x) {
        return fused::run(Fused::Convolution { taps }, x, Some(weight), Some(bias));
    }
    unfused::convolve(x, weight, bias, taps)
}

/// Each of `frames` frames of packed rows `[frames * pixels, channels]` to mean 0 and variance 1 (group norm with one group),
/// times `weight` plus `bias` (per channel), then SiLU if `silu`.
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
    if fused::takes(&x) {
        let operation = Fused::FrameNorm { frames, silu };
        return fused::run(operation, x, Some(weight), Some(bias));
    }
    unfused::frame_norm(x, weight, bias, frames, silu)
}

/// Frames of packed rows to another size, bilinearly with aligned corners: `x` is `[frames * height * width, C]`.
///
/// # Panics
/// When `x` does not have the rows that `resize` speaks of, or a size is zero.
#[must_use]
pub fn resize(x: Tensor<2>, resize: Resize) -> Tensor<2> {
    assert_eq!(x.dims()[0], resize.rows_in(), "{resize:?}");
    assert!(resize.rows_out() > 0, "{resize:?}");
    if resize.from == resize.to {
        return x;
    }
    if fused::takes(&x) {
        return fused::run(Fused::Resize { resize }, x, NONE, NONE);
    }
    unfused::resize(x, resize)
}

/// Elements that are added up at a time where all of an array are.
const SUMMED: usize = 1024;

/// The sum of all elements, `[1]`. On a device it has a fixed order; the library's own adds up in the order in which units end, and
/// has other bits each time.
#[must_use]
pub fn sum<const D: usize>(x: Tensor<D>) -> Tensor<1> {
    if fused::takes(&x) {
        return x.sum();
    }
    let mut length = x.shape().num_elements();
    let mut flat: Tensor<1> = x.reshape([length]);
    while length > SUMMED {
        let (rows, rest) = (length / SUMMED, length % SUMMED);
        let whole = flat.clone().narrow(0, 0, rows * SUMMED);
        let mut parts = vec![whole.reshape([rows, SUMMED]).sum_dim(1).reshape([rows])];
        if rest > 0 {
            parts.push(flat.narrow(0, rows * SUMMED, rest));
        }
        flat = Tensor::cat(parts, 0);
        length = rows + rest;
    }
    flat.reshape([1, length]).sum_dim(1).reshape([1])
}

/// The rows `ids` of `table` `[V, D]`: `[N, D]`.
#[must_use]
pub fn embedding(table: Tensor<2>, ids: &[u32]) -> Tensor<2> {
    #[cfg(feature = "kernels")]
    if gpu::takes(&table) && !ids.is_empty() {
        return gpu::run(gpu::Operation::Embedding { ids: ids.into() }, table, None);
    }
    let ids = indices(ids, &table);
    table.select(0, ids)
}

/// Row numbers as a tensor on the device of `like`.
#[must_use]
pub fn indices(ids: &[u32], like: &Tensor<2>) -> Tensor<1, Int> {
    let values: Vec<i64> = ids.iter().map(|id| i64::from(*id)).collect();
    let length = values.len();
    Tensor::from_data(
        TensorData::new(values, [length]),
        &like.device().without_autodiff(),
    )
}

/// The Euclidean norm of several arrays together, where they are.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "one a step; a box would only be another place to look"
)]
pub enum Norm {
    /// On the processor: known.
    Host(f64),
    /// On a device, `[1]`: reading it waits for everything before it.
    Device(Tensor<1>),
}

impl Norm {
    /// The norm of arrays that are all on one device.
    #[must_use]
    pub fn of<'a>(arrays: impl Iterator<Item = &'a Tensor<1>>) -> Self {
        let (mut host, mut device) = (0.0, Vec::new());
        for x in arrays {
            let x = x.clone().without_autodiff();
            if fused::takes(&x) {
                host += fused::sum_of_squares(x);
                continue;
            }
            #[cfg(feature = "kernels")]
            if gpu::takes(&x) {
                device.push(gpu::sum_of_squares(x));
                continue;
            }
            device.push(unfused::sum_of_squares(x));
        }
        if device.is_empty() {
            return Self::Host(host.sqrt());
        }
        Self::Device(sum(Tensor::cat(device, 0)).sqrt())
    }

    /// What is known without waiting.
    #[must_use]
    pub fn known(&self) -> Option<f64> {
        match self {
            Self::Host(norm) => Some(*norm),
            Self::Device(_) => None,
        }
    }

    /// Reads it.
    #[must_use]
    pub fn read(&self) -> f64 {
        match self {
            Self::Host(norm) => *norm,
            Self::Device(norm) => norm.clone().into_scalar::<f64>(),
        }
    }

    /// The factor that brings a gradient of this norm down to `limit`: `min(1, limit / (norm + 1e-6))`.
    #[must_use]
    pub fn clip_factor(&self, limit: f64) -> f64 {
        (limit / (self.read() + 1e-6)).min(1.0)
    }
}

/// The scalars of one AdamW step of one parameter, bias corrections included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamWStep {
    /// Gradients are brought down to this norm first.
    pub clip: Option<f64>,
    /// How much of the running mean and of the running mean square is kept, each in `[0, 1)`.
    pub betas: [f64; 2],
    /// Added to the root of the corrected mean square.
    pub epsilon: f64,
    /// Learning rate times weight decay.
    pub decay: f64,
    /// Learning rate divided by the correction of the mean.
    pub rate: f64,
    /// What the root of the mean square is multiplied by.
    pub square_correction: f64,
}

/// One AdamW step: new `(values, mean, square)`, in place where nobody else holds them. `norm` is that of all gradients together;
/// where a device has it and it is not finite, nothing changes.
#[must_use]
pub fn adamw(
    values: Tensor<1>,
    gradient: Tensor<1>,
    mean: Tensor<1>,
    square: Tensor<1>,
    norm: &Norm,
    step: AdamWStep,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    #[cfg(feature = "kernels")]
    if let (true, Norm::Device(norm)) = (gpu::takes(&values), norm) {
        return gpu::adamw(values, gradient, mean, square, norm, step);
    }
    let scale = step.clip.map_or(1.0, |limit| norm.clip_factor(limit));
    if fused::takes(&values) {
        return fused::adamw(values, gradient, mean, square, scale, step);
    }
    unfused::adamw(values, gradient, mean, square, scale, step)
}
