//! A training on disk: what the next step depends on, written down and read back, on any number of ranks.

use super::{Best, Objective, Progress, Trainer, TrainingError};
use crate::engine::{Parameters, Weights};
use crate::training::settings::Keep;
use std::path::Path;
use std::sync::Arc;

/// A training that can be written down.
pub trait Checkpoint {
    /// How many steps were taken.
    fn step(&self) -> u64;

    /// Everything that the next step depends on, besides settings, seed and data, on the host: to be written while training goes on.
    ///
    /// # Errors
    /// When a rank is lost.
    fn snapshot(&self) -> Result<Snapshot, TrainingError>;

    /// Writes it into an empty directory.
    ///
    /// # Errors
    /// When a file cannot be written.
    fn save(&self, directory: &Path) -> Result<(), TrainingError> {
        self.snapshot()?.write(directory)
    }
}

/// What a checkpoint holds. Of several ranks rank 0 has it where they share the state of the optimizer.
#[derive(Debug, Clone)]
pub struct Snapshot {
    weights: Weights,
    optimizer: Arc<Weights>,
    best: Option<Best>,
    progress: Progress,
}

impl Snapshot {
    /// Writes it into an empty directory.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(mut self, directory: &Path) -> Result<(), TrainingError> {
        self.weights.write(&directory.join(WEIGHTS))?;
        self.optimizer.write(&directory.join(OPTIMIZER))?;
        if let Some(best) = &mut self.best {
            let path = directory.join(BEST);
            let text = serde_json::to_string(&best.held_out).map_err(|e| damaged(&path, &e))?;
            best.weights.metadata.insert(HELD_OUT.to_owned(), text);
            best.weights.write(&path)?;
        }
        let path = directory.join(PROGRESS);
        let text =
            serde_json::to_vec_pretty(&self.progress).map_err(|error| damaged(&path, &error))?;
        std::fs::write(&path, text).map_err(|error| TrainingError::Write { path, error })
    }
}

impl<O: Objective> Checkpoint for Trainer<O> {
    fn step(&self) -> u64 {
        self.progress.step
    }

    fn snapshot(&self) -> Result<Snapshot, TrainingError> {
        let state = self.optimizer.state()?;
        Ok(self.with(Arc::new(state.unwrap_or_default())))
    }
}

impl<O: Objective> Trainer<O> {
    /// Writes everything that the next step depends on, besides settings, seed and data, into an empty directory. Where ranks share the
    /// state of the optimizer all of them must do so at once, and what rank 0 writes is whole; the others write nothing.
    ///
    /// # Errors
    /// When a file cannot be written, or a rank is lost.
    pub fn save(&self, directory: &Path) -> Result<(), TrainingError> {
        match self.optimizer.state()? {
            Some(state) => self.with(Arc::new(state)).write(directory),
            None => Ok(()),
        }
    }

    fn with(&self, optimizer: Arc<Weights>) -> Snapshot {
        Snapshot {
            weights: self.objective.module().weights(),
            optimizer,
            best: self.best.clone(),
            progress: self.progress,
        }
    }

    /// Runs `keep` with what can be written down, on every rank: also where it takes all of them to put it together.
    pub(in crate::training) fn kept<R>(
        &self,
        keep: impl FnOnce(&dyn Checkpoint) -> R,
    ) -> Result<R, TrainingError> {
        if !self.optimizer.is_sharded() {
            return Ok(keep(self));
        }
        let state = self.optimizer.state()?.unwrap_or_default();
        Ok(keep(&Whole {
            trainer: self,
            state: Arc::new(state),
        }))
    }

    /// Continues from a directory of [`Trainer::save`]: the next steps are those the stored run would have taken, to the bit.
    ///
    /// # Errors
    /// When the directory is damaged or of another model.
    pub fn resume(&mut self, directory: &Path) -> Result<(), TrainingError> {
        let path = directory.join(PROGRESS);
        let text = std::fs::read(&path).map_err(|error| damaged(&path, &error))?;
        let progress: Progress =
            serde_json::from_slice(&text).map_err(|error| damaged(&path, &error))?;
        let path = directory.join(BEST);
        let best = if self.keep == Keep::Best && path.is_file() {
            let mut weights = Weights::read(&path)?;
            let text = weights.metadata.remove(HELD_OUT).unwrap_or_default();
            let held_out = serde_json::from_str(&text).map_err(|error| damaged(&path, &error))?;
            self.objective.module().check_shapes(&weights)?;
            Some(Best { held_out, weights })
        } else {
            None
        };
        let weights = Weights::read(&directory.join(WEIGHTS))?;
        self.optimizer
            .restore(&Weights::read(&directory.join(OPTIMIZER))?)?;
        self.objective.module_mut().load(&weights)?;
        self.progress = progress;
        self.best = best;
        Ok(())
    }
}

/// A trainer, and what the ranks have put together of its optimizer.
struct Whole<'a, O> {
    trainer: &'a Trainer<O>,
    /// Nothing on other ranks than 0.
    state: Arc<Weights>,
}

impl<O: Objective> Checkpoint for Whole<'_, O> {
    fn step(&self) -> u64 {
        self.trainer.progress.step
    }

    fn snapshot(&self) -> Result<Snapshot, TrainingError> {
        Ok(self.trainer.with(Arc::clone(&self.state)))
    }
}

const WEIGHTS: &str = "weights.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const BEST: &str = "best.safetensors";
const PROGRESS: &str = "progress.json";
/// The key of the held-out losses in the metadata of [`BEST`].
const HELD_OUT: &str = "held_out";

fn damaged(path: &Path, reason: &dyn std::fmt::Display) -> TrainingError {
    TrainingError::Checkpoint {
        path: path.to_path_buf(),
        reason: reason.to_string(),
    }
}
