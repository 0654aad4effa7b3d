//! Training a VQ-VAE tokenizer (Supp. A): one step, the order of the data, a checkpoint that resumes to the same bytes.
//!
//! Everything a step does is a function of the seed, the step and the state: the clips it sees, the codes it replaces, the
//! learning rate. A checkpoint is weights, moments and the step.

use ndarray::Ix3;
use rand::seq::SliceRandom;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::optimizer::{AdamW, AdamWSettings, NotFinite};
use super::schedule::{Schedule, ScheduleError, Shape};
use crate::clip::Signal;
use crate::engine::{EngineError, Gradients, Parameters, Weights};
use crate::geometry::skeleton::HAND;
use crate::random::stream;
use crate::tokenizer::TokenizerError;
use crate::tokenizer::trained::{Prepared, batch};
use crate::tokenizer::vq::VqVae;

/// How a tokenizer trains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TokenizerTraining {
    /// Optimizer steps.
    #[schemars(range(min = 1))]
    pub steps: u64,
    /// Signals per step.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Peak learning rate.
    pub rate: f64,
    /// Steps until the peak.
    pub warmup: u64,
    /// The optimizer.
    pub optimizer: AdamWSettings,
}

impl Default for TokenizerTraining {
    fn default() -> Self {
        Self {
            steps: 1000,
            batch: 16,
            rate: 1e-3,
            warmup: 50,
            optimizer: AdamWSettings {
                betas: [0.9, 0.99],
                ..AdamWSettings::default()
            },
        }
    }
}

/// What one step reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    pub loss: f64,
    pub reconstruction: f64,
    pub commitment: f64,
    /// Of all gradients together, before clipping.
    pub gradient_norm: f64,
    pub rate: f64,
    /// Codes that were replaced.
    pub replaced: usize,
}

/// Why a step or a resume was refused.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// Steps are counted from 1.
    #[error("the loss of step {step} is {loss}; the last good checkpoint is kept")]
    NotFinite { step: u64, loss: f64 },
    #[error("{0}; the last good checkpoint is kept")]
    Gradient(#[from] NotFinite),
    #[error("there is nothing to train on")]
    NoData,
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    #[error(transparent)]
    Schedule(#[from] ScheduleError),
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// A training run between two steps.
#[derive(Debug, Clone)]
pub struct Trainer {
    model: VqVae,
    optimizer: AdamW,
    schedule: Schedule,
    epochs: Epochs,
    seed: u64,
}

/// Which signals each step sees: epochs are permutations, drawn for (seed, epoch), read one after the other.
#[derive(Debug, Clone)]
pub(super) struct Epochs {
    seed: u64,
    batch: usize,
    /// The order of the epoch it was last asked for.
    order: (u64, Vec<usize>),
}

impl Epochs {
    pub(super) fn new(seed: u64, batch: usize) -> Self {
        Self {
            seed,
            batch: batch.max(1),
            order: (u64::MAX, Vec::new()),
        }
    }

    /// The signals of `step`, of `count` (at least 1) that there are.
    pub(super) fn choose(&mut self, step: u64, count: usize) -> Vec<usize> {
        let first = step * self.batch as u64;
        (first..first + self.batch as u64)
            .map(|place| {
                let epoch = place / count as u64;
                if self.order.0 != epoch || self.order.1.len() != count {
                    let mut order: Vec<usize> = (0..count).collect();
                    order.shuffle(&mut stream(self.seed, "train_tokenizer.order", epoch, 0));
                    self.order = (epoch, order);
                }
                self.order.1[(place % count as u64) as usize]
            })
            .collect()
    }
}

impl Trainer {
    /// A run from the start.
    ///
    /// # Errors
    /// When warm-up is longer than the run.
    pub fn new(
        mut model: VqVae,
        settings: &TokenizerTraining,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        model.start_training();
        Ok(Self {
            optimizer: AdamW::new(settings.optimizer.clone(), &model),
            schedule: Schedule::new(
                Shape::Cosine,
                settings.rate,
                0.0,
                settings.warmup,
                settings.steps,
            )?,
            epochs: Epochs::new(seed, settings.batch),
            seed,
            model,
        })
    }

    #[must_use]
    pub fn model(&self) -> &VqVae {
        &self.model
    }

    /// How many steps were taken.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.optimizer.steps()
    }

    #[must_use]
    pub fn finished(&self) -> bool {
        self.steps() >= self.schedule.total()
    }

    /// Takes one step on `data`, normalised signals.
    ///
    /// # Errors
    /// When there is no data, or the loss or its gradient is not finite; nothing has changed then.
    pub fn step(&mut self, data: &[Prepared]) -> Result<StepReport, TrainingError> {
        if data.is_empty() {
            return Err(TrainingError::NoData);
        }
        let step = self.steps();
        let chosen: Vec<Prepared> = self
            .epochs
            .choose(step, data.len())
            .into_iter()
            .map(|i| data[i].clone())
            .collect();
        let trained = self.model.forward_training(&batch(&self.model, &chosen));
        let weight = self.model.settings().commitment_weight;
        let loss = trained.reconstruction + weight * trained.commitment;
        if !loss.is_finite() {
            let step = step + 1;
            return Err(TrainingError::NotFinite { step, loss });
        }
        let gradients = Gradients::of(&trained.loss, &self.model);
        let rate = self.schedule.rate(step);
        let gradient_norm = self.optimizer.step(&mut self.model, gradients, rate)?;
        let quantizer = self.model.quantizer_mut();
        let sums = quantizer.sums(&trained.assignment);
        let update = quantizer.update(&sums, &trained.assignment.unit, self.seed, step);
        Ok(StepReport {
            loss,
            reconstruction: trained.reconstruction,
            commitment: trained.commitment,
            gradient_norm,
            rate,
            replaced: update.dead.len(),
        })
    }

    /// Everything that the next step depends on, besides settings, seed and data.
    #[must_use]
    pub fn checkpoint(&self) -> Weights {
        let mut weights = Weights::default();
        weights.add_below("model", self.model.weights());
        weights.add_below("optimizer", self.optimizer.state());
        weights
    }

    /// Continues from a checkpoint of the same settings.
    ///
    /// # Errors
    /// When it is of another model.
    pub fn restore(&mut self, checkpoint: &Weights) -> Result<(), TrainingError> {
        self.model.load(&checkpoint.below("model"))?;
        self.optimizer.restore(&checkpoint.below("optimizer"))?;
        Ok(())
    }
}

/// Joints seen in a mirror: x (right) is negated, in the camera's frame. Left and right hands use the same list of joints, so
/// a mirrored left hand is a right hand (Supp. A).
///
/// # Errors
/// When the signal is not `[samples, joints, 3]`.
pub fn mirrored(signal: &Signal) -> Result<Signal, ndarray::ShapeError> {
    let joints = signal.values.clone().into_dimensionality::<Ix3>()?;
    Ok(Signal {
        values: HAND.mirrored(&joints).into_dyn(),
        valid: signal.valid.clone(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::tokenizer::vq::VqSettings;

    const SHAPE: crate::modality::Shape = crate::modality::Shape::Temporal {
        samples: 8,
        channels: 2,
    };

    fn trainer(steps: u64) -> Trainer {
        let compute = Compute::cpu();
        let sizes = VqSettings {
            codebook: 32,
            code_width: 4,
            width: 16,
            depth: 1,
            heads: 2,
            ..VqSettings::default()
        };
        let model = VqVae::new(&Initialise::new(&compute, 4), &sizes, &SHAPE).unwrap();
        let training = TokenizerTraining {
            steps,
            batch: 8,
            warmup: 2,
            ..TokenizerTraining::default()
        };
        Trainer::new(model, &training, 4).unwrap()
    }

    fn data() -> Vec<Prepared> {
        (0..20)
            .map(|signal| Prepared {
                values: (0..16)
                    .map(|i| (signal as f32 * 0.8 + i as f32 * 0.4).sin())
                    .collect(),
                valid: (signal % 5 == 0).then(|| (0..8).map(|t| t != 3).collect()),
            })
            .collect()
    }

    #[test]
    fn training_lowers_the_error_and_a_killed_run_resumes_to_the_same_bytes() {
        let data = data();
        let mut whole = trainer(60);
        let mut losses = Vec::new();
        let mut stored = None;
        while !whole.finished() {
            if whole.steps() == 23 {
                stored = Some(whole.checkpoint().to_bytes());
            }
            losses.push(whole.step(&data).unwrap().reconstruction);
        }
        assert!(
            losses[59] < 0.5 * losses[0],
            "{} to {}",
            losses[0],
            losses[59]
        );

        let mut resumed = trainer(60);
        resumed
            .restore(&Weights::from_bytes(&stored.unwrap()).unwrap())
            .unwrap();
        assert_eq!(resumed.steps(), 23);
        while !resumed.finished() {
            resumed.step(&data).unwrap();
        }
        assert!(resumed.checkpoint().to_bytes() == whole.checkpoint().to_bytes());
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
        let data = data();
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| {
                let mut trainer = trainer(6);
                while !trainer.finished() {
                    trainer.step(&data).unwrap();
                }
                trainer.checkpoint().to_bytes()
            })
        };
        let one = on(1);
        assert!(on(2) == one && on(3) == one);
    }

    #[test]
    fn a_loss_that_is_not_finite_stops_with_the_step_and_changes_nothing() {
        let mut trainer = trainer(5);
        trainer.step(&data()).unwrap();
        let before = trainer.checkpoint();
        let huge = vec![Prepared {
            values: vec![1e30; 16],
            valid: None,
        }];
        let error = trainer.step(&huge).unwrap_err();
        assert!(error.to_string().contains("loss of step 2 is"), "{error}");
        assert_eq!(trainer.checkpoint(), before);
        let gradient = NotFinite {
            step: 2,
            norm: f64::INFINITY,
        };
        let message = TrainingError::from(gradient).to_string();
        assert!(message.contains("gradient of step 2"), "{message}");
    }

    #[test]
    fn every_signal_is_seen_once_per_epoch() {
        let mut trainer = trainer(50);
        let seen: Vec<usize> = (0..5)
            .flat_map(|step| trainer.epochs.choose(step, 20))
            .collect();
        for epoch in seen.chunks(20) {
            let mut epoch = epoch.to_vec();
            epoch.sort_unstable();
            assert_eq!(epoch, (0..20).collect::<Vec<_>>());
        }
        assert_ne!(seen[..20], seen[20..]);
    }

    #[test]
    fn the_other_hand_in_a_mirror_is_turned_around_and_back() {
        let joints = ndarray::Array3::from_shape_fn((2, 21, 3), |(t, j, k)| {
            (t + 3 * j + 7 * k) as f32 - 20.0
        });
        let signal = Signal {
            values: joints.into_dyn(),
            valid: None,
        };
        let once = mirrored(&signal).unwrap();
        assert_eq!(once.values[[1, 4, 0]], -signal.values[[1, 4, 0]]);
        assert_eq!(once.values[[1, 4, 2]], signal.values[[1, 4, 2]]);
        assert_eq!(mirrored(&once).unwrap(), signal);
    }
}
