//! The codebook of the VQ-VAE tokenizers (Supp. A): codes near the unit sphere, compared by cosine, moved by running means.
//!
//! Always f32, whatever the model computes in. One training step is: [`Quantizer::assign`] latents to codes, sum them per code
//! ([`CodeSums`], which add up over processes), [`Quantizer::update`]; on a device the same without the host (`on_device`). Codes that fall out of use are replaced
//! by latents of the batch; because counts start at 0, that is also how a codebook comes to life.

mod on_device;

pub use on_device::DeviceAssignment;

use burn::tensor::{Tensor, TensorData};
use rand::RngExt;
use rand::seq::index;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::engine::ops::Norm;
use crate::engine::parameters::to_host;
use crate::engine::{Initialise, Parameter, Reading, ops, parameters};
use crate::random::{StreamRng, stream};

/// How a codebook learns.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct QuantizerSettings {
    /// How many codes there are: the vocabulary.
    pub codebook: usize,
    /// Values per code.
    pub code_width: usize,
    /// Decay of the running means of codes and counts.
    pub decay: f64,
    /// Codes with a smaller running count are replaced by latents of the batch.
    pub dead_below: f64,
    /// Weight of the loss that pulls latents to their codes.
    pub commitment: f64,
}

impl Default for QuantizerSettings {
    fn default() -> Self {
        Self {
            codebook: 512,
            code_width: 32,
            decay: 0.99,
            dead_below: 2.0,
            commitment: 1.0,
        }
    }
}

/// The codes and their running counts.
#[derive(Debug, Clone)]
pub struct Quantizer {
    state: State,
    settings: QuantizerSettings,
}

/// As named in released checkpoints.
#[derive(Debug, Clone)]
struct State {
    initted: Parameter,
    /// `[K]`, running count per batch.
    cluster_size: Parameter,
    /// `[K, L]`; norms drift slightly below 1, and decoding uses them as stored.
    embed: Parameter,
}
parameters!(State {
    initted,
    cluster_size,
    embed
});
parameters!(Quantizer { state => "_codebook" });

/// Which code each latent of a batch is nearest to.
#[derive(Debug, Clone, PartialEq)]
pub struct Assignment {
    /// `[M]`.
    pub ids: Vec<u32>,
    /// The latents at unit length, `[M, L]`.
    pub unit: Vec<f32>,
}

/// An assignment, where its latents were computed.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "one a micro-batch; a box would only be another place to look"
)]
pub enum Assigned {
    /// On the processor.
    Host(Assignment),
    /// On a device.
    Device(DeviceAssignment),
}

impl Assigned {
    /// On the host; waits for a device.
    #[must_use]
    pub fn to_host(&self) -> Assignment {
        match self {
            Self::Host(assignment) => assignment.clone(),
            Self::Device(batch) => Assignment {
                ids: batch.ids.to_data().iter::<u32>().collect(),
                unit: to_host(batch.unit_ML.clone()),
            },
        }
    }
}

/// Counts and sums of unit latents per code; they add up over processes.
#[derive(Debug, Clone, PartialEq)]
pub struct CodeSums {
    /// `[K]`.
    pub counts: Vec<f32>,
    /// `[K, L]`.
    pub sums: Vec<f32>,
}

/// What an update did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Update {
    /// The codes that were replaced, ascending.
    pub dead: Vec<usize>,
}

impl Quantizer {
    /// A fresh codebook: random directions, no counts.
    #[must_use]
    pub fn new(init: &Initialise<'_>, settings: &QuantizerSettings) -> Self {
        let init = init.at("_codebook");
        let (codes, width) = (settings.codebook, settings.code_width);
        let directions = || {
            let bound = (6.0 / width as f64).sqrt();
            let mut drawn = init.uniform("embed", &[codes, width], bound).to_vec();
            normalise(&mut drawn, width);
            drawn
        };
        Self {
            state: State {
                initted: init.fixed(&[1], || vec![1.0]),
                cluster_size: init.fixed(&[codes], || vec![0.0; codes]),
                embed: init.fixed(&[codes, width], directions),
            },
            settings: settings.clone(),
        }
    }

    /// What it was made with.
    #[must_use]
    pub fn settings(&self) -> &QuantizerSettings {
        &self.settings
    }

    /// The running counts, `[K]`.
    #[must_use]
    pub fn counts(&self) -> Vec<f32> {
        self.state.cluster_size.to_vec()
    }

    /// The codes as stored, `[K, L]`.
    #[must_use]
    pub fn codes(&self) -> Vec<f32> {
        self.state.embed.to_vec()
    }

    /// The nearest code (largest cosine) of each latent; `latents` is `[M, L]`.
    #[must_use]
    pub fn assign(&self, mut latents: Vec<f32>) -> Assignment {
        let width = self.settings.code_width;
        normalise(&mut latents, width);
        let mut codes = self.codes();
        normalise(&mut codes, width);
        Assignment {
            ids: ops::nearest(&latents, &codes, width),
            unit: latents,
        }
    }

    /// The nearest code of each latent `[M, L]`, and its values as stored, `[M, L]`.
    #[must_use]
    pub fn quantise(&self, z_ML: &Tensor<2>) -> (Tensor<2>, Assigned) {
        if !ops::on_processor(z_ML) {
            let (codes_ML, batch) = self.assign_on_device(z_ML.clone());
            return (codes_ML, Assigned::Device(batch));
        }
        let assignment = self.assign(to_host(z_ML.clone()));
        let data = TensorData::new(self.look_up(&assignment.ids), z_ML.dims());
        let device = self.state.embed.untracked().device();
        (Tensor::from_data(data, &device), Assigned::Host(assignment))
    }

    /// Moves the codes after a step, whose micro-batches were assigned like this; gives how many were replaced. Where all are on a device
    /// nobody waits for it, and nothing changes where the `norm` of the step's gradient is there and not finite.
    pub fn follow(&mut self, batches: Vec<Assigned>, norm: &Norm, seed: u64, step: u64) -> Reading {
        let mut on_device = Vec::new();
        for batch in &batches {
            if let Assigned::Device(batch) = batch {
                on_device.push(batch.clone());
            }
        }
        if !batches.is_empty() && on_device.len() == batches.len() {
            let batch = DeviceAssignment::joined(on_device);
            return self.update_on_device(&batch, norm, seed, step);
        }
        let mut whole = Assignment {
            ids: Vec::new(),
            unit: Vec::new(),
        };
        for batch in batches {
            let mut batch = batch.to_host();
            whole.ids.append(&mut batch.ids);
            whole.unit.append(&mut batch.unit);
        }
        let sums = self.sums(&whole);
        let update = self.update(&sums, &whole.unit, seed, step);
        Reading::Host(vec![update.dead.len() as f64])
    }

    /// The codes of `ids` as stored, `[M, L]`.
    ///
    /// # Panics
    /// When an id is outside the codebook.
    #[must_use]
    pub fn look_up(&self, ids: &[u32]) -> Vec<f32> {
        let width = self.settings.code_width;
        let codes = self.codes();
        ids.iter()
            .flat_map(|id| codes[*id as usize * width..][..width].iter().copied())
            .collect()
    }

    /// Counts and sums of one batch.
    #[must_use]
    pub fn sums(&self, assignment: &Assignment) -> CodeSums {
        let (codes, width) = (self.settings.codebook, self.settings.code_width);
        let mut counts = vec![0.0; codes];
        let mut sums = vec![0.0_f64; codes * width];
        for (id, unit) in assignment
            .ids
            .iter()
            .zip(assignment.unit.chunks_exact(width))
        {
            let id = *id as usize;
            counts[id] += 1.0;
            for (sum, value) in sums[id * width..][..width].iter_mut().zip(unit) {
                *sum += f64::from(*value);
            }
        }
        let sums = sums.into_iter().map(|sum| sum as f32).collect();
        CodeSums { counts, sums }
    }

    /// Moves the codes towards the means of their latents and replaces dead ones by rows of `pool`, unit latents `[rows, L]`,
    /// drawn for `(seed, step)`: without repetition while there are enough.
    pub fn update(&mut self, sums: &CodeSums, pool: &[f32], seed: u64, step: u64) -> Update {
        let rows = pool.len() / self.settings.code_width;
        self.update_from(sums, pool, |count| {
            let mut random = stream(seed, "quantizer.dead_codes", step, 0);
            draw_rows(&mut random, count, rows)
        })
    }

    /// As [`Quantizer::update`], with `choose(dead codes)` giving the rows of `pool` that take their places, in order.
    ///
    /// # Panics
    /// When `choose` gives too few rows or one outside the pool.
    pub fn update_from(
        &mut self,
        sums: &CodeSums,
        pool: &[f32],
        choose: impl FnOnce(usize) -> Vec<usize>,
    ) -> Update {
        let width = self.settings.code_width;
        let keep = self.settings.decay as f32;
        let learn = (1.0 - self.settings.decay) as f32;
        let (mut counts, mut codes) = (self.counts(), self.codes());
        let mut target = vec![0.0_f32; width];
        for (k, code) in codes.chunks_exact_mut(width).enumerate() {
            let n = sums.counts[k];
            counts[k] = keep * counts[k] + learn * n;
            if n > 0.0 {
                for (value, sum) in target.iter_mut().zip(&sums.sums[k * width..][..width]) {
                    *value = sum / n;
                }
            } else {
                target.copy_from_slice(code);
            }
            normalise(&mut target, width);
            for (value, towards) in code.iter_mut().zip(&target) {
                *value = keep * *value + learn * towards;
            }
        }
        let dead: Vec<usize> = counts
            .iter()
            .enumerate()
            .filter(|(_, count)| f64::from(**count) < self.settings.dead_below)
            .map(|(k, _)| k)
            .collect();
        if !dead.is_empty() && !pool.is_empty() {
            let rows = choose(dead.len());
            assert!(rows.len() >= dead.len(), "one row per dead code");
            for (k, row) in dead.iter().zip(rows) {
                codes[k * width..][..width].copy_from_slice(&pool[row * width..][..width]);
            }
        }
        self.state.cluster_size.set(counts);
        self.state.embed.set(codes);
        Update { dead }
    }
}

/// Scales each row of `width` values to unit length; rows shorter than 1e-12 stay what they are, divided by 1e-12.
pub fn normalise(rows: &mut [f32], width: usize) {
    for row in rows.chunks_exact_mut(width) {
        let square: f64 = row.iter().map(|value| f64::from(*value).powi(2)).sum();
        let scale = 1.0 / square.sqrt().max(1e-12);
        for value in row {
            *value = (f64::from(*value) * scale) as f32;
        }
    }
}

/// `count` of `rows` row numbers, without repetition if there are enough rows.
fn draw_rows(random: &mut StreamRng, count: usize, rows: usize) -> Vec<usize> {
    if count <= rows {
        index::sample(random, rows, count).into_vec()
    } else {
        (0..count).map(|_| random.random_range(0..rows)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Parameters};

    fn quantizer(codebook: usize) -> Quantizer {
        let compute = Compute::cpu();
        let settings = QuantizerSettings {
            codebook,
            code_width: 3,
            ..QuantizerSettings::default()
        };
        Quantizer::new(&Initialise::new(&compute, 5), &settings)
    }

    #[test]
    fn a_fresh_code_has_unit_length_and_finds_itself() {
        let quantizer = quantizer(7);
        let codes = quantizer.codes();
        for code in codes.chunks_exact(3) {
            let norm: f32 = code.iter().map(|value| value * value).sum();
            assert!((norm - 1.0).abs() < 1e-6);
        }
        let scaled = codes.iter().map(|value| value * 40.0).collect();
        assert_eq!(quantizer.assign(scaled).ids, [0, 1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn unused_codes_are_replaced_by_different_latents_and_counts_stay() {
        let mut quantizer = quantizer(4);
        let latents: Vec<f32> = (0..30).map(|i| (i as f32 * 1.7).sin()).collect();
        let assignment = quantizer.assign(latents);
        let sums = quantizer.sums(&assignment);
        assert_eq!(sums.counts.iter().sum::<f32>(), 10.0);
        let update = quantizer.update(&sums, &assignment.unit, 0, 0);
        assert_eq!(update.dead, [0, 1, 2, 3]);
        let codes = quantizer.codes();
        for (k, code) in codes.chunks_exact(3).enumerate() {
            assert!(assignment.unit.chunks_exact(3).any(|row| row == code));
            assert!((quantizer.counts()[k] - 0.01 * sums.counts[k]).abs() < 1e-7);
            for other in codes.chunks_exact(3).skip(k + 1) {
                assert_ne!(code, other);
            }
        }
    }

    #[test]
    fn more_dead_codes_than_latents_draw_with_repetition() {
        let mut quantizer = quantizer(9);
        let assignment = quantizer.assign(vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let sums = quantizer.sums(&assignment);
        assert_eq!(
            quantizer.update(&sums, &assignment.unit, 1, 2).dead.len(),
            9
        );
    }

    #[test]
    fn names_are_those_of_released_checkpoints() {
        let names: Vec<String> = quantizer(2)
            .inventory()
            .into_iter()
            .map(|entry| entry.0)
            .collect();
        assert_eq!(
            names,
            [
                "_codebook.initted",
                "_codebook.cluster_size",
                "_codebook.embed"
            ]
        );
    }
}
