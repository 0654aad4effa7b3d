//! Prunes the cache: what no run directory refers to, what is damaged, and what killed processes left behind.

use super::cache::{Cache, Key};
use super::error::{AtPath, Holder, RunError};
use super::files;
use super::interrupt::Interrupt;
use super::lock::{Lock, Mode};
use super::record::{RunDirectory, State};
use super::schedule::{PLAN, Schedule};
use super::stage::StageRecord;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Held by who prunes, alone; and shared by every run from before it looks into the cache until its plan is written. Taken before
/// any other lock.
const PRUNING: &str = ".lock-gc";

/// Keeps `reviv gc` away until it is dropped: for a run that begins.
pub(super) fn keep_away(
    runs: &Path,
    interrupt: &Interrupt,
    waiting: impl FnOnce(Option<Holder>),
) -> Result<Lock, RunError> {
    files::create_directory(runs)?;
    Lock::wait_as(&runs.join(PRUNING), Mode::Shared, interrupt, waiting)
}

/// What was pruned, or would be.
#[derive(Debug, Default, Serialize)]
pub struct Pruned {
    /// Files and directories that were removed, or would be.
    #[serde(serialize_with = "crate::formats::text::serialize_paths")]
    pub paths: Vec<PathBuf>,
    /// Their size in bytes, all together.
    pub bytes: u64,
    /// Artifacts that runs refer to.
    pub kept: usize,
}

/// What to prune.
#[derive(Debug, Clone, Copy, Default)]
pub struct Options {
    /// Only say what would go.
    pub dry_run: bool,
    /// Also the checkpoints of finished stages; `reviv verify` can then redo no steps from them.
    pub checkpoints: bool,
}

/// Prunes the cache of `runs`. An artifact stays as long as a run directory refers to it: delete the run's directory first.
pub fn prune(runs: &Path, options: Options) -> Result<Pruned, RunError> {
    let cache = Cache::of(runs);
    let mut pruned = Pruned::default();
    if !runs.is_dir() {
        return Ok(pruned);
    }
    // From here to the end no run begins: one that has looked into the cache has said what it refers to, or has not looked yet.
    let _alone = if options.dry_run {
        None
    } else {
        let never = Interrupt::default();
        Some(Lock::wait(&runs.join(PRUNING), &never, |_| {})?)
    };
    let (referred, checkpoints) = referred(runs)?;
    for leaf in cache.entries()? {
        let whole = leaf.extension.is_empty();
        let belongs = ["made.json", "seen.json"].contains(&leaf.extension.as_str());
        if (whole || belongs) && referred.contains(&leaf.key) {
            pruned.kept += usize::from(whole);
            continue;
        }
        let path = cache.lock_path(&leaf.key);
        // Whoever makes the artifact now holds the lock: leave all of it alone.
        let Some(lock) = Lock::attempt(&path, Mode::Exclusive)? else {
            continue;
        };
        if leaf.extension != "lock" {
            pruned.take(&leaf.path, options)?;
        }
        if !options.dry_run {
            lock.remove()?;
        }
    }
    if options.checkpoints {
        for path in checkpoints {
            pruned.take(&path, options)?;
        }
    }
    Ok(pruned)
}

impl Pruned {
    fn take(&mut self, path: &Path, options: Options) -> Result<(), RunError> {
        let meta = match std::fs::symlink_metadata(path) {
            Ok(meta) => meta,
            // Whoever made it has finished since it was listed.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error).at("reading", path),
        };
        self.bytes += if meta.is_dir() {
            files::size_below(path)?
        } else {
            meta.len()
        };
        self.paths.push(path.to_path_buf());
        if options.dry_run {
            return Ok(());
        }
        files::remove(path)
    }
}

/// The keys that run directories refer to, and the checkpoints of their finished stages.
fn referred(runs: &Path) -> Result<(BTreeSet<Key>, Vec<PathBuf>), RunError> {
    let mut keys = BTreeSet::new();
    let mut checkpoints = Vec::new();
    for run in RunDirectory::all(runs)? {
        let plan = run.path().join(PLAN);
        if !plan.exists() {
            if run.is_busy() {
                return Err(RunError::Request {
                    message: format!("run `{}` is just being planned", run.name()),
                    help: "try again in a moment".into(),
                });
            }
            continue;
        }
        // A plan that cannot be read stops everything: what it refers to is not known.
        let schedule = Schedule::read(&run)?;
        for work in &schedule.works {
            keys.insert(work.key);
            let directory = run.path().join("stages").join(&work.directory);
            let done = StageRecord::read(&directory).is_some_and(|r| r.state == State::Done);
            let home = directory.join("checkpoints");
            if done && home.is_dir() {
                checkpoints.push(home);
            }
        }
    }
    Ok((keys, checkpoints))
}
