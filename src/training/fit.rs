//! The loop of every training: steps, held-out losses, checkpoints, and a callback that sees all of it and may stop it.

use super::trainer::checkpoint::Checkpoint;
use super::trainer::{HeldOut, Objective, StepReport, Trainer, TrainingError};
use super::validation::Score;
use crate::engine::{Communicator, Parameters, RankError};
use crate::flow::Flow;
use std::collections::BTreeMap;

/// How often a run looks at itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Intervals {
    /// Held-out losses after every so many steps, and at the end; 0: at the end only.
    pub validate_every: u64,
    /// A checkpoint after every so many steps; 0: only when stopped.
    pub checkpoint_every: u64,
    /// Where numbers are on a device, they are read, and steps are told of, after every so many of them; 0: after each.
    pub read_every: u64,
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
    /// A step was taken; where its numbers are on a device, some steps ago.
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

/// Asks `callback` to keep the state.
fn kept<O: Objective, E: From<TrainingError>>(
    trainer: &Trainer<O>,
    callback: &mut Callback<'_, E>,
) -> Result<Flow, E> {
    trainer.kept(|state| callback(Event::Checkpoint(state)))?
}

/// Every rank comes to the same decision: to stop where one of them is asked to.
fn agreed<E: From<TrainingError> + std::fmt::Display>(
    ranks: &Communicator,
    flow: Result<Flow, E>,
) -> Result<bool, E> {
    let told = flow.as_ref().map(|flow| *flow == Flow::Stop);
    let any = ranks.any(told.map_err(ToString::to_string));
    flow?;
    Ok(any.map_err(TrainingError::from)?)
}

/// Ranks that continue from different checkpoints are refused.
fn same_step(ranks: &Communicator, step: u64) -> Result<(), RankError> {
    let steps = ranks.gather(Ok(step.to_le_bytes().to_vec()))?;
    let other = steps.iter().position(|other| *other != step.to_le_bytes());
    other.map_or(Ok(()), |rank| {
        let reason = format!(
            "rank {} is at step {step}: do all see the same checkpoints?",
            ranks.rank()
        );
        Err(ranks.odd(rank, &reason))
    })
}

/// Trains to the last step. `batch(step, i)` gives micro-batch `i` of `step` (counted from 0), in order; `validate` gives held-out
/// losses by modality, nothing where there are none; of several ranks each calls it, `batch` for its own micro-batches. Returns the step whose weights the model has, with its held-out losses.
///
/// # Errors
/// What `batch`, `validate` or `callback` says, or when loss or gradient are not finite; the trainer is as after its last step.
/// [`TrainingError::Stopped`] after a last checkpoint, where the callback stops it before its end.
pub fn fit<O: Objective, E: From<TrainingError> + std::fmt::Display>(
    trainer: &mut Trainer<O>,
    intervals: Intervals,
    mut batch: impl FnMut(u64, usize) -> Result<O::Batch, E>,
    mut validate: impl FnMut(&O) -> Result<BTreeMap<String, Score>, E>,
    callback: &mut Callback<'_, E>,
) -> Result<HeldOut, E> {
    let total = trainer.total_steps();
    let ranks = trainer.ranks().communicator().clone();
    same_step(&ranks, trainer.progress().step).map_err(TrainingError::from)?;
    let mut validated = |trainer: &mut Trainer<O>, callback: &mut Callback<'_, E>| {
        let held_out = HeldOut {
            step: trainer.progress().step,
            scores: validate(trainer.objective())?,
            ..HeldOut::default()
        };
        let mut stop = false;
        if !held_out.scores.is_empty() {
            stop = agreed(&ranks, callback(Event::Validation(&held_out)))?;
            trainer.note(held_out.clone());
        }
        Ok::<_, E>((held_out, stop))
    };
    let start = Event::Start {
        parameters: trainer.model().count(),
        step: trainer.progress().step,
        total,
    };
    let mut stop = agreed(&ranks, callback(start))?;
    while trainer.progress().step < total {
        if stop {
            agreed(&ranks, kept(trainer, callback))?;
            return Err(TrainingError::Stopped.into());
        }
        let step = trainer.progress().step;
        trainer.advance(|index| batch(step, index))?;
        let step = trainer.progress().step;
        let due = |every: u64| every > 0 && step.is_multiple_of(every) && step < total;
        let looked_at = due(intervals.validate_every) || due(intervals.checkpoint_every);
        let unread = trainer.waits().unwrap_or(u64::MAX);
        if unread >= intervals.read_every || looked_at || step == total {
            for report in trainer.read()? {
                let report = Event::Step {
                    report: &report,
                    total,
                };
                stop |= agreed(&ranks, callback(report))?;
            }
        }
        if due(intervals.validate_every) {
            stop |= validated(trainer, callback)?.1;
        }
        if due(intervals.checkpoint_every) && !stop {
            stop |= agreed(&ranks, kept(trainer, callback))?;
        }
    }
    let (last, _) = validated(trainer, callback)?;
    Ok(trainer.finish()?.unwrap_or(last))
}
