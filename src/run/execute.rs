//! Executes an experiment: topological, cached, interruptible, resumable, sharded.
//!
//! The same experiment asked for again finds its run by identity and goes on where it stopped. Each piece of work is done
//! under its key's lock, so that shards and other runs over the same disk wait for it instead of doing it twice.

use super::cache::{Cache, Entry, Key};
use super::error::RunError;
use super::inputs::Fingerprints;
pub use super::job::Job;
use super::metrics::{self, Row};
use super::progress::duration;
use super::record::{Owned, RunDirectory, State};
use super::schedule::{Schedule, Task};
use super::stage::{self, Surroundings};
use super::worker_pool::Ended;
use super::{gc, provenance, report};
use crate::experiment::Settings;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What became of it.
#[derive(Debug)]
pub struct Outcome {
    /// The record of the run.
    pub run: RunDirectory,
    /// How the part of this process ended.
    pub state: State,
    /// Pieces of work done by this process.
    pub made: usize,
    /// Pieces of work that were there already.
    pub found: usize,
    /// Every stage that failed, in order; what depends on it was left out, everything else was done.
    pub failures: Vec<RunError>,
    /// Where the artifact of each stage is, of those that are made; of a sweep, that of the last arm.
    pub artifacts: BTreeMap<String, PathBuf>,
    /// What there was to do.
    pub schedule: Schedule,
}

impl Outcome {
    /// The settings of a stage.
    #[must_use]
    pub fn settings(&self, stage: &str) -> Option<&Settings> {
        self.work(stage).map(|work| &work.settings)
    }

    /// What a stage recorded step by step; nothing where it was made by another run.
    ///
    /// # Errors
    /// When the record cannot be read.
    pub fn metrics(&self, stage: &str) -> Result<Vec<Row>, RunError> {
        let directory = |work: &Task| self.run.path().join("stages").join(&work.directory);
        self.work(stage)
            .map_or_else(|| Ok(Vec::new()), |work| metrics::read(&directory(work)))
    }

    fn work(&self, stage: &str) -> Option<&Task> {
        let mut works = self.schedule.works.iter();
        works.find(|work| work.stage == stage)
    }
}

/// Where the artifacts that are made lie, by stage.
fn artifacts(schedule: &Schedule, cache: &Cache) -> BTreeMap<String, PathBuf> {
    let works = schedule.works.iter();
    works
        .filter(|work| cache.contains(&work.key))
        .map(|work| (work.stage.clone(), cache.path(&work.key)))
        .collect()
}

/// Runs an experiment. An error means that the run could not be begun; what fails later is in the [`Outcome`].
pub fn execute(job: &Job<'_>) -> Result<Outcome, RunError> {
    let mut cache = Cache::of(job.runs);
    if job.check {
        cache = cache.strict();
    }
    let prints = Fingerprints::remembered(&cache).watched(job.progress, job.interrupt);
    let schedule = Schedule::of(job.experiment, prints)?;
    let targets = schedule.targets(job.only, job.shard)?;
    let asked = job.experiment.path.display().to_string();
    let planning = gc::keep_away(job.runs, job.interrupt, |_| {
        job.progress.say("  waiting for `reviv gc`");
    })?;
    let run = RunDirectory::find_or_create(
        job.runs,
        &schedule.name,
        schedule.identity,
        &asked,
        job.interrupt,
    )?;

    if run.read()?.state == State::Done && schedule.to_do(&schedule.results(), &cache).is_empty() {
        let found = schedule.works.len();
        return Ok(Outcome {
            run,
            state: State::Done,
            made: 0,
            found,
            failures: Vec::new(),
            artifacts: artifacts(&schedule, &cache),
            schedule,
        });
    }

    let owned = run.own(job.shard)?;
    owned.begin()?;
    let worker = Worker {
        job,
        schedule: &schedule,
        cache: &cache,
        run: &run,
        made: AtomicUsize::new(0),
    };
    let planned = provenance::write(job, &schedule, &run);
    drop(planning);
    let Ended { mut failures, end } = match planned {
        Ok(()) => worker.work(&targets),
        Err(error) => Ended {
            end: Some(error),
            ..Ended::default()
        },
    };
    let made = worker.made.into_inner();
    let state = match end {
        None if failures.is_empty() => State::Done,
        None => State::Failed,
        Some(RunError::Interrupted) => State::Interrupted,
        Some(error) => {
            failures.push(error);
            State::Failed
        }
    };
    let state = finish(&owned, &schedule, &cache, state, &mut failures);
    let found = schedule
        .works
        .iter()
        .filter(|work| cache.contains(&work.key))
        .count();
    Ok(Outcome {
        run,
        state,
        made,
        found: found.saturating_sub(made),
        failures,
        artifacts: artifacts(&schedule, &cache),
        schedule,
    })
}

/// Writes the end of this process's part, and the page.
fn finish(
    owned: &Owned,
    schedule: &Schedule,
    cache: &Cache,
    state: State,
    failures: &mut Vec<RunError>,
) -> State {
    let complete = || schedule.to_do(&schedule.results(), cache).is_empty();
    let end = owned.end(state, failures.first().map(RunError::failure), complete);
    let page = owned.alone(|| report::write(owned.directory()));
    // With the disk full, say so once; the record is as whole as the disk allows.
    if let (Err(error), true) = (end.and(page), failures.is_empty()) {
        failures.push(error);
    }
    match state {
        State::Done if !failures.is_empty() => State::Failed,
        // This part is done; others of the run may not be.
        State::Done if !complete() => State::Queued,
        state => state,
    }
}

struct Worker<'a> {
    job: &'a Job<'a>,
    schedule: &'a Schedule,
    cache: &'a Cache,
    run: &'a RunDirectory,
    made: AtomicUsize,
}

impl Worker<'_> {
    /// Makes what `targets` need.
    fn work(&self, targets: &BTreeSet<Key>) -> Ended {
        let to_do = self.schedule.to_do(targets, self.cache);
        if let Err(error) = self.note_found() {
            return Ended {
                end: Some(error),
                ..Ended::default()
            };
        }
        let make = |index: usize, work: &Task| {
            self.job.interrupt.check()?;
            let label = work.label(self.schedule.sweep);
            let made = self.one(work, &label, index + 1, to_do.len());
            if let Err(error) = &made
                && !ends(error)
            {
                self.job.progress.say(&format!("  failed {label}: {error}"));
            }
            made
        };
        self.job.crew.work(&to_do, make, ends)
    }

    /// Leaves a note in the directory of every stage that is in the cache already.
    fn note_found(&self) -> Result<(), RunError> {
        for work in &self.schedule.works {
            match self.cache.look(&work.key) {
                Entry::Whole(_) => stage::note_cached(work, &self.directory(work), self.cache)?,
                Entry::Damaged(why) => {
                    let path = self.cache.path(&work.key);
                    self.job.progress.say(&format!(
                        "  damaged {}: {why}; it is made again",
                        path.display()
                    ));
                }
                Entry::Absent => {}
            }
        }
        Ok(())
    }

    fn one(&self, work: &Task, label: &str, index: usize, of: usize) -> Result<(), RunError> {
        let progress = self.job.progress;
        let _lock = self.cache.lock(&work.key, self.job.interrupt, |holder| {
            let who =
                holder.map_or_else(String::new, |h| format!(" (pid {} on `{}`)", h.pid, h.host));
            progress.say(&format!(
                "  waiting for another process{who} that makes {label}"
            ));
        })?;
        let directory = self.directory(work);
        if self.cache.contains(&work.key) {
            progress.say(&format!(
                "  [{index}/{of}] {label}: made by another process"
            ));
            return stage::note_cached(work, &directory, self.cache);
        }
        progress.say(&format!("  [{index}/{of}] {label}"));
        let around = Surroundings {
            cache: self.cache,
            data: &self.schedule.data,
            progress,
            interrupt: self.job.interrupt,
            peers: self.job.crew.peers,
        };
        let made = stage::make(work, label, &directory, &around)?;
        progress.say(&format!(
            "  [{index}/{of}] {label}: done in {}",
            duration(made.seconds)
        ));
        self.made.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    fn directory(&self, work: &Task) -> std::path::PathBuf {
        self.run.path().join("stages").join(&work.directory)
    }
}

/// Asked to stop, or without space: nothing else can go well.
fn ends(error: &RunError) -> bool {
    matches!(error, RunError::Interrupted | RunError::NoSpace { .. })
}
