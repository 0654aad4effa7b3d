//! Other processes that do a stage together with this one.
//!
//! One process, rank 0, has the run: its directory, the cache, the progress, the record. Before a stage whose op is
//! [`together`](crate::experiment::Op::together) it hands the others what they need for it; they run the same op in a context
//! that records nothing. What they write are pieces that are theirs alone: shards, clips. Every other stage is rank 0's.

use super::inputs;
use crate::experiment::{InputArtifact, StageContext, StageError};
use crate::run::cache::Cache;
use crate::run::context::{explain, explain_panic};
use crate::run::error::RunError;
use crate::run::schedule::Task;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// How rank 0 reaches the others.
pub trait Peers: std::fmt::Debug + Sync {
    /// Hands them a stage.
    ///
    /// # Errors
    /// When one of them is lost.
    fn begin(&self, part: &Part) -> Result<(), String>;

    /// The end of the stage here.
    ///
    /// # Errors
    /// When another has failed.
    fn end(&self, mine: Result<(), String>) -> Result<(), String>;
}

/// A stage as the others get it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Part {
    task: Task,
    checkpoints: PathBuf,
    output: PathBuf,
    data: BTreeMap<String, PathBuf>,
}

impl Part {
    pub(super) fn new(
        task: &Task,
        checkpoints: &Path,
        output: &Path,
        data: &BTreeMap<String, PathBuf>,
    ) -> Self {
        Self {
            task: task.clone(),
            checkpoints: checkpoints.to_path_buf(),
            output: output.to_path_buf(),
            data: data.clone(),
        }
    }

    /// Does a stage that rank 0 has handed out.
    pub fn work(&self, cache: &Cache) -> Result<(), RunError> {
        let op = self.task.op()?;
        let mut context = Silent {
            part: self,
            inputs: inputs(&self.task, cache)?,
        };
        let run = AssertUnwindSafe(|| op.run(&self.task.settings, &mut context));
        match catch_unwind(run) {
            Ok(result) => result
                .map(drop)
                .map_err(|error| explain(&self.task.stage, error)),
            Err(panic) => Err(explain_panic(&self.task.stage, op, panic.as_ref(), "")),
        }
    }
}

/// What an op sees on the other ranks.
struct Silent<'a> {
    part: &'a Part,
    inputs: Vec<(String, Vec<InputArtifact>)>,
}

impl StageContext for Silent<'_> {
    fn stage(&self) -> &str {
        &self.part.task.stage
    }

    fn inputs(&self, port: &str) -> &[InputArtifact] {
        let found = self.inputs.iter().find(|(name, _)| name == port);
        found.map_or(&[], |(_, artifacts)| artifacts)
    }

    fn output(&self) -> &Path {
        &self.part.output
    }

    fn checkpoints(&self) -> &Path {
        &self.part.checkpoints
    }

    fn seed(&self) -> u64 {
        self.part.task.seed
    }

    fn data_root(&self, name: &str) -> Option<&Path> {
        self.part.data.get(name).map(PathBuf::as_path)
    }

    fn record(&mut self, _: u64, _: &[(&str, f64)]) -> Result<(), StageError> {
        Ok(())
    }

    fn record_text(&mut self, _: u64, _: &str, _: &str) -> Result<(), StageError> {
        Ok(())
    }

    fn record_histogram(&mut self, _: u64, _: &str, _: &[f32]) -> Result<(), StageError> {
        Ok(())
    }

    fn progress(&mut self, _: u64, _: u64, _: &str) {}

    fn log(&mut self, _: &str) {}

    /// Rank 0 decides for all.
    fn interrupted(&self) -> bool {
        false
    }
}
