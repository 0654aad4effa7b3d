//! What a run is asked to do.

use super::interrupt::Interrupt;
use super::progress::Progress;
use super::record::Shard;
use super::worker_pool::WorkerPool;
use crate::experiment::Experiment;
use std::path::Path;

/// What to run, and how.
pub struct Job<'a> {
    /// What to run: a checked experiment or sweep.
    pub experiment: &'a Experiment,
    /// The directory of runs; the cache lies in it.
    pub runs: &'a Path,
    /// Only this stage, and what it needs.
    pub only: Option<&'a str>,
    /// Which of the cells this process does.
    pub shard: Shard,
    /// Read every byte of what is in the cache before it is used.
    pub check: bool,
    /// How many stages at once.
    pub crew: WorkerPool,
    /// Where to say how far it is.
    pub progress: &'a Progress,
    /// Who may stop it; what was stopped can be resumed.
    pub interrupt: &'a Interrupt,
}
