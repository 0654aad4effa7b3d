//! One training step, and the state between steps (Supp. A and B): the same for MGET, VQ-VAEs and video tokenizers.
//!
//! What differs is an [`Objective`]: the module, its loss on a micro-batch, and what a step changes that no gradient does
//! (codebooks). Everything a step does is a function of the seed, the step and the state.
//!
//! A device is not waited for inside a step: [`Trainer::advance`] leaves losses and norms where they are, and [`Trainer::read`] reads
//! those of all steps since at once. On the processor, and where several ranks train, they are known when the step is taken.

pub mod checkpoint;
pub mod ranks;
mod unread;

pub use unread::{Found, Named};

use self::ranks::{Ranks, ShareError, Told};
use self::unread::{Micro, Unread};
use super::optimizer::{AdamW, AdamWSettings, NotFinite};
use super::schedule::{Schedule, ScheduleError};
use super::settings::{Keep, SettingsError};
use super::source::DataError;
use super::validation::Score;
use crate::engine::cuts::backward_order;
use crate::engine::gradients::Complete;
use crate::engine::ops::Norm;
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

    /// The loss of a micro-batch, and the gradients of `share` times it; changes nothing, and waits for no device. `complete`, where there is one, may hear of
    /// gradients as soon as backward is done with them, so that they are sent while it goes on.
    ///
    /// # Errors
    /// When the batch does not fit the module.
    fn micro_step(
        &self,
        batch: &Self::Batch,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> Result<Found<Self::Trace>, TrainingError>;

    /// The names of the parameters, about in the order in which backward completes their gradients.
    fn backward_order(&self) -> Vec<String> {
        backward_order(self.module(), &[])
    }

    /// What the step changes besides what the gradients did, after the optimizer; `step` is counted from 0. Where a device has the
    /// `norm` of the gradients and it is not finite, nothing. Returns further numbers for the report.
    fn finish_step(&mut self, traces: Vec<Self::Trace>, norm: &Norm, step: u64) -> Named {
        let _ = (traces, norm, step);
        Named::none()
    }
}

/// What a forward and backward pass over one micro-batch found, as ranks tell each other.
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
    unread: Vec<Unread>,
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
    /// How many later steps were taken before this one was read; 0 on the processor.
    pub behind: u64,
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

/// What was found in the micro-batches of a step, and the sum of their gradients where any asks for one.
type Computed<T> = (Vec<Found<T>>, Option<Gradients>);

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
            unread: Vec::new(),
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

    /// Takes one step, and reads what it did; `next(i)` gives its micro-batch `i`, of those that are this rank's ([`Ranks::own`]).
    ///
    /// # Errors
    /// When a batch cannot be had, or loss or gradient are not finite, here or on another rank. Model and optimizer are as before then,
    /// but on a device: there no weight has changed, and the optimizer has counted the step.
    pub fn step<E: From<TrainingError> + std::fmt::Display>(
        &mut self,
        next: impl FnMut(usize) -> Result<O::Batch, E>,
    ) -> Result<StepReport, E> {
        self.advance(next)?;
        let mut reports = self.read()?;
        Ok(reports.pop().expect("the step that was just taken"))
    }

    /// As [`Trainer::step`], but waits for no device: the report comes with the next [`Trainer::read`], and so does an error that only
    /// the device knows of. Steps behind a refused one are taken before that.
    ///
    /// # Errors
    /// As [`Trainer::step`], of what is known.
    pub fn advance<E: From<TrainingError> + std::fmt::Display>(
        &mut self,
        mut next: impl FnMut(usize) -> Result<O::Batch, E>,
    ) -> Result<(), E> {
        let mut progress = self.progress;
        progress.step += 1;
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
            let found = objective.micro_step(&batch, shares[index], complete)?;
            Ok(found)
        };
        let (found, sum) = self.computed(shares.len(), micro_step)?;
        let (mut micros, mut traces) = (Vec::new(), Vec::new());
        for (found, share) in found.into_iter().zip(&shares) {
            progress.samples += found.used.samples;
            progress.input_tokens += found.used.input_tokens;
            progress.target_tokens += found.used.target_tokens;
            if let Some(loss) = found.bad_loss() {
                let step = progress.step;
                return Err(TrainingError::Loss { step, loss }.into());
            }
            micros.push(Micro {
                numbers: found.numbers,
                parts: found.parts,
                share: *share,
            });
            traces.push(found.trace);
        }
        let learning_rate = self.schedule.rate(self.progress.step);
        let mut gradients = sum.unwrap_or_default();
        gradients.complete(self.objective.module());
        let norm = self
            .optimizer
            .step_unread(self.objective.module_mut(), gradients, learning_rate)
            .map_err(TrainingError::from)?;
        self.optimizer
            .gather(self.objective.module_mut())
            .map_err(TrainingError::from)?;
        if self.ranks.communicator().size() > 1 {
            self.ranks.note(norm.read());
        }
        let further = (self.objective).finish_step(traces, &norm, self.progress.step);
        self.progress = progress;
        self.unread.push(Unread {
            micros,
            norm: norm.into(),
            further,
            learning_rate,
            progress,
        });
        Ok(())
    }

    /// What all ranks found in the micro-batches of a step, and the sum of their gradients.
    fn computed<E: From<TrainingError> + std::fmt::Display>(
        &self,
        count: usize,
        mut micro_step: impl FnMut(usize, Option<&mut Complete<'_>>) -> Result<Found<O::Trace>, E>,
    ) -> Result<Computed<O::Trace>, E> {
        if self.ranks.communicator().size() == 1 {
            let (mut all, mut sum): (Vec<_>, Option<Gradients>) = (Vec::new(), None);
            for index in 0..count {
                let mut found = micro_step(index, None)?;
                if let Some(gradients) = found.gradients.take() {
                    sum = Some(match sum {
                        Some(sum) => sum.plus(gradients),
                        None => gradients,
                    });
                }
                all.push(found);
            }
            return Ok((all, sum));
        }
        let told = |index: usize, complete: Option<&mut Complete<'_>>| {
            micro_step(index, complete).map(Found::told)
        };
        let (step, model) = (self.progress.step, self.objective.module());
        let (micros, sum) = self.ranks.sum(step, count, model, told)?;
        Ok((micros.into_iter().map(Found::heard).collect(), sum))
    }

    /// How many steps were taken that nobody has read, where reading them waits for a device; all are known elsewhere.
    #[must_use]
    pub fn waits(&self) -> Option<u64> {
        let known = self.unread.iter().all(Unread::is_known);
        (!known).then_some(self.unread.len() as u64)
    }

    /// The reports of the steps since the last reading, in order.
    ///
    /// # Errors
    /// When the loss or the gradient of one of them was not finite. It has changed no weight; what was computed behind it is not to be
    /// kept.
    pub fn read(&mut self) -> Result<Vec<StepReport>, TrainingError> {
        Unread::read(std::mem::take(&mut self.unread))
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
