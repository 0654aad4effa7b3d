//! One training step, and the state between steps (Supp. B).

use super::optimizer::{AdamW, NotFinite};
use super::schedule::Schedule;
use super::settings::TrainingSettings;
use super::source::DataError;
use crate::engine::{EngineError, Gradients, Parameters, Weights};
use crate::mget::{Batch, Loss, LossValues, Mget};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A model in training.
#[derive(Debug)]
pub struct Trainer {
    model: Mget,
    optimizer: AdamW,
    schedule: Schedule,
    loss: Loss,
    batch: usize,
    activation_checkpointing: bool,
    progress: Progress,
}

/// What a checkpoint says besides weights and moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Progress {
    /// Optimizer steps taken.
    pub step: u64,
    /// Samples used.
    pub samples: u64,
    /// EncoderInput tokens that were there, without padding or lost budget.
    pub input_tokens: u64,
    /// Target tokens that were there.
    pub target_tokens: u64,
}

/// What one step did.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// The step, counted from 1.
    pub step: u64,
    /// What was minimised.
    pub loss: f64,
    /// Mean cross-entropy per modality of the spec (nats) and its tokens; `None` when it was not asked for.
    pub modalities: Vec<Option<(f64, usize)>>,
    /// Learning rate.
    pub learning_rate: f64,
    /// Global norm before clipping.
    pub gradient_norm: f64,
    /// Totals so far.
    pub progress: Progress,
}

/// Why training stopped.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    #[error("the loss of step {step} is {loss}; nothing was changed, the last checkpoint is good")]
    Loss { step: u64, loss: f64 },
    #[error("{0}; nothing was changed, the last checkpoint is good")]
    Gradient(#[from] NotFinite),
    #[error(transparent)]
    Data(#[from] DataError),
    #[error(transparent)]
    Engine(#[from] EngineError),
    #[error("{path}: {reason}")]
    Checkpoint { path: PathBuf, reason: String },
    #[error("{path}: {error}")]
    Write {
        path: PathBuf,
        #[source]
        error: std::io::Error,
    },
}

impl Trainer {
    /// Starts to train `model`.
    #[must_use]
    pub fn new(mut model: Mget, settings: &TrainingSettings, schedule: Schedule) -> Self {
        let optimizer = AdamW::new(settings.optimizer.clone(), &model);
        model.start_training();
        Self {
            model,
            optimizer,
            schedule,
            loss: settings.loss,
            batch: settings.batch,
            activation_checkpointing: settings.activation_checkpointing,
            progress: Progress::default(),
        }
    }

    /// Takes one step. `next` is called once for each of `micro_batches` micro-batches.
    ///
    /// # Errors
    /// When data cannot be read, or loss or gradient are not finite. Model and optimizer are as before then.
    pub fn step(
        &mut self,
        micro_batches: usize,
        mut next: impl FnMut() -> Result<Batch, DataError>,
    ) -> Result<StepReport, TrainingError> {
        let mut progress = self.progress;
        progress.step += 1;
        let mut sum: Option<Gradients> = None;
        let mut loss = 0.0;
        let mut modalities = vec![None; self.model.spec().modalities.len()];
        for _ in 0..micro_batches {
            let batch = next()?;
            // The loss of a step is the mean over its micro-batches, as in the reference.
            let share = batch.samples() as f64 / self.batch as f64;
            progress.samples += batch.samples() as u64;
            progress.input_tokens += batch.visible.sequence.len() as u64;
            progress.target_tokens += batch.targets.sequence.len() as u64;

            let (values, gradients) = self.gradients(&batch, share);
            if !values.total.is_finite() {
                return Err(TrainingError::Loss {
                    step: progress.step,
                    loss: values.total,
                });
            }
            loss += values.total * share;
            add(&mut modalities, &values);
            // A batch that asks for nothing has no gradient.
            if let Some(gradients) = gradients {
                sum = Some(match sum {
                    Some(sum) => sum.plus(gradients),
                    None => gradients,
                });
            }
        }
        let learning_rate = self.schedule.rate(self.progress.step);
        let mut gradients = sum.unwrap_or_default();
        gradients.complete(&self.model);
        let gradient_norm = self
            .optimizer
            .step(&mut self.model, gradients, learning_rate)?;
        self.progress = progress;
        Ok(StepReport {
            step: progress.step,
            loss,
            modalities,
            learning_rate,
            gradient_norm,
            progress,
        })
    }

    /// The losses of a batch, and the gradients of `share` times their total, if it has any.
    fn gradients(&self, batch: &Batch, share: f64) -> (LossValues, Option<Gradients>) {
        if self.activation_checkpointing {
            return self.model.recomputed(batch, self.loss, share);
        }
        let losses = self.model.losses(batch, self.loss);
        let values = losses.values();
        let total = losses.total.filter(|_| values.total.is_finite());
        let gradients = total.map(|total| Gradients::of(&(total * share), &self.model));
        (values, gradients)
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> &Mget {
        &self.model
    }

    /// Totals so far.
    #[must_use]
    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// How many steps the run has.
    #[must_use]
    pub fn total_steps(&self) -> u64 {
        self.schedule.total()
    }

    /// Writes weights, moments and progress into an empty directory.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, directory: &Path) -> Result<(), TrainingError> {
        self.model.weights().write(&directory.join(WEIGHTS))?;
        self.optimizer.state().write(&directory.join(OPTIMIZER))?;
        let path = directory.join(PROGRESS);
        let text =
            serde_json::to_vec_pretty(&self.progress).map_err(|error| checkpoint(&path, &error))?;
        std::fs::write(&path, text).map_err(|error| TrainingError::Write { path, error })
    }

    /// Continues from a directory of [`Trainer::save`]: the next steps are those the stored run would have taken, to the bit.
    ///
    /// # Errors
    /// When the directory is damaged or of another model.
    pub fn resume(&mut self, directory: &Path) -> Result<(), TrainingError> {
        let path = directory.join(PROGRESS);
        let text = std::fs::read(&path).map_err(|error| checkpoint(&path, &error))?;
        let progress: Progress =
            serde_json::from_slice(&text).map_err(|error| checkpoint(&path, &error))?;
        let weights = Weights::read(&directory.join(WEIGHTS))?;
        self.optimizer
            .restore(&Weights::read(&directory.join(OPTIMIZER))?)?;
        self.model.load(&weights)?;
        self.progress = progress;
        Ok(())
    }
}

const WEIGHTS: &str = "weights.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const PROGRESS: &str = "progress.json";

fn checkpoint(path: &Path, reason: &dyn std::fmt::Display) -> TrainingError {
    TrainingError::Checkpoint {
        path: path.to_path_buf(),
        reason: reason.to_string(),
    }
}

/// Adds means over tokens of another micro-batch.
fn add(sums: &mut [Option<(f64, usize)>], values: &LossValues) {
    for (sum, value) in sums.iter_mut().zip(&values.modalities) {
        *sum = match (*sum, *value) {
            (Some((a, n)), Some((b, m))) => {
                let (wa, wb) = (n as f64, m as f64);
                Some(((a * wa + b * wb) / (wa + wb), n + m))
            }
            (sum, value) => sum.or(value),
        };
    }
}
