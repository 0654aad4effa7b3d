//! A codebook where its model computes, on a device: the steps of the host in f32, and nobody waits for them.
//!
//! Suffixes: `M` latents of the batch, `K` codes, `L` code width.

use burn::tensor::{Device, Int, Tensor, TensorData};
use rand::RngExt;
use rand::seq::index;

use super::{Quantizer, QuantizerSettings};
use crate::engine::ops::Norm;
use crate::engine::{Parameter, Reading};
use crate::random::stream;

/// Latents compared with all codes at a time: as many rows of scores are held.
const ROWS: usize = 4096;

/// The nearest code of each latent of a batch.
#[derive(Debug, Clone)]
pub struct DeviceAssignment {
    /// `[M]`.
    pub ids: Tensor<1, Int>,
    /// The latents at unit length.
    pub unit_ML: Tensor<2>,
}

impl DeviceAssignment {
    /// Several, one after the other.
    #[must_use]
    pub fn joined(all: Vec<Self>) -> Self {
        let (ids, units) = all.into_iter().map(|one| (one.ids, one.unit_ML)).unzip();
        Self {
            ids: Tensor::cat(ids, 0),
            unit_ML: Tensor::cat(units, 0),
        }
    }
}

/// Scales each row to unit length; a row shorter than 1e-12 is divided by that.
fn unit(x_ML: Tensor<2>) -> Tensor<2> {
    let length_M1 = x_ML.clone().square().sum_dim(1).sqrt();
    x_ML / length_M1.clamp_min(1e-12)
}

/// Pieces of at most [`ROWS`] of so many rows: where each starts, and its length.
fn pieces(rows: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..rows)
        .step_by(ROWS)
        .map(move |start| (start, ROWS.min(rows - start)))
}

/// Rows of the pool for as many dead codes as there may be, which the host does not know: the first dead code takes the first, and so
/// on. Drawn for `(seed, step)`, without repetition while there are enough.
fn replacements(codes: usize, rows: usize, seed: u64, step: u64) -> Vec<i64> {
    let mut random = stream(seed, "quantizer.dead_codes", step, 0);
    let mut drawn = index::sample(&mut random, rows, codes.min(rows)).into_vec();
    while drawn.len() < codes {
        drawn.push(random.random_range(0..rows));
    }
    drawn.into_iter().map(|row| row as i64).collect()
}

impl Quantizer {
    /// As [`Quantizer::assign`], of latents `[M, L]` on a device, with their codes as stored `[M, L]`.
    #[must_use]
    pub fn assign_on_device(&self, z_ML: Tensor<2>) -> (Tensor<2>, DeviceAssignment) {
        let unit_ML = unit(z_ML.without_autodiff());
        let embed_KL = self.state.embed.tensor::<2>();
        let towards_LK = unit(embed_KL.clone()).transpose();
        let ids = pieces(unit_ML.dims()[0]).map(|(start, rows)| {
            let scores_MK = unit_ML
                .clone()
                .narrow(0, start, rows)
                .matmul(towards_LK.clone());
            scores_MK.argmax(1).reshape([rows])
        });
        let ids = Tensor::cat(ids.collect(), 0);
        (
            embed_KL.select(0, ids.clone()),
            DeviceAssignment { ids, unit_ML },
        )
    }

    /// Counts `[K, 1]` and sums `[K, L]` of unit latents per code.
    fn sums_on_device(&self, batch: &DeviceAssignment) -> [Tensor<2>; 2] {
        let device = batch.unit_ML.device();
        let codes = self.settings.codebook;
        let numbers: Tensor<2, Int> = Tensor::arange(0..codes as i64, &device).reshape([1, codes]);
        let parts = pieces(batch.unit_ML.dims()[0]).map(|(start, rows)| {
            let ids_M1 = batch.ids.clone().narrow(0, start, rows).reshape([rows, 1]);
            let taken_MK = ids_M1
                .expand([rows, codes])
                .equal(numbers.clone().expand([rows, codes]));
            let taken_KM = taken_MK.float().transpose();
            let unit_ML = batch.unit_ML.clone().narrow(0, start, rows);
            [taken_KM.clone().sum_dim(1), taken_KM.matmul(unit_ML)]
        });
        let sum = parts.reduce(|[n, sum], [more, further]| [n + more, sum + further]);
        sum.expect("a batch has latents")
    }

    /// As [`Quantizer::update`] after [`Quantizer::sums`], of latents on a device; gives how many codes were replaced. Which latents replace
    /// them is drawn otherwise than on the host, since nobody there knows how many are needed. Nothing changes where the device has the `norm`
    /// of the step's gradient, and it is not finite.
    pub fn update_on_device(
        &mut self,
        batch: &DeviceAssignment,
        norm: &Norm,
        seed: u64,
        step: u64,
    ) -> Reading {
        let QuantizerSettings {
            codebook: codes,
            code_width: width,
            decay,
            dead_below,
            ..
        } = self.settings;
        let [n_K1, sums_KL] = self.sums_on_device(batch);
        let old_K1 = self.state.cluster_size.reshaped([codes, 1]);
        let old_KL = self.state.embed.tensor::<2>();
        let counts_K1 = old_K1.clone() * decay + n_K1.clone() * (1.0 - decay);
        let used_KL = n_K1.clone().greater_elem(0.0).expand([codes, width]);
        let means_KL = sums_KL / n_K1.clamp_min(1.0);
        let target_KL = unit(old_KL.clone().mask_where(used_KL, means_KL));
        let moved_KL = old_KL.clone() * decay + target_KL * (1.0 - decay);

        let dead_K1 = counts_K1.clone().lower_elem(dead_below);
        let device = batch.unit_ML.device();
        let rows = replacements(codes, batch.unit_ML.dims()[0], seed, step);
        let rows = integers(rows, &device);
        // The place of each code among the dead ones.
        let place_K = (dead_K1.clone().int().reshape([codes]).cumsum(0) - 1).clamp_min(0);
        let fresh_KL = batch.unit_ML.clone().select(0, rows.select(0, place_K));
        let codes_KL = moved_KL.mask_where(dead_K1.clone().expand([codes, width]), fresh_KL);

        let keep = |new: Tensor<2>, old: Tensor<2>| match norm {
            Norm::Host(_) => new,
            Norm::Device(norm) => {
                let finite = norm.clone().is_finite().reshape([1, 1]);
                old.clone().mask_where(finite.expand(old.dims()), new)
            }
        };
        put(&mut self.state.cluster_size, keep(counts_K1, old_K1));
        put(&mut self.state.embed, keep(codes_KL, old_KL));
        Reading::of([dead_K1.int().sum().float()])
    }
}

fn integers(values: Vec<i64>, device: &Device) -> Tensor<1, Int> {
    let length = values.len();
    Tensor::from_data(TensorData::new(values, [length]), device)
}

fn put(parameter: &mut Parameter, values: Tensor<2>) {
    let length = parameter.len();
    parameter.put(values.reshape([length]), false);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, DeviceChoice, DeviceKind, Initialise, Precision};

    /// The processor, whose tensors take the same way, and a GPU, in hardware or played.
    fn devices() -> Vec<Compute> {
        let mut all = vec![Compute::cpu()];
        match Compute::new(DeviceChoice::first(DeviceKind::Wgpu), Precision::F32) {
            Ok(gpu) => all.push(gpu),
            Err(error) => eprintln!("skipped: on a GPU: {error}"),
        }
        all
    }

    fn quantizer(compute: &Compute, dead_below: f64) -> Quantizer {
        let settings = QuantizerSettings {
            codebook: 12,
            code_width: 4,
            dead_below,
            ..QuantizerSettings::default()
        };
        Quantizer::new(&Initialise::new(compute, 5), &settings)
    }

    fn latents(count: usize, phase: f32) -> Vec<f32> {
        (0..count * 4)
            .map(|i| (i as f32 * 1.7 + phase).sin())
            .collect()
    }

    fn tensor(values: &[f32], compute: &Compute) -> Tensor<2> {
        let data = TensorData::new(values.to_vec(), [values.len() / 4, 4]);
        Tensor::from_data(data, compute.device())
    }

    fn norm(value: f32, compute: &Compute) -> Norm {
        Norm::Device(Tensor::from_floats([value], compute.device()))
    }

    fn close(found: &[f32], expected: &[f32]) -> bool {
        found.len() == expected.len()
            && found
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-5)
    }

    #[test]
    fn codes_that_are_used_move_as_on_the_host() {
        for compute in devices() {
            let mut here = quantizer(&Compute::cpu(), 0.0);
            let mut there = quantizer(&compute, 0.0);
            for step in 0..5 {
                let batch = latents(40, step as f32);
                let expected = here.assign(batch.clone());
                let sums = here.sums(&expected);
                here.update(&sums, &expected.unit, 1, step);
                let (_, found) = there.assign_on_device(tensor(&batch, &compute));
                let ids: Vec<i64> = found.ids.to_data().iter::<i64>().collect();
                let expected: Vec<i64> = expected.ids.iter().map(|id| i64::from(*id)).collect();
                assert_eq!(ids, expected);
                let replaced = there.update_on_device(&found, &norm(1.0, &compute), 1, step);
                assert_eq!(replaced.read(), [0.0]);
                assert!(close(&there.counts(), &here.counts()), "step {step}");
                assert!(close(&there.codes(), &here.codes()), "step {step}");
            }
        }
    }

    #[test]
    fn dead_codes_become_different_latents_of_the_batch() {
        for compute in devices() {
            let mut quantizer = quantizer(&compute, 2.0);
            let (codes, batch) = quantizer.assign_on_device(tensor(&latents(30, 0.0), &compute));
            assert_eq!(codes.dims(), [30, 4]);
            let replaced = quantizer.update_on_device(&batch, &Norm::Host(1.0), 3, 7);
            assert_eq!(replaced.read(), [12.0]);
            let pool = crate::engine::parameters::to_host(batch.unit_ML.clone());
            let codes = quantizer.codes();
            for (k, code) in codes.chunks_exact(4).enumerate() {
                assert!(pool.chunks_exact(4).any(|row| row == code), "{k}");
                assert!(codes.chunks_exact(4).skip(k + 1).all(|other| other != code));
            }
            // A few latents for many codes are taken again.
            let (_, few) = quantizer.assign_on_device(tensor(&latents(5, 1.0), &compute));
            assert_eq!(
                quantizer
                    .update_on_device(&few, &Norm::Host(1.0), 3, 8)
                    .read(),
                [12.0]
            );
        }
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        for compute in devices() {
            let mut quantizer = quantizer(&compute, 2.0);
            let before = (quantizer.counts(), quantizer.codes());
            let (_, batch) = quantizer.assign_on_device(tensor(&latents(30, 0.0), &compute));
            for bad in [f32::NAN, f32::INFINITY] {
                let _ = quantizer.update_on_device(&batch, &norm(bad, &compute), 0, 0);
                assert!((quantizer.counts(), quantizer.codes()) == before, "{bad}");
            }
        }
    }
}
