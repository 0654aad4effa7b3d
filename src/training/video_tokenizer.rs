//! Training a video tokenizer (Supp. A; the paper takes Cosmos as released): one step on the squared error of pixels and
//! on even use of the codes, and a checkpoint that resumes to the same bytes.
//!
//! Clips are read when a step asks for them, so memory does not grow with the data.

use super::optimizer::AdamW;
use super::schedule::{Schedule, Shape};
use super::tokenizer::{Epochs, TokenizerTraining, TrainingError};
use crate::clip::Signal;
use crate::engine::{Gradients, Parameters, Weights};
use crate::tokenizer::video::VideoTokenizer;

/// Weight of the latents' unevenness beside the error of pixels.
const EVENNESS: f64 = 0.01;

/// What one step reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VideoStepReport {
    /// Mean squared error of pixels in [-1, 1].
    pub loss: f64,
    /// Of all gradients together, before clipping.
    pub gradient_norm: f64,
    pub rate: f64,
}

/// A training run between two steps.
#[derive(Debug, Clone)]
pub struct VideoTrainer {
    model: VideoTokenizer,
    optimizer: AdamW,
    schedule: Schedule,
    epochs: Epochs,
}

impl VideoTrainer {
    /// A run from the start.
    ///
    /// # Errors
    /// When warm-up is longer than the run.
    pub fn new(
        mut model: VideoTokenizer,
        settings: &TokenizerTraining,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        model.network_mut().start_training();
        Ok(Self {
            optimizer: AdamW::new(settings.optimizer.clone(), model.network()),
            schedule: Schedule::new(
                Shape::Cosine,
                settings.rate,
                0.0,
                settings.warmup,
                settings.steps,
            )?,
            epochs: Epochs::new(seed, settings.batch),
            model,
        })
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

    /// The tokenizer as it is now; it records nothing.
    #[must_use]
    pub fn tokenizer(&self) -> VideoTokenizer {
        let mut tokenizer = self.model.clone();
        *tokenizer.network_mut() = self.model.network().frozen();
        tokenizer
    }

    /// Which of `count` clips the next step sees.
    pub fn choose(&mut self, count: usize) -> Vec<usize> {
        self.epochs.choose(self.steps(), count)
    }

    /// Takes one step on `clips`, those of [`VideoTrainer::choose`].
    ///
    /// # Errors
    /// When a clip has another size, or the loss or its gradient is not finite; nothing has changed then.
    pub fn step(&mut self, clips: &[Signal]) -> Result<VideoStepReport, TrainingError> {
        if clips.is_empty() {
            return Err(TrainingError::NoData);
        }
        let step = self.steps();
        let trained = self.model.train(clips)?;
        let loss = f64::from(trained.loss.clone().into_scalar::<f32>());
        if !loss.is_finite() {
            let step = step + 1;
            return Err(TrainingError::NotFinite { step, loss });
        }
        let total = trained.loss + trained.unevenness * EVENNESS;
        let gradients = Gradients::of(&total, self.model.network());
        let rate = self.schedule.rate(step);
        let gradient_norm = self
            .optimizer
            .step(self.model.network_mut(), gradients, rate)?;
        Ok(VideoStepReport {
            loss,
            gradient_norm,
            rate,
        })
    }

    /// Everything that the next step depends on, besides settings, seed and data.
    #[must_use]
    pub fn checkpoint(&self) -> Weights {
        let mut weights = Weights::default();
        weights.add_below("model", self.model.network().weights());
        weights.add_below("optimizer", self.optimizer.state());
        weights
    }

    /// Continues from a checkpoint of the same settings.
    ///
    /// # Errors
    /// When it is of another model.
    pub fn restore(&mut self, checkpoint: &Weights) -> Result<(), TrainingError> {
        self.model.network_mut().load(&checkpoint.below("model"))?;
        self.optimizer.restore(&checkpoint.below("optimizer"))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokenizer::video::testing::small;
    use ndarray::{ArrayD, IxDyn};

    fn trainer() -> VideoTrainer {
        let model = small([4, 16, 16], [4, 4], &[4, 3], 2);
        let training = TokenizerTraining {
            steps: 8,
            batch: 2,
            warmup: 2,
            rate: 3e-3,
            ..TokenizerTraining::default()
        };
        VideoTrainer::new(model, &training, 5).unwrap()
    }

    fn step(trainer: &mut VideoTrainer) -> f64 {
        let clips: Vec<Signal> = trainer
            .choose(5)
            .into_iter()
            .map(|clip| Signal {
                values: ArrayD::from_shape_fn(IxDyn(&[4, 16, 16, 3]), |at| {
                    ((at[0] + 2 * at[1] + at[2] + 5 * clip) as f32 * 0.2).sin()
                }),
                valid: None,
            })
            .collect();
        trainer.step(&clips).unwrap().loss
    }

    #[test]
    fn training_lowers_the_error_and_a_killed_run_resumes_to_the_same_bytes() {
        let mut whole = trainer();
        let mut losses = Vec::new();
        let mut stored = None;
        while !whole.finished() {
            if whole.steps() == 3 {
                stored = Some(whole.checkpoint().to_bytes());
            }
            losses.push(step(&mut whole));
        }
        assert!(losses[7] < losses[0], "{losses:?}");
        let mut resumed = trainer();
        resumed
            .restore(&Weights::from_bytes(&stored.unwrap()).unwrap())
            .unwrap();
        while !resumed.finished() {
            step(&mut resumed);
        }
        assert!(resumed.checkpoint().to_bytes() == whole.checkpoint().to_bytes());
    }
}
