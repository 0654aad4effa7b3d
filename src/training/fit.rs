//! The loop of every training: steps, held-out losses, checkpoints, and a callback that sees all of it and may stop it.

use super::trainer::{HeldOut, Objective, StepReport, Trainer, TrainingError};
use super::validation::Score;
use std::collections::BTreeMap;

/// What a callback wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Flow {
    /// Go on.
    #[default]
    Continue,
    /// Save a checkpoint after this step, and stop.
    Stop,
}

/// How often a run looks at itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Intervals {
    /// Held-out losses after every so many steps, and at the end; 0: at the end only.
    pub validate_every: u64,
    /// A checkpoint after every so many steps; 0: only when stopped.
    pub checkpoint_every: u64,
}

/// What a callback sees.
#[derive(Debug)]
pub enum Event<'a, O> {
    /// A step was taken, of so many.
    Step {
        /// What it did.
        report: &'a StepReport,
        /// How many steps the run has.
        total: u64,
    },
    /// Held-out losses were computed.
    Validation(&'a HeldOut),
    /// Now the state should be kept: [`Trainer::save`] writes it.
    Checkpoint(&'a Trainer<O>),
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Fitted {
    /// Whether the callback stopped it before its last step.
    pub flow: Flow,
    /// The step whose weights the model has, and its held-out losses.
    pub held_out: HeldOut,
}

/// Trains to the last step. `batch(step, i)` gives micro-batch `i` of `step` (counted from 0), in order; `validate` gives held-out
/// losses by modality, nothing where there are none.
///
/// # Errors
/// What `batch`, `validate` or `callback` says, or when loss or gradient are not finite; the trainer is as after its last step.
pub fn fit<O: Objective, E: From<TrainingError>>(
    trainer: &mut Trainer<O>,
    intervals: Intervals,
    mut batch: impl FnMut(u64, usize) -> Result<O::Batch, E>,
    mut validate: impl FnMut(&O) -> Result<BTreeMap<String, Score>, E>,
    mut callback: impl FnMut(Event<'_, O>) -> Result<Flow, E>,
) -> Result<Fitted, E> {
    let total = trainer.total_steps();
    let mut validated = |trainer: &mut Trainer<O>,
                         callback: &mut dyn FnMut(Event<'_, O>) -> Result<Flow, E>|
     -> Result<(HeldOut, Flow), E> {
        let held_out = HeldOut {
            step: trainer.progress().step,
            scores: validate(trainer.objective())?,
        };
        let mut flow = Flow::Continue;
        if !held_out.scores.is_empty() {
            flow = callback(Event::Validation(&held_out))?;
            trainer.note(held_out.clone());
        }
        Ok((held_out, flow))
    };
    while trainer.progress().step < total {
        let step = trainer.progress().step;
        let report = trainer.step(|index| batch(step, index))?;
        let step = report.step;
        let mut stop = callback(Event::Step {
            report: &report,
            total,
        })? == Flow::Stop;
        let due = |every: u64| every > 0 && step.is_multiple_of(every) && step < total;
        if due(intervals.validate_every) {
            stop |= validated(trainer, &mut callback)?.1 == Flow::Stop;
        }
        stop &= step < total;
        if due(intervals.checkpoint_every) || stop {
            stop |= callback(Event::Checkpoint(trainer))? == Flow::Stop;
        }
        if stop {
            let held_out = HeldOut {
                step,
                ..HeldOut::default()
            };
            let flow = Flow::Stop;
            return Ok(Fitted { flow, held_out });
        }
    }
    let (last, _) = validated(trainer, &mut callback)?;
    Ok(Fitted {
        flow: Flow::Continue,
        held_out: trainer.finish()?.unwrap_or(last),
    })
}
