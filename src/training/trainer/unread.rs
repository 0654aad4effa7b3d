//! Steps whose numbers may still be on the device: what a micro-batch found, and what becomes a report when somebody reads it.

use super::ranks::Told;
use super::{MicroStep, Progress, StepReport, TrainingError};
use crate::engine::{Gradients, Reading};
use crate::training::optimizer::NotFinite;

/// What a forward and backward pass over one micro-batch found.
#[derive(Debug)]
pub struct Found<T> {
    /// What is minimised, and behind it the means of the parts.
    pub numbers: Reading,
    /// Parts of the loss by name, with their weights among micro-batches.
    pub parts: Vec<(String, f64)>,
    /// `None` where nothing was asked for, or the loss is known not to be finite.
    pub gradients: Option<Gradients>,
    /// Samples and tokens of the micro-batch; `step` is 0.
    pub used: Progress,
    /// For [`super::Objective::finish_step`].
    pub trace: T,
}

impl<T: Told> Found<T> {
    /// As ranks tell each other: waits for the device.
    pub(super) fn told(self) -> MicroStep<T> {
        let mut numbers = self.numbers.read().into_iter();
        let loss = numbers.next().unwrap_or_default();
        let parts = self.parts.into_iter().zip(numbers);
        MicroStep {
            loss,
            parts: parts
                .map(|((name, weight), mean)| (name, mean, weight))
                .collect(),
            gradients: self.gradients,
            used: self.used,
            trace: self.trace,
        }
    }

    /// As they were told.
    pub(super) fn heard(micro: MicroStep<T>) -> Self {
        let means = micro.parts.iter().map(|(_, mean, _)| *mean);
        Self {
            numbers: Reading::Host(std::iter::once(micro.loss).chain(means).collect()),
            parts: (micro.parts.into_iter())
                .map(|(name, _, weight)| (name, weight))
                .collect(),
            gradients: micro.gradients,
            used: micro.used,
            trace: micro.trace,
        }
    }

    /// Whether the loss is known, and not finite: which it is then.
    pub(super) fn bad_loss(&self) -> Option<f64> {
        let loss = *self.numbers.known()?.first()?;
        (!loss.is_finite()).then_some(loss)
    }
}

/// Numbers by name.
#[derive(Debug, Clone)]
pub struct Named {
    /// One name each.
    pub names: Vec<String>,
    /// As many numbers.
    pub numbers: Reading,
}

impl Named {
    /// Nothing to report.
    #[must_use]
    pub fn none() -> Self {
        Self {
            names: Vec::new(),
            numbers: Reading::Host(Vec::new()),
        }
    }
}

/// What is left of a micro-batch.
#[derive(Debug, Clone)]
pub(super) struct Micro {
    /// As [`Found::numbers`].
    pub(super) numbers: Reading,
    /// As [`Found::parts`].
    pub(super) parts: Vec<(String, f64)>,
    /// Its share of the step.
    pub(super) share: f64,
}

/// A step that was taken.
#[derive(Debug, Clone)]
pub(super) struct Unread {
    pub(super) micros: Vec<Micro>,
    pub(super) norm: Reading,
    /// What the step changed besides.
    pub(super) further: Named,
    pub(super) learning_rate: f64,
    pub(super) progress: Progress,
}

impl Unread {
    fn readings(&self) -> impl Iterator<Item = &Reading> {
        let micros = self.micros.iter().map(|micro| &micro.numbers);
        micros.chain([&self.norm, &self.further.numbers])
    }

    /// Whether reading it waits for nothing.
    pub(super) fn is_known(&self) -> bool {
        self.readings().all(|reading| reading.known().is_some())
    }

    /// The reports of `steps`, in order, waiting once; the first one that should not have been taken ends them.
    pub(super) fn read(steps: Vec<Self>) -> Result<Vec<StepReport>, TrainingError> {
        let readings: Vec<&Reading> = steps.iter().flat_map(Self::readings).collect();
        let mut read = Reading::read_all(&readings).into_iter();
        let last = steps.last().map_or(0, |step| step.progress.step);
        let reports = steps.into_iter().map(|step| {
            let report = step.report(&mut read)?;
            let behind = last - report.step;
            Ok(StepReport { behind, ..report })
        });
        reports.collect()
    }

    /// `read` gives what [`Unread::readings`] named.
    fn report(
        self,
        read: &mut impl Iterator<Item = Vec<f64>>,
    ) -> Result<StepReport, TrainingError> {
        let mut next = || read.next().unwrap_or_default().into_iter();
        let step = self.progress.step;
        let (mut loss, mut parts) = (0.0, Vec::new());
        for micro in self.micros {
            let mut numbers = next();
            let own = numbers.next().unwrap_or_default();
            if !own.is_finite() {
                return Err(TrainingError::Loss { step, loss: own });
            }
            loss += own * micro.share;
            let means = micro.parts.into_iter().zip(numbers);
            add(
                &mut parts,
                means.map(|((name, weight), mean)| (name, mean, weight)),
            );
        }
        let gradient_norm = next().next().unwrap_or_default();
        if !gradient_norm.is_finite() {
            let norm = gradient_norm;
            return Err(NotFinite { step, norm }.into());
        }
        let further = self.further.names.into_iter().zip(next());
        let parts = parts.into_iter().map(|(name, mean, _)| (name, mean));
        Ok(StepReport {
            step,
            loss,
            parts: parts.chain(further).collect(),
            learning_rate: self.learning_rate,
            gradient_norm,
            progress: self.progress,
            waited: 0.0,
            behind: 0,
        })
    }
}

/// Adds weighted means of another micro-batch.
fn add(sums: &mut Vec<(String, f64, f64)>, parts: impl Iterator<Item = (String, f64, f64)>) {
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
