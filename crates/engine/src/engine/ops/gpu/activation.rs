//! GELU and SwiGLU, element by element.
#![allow(unsafe_code)]
// `erf` is the kernels' own; the standard library has none yet.
#![allow(unstable_name_collisions)]

use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::{Kernel, Saved, UNITS, cubes, empty};

fn total(x: &CubeTensor) -> usize {
    x.meta.shape().iter().product()
}

fn like(x: &CubeTensor) -> CubeTensor {
    let shape: Vec<usize> = x.meta.shape().iter().copied().collect();
    empty(x, &shape)
}

/// `x Phi(x)`.
#[derive(Debug)]
pub struct Gelu;

#[cube(launch_unchecked)]
fn gelu(x: &Tensor<f32>, y: &mut Tensor<f32>, total: u32) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let value = x[ABSOLUTE_POS];
    y[ABSOLUTE_POS] = value * 0.5 * (1.0 + (value * core::f32::consts::FRAC_1_SQRT_2).erf());
}

/// `Phi(x) + x phi(x)`, times the gradient of the output.
#[cube(launch_unchecked)]
fn gelu_gradient(x: &Tensor<f32>, dy: &Tensor<f32>, dx: &mut Tensor<f32>, total: u32) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let value = x[ABSOLUTE_POS];
    let share = 0.5 * (1.0 + (value * core::f32::consts::FRAC_1_SQRT_2).erf());
    // 1 / sqrt(2 pi)
    let density = (0.0 - 0.5 * value * value).exp() * 0.398_942_3;
    dx[ABSOLUTE_POS] = dy[ABSOLUTE_POS] * (share + value * density);
}

impl Kernel for Gelu {
    fn forward(&self, [x, _]: [&CubeTensor; 2]) -> Saved {
        let (y, total) = (like(x), total(x));
        // SAFETY: units stay below the size of both arrays.
        unsafe {
            gelu::launch_unchecked(
                &x.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                x.clone().into_tensor_arg(),
                y.clone().into_tensor_arg(),
                total as u32,
            );
        }
        Saved::output(y)
    }

    fn backward(
        &self,
        [x, _]: [&CubeTensor; 2],
        _: &Saved,
        dy: CubeTensor,
        _: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let (dx, total) = (like(x), total(x));
        // SAFETY: as in `forward`.
        unsafe {
            gelu_gradient::launch_unchecked(
                &x.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                x.clone().into_tensor_arg(),
                dy.into_tensor_arg(),
                dx.clone().into_tensor_arg(),
                total as u32,
            );
        }
        [Some(dx), None]
    }
}

/// `silu(gate) * value`.
#[derive(Debug)]
pub struct SwiGlu;

#[cube(launch_unchecked)]
fn swiglu(gate: &Tensor<f32>, value: &Tensor<f32>, y: &mut Tensor<f32>, total: u32) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let gate = gate[ABSOLUTE_POS];
    y[ABSOLUTE_POS] = gate / (1.0 + (-gate).exp()) * value[ABSOLUTE_POS];
}

#[cube(launch_unchecked)]
fn swiglu_gradient(
    gate: &Tensor<f32>,
    value: &Tensor<f32>,
    dy: &Tensor<f32>,
    dgate: &mut Tensor<f32>,
    dvalue: &mut Tensor<f32>,
    total: u32,
) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let gate = gate[ABSOLUTE_POS];
    let above = dy[ABSOLUTE_POS];
    let open = 1.0 / (1.0 + (-gate).exp());
    dgate[ABSOLUTE_POS] = above * value[ABSOLUTE_POS] * open * (1.0 + gate * (1.0 - open));
    dvalue[ABSOLUTE_POS] = above * gate * open;
}

impl Kernel for SwiGlu {
    fn forward(&self, [gate, value]: [&CubeTensor; 2]) -> Saved {
        let (y, total) = (like(gate), total(gate));
        // SAFETY: units stay below the size that all arrays share.
        unsafe {
            swiglu::launch_unchecked(
                &gate.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                gate.clone().into_tensor_arg(),
                value.clone().into_tensor_arg(),
                y.clone().into_tensor_arg(),
                total as u32,
            );
        }
        Saved::output(y)
    }

    fn backward(
        &self,
        [gate, value]: [&CubeTensor; 2],
        _: &Saved,
        dy: CubeTensor,
        _: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let (dgate, dvalue, total) = (like(gate), like(gate), total(gate));
        // SAFETY: as in `forward`.
        unsafe {
            swiglu_gradient::launch_unchecked(
                &gate.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                gate.clone().into_tensor_arg(),
                value.clone().into_tensor_arg(),
                dy.into_tensor_arg(),
                dgate.clone().into_tensor_arg(),
                dvalue.clone().into_tensor_arg(),
                total as u32,
            );
        }
        [Some(dgate), Some(dvalue)]
    }
}
