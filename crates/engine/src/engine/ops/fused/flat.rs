//! Passes over flat parameters: the optimizer's step, and norms of gradients.

use burn::backend::Flex;
use burn::tensor::Tensor;
use burn_flex::FlexTensor;
use rayon::prelude::*;

use super::super::AdamWStep;
use super::{Array, vector};

/// Elements per task.
const ELEMENTS: usize = 16 * 1024;

fn flex(tensor: Tensor<1>) -> FlexTensor {
    tensor
        .try_into_primitive::<Flex>()
        .expect("the front door lets only arrays of the CPU in")
}

pub(super) fn host(tensor: Tensor<1>) -> FlexTensor {
    flex(tensor).to_contiguous()
}

/// An array to be read; it may be a part of another.
fn read(tensor: Tensor<1>) -> Array {
    let tensor = flex(tensor);
    if tensor.is_contiguous() {
        Array(tensor)
    } else {
        Array::dense(&tensor)
    }
}

/// One AdamW step in one pass; in place where the arrays are not shared.
pub fn adamw(
    values: Tensor<1>,
    gradient: Tensor<1>,
    mean: Tensor<1>,
    square: Tensor<1>,
    scale: f64,
    step: AdamWStep,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    let [mut values, mut mean, mut square] = [values, mean, square].map(host);
    let gradient = read(gradient);
    let [beta1, beta2] = step.betas.map(|beta| beta as f32);
    let [learn1, learn2] = step.betas.map(|beta| (1.0 - beta) as f32);
    let (scale, epsilon, keep) = (scale as f32, step.epsilon as f32, (1.0 - step.decay) as f32);
    let (rate, correction) = (step.rate as f32, step.square_correction as f32);
    values
        .storage_mut::<f32>()
        .par_chunks_mut(ELEMENTS)
        .zip(mean.storage_mut::<f32>().par_chunks_mut(ELEMENTS))
        .zip(square.storage_mut::<f32>().par_chunks_mut(ELEMENTS))
        .zip(gradient.values().par_chunks(ELEMENTS))
        .for_each(|(((values, means), squares), gradients)| {
            vector::vectorised(
                #[inline(always)]
                || {
                    let moments = means.iter_mut().zip(squares);
                    for ((value, (mean, square)), gradient) in
                        values.iter_mut().zip(moments).zip(gradients)
                    {
                        let gradient = gradient * scale;
                        *mean = *mean * beta1 + gradient * learn1;
                        *square = *square * beta2 + gradient * gradient * learn2;
                        *value =
                            *value * keep - *mean / (square.sqrt() * correction + epsilon) * rate;
                    }
                },
            );
        });
    let [values, mean, square] = [values, mean, square].map(Tensor::from_primitive::<Flex>);
    (values, mean, square)
}

/// The sum of squares: in f32 within tasks, in f64 over them.
pub fn sum_of_squares(x: Tensor<1>) -> f64 {
    let x = read(x);
    let partial: Vec<f64> = x
        .values()
        .par_chunks(ELEMENTS)
        .map(|chunk| {
            vector::vectorised(
                #[inline(always)]
                || f64::from(vector::dot(chunk, chunk)),
            )
        })
        .collect();
    partial.iter().sum()
}
