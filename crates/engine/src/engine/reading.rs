//! Numbers that a device may not have computed yet.
//!
//! Reading one waits for everything before it. A training step leaves its losses where they are, and those of several steps are read at
//! once; on the processor they are known at once.

use burn::tensor::Tensor;

use super::ops::{self, Norm};
use super::parameters::to_host;

/// Some numbers, where they are.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "a few a step; a box would only be another place to look"
)]
pub enum Reading {
    /// On the processor: known.
    Host(Vec<f64>),
    /// On a device, `[numbers]`.
    Device(Tensor<1>),
}

impl Reading {
    /// The values of `numbers`, of one element each and all on one device, in this order.
    #[must_use]
    pub fn of(numbers: impl IntoIterator<Item = Tensor<1>>) -> Self {
        let numbers = numbers.into_iter().map(Tensor::without_autodiff);
        let numbers: Vec<Tensor<1>> = numbers.collect();
        if numbers.iter().all(ops::on_processor) {
            let known = numbers.into_iter().flat_map(to_host);
            return Self::Host(known.map(f64::from).collect());
        }
        Self::Device(Tensor::cat(numbers, 0))
    }

    /// What is known without waiting.
    #[must_use]
    pub fn known(&self) -> Option<&[f64]> {
        match self {
            Self::Host(numbers) => Some(numbers),
            Self::Device(_) => None,
        }
    }

    /// Reads the numbers.
    #[must_use]
    pub fn read(&self) -> Vec<f64> {
        match self {
            Self::Host(numbers) => numbers.clone(),
            Self::Device(numbers) => to_host(numbers.clone())
                .into_iter()
                .map(f64::from)
                .collect(),
        }
    }

    /// Reads several, all on one device, waiting once.
    #[must_use]
    pub fn read_all(readings: &[&Self]) -> Vec<Vec<f64>> {
        let on_device = readings.iter().filter_map(|reading| match reading {
            Self::Host(_) => None,
            Self::Device(numbers) => Some(numbers.clone()),
        });
        let on_device: Vec<Tensor<1>> = on_device.collect();
        let mut read = if on_device.is_empty() {
            Vec::new()
        } else {
            to_host(Tensor::cat(on_device, 0))
        }
        .into_iter();
        let each = readings.iter().map(|reading| match reading {
            Self::Host(numbers) => numbers.clone(),
            Self::Device(numbers) => {
                let count = numbers.dims()[0];
                read.by_ref().take(count).map(f64::from).collect()
            }
        });
        each.collect()
    }
}

impl From<Norm> for Reading {
    fn from(norm: Norm) -> Self {
        match norm {
            Norm::Host(norm) => Self::Host(vec![norm]),
            Norm::Device(norm) => Self::Device(norm),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, DeviceChoice, DeviceKind, Precision};

    #[test]
    fn numbers_of_the_processor_are_known_and_several_readings_keep_their_order() {
        let mut devices = vec![Compute::cpu()];
        let gpu = DeviceChoice::first(DeviceKind::Wgpu);
        match Compute::new(gpu, Precision::F32) {
            Ok(gpu) => devices.push(gpu),
            Err(error) => eprintln!("skipped: on a GPU: {error}"),
        }
        for compute in devices {
            let one = |value: f32| Tensor::<1>::from_floats([value], compute.device());
            let (a, b) = (
                Reading::of([one(1.5), one(f32::NAN)]),
                Reading::of([one(-2.0)]),
            );
            let here = compute.choice() == DeviceChoice::CPU;
            assert_eq!(b.known().is_some(), here);
            let host = Reading::Host(vec![7.0]);
            let read = Reading::read_all(&[&a, &host, &b, &Reading::of([])]);
            assert_eq!(read[0][0], 1.5);
            assert!(read[0][1].is_nan());
            assert_eq!(read[1..], [vec![7.0], vec![-2.0], vec![]]);
            assert_eq!(b.read(), [-2.0]);
        }
    }
}
