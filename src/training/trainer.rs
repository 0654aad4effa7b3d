//! One training step, and the state between steps (Supp. A and B): the same for MGET, VQ-VAEs and video tokenizers.
//!
//! What differs is an [`Objective`]: the module, its loss on a micro-batch, and what a step changes that no gradient does
//! (codebooks). Everything a step does is a function of the seed, the step and the state.

pub mod checkpoint;
pub mod ranks;

use self::ranks::{Ranks, ShareError, Told};
use super::optimizer::{AdamW, AdamWSettings, NotFinite};
use super::schedule::{Schedule, ScheduleError};
use super::settings::{Keep, SettingsError};
use super::source::DataError;
use super::validation::Score;
use crate::engine::cuts::backward_order;
use crate::engine::gradients::Complete;
use crate::engine::{EngineError, Gradients, Parameters, RankError, Weights};
use crate::formats::ReadError;
use crate::masking::MaskingError;
use crate::mget::SpecError;
use crate::model::ModelError;
use crate::tokenizer::TokenizerError;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What is trained, and what it is trained to do.
pub trait Objective {
    /// The parameters.
    type Module: Parameters;
    /// What one forward pass takes.
    type Batch;
    /// What a micro-batch leaves for [`Objective::finish_step`]; ranks tell each other theirs.
    type Trace: Told;

    /// The module in training.
    fn module(&self) -> &Self::Module;

    /// The module, to be changed by the optimizer or a checkpoint.
    fn module_mut(&mut self) -> &mut Self::Module;

    /// The loss of a micro-batch, and the gradients of `share` times it; changes nothing. `complete`, where there is one, may hear of
    /// gradients as soon as backward is done with them, so that they are sent while it goes on.
    ///
    /// # Errors
    /// When the batch does not fit the module.
    fn micro_step(
        &self,
        batch: &Self::Batch,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> Result<MicroStep<Self::Trace>, TrainingError>;

    /// The names of the parameters, about in the order in which backward completes their gradients.
    fn backward_order(&self) -> Vec<String> {
        backward_order(self.module(), &[])
    }

    /// What the step changes besides what the gradients did, after the optimizer; `step` is counted from 0. Returns further
    /// numbers for the report.
    fn finish_step(&mut self, traces: Vec<Self::Trace>, step: u64) -> Vec<(String, f64)> {
        let _ = (traces, step);
        Vec::new()
    }
}

/// What a forward and backward pass over one micro-batch gave.
#[derive(Debug)]
pub struct MicroStep<T> {
    /// What is minimised.
    pub loss: f64,
    /// Parts of the loss by name: mean, and its weight among micro-batches.
    pub parts: Vec<(String, f64, f64)>,
    /// `None` where nothing was asked for, or the loss is not finite.
    pub gradients: Option<Gradients>,
    /// Samples and tokens of the micro-batch; `step` is 0.
    pub used: Progress,
    /// For [`Objective::finish_step`].
    pub trace: T,
}

/// A model in training.
#[derive(Debug, Clone)]
pub struct Trainer<O> {
    objective: O,
    optimizer: AdamW,
    schedule: Schedule,
    micro_batches: Vec<usize>,
    ranks: Ranks,
    keep: Keep,
    best: Option<Best>,
    progress: Progress,
}

/// What a checkpoint says besides weights and moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Progress {
    /// Optimizer steps taken.
    pub step: u64,
    /// Samples used.
    pub samples: u64,
    /// Input tokens that were there, without padding or lost budget.
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
    /// Parts of the loss and other numbers by name: `loss/body`, `loss/commitment`, `codes/replaced`.
    pub parts: Vec<(String, f64)>,
    /// Learning rate.
    pub learning_rate: f64,
    /// Global norm before clipping.
    pub gradient_norm: f64,
    /// Totals so far.
    pub progress: Progress,
    /// Seconds that steps have waited for data so far.
    pub waited: f64,
}

impl StepReport {
    /// Everything by name, for the record of a run.
    #[must_use]
    pub fn scalars(&self) -> Vec<(&str, f64)> {
        let mut scalars = vec![
            ("loss", self.loss),
            ("learning_rate", self.learning_rate),
            ("gradient_norm", self.gradient_norm),
        ];
        scalars.extend(self.parts.iter().map(|(name, v)| (name.as_str(), *v)));
        scalars
    }
}

/// Held-out losses at one step, by what was predicted.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct HeldOut {
    /// After how many steps.
    pub step: u64,
    /// By modality.
    pub scores: BTreeMap<String, Score>,
    /// What token frequencies alone give, where that was computed.
    pub baseline: BTreeMap<String, Score>,
}

impl HeldOut {
    /// The loss that token frequencies alone give; NaN where it is not known.
    #[must_use]
    pub fn baseline_of(&self, modality: &str) -> f64 {
        self.baseline
            .get(modality)
            .map_or(f64::NAN, |score| score.loss)
    }

    /// The mean over modalities; `None` where nothing was held out.
    #[must_use]
    pub fn mean(&self) -> Option<f64> {
        let sum: f64 = self.scores.values().map(|score| score.loss).sum();
        (!self.scores.is_empty()).then(|| sum / self.scores.len() as f64)
    }
}

/// The weights with the lowest held-out loss so far.
#[derive(Debug, Clone)]
struct Best {
    held_out: HeldOut,
    weights: Weights,
}

/// Why training stopped.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// Steps are counted from 1.
    #[error("the loss of step {step} is {loss}; nothing was changed, the last checkpoint is good")]
    Loss {
        /// The step that was not taken.
        step: u64,
        /// The loss of one of its micro-batches, NaN or infinite.
        loss: f64,
    },
    /// The gradient of a step is not finite; the step was not taken.
    #[error("{0}; nothing was changed, the last checkpoint is good")]
    Gradient(#[from] NotFinite),
    /// No clip has a signal to train on.
    #[error("there is nothing to train on")]
    NoData,
    /// The callback asked to stop.
    #[error("stopped by its callback")]
    Stopped,
    /// A rank of the job has ended, or does not answer.
    #[error(transparent)]
    Rank(#[from] RankError),
    /// The batch does not divide over the ranks.
    #[error(transparent)]
    Share(#[from] ShareError),
    /// The format of the clips has no modality of this name.
    #[error("the clips have no modality `{0}`")]
    UnknownModality(String),
    /// A signal of a clip cannot be taken, or cannot be used.
    #[error("clip `{clip}`: {reason}")]
    Clip {
        /// The id of the clip.
        clip: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The settings of the training cannot be used.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The model to be trained cannot be built.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The settings of the masking cannot be used.
    #[error(transparent)]
    Masking(#[from] MaskingError),
    /// A model cannot be put together, or its tokenizers refuse a clip.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A training sample cannot be read, or does not fit the model.
    #[error(transparent)]
    Data(#[from] DataError),
    /// A clip cannot be read.
    #[error(transparent)]
    Clips(#[from] ReadError),
    /// A tokenizer cannot be built or fitted, or refuses a signal.
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    /// Warm-up and cool-down are longer than the run.
    #[error(transparent)]
    Schedule(#[from] ScheduleError),
    /// Weights or the state of the optimizer cannot be read, written or taken over.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A file of a checkpoint is missing, damaged or of another form.
    #[error("{path}: {reason}")]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The progress of a checkpoint cannot be written.
    #[error("{path}: {error}")]
    Write {
        /// The file of the progress.
        path: PathBuf,
        /// What the operating system says.
        #[source]
        error: std::io::Error,
    },
}

impl<O: Objective> Trainer<O> {
    /// Starts to train, alone. `micro_batches` are the samples of each forward pass of a step.
    #[must_use]
    pub fn start(
        mut objective: O,
        optimizer: AdamWSettings,
        schedule: Schedule,
        micro_batches: Vec<usize>,
        keep: Keep,
    ) -> Self {
        let optimizer = AdamW::new(optimizer, objective.module());
        objective.module_mut().start_training();
        Self {
            objective,
            optimizer,
            schedule,
            micro_batches,
            ranks: Ranks::default(),
            keep,
            best: None,
            progress: Progress::default(),
        }
    }

    /// Shares every step with other ranks, `micro_batch` samples in a forward pass (0: whatever suits them). All of them must be
    /// here with the same module, schedule and batch.
    ///
    /// # Errors
    /// When they cannot share it evenly.
    pub fn shared(mut self, ranks: Ranks, micro_batch: usize) -> Result<Self, ShareError> {
        let batch = self.micro_batches.iter().sum();
        self.micro_batches = ranks.micro_batches(batch, micro_batch)?;
        let (optimizer, model) = (self.optimizer, self.objective.module());
        self.optimizer = optimizer.shard(ranks.communicator(), model);
        self.ranks = ranks.in_order(self.objective.backward_order());
        Ok(self)
    }

    /// Takes one step; `next(i)` gives its micro-batch `i`, of those that are this rank's ([`Ranks::own`]).
    ///
    /// # Errors
    /// When a batch cannot be had, or loss or gradient are not finite, here or on another rank. Model and optimizer are as before
    /// then.
    pub fn step<E: From<TrainingError> + std::fmt::Display>(
        &mut self,
        mut next: impl FnMut(usize) -> Result<O::Batch, E>,
    ) -> Result<StepReport, E> {
        let mut progress = self.progress;
        progress.step += 1;
        let mut loss = 0.0;
        let mut parts: Vec<(String, f64, f64)> = Vec::new();
        let mut traces = Vec::new();
        let samples: usize = self.micro_batches.iter().sum();
        let shares: Vec<f64> = self
            .micro_batches
            .iter()
            .map(|n| *n as f64 / samples as f64)
            .collect();
        let objective = &self.objective;
        let micro_step = |index: usize, complete: Option<&mut Complete<'_>>| -> Result<_, E> {
            let batch = next(index)?;
            // The loss of a step is the mean over its micro-batches, as in the reference.
            let micro = objective.micro_step(&batch, shares[index], complete)?;
            Ok(micro)
        };
        let (step, model) = (self.progress.step, objective.module());
        let (micros, sum) = self.ranks.sum(step, shares.len(), model, micro_step)?;
        for (micro, share) in micros.into_iter().zip(&shares) {
            progress.samples += micro.used.samples;
            progress.input_tokens += micro.used.input_tokens;
            progress.target_tokens += micro.used.target_tokens;
            if !micro.loss.is_finite() {
                let (step, loss) = (progress.step, micro.loss);
                return Err(TrainingError::Loss { step, loss }.into());
            }
            loss += micro.loss * share;
            add(&mut parts, micro.parts);
            traces.push(micro.trace);
        }
        let learning_rate = self.schedule.rate(self.progress.step);
        let mut gradients = sum.unwrap_or_default();
        gradients.complete(self.objective.module());
        let gradient_norm = self
            .optimizer
            .step(self.objective.module_mut(), gradients, learning_rate)
            .map_err(TrainingError::from)?;
        self.optimizer
            .gather(self.objective.module_mut())
            .map_err(TrainingError::from)?;
        self.ranks.note(gradient_norm);
        let further = self.objective.finish_step(traces, self.progress.step);
        self.progress = progress;
        let parts = parts.into_iter().map(|(name, mean, _)| (name, mean));
        Ok(StepReport {
            step: progress.step,
            loss,
            parts: parts.chain(further).collect(),
            learning_rate,
            gradient_norm,
            progress,
            waited: 0.0,
        })
    }

    /// Takes note of held-out losses; where the best weights are to be kept, these are if they are better.
    pub fn note(&mut self, held_out: HeldOut) {
        let best = self.best.as_ref().and_then(|best| best.held_out.mean());
        let better = held_out
            .mean()
            .is_some_and(|mean| best.is_none_or(|best| mean < best));
        if self.keep == Keep::Best && better {
            self.best = Some(Best {
                held_out,
                weights: self.objective.module().weights(),
            });
        }
    }

    /// Puts the best weights back, where they were to be kept, and says which they are.
    ///
    /// # Errors
    /// When they are not those of the module: a damaged checkpoint.
    pub fn finish(&mut self) -> Result<Option<HeldOut>, TrainingError> {
        let Some(best) = self.best.take() else {
            return Ok(None);
        };
        self.objective.module_mut().load(&best.weights)?;
        Ok(Some(best.held_out))
    }

    /// What is trained.
    #[must_use]
    pub fn objective(&self) -> &O {
        &self.objective
    }

    /// The module in training.
    #[must_use]
    pub fn model(&self) -> &O::Module {
        self.objective.module()
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

    /// The ranks it trains on.
    #[must_use]
    pub fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// Samples of each forward pass of a step, over all ranks.
    #[must_use]
    pub fn micro_batches(&self) -> &[usize] {
        &self.micro_batches
    }
}

/// Adds weighted means of another micro-batch.
fn add(sums: &mut Vec<(String, f64, f64)>, parts: Vec<(String, f64, f64)>) {
    for (name, mean, weight) in parts {
        match sums.iter_mut().find(|sum| sum.0 == name) {
            Some((_, a, wa)) => {
                *a = (*a * *wa + mean * weight) / (*wa + weight);
                *wa += weight;
            }
            None => sums.push((name, mean, weight)),
        }
    }
}
