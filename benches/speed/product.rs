//! One large product of matrices, in the precision of everything else: what the device has at its best.

use crate::measure::Meter;
use reviv::engine::{Tensor, ops};

/// Rows, columns and what is added up.
const SIDE: usize = 4096;

pub fn run(meter: &Meter) {
    let compute = crate::compute();
    let matrix = |phase: f32| {
        let values = Tensor::arange(0..(SIDE * SIDE) as i64, compute.device()).float();
        (values * 0.37 + phase).sin().reshape([SIDE, SIDE])
    };
    let (a, b): (Tensor<2>, Tensor<2>) = (matrix(0.0), matrix(0.5));
    let flop = 2.0 * (SIDE as f64).powi(3);
    meter.measure_flop("product", Some(flop), || {
        let product = ops::linear_in(compute.precision(), a.clone(), b.clone(), None);
        // Waits for a device.
        std::hint::black_box(product.slice([0..1, 0..1]).into_data());
    });
}
