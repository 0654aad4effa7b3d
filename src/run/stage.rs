//! One stage at work: what its op sees of the run, and what stays of it.

pub mod peers;

use self::peers::{Part, Peers};
use super::cache::{Cache, Entry, Key, Made, Recipe};
use super::context::{Context, explain, explain_panic};
use super::environment;
use super::error::{Failure, RunError};
use super::files;
use super::inputs::Fingerprints;
use super::interrupt::Interrupt;
use super::metrics::Metrics;
use super::progress::Progress;
use super::record::State;
use super::schedule::Task;
use crate::experiment::InputArtifact;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// `stage.json`: where one stage of a run stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageRecord {
    /// The stage's name where it appears first.
    pub stage: String,
    /// The op that does it.
    pub op: String,
    /// Address of its artifact.
    pub key: Key,
    /// Where the stage stands.
    pub state: State,
    /// The artifact, relative to the directory of runs.
    pub artifact: String,
    /// How often it was begun.
    pub attempts: u32,
    /// Of work, over all attempts that could write their end.
    pub seconds: f64,
    /// UTC.
    pub started: Option<String>,
    /// UTC; `None` while it runs, where it was killed, or where it was found in the cache at once.
    pub ended: Option<String>,
    /// For a stage that was found in the cache: where it was made.
    pub found: Option<Made>,
    /// Why it failed; `None` in every other state.
    pub error: Option<Failure>,
}

impl StageRecord {
    /// The record in a stage's directory, if there is one.
    pub fn read(directory: &Path) -> Option<Self> {
        files::read_json(&directory.join("stage.json")).ok()
    }

    fn write(&self, directory: &Path) -> Result<(), RunError> {
        files::write_json(&directory.join("stage.json"), self)
    }

    fn new(work: &Task, cache: &Cache) -> Self {
        let runs = cache.root().parent().unwrap_or(Path::new(""));
        let artifact = cache.path(&work.key);
        let artifact = artifact.strip_prefix(runs).unwrap_or(&artifact);
        Self {
            stage: work.stage.clone(),
            op: work.op.clone(),
            key: work.key,
            state: State::Queued,
            artifact: artifact.to_string_lossy().into_owned(),
            attempts: 0,
            seconds: 0.0,
            started: None,
            ended: None,
            found: None,
            error: None,
        }
    }
}

/// Notes in a stage's directory that its artifact was there already.
pub fn note_cached(work: &Task, directory: &Path, cache: &Cache) -> Result<(), RunError> {
    let kept = StageRecord::read(directory).filter(|record| record.key == work.key);
    if kept
        .as_ref()
        .is_some_and(|record| record.state == State::Done)
    {
        return Ok(());
    }
    files::create_directory(directory)?;
    let mut record = kept.unwrap_or_else(|| StageRecord::new(work, cache));
    record.state = State::Done;
    record.error = None;
    let here = stage_path(directory, cache);
    match cache.made(&work.key) {
        // Made right here, by a process that was killed before it could say so.
        Some(made) if made.stage == here => record.seconds = made.seconds,
        made => record.found = made,
    }
    record.write(directory)
}

/// What a stage needs beside its own work.
#[derive(Debug)]
pub struct Surroundings<'a> {
    /// Where its inputs come from, and where the artifact goes.
    pub cache: &'a Cache,
    /// Where data sets lie: name to directory.
    pub data: &'a BTreeMap<String, PathBuf>,
    /// Where to say how far it is.
    pub progress: &'a Progress,
    /// Who may stop it.
    pub interrupt: &'a Interrupt,
    /// Other processes, for the stages that all do together.
    pub peers: Option<&'a dyn Peers>,
}

/// Does one piece of work in `directory` and puts the artifact into the cache. The caller holds the key's lock.
pub fn make(
    work: &Task,
    label: &str,
    directory: &Path,
    around: &Surroundings<'_>,
) -> Result<StageRecord, RunError> {
    files::create_directory(directory)?;
    let mut record = StageRecord::read(directory)
        .filter(|record| record.key == work.key)
        .unwrap_or_else(|| StageRecord::new(work, around.cache));
    record.state = State::Running;
    record.attempts += 1;
    record.started = Some(environment::now_text());
    record.ended = None;
    record.error = None;
    record.write(directory)?;

    let output = around.cache.begin(&work.key)?;
    let (seconds, result) = perform(work, label, directory, output, around);
    record.seconds += seconds;
    let result = result.and_then(|contents| {
        unchanged(work, around.cache)?;
        let made = Made {
            op: work.op.clone(),
            seconds: record.seconds,
            host: environment::host(),
            at: environment::now_text(),
            stage: stage_path(directory, around.cache),
        };
        around
            .cache
            .publish(&work.key, &work.kind, recipe(work), contents, &made)
    });
    record.ended = Some(environment::now_text());
    match &result {
        Ok(_) => record.state = State::Done,
        Err(RunError::Interrupted) => record.state = State::Interrupted,
        Err(error) => {
            record.state = State::Failed;
            record.error = Some(error.failure());
        }
    }
    if result.is_err() {
        // The first error is the cause and must be recorded; what stays here goes when the work is begun again.
        let _ = around.cache.abandon(&work.key);
    }
    match (result, record.write(directory)) {
        (Ok(_), written) => written.map(|()| record),
        // The first error is the cause; that its record could not be written follows from it.
        (Err(error), _) => Err(error),
    }
}

/// What was hashed before the work must be what the work has read.
fn unchanged(work: &Task, cache: &Cache) -> Result<(), RunError> {
    let mut prints = Fingerprints::remembered(cache);
    for file in &work.files {
        if prints.of(&file.path)?.hash.to_hex().as_str() != file.blake3 {
            return Err(RunError::Changed {
                what: format!("`{}`", file.path.display()),
                detail: format!("it became another while `{}` was made from it", work.stage),
            });
        }
    }
    Ok(())
}

/// Does one piece of work again, in a scratch directory with `checkpoints/` to start from, and gives the directory of what
/// it made. Nothing of the run or the cache changes.
pub fn redo(
    work: &Task,
    label: &str,
    scratch: &Path,
    around: &Surroundings<'_>,
) -> Result<PathBuf, RunError> {
    let output = scratch.join("output");
    files::create_directory(&output)?;
    let (_, result) = perform(work, label, scratch, output.clone(), around);
    result.map(|_| output)
}

/// Runs the op: its seconds, and what it says of its artifact.
fn perform(
    work: &Task,
    label: &str,
    directory: &Path,
    output: PathBuf,
    around: &Surroundings<'_>,
) -> (f64, Result<Value, RunError>) {
    let prepare = || -> Result<_, RunError> {
        let checkpoints = directory.join("checkpoints");
        files::create_directory(&checkpoints)?;
        let context = Context {
            stage: &work.stage,
            inputs: inputs(work, around.cache)?,
            output,
            checkpoints,
            seed: work.seed,
            data: around.data,
            metrics: Some(Metrics::open(directory, hparams(work.settings.json()))?),
            log: directory.join("log.txt"),
            log_file: None,
            failed: None,
            task: around.progress.task(label),
            interrupt: around.interrupt,
        };
        Ok((work.op()?, context))
    };
    let (op, mut context) = match prepare() {
        Ok(prepared) => prepared,
        Err(error) => return (0.0, Err(error)),
    };
    let peers = around.peers.filter(|_| op.together());
    let lost = |message: String| {
        RunError::Stage {
        stage: work.stage.clone(),
        code: "E0808".into(),
        message,
        help: "mend it there and ask for the same experiment again, on any number of ranks: it continues".into(),
        exit: 2,
    }
    };
    if let Some(peers) = peers {
        let (checkpoints, output) = (&context.checkpoints, &context.output);
        let part = Part::new(work, checkpoints, output, around.data);
        if let Err(message) = peers.begin(&part) {
            return (0.0, context.close(Err(lost(message))));
        }
    }
    // A panic is a bug of the op; the rest of the run and its record must not suffer from it.
    let result = catch_unwind(AssertUnwindSafe(|| op.run(&work.settings, &mut context)));
    let result = match result {
        Ok(result) => result.map_err(|error| explain(&work.stage, error)),
        Err(panic) => Err(explain_panic(
            &work.stage,
            op,
            panic.as_ref(),
            "please report it with the run's directory; everything finished before it stays",
        )),
    };
    let ended = peers.map_or(Ok(()), |peers| {
        peers.end(result.as_ref().map(drop).map_err(ToString::to_string))
    });
    let result = result.and_then(|contents| ended.map_err(lost).map(|()| contents));
    (context.task.seconds(), context.close(result))
}

fn stage_path(directory: &Path, cache: &Cache) -> String {
    let runs = cache.root().parent().unwrap_or(Path::new(""));
    let relative = directory.strip_prefix(runs).unwrap_or(directory);
    relative.to_string_lossy().into_owned()
}

/// What decided the artifact, for its manifest. Paths stay out: where a file lies decides nothing.
pub fn recipe(work: &Task) -> Recipe {
    let mut settings = work.settings.json().clone();
    for file in &work.files {
        let mut at = Some(&mut settings);
        for part in file.key.split('.') {
            at = match at {
                Some(Value::Object(map)) => map.get_mut(part),
                Some(Value::Array(items)) => {
                    part.parse().ok().and_then(|i: usize| items.get_mut(i))
                }
                _ => None,
            };
        }
        if let Some(value) = at {
            *value = Value::Null;
        }
    }
    Recipe {
        op: work.op.clone(),
        version: work.version,
        seed: work.seeded.then_some(work.seed),
        settings,
        files: work
            .files
            .iter()
            .map(|file| (file.key.clone(), file.blake3.clone()))
            .collect(),
        inputs: work
            .inputs
            .iter()
            .map(|port| {
                (
                    port.port.clone(),
                    port.from.iter().map(|(_, key)| *key).collect(),
                )
            })
            .collect(),
    }
}

pub(super) fn inputs(
    work: &Task,
    cache: &Cache,
) -> Result<Vec<(String, Vec<InputArtifact>)>, RunError> {
    let mut ports = Vec::new();
    for port in &work.inputs {
        let mut artifacts = Vec::new();
        for (stage, key) in &port.from {
            let manifest = match cache.look(key) {
                Entry::Whole(manifest) => manifest,
                Entry::Absent | Entry::Damaged(_) => {
                    return Err(RunError::Changed {
                        what: format!("the artifact of `{stage}`"),
                        detail: format!("`{}` is gone or damaged", cache.path(key).display()),
                    });
                }
            };
            artifacts.push(InputArtifact {
                stage: stage.clone(),
                op: manifest.recipe.op,
                path: cache.path(key),
                contents: manifest.contents,
            });
        }
        ports.push((port.port.clone(), artifacts));
    }
    Ok(ports)
}

/// Settings as TensorBoard shows them: dotted names to scalars.
fn hparams(settings: &Value) -> Vec<(String, Value)> {
    fn flatten(prefix: &str, value: &Value, flat: &mut Vec<(String, Value)>) {
        match value {
            Value::Object(map) => {
                for (name, value) in map {
                    let dot = if prefix.is_empty() { "" } else { "." };
                    flatten(&format!("{prefix}{dot}{name}"), value, flat);
                }
            }
            Value::Null => {}
            other => flat.push((prefix.to_owned(), other.clone())),
        }
    }
    let mut flat = Vec::new();
    flatten("", settings, &mut flat);
    flat
}
