//! The optimizer's step in one pass, with a norm that the host has not seen.
#![allow(unsafe_code)]

use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::super::AdamWStep;
use super::{UNITS, cubes, primitive};

#[cube(launch_unchecked)]
fn step_kernel(
    values: &mut Tensor<f32>,
    gradient: &Tensor<f32>,
    means: &mut Tensor<f32>,
    squares: &mut Tensor<f32>,
    norm: &Tensor<f32>,
    total: u32,
    clip: f32,
    beta1: f32,
    learn1: f32,
    beta2: f32,
    learn2: f32,
    epsilon: f32,
    keep: f32,
    rate: f32,
    correction: f32,
) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let norm = norm[0];
    // An exponent of ones: infinity, or not a number. Such a step changes nothing.
    if (u32::reinterpret(norm) & 0x7f80_0000) == 0x7f80_0000 {
        terminate!();
    }
    let mut scale = f32::new(1.0);
    if clip > 0.0 && clip < norm + 1e-6 {
        scale = clip / (norm + 1e-6);
    }
    let gradient = gradient[ABSOLUTE_POS] * scale;
    let mean = means[ABSOLUTE_POS] * beta1 + gradient * learn1;
    let square = squares[ABSOLUTE_POS] * beta2 + gradient * gradient * learn2;
    means[ABSOLUTE_POS] = mean;
    squares[ABSOLUTE_POS] = square;
    values[ABSOLUTE_POS] =
        values[ABSOLUTE_POS] * keep - mean / (square.sqrt() * correction + epsilon) * rate;
}

/// An array to write to: itself where nobody else has it.
fn own(tensor: burn::tensor::Tensor<1>) -> CubeTensor {
    let tensor = primitive(tensor);
    if tensor.can_mut() {
        tensor
    } else {
        tensor.copy()
    }
}

/// One AdamW step; where `norm`, of all gradients, is not finite, nothing changes.
pub fn adamw(
    values: burn::tensor::Tensor<1>,
    gradient: burn::tensor::Tensor<1>,
    mean: burn::tensor::Tensor<1>,
    square: burn::tensor::Tensor<1>,
    norm: &burn::tensor::Tensor<1>,
    step: AdamWStep,
) -> (
    burn::tensor::Tensor<1>,
    burn::tensor::Tensor<1>,
    burn::tensor::Tensor<1>,
) {
    let [total] = values.dims();
    let [values, mean, square] = [values, mean, square].map(own);
    let [beta1, beta2] = step.betas.map(|beta| beta as f32);
    let [learn1, learn2] = step.betas.map(|beta| (1.0 - beta) as f32);
    // SAFETY: units stay below the size that the arrays of one parameter share.
    unsafe {
        step_kernel::launch_unchecked(
            &values.client,
            cubes(total),
            CubeDim::new_1d(UNITS),
            values.clone().into_tensor_arg(),
            primitive(gradient).into_tensor_arg(),
            mean.clone().into_tensor_arg(),
            square.clone().into_tensor_arg(),
            primitive(norm.clone()).into_tensor_arg(),
            total as u32,
            step.clip.unwrap_or(0.0) as f32,
            beta1,
            learn1,
            beta2,
            learn2,
            step.epsilon as f32,
            (1.0 - step.decay) as f32,
            step.rate as f32,
            step.square_correction as f32,
        );
    }
    let [values, mean, square] =
        [values, mean, square].map(burn::tensor::Tensor::from_primitive::<CubeBackend>);
    (values, mean, square)
}
