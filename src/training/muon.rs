//! Muon: the momentum of a matrix, made orthogonal before it is a step (Jordan et al. 2024; scaled as by Liu et al. 2025,
//! arXiv 2502.16982, so that learning rate and weight decay are those of AdamW). Not in the paper.

use burn::tensor::Tensor;

use crate::engine::ops;

/// How much of the momentum is kept from step to step.
const MOMENTUM: f64 = 0.95;

/// Rounds of the Newton-Schulz iteration, and the coefficients of its odd polynomial of degree five: singular values between 0.001
/// and 1 end between 0.7 and 1.2.
const ROUNDS: usize = 5;
const COEFFICIENTS: (f64, f64, f64) = (3.4445, -4.7750, 2.0315);

/// Root mean square of a step at learning rate 1: about that of AdamW.
const SCALE: f64 = 0.2;

/// How many matrices of one kind the parameter `name` of this shape holds, stacked over its rows, if Muon is for it: the matrices
/// inside blocks. Tables of embeddings, heads, norms, biases and convolutions are not.
#[must_use]
pub fn matrices(name: &str, shape: &[usize]) -> Option<usize> {
    let in_a_block = name.split('.').any(|part| part.parse::<u32>().is_ok());
    if !in_a_block || shape.len() != 2 || !name.ends_with(".weight") {
        return None;
    }
    let stacked = match name.rsplit('.').nth(1) {
        Some("qkv") => 3,
        Some("kv") => 2,
        _ => 1,
    };
    shape[0].is_multiple_of(stacked).then_some(stacked)
}

/// One step of one parameter, `[rows, columns]` flat: its new values and momentum. `decay` is learning rate times weight decay.
#[must_use]
pub fn step(
    values: Tensor<1>,
    gradient: Tensor<1>,
    momentum: Tensor<1>,
    shape: [usize; 2],
    matrices: usize,
    rate: f64,
    decay: f64,
) -> (Tensor<1>, Tensor<1>) {
    let momentum = momentum * MOMENTUM + gradient.clone() * (1.0 - MOMENTUM);
    // Nesterov: where the momentum will be after the same gradient once more.
    let ahead = momentum.clone() * MOMENTUM + gradient * (1.0 - MOMENTUM);
    let [rows, columns] = shape;
    let each = rows / matrices;
    let scale = SCALE * (each.max(columns) as f64).sqrt();
    let steps = ahead
        .reshape([rows, columns])
        .chunk(matrices, 0)
        .into_iter()
        .map(orthogonal)
        .collect();
    let step = Tensor::cat(steps, 0).reshape([rows * columns]);
    (values * (1.0 - decay) - step * (rate * scale), momentum)
}

/// The orthogonal matrix nearest to `x`, about: its singular vectors, with singular values near 1. Zeros stay zeros.
fn orthogonal(x: Tensor<2>) -> Tensor<2> {
    let [rows, columns] = x.dims();
    let tall = rows > columns;
    let x = if tall { x.transpose() } else { x };
    let norm = x.clone().square().sum().sqrt() + 1e-7;
    let mut x = x / norm.reshape([1, 1]);
    let (a, b, c) = COEFFICIENTS;
    for _ in 0..ROUNDS {
        let squared = ops::linear(x.clone(), x.clone(), None);
        let polynomial = squared.clone() * b + ops::linear(squared.clone(), squared, None) * c;
        x = x.clone() * a + ops::linear(polynomial, x.transpose(), None);
    }
    if tall { x.transpose() } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::nn::Linear;

    #[test]
    fn singular_values_come_near_one_and_zeros_stay() {
        let compute = Compute::cpu();
        for (rows, columns) in [(6, 24), (24, 6), (12, 12)] {
            let layer = Linear::new(&Initialise::new(&compute, 3), columns, rows, false);
            let x = orthogonal(layer.weight.untracked().reshape([rows, columns]));
            let gram = if rows > columns {
                x.clone().transpose().matmul(x)
            } else {
                x.clone().matmul(x.transpose())
            };
            let side = rows.min(columns);
            let gram = crate::engine::parameters::to_host(gram);
            // The sum of squared singular values, and that of their fourth powers.
            let trace: f32 = (0..side).map(|i| gram[i * side + i]).sum();
            let fourth: f32 = gram.iter().map(|v| v * v).sum();
            let (mean, square) = (trace / side as f32, fourth / side as f32);
            assert!((0.6..1.3).contains(&mean), "{rows} x {columns}: {mean}");
            assert!(square - mean * mean < 0.2, "{rows} x {columns}: {square}");
        }
        let zeros = orthogonal(Tensor::zeros([3, 5], compute.device()));
        assert_eq!(zeros.abs().sum().into_scalar::<f32>(), 0.0);
    }

    #[test]
    fn matrices_of_blocks_alone_are_taken() {
        assert_eq!(matrices("encoder.3.attn.qkv.weight", &[36, 12]), Some(3));
        assert_eq!(matrices("decoder.0.cross.kv.weight", &[24, 12]), Some(2));
        assert_eq!(matrices("encoder.0.mlp.fc1.weight", &[32, 12]), Some(1));
        assert_eq!(matrices("encoder.0.norm1.weight", &[12]), None);
        assert_eq!(
            matrices("encoder_embeddings.rgb.token_emb.weight", &[9, 4]),
            None
        );
        assert_eq!(matrices("down.0.conv.weight", &[4, 4, 3, 3, 3]), None);
    }
}
