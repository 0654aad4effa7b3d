//! Sums of squares of gradients, without the host.
#![allow(unsafe_code)]

use burn_cubecl::CubeBackend;
use cubecl::prelude::*;

use super::{UNITS, empty, primitive};

/// Elements of a unit.
const EACH: u32 = 64;

#[cube(launch_unchecked)]
fn squares(
    x: &Tensor<f32>,
    sums: &mut Tensor<f32>,
    total: u32,
    each: u32,
    #[comptime] units: usize,
) {
    let unit = UNIT_POS_X as usize;
    let each = each as usize;
    let start = CUBE_POS_X as usize * units * each + unit;
    let mut sum = f32::new(0.0);
    for step in 0..each {
        let at = start + step * units;
        if at < total as usize {
            sum += x[at] * x[at];
        }
    }
    let mut shared = Shared::<[f32]>::new_slice(units);
    shared[unit] = sum;
    sync_cube();
    if unit == 0 {
        sum = f32::new(0.0);
        for other in 0..units {
            sum += shared[other];
        }
        sums[CUBE_POS_X as usize] = sum;
    }
}

/// The sum of squares of all elements, `[1]`, where `x` is.
pub fn sum_of_squares(x: burn::tensor::Tensor<1>) -> burn::tensor::Tensor<1> {
    let [total] = x.dims();
    let x = primitive(x);
    // A grid has at most 65 535 cubes along an axis.
    let mut each = EACH;
    while total.div_ceil((UNITS * each) as usize) > 65_535 {
        each *= 2;
    }
    let cubes = total.div_ceil((UNITS * each) as usize).max(1);
    let sums = empty(&x, &[cubes]);
    // SAFETY: elements of `x` are compared with its length; each cube writes its own element of `sums`.
    unsafe {
        squares::launch_unchecked(
            &x.client,
            CubeCount::Static(cubes as u32, 1, 1),
            CubeDim::new_1d(UNITS),
            x.clone().into_tensor_arg(),
            sums.clone().into_tensor_arg(),
            total as u32,
            each,
            UNITS as usize,
        );
    }
    super::super::sum(burn::tensor::Tensor::<1>::from_primitive::<CubeBackend>(
        sums,
    ))
}
