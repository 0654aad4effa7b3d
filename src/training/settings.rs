//! How MGET is trained (Supp. B).

use super::optimizer::AdamWSettings;
use super::schedule::{Schedule, ScheduleError, Shape};
use crate::engine::communicator::reduce::Reduction;
use crate::mget::Loss;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Length, batch, learning rate and care of a training run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingSettings {
    /// Optimizer steps; or give `epochs` or `total_tokens` instead.
    pub steps: Option<u64>,
    /// Length in passes over the clips.
    pub epochs: Option<f64>,
    /// Length in nominal tokens: visible plus target budget of every sample, used or not.
    pub total_tokens: Option<f64>,
    /// Samples per optimizer step, over all micro-batches.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Samples per forward pass; a larger `batch` accumulates gradients, and ranks share them. 0 means `batch`, shared evenly.
    pub micro_batch: usize,
    /// In which order ranks add up gradients.
    pub reduction: Reduction,
    /// Compute the activations of each block once more in backward instead of keeping them: less memory, more time.
    pub activation_checkpointing: bool,
    /// Peak learning rate. The paper: 1e-4 per 256 samples, so 4e-4 at batch 1024.
    pub learning_rate: f64,
    /// Learning rate at the end.
    pub final_learning_rate: f64,
    /// Linear rise from 0: `{steps: n}`, `{epochs: x}` or `{tokens: n}`.
    pub warmup: Duration,
    /// What the learning rate does after the warm-up.
    pub schedule: Shape,
    /// AdamW and clipping.
    pub optimizer: AdamWSettings,
    /// How losses of modalities become one number.
    pub loss: Loss,
    /// How often a clip is used in a row, each time with other masks.
    #[schemars(range(min = 1))]
    pub repeat: usize,
    /// Validate after every so many steps, and at the end; 0: at the end only.
    pub validate_every: u64,
    /// At most this many validation clips, always the same with the same masks.
    pub validation_clips: usize,
    /// Which weights the model has in the end.
    pub keep: Keep,
    /// Checkpoint after every so many steps; 0: only when interrupted.
    pub checkpoint_every: u64,
    /// Threads that prepare batches ahead. Results do not depend on it.
    #[schemars(range(min = 1))]
    pub loader_threads: usize,
    /// On a GPU, losses and norms of so many steps are read at once: reading waits for the device. Results do not depend on it. The
    /// processor has them after every step.
    #[schemars(range(min = 1))]
    #[serde(skip_serializing_if = "is_usual")]
    pub read_every: u64,
}

/// Steps on a GPU whose losses are read at once.
pub const READ_EVERY: u64 = 10;

/// Whether a setting that decides nothing is what it usually is: then it stands in no record.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
pub(crate) fn is_usual(every: &u64) -> bool {
    *every == READ_EVERY
}

impl Default for TrainingSettings {
    fn default() -> Self {
        Self {
            steps: None,
            epochs: None,
            total_tokens: None,
            batch: 16,
            micro_batch: 0,
            reduction: Reduction::default(),
            activation_checkpointing: false,
            learning_rate: 1e-3,
            final_learning_rate: 0.0,
            warmup: Duration::Steps(0),
            schedule: Shape::Cosine,
            optimizer: AdamWSettings::default(),
            loss: Loss::Mod,
            repeat: 1,
            validate_every: 0,
            validation_clips: 256,
            keep: Keep::Last,
            checkpoint_every: 500,
            loader_threads: 1,
            read_every: READ_EVERY,
        }
    }
}

/// Which weights a trained model has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Keep {
    /// Those after the last step.
    #[default]
    Last,
    /// Those with the lowest held-out loss, of the steps at which it was computed (`validate_every`).
    Best,
}

/// A stretch of training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Duration {
    /// In optimizer steps.
    Steps(u64),
    /// In passes over the clips.
    Epochs(f64),
    /// In nominal tokens.
    Tokens(f64),
}

/// What spans are measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatasetSize {
    /// Clips of one pass over the training data.
    pub clips: u64,
    /// Nominal tokens of one sample, visible plus target.
    pub tokens_per_sample: u64,
}

/// Why training settings cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// The length of the run is given more than once or not at all.
    #[error("give exactly one of `steps`, `epochs` and `total_tokens`")]
    Length,
    /// The setting of this name is 0 where it must not be, negative or not finite.
    #[error("`{0}` must be a positive, finite number")]
    Positive(&'static str),
    /// The setting of this name has a value it cannot have.
    #[error("`{0}` is out of its range")]
    Range(String),
    /// Warm-up and cool-down are longer than the run.
    #[error(transparent)]
    Schedule(#[from] ScheduleError),
}

impl TrainingSettings {
    /// How many optimizer steps the run has.
    ///
    /// # Errors
    /// When the length is given twice or not at all, or is not positive.
    pub fn total_steps(&self, measure: DatasetSize) -> Result<u64, SettingsError> {
        let span = match (self.steps, self.epochs, self.total_tokens) {
            (Some(steps), None, None) => Duration::Steps(steps),
            (None, Some(epochs), None) => Duration::Epochs(epochs),
            (None, None, Some(tokens)) => Duration::Tokens(tokens),
            _ => return Err(SettingsError::Length),
        };
        let name = match span {
            Duration::Steps(_) => "steps",
            Duration::Epochs(_) => "epochs",
            Duration::Tokens(_) => "total_tokens",
        };
        match self.steps_of(span, measure) {
            Some(steps) if steps > 0 => Ok(steps),
            _ => Err(SettingsError::Positive(name)),
        }
    }

    fn steps_of(&self, span: Duration, measure: DatasetSize) -> Option<u64> {
        let batch = self.batch.max(1) as f64;
        let steps = match span {
            Duration::Steps(steps) => return Some(steps),
            // A step that is cut off at the end of an epoch is left out, as in the reference.
            Duration::Epochs(epochs) => {
                epochs
                    * (measure.clips as f64 * self.repeat.max(1) as f64 / batch)
                        .floor()
                        .max(1.0)
            }
            Duration::Tokens(tokens) => tokens / (batch * measure.tokens_per_sample.max(1) as f64),
        };
        (steps.is_finite() && steps >= 0.0).then_some(steps.ceil() as u64)
    }

    /// The learning rate of every step.
    ///
    /// # Errors
    /// When length, warm-up, rates or optimizer cannot be used.
    pub fn learning_rates(&self, measure: DatasetSize) -> Result<Schedule, SettingsError> {
        for (name, value) in [
            ("batch", self.batch),
            ("repeat", self.repeat),
            ("loader_threads", self.loader_threads),
        ] {
            if value == 0 {
                return Err(SettingsError::Positive(name));
            }
        }
        if !(self.learning_rate.is_finite() && self.learning_rate > 0.0) {
            return Err(SettingsError::Positive("learning_rate"));
        }
        if !(self.final_learning_rate.is_finite() && self.final_learning_rate >= 0.0) {
            return Err(SettingsError::Range("final_learning_rate".to_owned()));
        }
        if matches!(self.schedule, Shape::InverseSqrt { timescale: 0, .. }) {
            return Err(SettingsError::Positive("schedule.timescale"));
        }
        if let Some(name) = self.optimizer.wrong() {
            return Err(SettingsError::Range(format!("optimizer.{name}")));
        }
        let total = self.total_steps(measure)?;
        let warmup = self
            .steps_of(self.warmup, measure)
            .ok_or(SettingsError::Positive("warmup"))?;
        Ok(Schedule::new(
            self.schedule,
            self.learning_rate,
            self.final_learning_rate,
            warmup,
            total,
        )?)
    }

    /// Samples that pass through the model at once.
    #[must_use]
    pub fn largest_micro_batch(&self) -> usize {
        self.micro_batches().into_iter().max().unwrap_or(self.batch)
    }

    /// Samples of each micro-batch of a step.
    #[must_use]
    pub fn micro_batches(&self) -> Vec<usize> {
        micro_batches(self.batch, self.micro_batch)
    }
}

/// Samples of each forward pass of a step of `batch` samples, `size` (0: all) at a time.
pub(super) fn micro_batches(batch: usize, size: usize) -> Vec<usize> {
    let size = if size == 0 { batch } else { size.min(batch) };
    let mut left = batch;
    let mut sizes = Vec::new();
    while left > 0 {
        sizes.push(size.min(left));
        left -= size.min(left);
    }
    sizes
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAPER: DatasetSize = DatasetSize {
        clips: 1_000_000,
        tokens_per_sample: 4096,
    };

    fn paper() -> TrainingSettings {
        TrainingSettings {
            batch: 1024,
            epochs: Some(123.0),
            warmup: Duration::Tokens(10e9),
            ..Default::default()
        }
    }

    #[test]
    fn the_paper_s_run_has_its_published_steps() {
        // The release: 976 steps per epoch, 123 epochs, 2385 steps of warm-up.
        assert_eq!(paper().total_steps(PAPER).unwrap(), 120_048);
        assert_eq!(paper().steps_of(Duration::Tokens(10e9), PAPER), Some(2385));
        let rates = paper().learning_rates(PAPER).unwrap();
        assert!((rates.rate(2384) - 1e-3).abs() < 1e-12);
    }

    #[test]
    fn lengths_that_cannot_be_used_are_refused() {
        let refused = |change: fn(&mut TrainingSettings)| {
            let mut settings = paper();
            change(&mut settings);
            settings.learning_rates(PAPER).is_err()
        };
        assert!(refused(|s| s.steps = Some(3)));
        assert!(refused(|s| s.epochs = None));
        assert!(refused(|s| s.epochs = Some(0.0)));
        assert!(refused(|s| s.epochs = Some(f64::NAN)));
        assert!(refused(|s| s.learning_rate = f64::INFINITY));
        assert!(refused(|s| s.batch = 0));
        assert!(refused(|s| s.warmup = Duration::Epochs(124.0)));
        assert!(refused(|s| s.final_learning_rate = f64::NAN));
        assert!(refused(|s| s.final_learning_rate = -1e-5));
        assert!(refused(|s| s.optimizer.clip_norm = Some(-1.0)));
        let timescale = |timescale| {
            let mut settings = paper();
            settings.schedule = Shape::InverseSqrt {
                timescale,
                cooldown_steps: 10,
            };
            settings.learning_rates(PAPER).is_ok()
        };
        assert!(timescale(1) && !timescale(0));
    }

    #[test]
    fn micro_batches_add_up_to_the_batch() {
        let sizes = |batch, micro_batch| {
            TrainingSettings {
                batch,
                micro_batch,
                ..Default::default()
            }
            .micro_batches()
        };
        assert_eq!(sizes(8, 0), [8]);
        assert_eq!(sizes(8, 3), [3, 3, 2]);
        assert_eq!(sizes(8, 100), [8]);
    }
}
