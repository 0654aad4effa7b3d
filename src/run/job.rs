//! What a run is asked to do.

use super::interrupt::Interrupt;
use super::progress::Progress;
use super::record::Shard;
use super::worker_pool::WorkerPool;
use crate::experiment::Experiment;
use std::path::Path;

/// What to run, and how.
pub struct Job<'a> {
    pub experiment: &'a Experiment,
    /// The directory of runs; the cache lies in it.
    pub runs: &'a Path,
    /// Only this stage, and what it needs.
    pub only: Option<&'a str>,
    pub shard: Shard,
    /// Read every byte of what is in the cache before it is used.
    pub check: bool,
    /// How many stages at once.
    pub crew: WorkerPool,
    pub progress: &'a Progress,
    pub interrupt: &'a Interrupt,
}
