//! Rows to mean 0 and variance 1, the heart of a layer norm: a cube per row.
#![allow(unsafe_code)]

use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::{Kernel, Saved, empty, sides};

/// Units that share a row.
const SHARED_BY: u32 = 64;
/// Rows along the first axis of the grid.
const ACROSS: u32 = 32_768;

#[derive(Debug)]
pub struct Standardise {
    /// Added to the variance.
    pub epsilon: f32,
}

/// What every unit brought, added up in their order.
#[cube]
fn together(own: f32, shared: &mut Shared<[f32]>, unit: usize, #[comptime] units: usize) -> f32 {
    // Others may still read what was added up before.
    sync_cube();
    shared[unit] = own;
    sync_cube();
    let mut sum = f32::new(0.0);
    for other in 0..units {
        sum += shared[other];
    }
    sum
}

#[cube(launch_unchecked)]
fn standardise(
    x: &Tensor<f32>,
    y: &mut Tensor<f32>,
    scales: &mut Tensor<f32>,
    rows: u32,
    width: u32,
    epsilon: f32,
    #[comptime] units: usize,
) {
    let row = (CUBE_POS_Y * ACROSS + CUBE_POS_X) as usize;
    if row >= rows as usize {
        terminate!();
    }
    let unit = UNIT_POS_X as usize;
    let width = width as usize;
    let start = row * width;
    let mut shared = Shared::<[f32]>::new_slice(units);
    let mut sum = f32::new(0.0);
    let mut column = unit;
    while column < width {
        sum += x[start + column];
        column += units;
    }
    let mean = together(sum, &mut shared, unit, units) / f32::cast_from(width);
    let mut squares = f32::new(0.0);
    let mut column = unit;
    while column < width {
        let off = x[start + column] - mean;
        squares += off * off;
        column += units;
    }
    let variance = together(squares, &mut shared, unit, units) / f32::cast_from(width);
    let scale = 1.0 / (variance + epsilon).sqrt();
    if unit == 0 {
        scales[row] = scale;
    }
    let mut column = unit;
    while column < width {
        y[start + column] = (x[start + column] - mean) * scale;
        column += units;
    }
}

#[cube(launch_unchecked)]
fn gradient(
    y: &Tensor<f32>,
    dy: &Tensor<f32>,
    scales: &Tensor<f32>,
    dx: &mut Tensor<f32>,
    rows: u32,
    width: u32,
    #[comptime] units: usize,
) {
    let row = (CUBE_POS_Y * ACROSS + CUBE_POS_X) as usize;
    if row >= rows as usize {
        terminate!();
    }
    let unit = UNIT_POS_X as usize;
    let width = width as usize;
    let start = row * width;
    let mut shared = Shared::<[f32]>::new_slice(units);
    let mut sum = f32::new(0.0);
    let mut along = f32::new(0.0);
    let mut column = unit;
    while column < width {
        let above = dy[start + column];
        sum += above;
        along += above * y[start + column];
        column += units;
    }
    let mean = together(sum, &mut shared, unit, units) / f32::cast_from(width);
    let along = together(along, &mut shared, unit, units) / f32::cast_from(width);
    let scale = scales[row];
    let mut column = unit;
    while column < width {
        let at = start + column;
        dx[at] = (dy[at] - mean - y[at] * along) * scale;
        column += units;
    }
}

fn grid(rows: usize) -> CubeCount {
    let rows = rows as u32;
    CubeCount::Static(rows.clamp(1, ACROSS), rows.div_ceil(ACROSS).max(1), 1)
}

impl Kernel for Standardise {
    fn forward(&self, [x, _]: [&CubeTensor; 2]) -> Saved {
        let [rows, width] = sides(x);
        let (y, scales) = (empty(x, &[rows, width]), empty(x, &[rows]));
        // SAFETY: a cube per row, whose units stay below the width.
        unsafe {
            standardise::launch_unchecked(
                &x.client,
                grid(rows),
                CubeDim::new_1d(SHARED_BY),
                x.clone().into_tensor_arg(),
                y.clone().into_tensor_arg(),
                scales.clone().into_tensor_arg(),
                rows as u32,
                width as u32,
                self.epsilon,
                SHARED_BY as usize,
            );
        }
        Saved {
            output: y,
            normalisers: Some(scales),
        }
    }

    fn backward(
        &self,
        [x, _]: [&CubeTensor; 2],
        saved: &Saved,
        dy: CubeTensor,
        _: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let [rows, width] = sides(x);
        let dx = empty(x, &[rows, width]);
        let scales = saved
            .normalisers
            .as_ref()
            .expect("forward of a norm leaves them");
        // SAFETY: as in `forward`.
        unsafe {
            gradient::launch_unchecked(
                &x.client,
                grid(rows),
                CubeDim::new_1d(SHARED_BY),
                saved.output.clone().into_tensor_arg(),
                dy.into_tensor_arg(),
                scales.clone().into_tensor_arg(),
                dx.clone().into_tensor_arg(),
                rows as u32,
                width as u32,
                SHARED_BY as usize,
            );
        }
        [Some(dx), None]
    }
}
