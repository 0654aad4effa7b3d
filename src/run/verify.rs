//! Verifies a run: its inputs and artifacts still have the bytes they had, and doing its work again, from a checkpoint where
//! there is one, gives the same bytes.

use super::cache::{Cache, Entry, MANIFEST, Manifest};
use super::checkpoint;
use super::environment;
use super::error::RunError;
use super::files;
use super::inputs;
use super::interrupt::Interrupt;
use super::progress::Progress;
use super::provenance::LockFile;
use super::record::{RunDirectory, State};
use super::schedule::{Schedule, Task};
use super::stage::{self, StageRecord, Surroundings};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// What was looked at: an input or a stage; `, again` where the stage was done again.
    pub what: String,
    /// What the look says of it.
    pub verdict: Verdict,
    /// What was found.
    pub detail: String,
}

/// What a look says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The bytes are those of the record.
    Same,
    /// The bytes are others, or cannot be had.
    Changed,
    /// Not looked at, and why.
    Skipped,
    /// It was damaged or gone, and was made again.
    Repaired,
    /// It could not be looked at or made again, and why.
    Failed,
}

/// How much to do again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Redo {
    /// Only hash.
    Nothing,
    /// From checkpoints, and whole stages that took less than a minute.
    Quick,
    /// Everything.
    All,
}

/// What to do beside looking.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct How {
    /// Which stages are done again to compare.
    pub redo: Redo,
    /// Make again what is damaged or gone.
    pub repair: bool,
}

impl From<Redo> for How {
    fn from(redo: Redo) -> Self {
        Self {
            redo,
            repair: false,
        }
    }
}

/// Stages without a checkpoint that took longer are only done again when all of it is asked for.
const QUICK_SECONDS: f64 = 60.0;

/// Looks at everything, in the order of the work. What cannot be looked at or made again is a finding like any other; only an
/// interrupt, or a plan that cannot be read, ends it.
pub fn verify(
    run: &RunDirectory,
    how: impl Into<How>,
    progress: &Progress,
    interrupt: &Interrupt,
) -> Result<Vec<Check>, RunError> {
    let how = how.into();
    let schedule = Schedule::read(run)?;
    let lock: LockFile = files::read_json(&run.path().join("lock.json"))?;
    let cache = Cache::of(run.runs());
    let mut checks = outside(&lock);
    for work in &schedule.works {
        interrupt.check()?;
        let label = work.label(schedule.sweep);
        let around = Surroundings {
            cache: &cache,
            data: &schedule.data,
            progress,
            interrupt,
            peers: None,
        };
        let directory = run.path().join("stages").join(&work.directory);
        let finished = StageRecord::read(&directory).is_some_and(|r| r.state == State::Done);
        let mut hashed = match cache.look(&work.key) {
            Entry::Absent if finished => Check::new(&label, Verdict::Changed, "it is gone"),
            Entry::Absent => Check::new(&label, Verdict::Skipped, "not made yet"),
            _ => Check::of(
                &label,
                cache.rehash(&work.key),
                "same bytes as when it was made",
            )?,
        };
        if how.repair && matches!(hashed.verdict, Verdict::Changed | Verdict::Failed) {
            progress.say(&format!("  repairing: {label}"));
            hashed = repair(work, hashed, &directory, &around)?;
        }
        let same = hashed.verdict == Verdict::Same;
        checks.push(hashed);
        if same && how.redo != Redo::Nothing {
            progress.say(&format!("  again: {label}"));
            checks.push(again(run, work, &label, how.redo, &around)?);
        }
    }
    Ok(checks)
}

impl Check {
    fn new(what: &str, verdict: Verdict, detail: impl Into<String>) -> Self {
        Self {
            what: what.into(),
            verdict,
            detail: detail.into(),
        }
    }

    /// A change is a finding, and so is what could not be looked at; an interrupt ends everything.
    fn of(what: &str, result: Result<(), RunError>, same: &str) -> Result<Self, RunError> {
        match result {
            Ok(()) => Ok(Self::new(what, Verdict::Same, same)),
            Err(RunError::Changed { detail, .. }) => Ok(Self::new(what, Verdict::Changed, detail)),
            Err(RunError::Interrupted) => Err(RunError::Interrupted),
            Err(error) => Ok(Self::new(what, Verdict::Failed, error.to_string())),
        }
    }
}

/// Makes a damaged artifact again and compares with what its manifest said, where that can still be read.
fn repair(
    work: &Task,
    found: Check,
    directory: &Path,
    around: &Surroundings<'_>,
) -> Result<Check, RunError> {
    let cache = around.cache;
    let before: Option<Manifest> = files::read_json(&cache.path(&work.key).join(MANIFEST)).ok();
    let _lock = cache.lock(&work.key, around.interrupt, |_| {
        around.progress.say("  waiting for another process");
    })?;
    let made = cache
        .set_aside(&work.key)
        .and_then(|()| stage::make(work, &found.what, directory, around).map(drop));
    let why = &found.detail;
    let (verdict, detail) = match (made, before, cache.look(&work.key)) {
        (Err(RunError::Interrupted), ..) => return Err(RunError::Interrupted),
        (Err(error), ..) => (Verdict::Failed, format!("{why}; not made again: {error}")),
        (Ok(()), Some(before), Entry::Whole(now)) if before.files != now.files => (
            Verdict::Changed,
            format!("{why}; made again with other bytes than the first time"),
        ),
        (Ok(()), Some(_), _) => (Verdict::Repaired, format!("{why}; made again: same bytes")),
        (Ok(()), None, _) => (Verdict::Repaired, format!("{why}; made again")),
    };
    Ok(Check::new(&found.what, verdict, detail))
}

fn outside(lock: &LockFile) -> Vec<Check> {
    let mut checks = Vec::new();
    for file in &lock.files {
        let what = format!("input `{}`", file.path.display());
        checks.push(match inputs::fingerprint(&file.path) {
            Ok(now) if now.hash.to_hex().as_str() == file.blake3 => {
                Check::new(&what, Verdict::Same, "same as when it was read")
            }
            Ok(_) => Check::new(&what, Verdict::Changed, "another than when it was read"),
            Err(error) => Check::new(&what, Verdict::Changed, error.to_string()),
        });
    }
    checks
}

/// Does one piece of work again beside the run and compares.
fn again(
    run: &RunDirectory,
    work: &Task,
    label: &str,
    redo: Redo,
    around: &Surroundings<'_>,
) -> Result<Check, RunError> {
    let what = format!("{label}, again");
    let made = around.cache.made(&work.key);
    let mut kept = run
        .path()
        .join("stages")
        .join(&work.directory)
        .join("checkpoints");
    if let Some(made) = made.as_ref().filter(|_| checkpoint::all(&kept).is_empty()) {
        kept = run.runs().join(&made.stage).join("checkpoints");
    }
    let from = checkpoint::all(&kept).into_iter().next();
    let seconds = made.map_or(f64::INFINITY, |made| made.seconds);
    if from.is_none() && redo == Redo::Quick && seconds > QUICK_SECONDS {
        let detail = format!("no checkpoint, and it took {seconds:.0} s; `--all` does it");
        return Ok(Check::new(&what, Verdict::Skipped, detail));
    }
    let scratch = run.path().join(format!(".verify-{}", environment::pid()));
    let begin = || {
        files::remove(&scratch)?;
        let Some((step, path)) = &from else {
            return Ok(());
        };
        let name = format!("step-{step:06}");
        files::copy_tree(path, &scratch.join("checkpoints").join(name))
    };
    let begun = begin();
    let how = from.as_ref().map_or_else(
        || "from the beginning: same bytes".to_owned(),
        |(step, _)| format!("from step {step}: same bytes"),
    );
    let result = begun
        .and_then(|()| stage::redo(work, label, &scratch, around))
        .and_then(|output| compare(work, around.cache, &output));
    files::remove(&scratch)?;
    Check::of(&what, result, &how)
}

fn compare(work: &Task, cache: &Cache, output: &Path) -> Result<(), RunError> {
    let changed = |detail: String| RunError::Changed {
        what: work.stage.clone(),
        detail,
    };
    let Entry::Whole(manifest) = cache.look(&work.key) else {
        return Err(changed("the artifact went away meanwhile".into()));
    };
    let mut now = BTreeMap::new();
    for file in files::files_below(output)? {
        let (hash, _) = files::hash(&output.join(&file))?;
        let name: Vec<_> = file.iter().map(|part| part.to_string_lossy()).collect();
        now.insert(name.join("/"), hash.to_hex().to_string());
    }
    now.remove(MANIFEST);
    for (name, file) in &manifest.files {
        match now.remove(name) {
            None => return Err(changed(format!("`{name}` was not made again"))),
            Some(hash) if hash != file.blake3 => {
                return Err(changed(format!("`{name}` came out with other bytes")));
            }
            Some(_) => {}
        }
    }
    now.into_keys().next().map_or(Ok(()), |name| {
        Err(changed(format!("`{name}` was not there the first time")))
    })
}
