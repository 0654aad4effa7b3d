//! Every operation unfused of the tensor library's own: what runs on GPU back ends, and what fused ones are tested against.

use burn::tensor::{DType, Tensor, TensorData, activation};

use super::super::Segments;
use super::{AdamWStep, ConvWindow, FRAME_NORM_EPSILON, Resize, Step, indices, steps};

pub fn linear(x: Tensor<2>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<2> {
    let y = x.matmul(weight.transpose());
    match bias {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    }
}

pub fn linear_bf16(x: Tensor<2>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<2> {
    let [x, weight] = [x, weight].map(|operand| operand.cast(DType::BF16));
    let y = x.matmul(weight.transpose()).cast(DType::F32);
    match bias {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    }
}

pub fn layer_norm(
    x: Tensor<2>,
    weight: Tensor<1>,
    bias: Option<Tensor<1>>,
    epsilon: f64,
) -> Tensor<2> {
    let centred = x.clone() - x.mean_dim(1);
    let variance = centred.clone().square().mean_dim(1);
    let y = centred / (variance + epsilon).sqrt() * weight.unsqueeze();
    match bias {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    }
}

pub fn self_attention(qkv: Tensor<2>, heads: usize, segments: &Segments) -> Tensor<2> {
    let [_, packed] = qkv.dims();
    let width = packed / 3;
    let q = qkv.clone().narrow(1, 0, width);
    let kv = qkv.narrow(1, width, 2 * width);
    cross_attention(q, kv, heads, segments)
}

pub fn cross_attention(
    q: Tensor<2>,
    kv: Tensor<2>,
    heads: usize,
    segments: &Segments,
) -> Tensor<2> {
    let [rows, width] = q.dims();
    let device = q.device();
    if let Some((count, queries, keys)) = segments.uniform()
        && keys > 0
    {
        return dense(q, kv, heads, [count, queries, keys]);
    }
    let mut parts = Vec::new();
    let mut done = 0;
    for segment in segments.list() {
        if segment.queries.start > done {
            parts.push(Tensor::zeros(
                [segment.queries.start - done, width],
                &device,
            ));
        }
        done = segment.queries.end;
        let (n, m) = (segment.queries.len(), segment.keys.len());
        if n == 0 {
            continue;
        }
        if m == 0 {
            parts.push(Tensor::zeros([n, width], &device));
            continue;
        }
        let q = q.clone().narrow(0, segment.queries.start, n);
        let kv = kv.clone().narrow(0, segment.keys.start, m);
        parts.push(dense(q, kv, heads, [1, n, m]));
    }
    if rows > done || parts.is_empty() {
        parts.push(Tensor::zeros([rows - done, width], &device));
    }
    Tensor::cat(parts, 0)
}

/// `count` segments of `n` queries and `m` keys each.
fn dense(q: Tensor<2>, kv: Tensor<2>, heads: usize, [count, n, m]: [usize; 3]) -> Tensor<2> {
    let [_, width] = q.dims();
    let head = width / heads;
    let q_SHNd = q.reshape([count, n, heads, head]).swap_dims(1, 2);
    let kv_SM2Hd = kv.reshape([count, m, 2, heads, head]);
    let part = |index: usize| -> Tensor<4> {
        let one: Tensor<5> = kv_SM2Hd.clone().narrow(2, index, 1);
        one.reshape([count, m, heads, head]).swap_dims(1, 2)
    };
    let scores = q_SHNd.matmul(part(0).swap_dims(2, 3)) * (head as f64).powf(-0.5);
    let mixed = activation::softmax(scores, 3).matmul(part(1));
    mixed.swap_dims(1, 2).reshape([count * n, width])
}

pub fn cross_entropy(logits: Tensor<2>, targets: &[u32]) -> Tensor<1> {
    let [rows, _] = logits.dims();
    let targets = indices(targets, &logits).reshape([rows, 1]);
    activation::log_softmax(logits, 1)
        .gather(1, targets)
        .reshape([rows])
        .neg()
}

pub fn convolve(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, taps: ConvWindow) -> Tensor<2> {
    let ([rows, channels], outputs) = (x.dims(), weight.dims()[0]);
    // A tap beside the picture reads the row of zeros behind the last.
    let sources: Vec<u32> = (0..taps.rows_out())
        .flat_map(|row| {
            (0..taps.count()).map(move |tap| taps.source(row, tap).unwrap_or(rows) as u32)
        })
        .collect();
    let sources = indices(&sources, &x);
    let nothing = Tensor::zeros([1, channels], &x.device());
    let padded = Tensor::cat(vec![x, nothing], 0);
    let columns = padded
        .select(0, sources)
        .reshape([taps.rows_out(), taps.count() * channels]);
    let weight = weight
        .reshape([outputs, channels, taps.count()])
        .swap_dims(1, 2)
        .reshape([outputs, taps.count() * channels]);
    columns.matmul(weight.transpose()) + bias.reshape([1, outputs])
}

pub fn frame_norm(
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
    let y = (centred / (variance + FRAME_NORM_EPSILON).sqrt()).reshape([rows, channels])
        * weight.reshape([1, channels])
        + bias.reshape([1, channels]);
    if silu { activation::silu(y) } else { y }
}

pub fn resize(x: Tensor<2>, resize: Resize) -> Tensor<2> {
    let ([_, channels], Resize { frames, from, to }) = (x.dims(), resize);
    let lines = x.reshape([frames, from[0], from[1] * channels]);
    let lines = along(lines, &steps(from[0], to[0]));
    let pixels = lines.reshape([frames * to[0], from[1], channels]);
    along(pixels, &steps(from[1], to[1])).reshape([resize.rows_out(), channels])
}

/// Resizes the second axis.
fn along(x: Tensor<3>, steps: &[Step]) -> Tensor<3> {
    let device = x.device();
    let pick = |at: fn(&Step) -> usize| {
        let ids: Vec<i64> = steps.iter().map(|step| at(step) as i64).collect();
        let ids = TensorData::new(ids, [steps.len()]);
        x.clone().select(
            1,
            Tensor::from_data(ids, &device.clone().without_autodiff()),
        )
    };
    let weights: Vec<f32> = steps.iter().map(|step| step.weight).collect();
    let weights = TensorData::new(weights, [1, steps.len(), 1]);
    let weights: Tensor<3> = Tensor::from_data(weights, &device.clone().without_autodiff());
    let lower = pick(|step| step.lower) * (weights.clone().neg() + 1.0);
    lower + pick(|step| step.upper) * weights
}

pub fn sum_of_squares(x: Tensor<1>) -> Tensor<1> {
    super::sum(x.square())
}

pub fn adamw(
    values: Tensor<1>,
    gradient: Tensor<1>,
    mean: Tensor<1>,
    square: Tensor<1>,
    scale: f64,
    step: AdamWStep,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    let gradient = gradient * scale;
    let [beta1, beta2] = step.betas;
    let mean = mean * beta1 + gradient.clone() * (1.0 - beta1);
    let square = square * beta2 + gradient.square() * (1.0 - beta2);
    let root = square.clone().sqrt() * step.square_correction + step.epsilon;
    let values = values * (1.0 - step.decay) - mean.clone() / root * step.rate;
    (values, mean, square)
}
