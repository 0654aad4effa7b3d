//! The loop of every training: steps, held-out losses, checkpoints, and a callback that sees all of it and may stop it.

use super::trainer::{HeldOut, Objective, StepReport, Trainer, TrainingError};
use super::validation::Score;
use crate::engine::Parameters;
use crate::flow::Flow;
use std::collections::BTreeMap;
use std::path::Path;

/// How often a run looks at itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Intervals {
    /// Held-out losses after every so many steps, and at the end; 0: at the end only.
    pub validate_every: u64,
    /// A checkpoint after every so many steps; 0: only when stopped.
    pub checkpoint_every: u64,
}

/// What a callback sees.
#[derive(Clone, Copy)]
pub enum Event<'a> {
    /// Training starts, or goes on from a checkpoint.
    Start {
        /// How many trainable numbers there are.
        parameters: usize,
        /// Steps taken before.
        step: u64,
        /// Steps of the whole run.
        total: u64,
    },
    /// A step was taken.
    Step {
        /// What it did.
        report: &'a StepReport,
        /// Steps of the whole run.
        total: u64,
    },
    /// Held-out losses were computed.
    Validation(&'a HeldOut),
    /// Now the state should be kept, where it can be.
    Checkpoint(&'a dyn Checkpoint),
    /// Work before and after the steps.
    Progress {
        /// So many
        done: usize,
        /// of so many
        total: usize,
        /// of these, a plural noun: `clips read`.
        unit: &'static str,
    },
}

/// A training that can be written down.
pub trait Checkpoint {
    /// How many steps were taken.
    fn step(&self) -> u64;

    /// Writes everything that the next step depends on, besides settings, seed and data, into an empty directory.
    ///
    /// # Errors
    /// When a file cannot be written.
    fn save(&self, directory: &Path) -> Result<(), TrainingError>;
}

impl<O: Objective> Checkpoint for Trainer<O> {
    fn step(&self) -> u64 {
        self.progress().step
    }

    fn save(&self, directory: &Path) -> Result<(), TrainingError> {
        Trainer::save(self, directory)
    }
}

/// What is told of a run, and may stop it.
pub type Callback<'a, E> = dyn FnMut(Event<'_>) -> Result<Flow, E> + 'a;

/// Tells `callback` how far the work beside the steps is.
pub(super) fn progress<E: From<TrainingError>>(
    callback: &mut Callback<'_, E>,
    done: usize,
    total: usize,
    unit: &'static str,
) -> Result<(), E> {
    match callback(Event::Progress { done, total, unit })? {
        Flow::Continue => Ok(()),
        Flow::Stop => Err(TrainingError::Stopped.into()),
    }
}

/// Trains to the last step. `batch(step, i)` gives micro-batch `i` of `step` (counted from 0), in order; `validate` gives held-out
/// losses by modality, nothing where there are none. Returns the step whose weights the model has, with its held-out losses.
///
/// # Errors
/// What `batch`, `validate` or `callback` says, or when loss or gradient are not finite; the trainer is as after its last step.
/// [`TrainingError::Stopped`] after a last checkpoint, where the callback stops it before its end.
pub fn fit<O: Objective, E: From<TrainingError>>(
    trainer: &mut Trainer<O>,
    intervals: Intervals,
    mut batch: impl FnMut(u64, usize) -> Result<O::Batch, E>,
    mut validate: impl FnMut(&O) -> Result<BTreeMap<String, Score>, E>,
    callback: &mut Callback<'_, E>,
) -> Result<HeldOut, E> {
    let total = trainer.total_steps();
    let mut validated = |trainer: &mut Trainer<O>, callback: &mut Callback<'_, E>| {
        let held_out = HeldOut {
            step: trainer.progress().step,
            scores: validate(trainer.objective())?,
            ..HeldOut::default()
        };
        let mut flow = Flow::Continue;
        if !held_out.scores.is_empty() {
            flow = callback(Event::Validation(&held_out))?;
            trainer.note(held_out.clone());
        }
        Ok::<_, E>((held_out, flow))
    };
    let mut stop = callback(Event::Start {
        parameters: trainer.model().count(),
        step: trainer.progress().step,
        total,
    })? == Flow::Stop;
    while trainer.progress().step < total {
        if stop {
            callback(Event::Checkpoint(trainer))?;
            return Err(TrainingError::Stopped.into());
        }
        let step = trainer.progress().step;
        let report = trainer.step(|index| batch(step, index))?;
        let step = report.step;
        stop |= callback(Event::Step {
            report: &report,
            total,
        })? == Flow::Stop;
        let due = |every: u64| every > 0 && step.is_multiple_of(every) && step < total;
        if due(intervals.validate_every) {
            stop |= validated(trainer, callback)?.1 == Flow::Stop;
        }
        if due(intervals.checkpoint_every) && !stop {
            stop |= callback(Event::Checkpoint(trainer))? == Flow::Stop;
        }
    }
    let (last, _) = validated(trainer, callback)?;
    Ok(trainer.finish()?.unwrap_or(last))
}
