//! The record of one run: its directory, its state, and who works on it.
//!
//! ```text
//! runs/
//!   index.jsonl                  one line per state change
//!   cache/                       artifacts
//!   1122-mget_tiny-7f3a/         MMDD-name-first four of the identity
//!     run.json  plan.json  lock.json  resolved.yaml
//!     source/                    byte copies of every layer
//!     stages/mget/               stage.json, metrics.jsonl, TensorBoard events, log.txt, checkpoints/
//!     report/index.html
//! ```

use super::cache::Key;
use super::environment;
use super::error::{AtPath, Failure, RunError};
use super::files;
use super::interrupt::Interrupt;
use super::lock::{self, Lock, Mode};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// Where a run, a part of one, or a stage stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// There is work left, and nobody is on it.
    Queued,
    /// A process works on it.
    Running,
    /// Everything that was asked for is there.
    Done,
    /// It ended with an error; asking again tries again.
    Failed,
    /// It was stopped; asking again continues.
    Interrupted,
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Interrupted => "interrupted",
        })
    }
}

/// Which part of a run a process does: `2/4` is the second of four.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Shard {
    /// From 1.
    pub index: u32,
    /// How many parts there are.
    pub count: u32,
}

impl Shard {
    /// All of it.
    pub const WHOLE: Self = Self { index: 1, count: 1 };
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(index, count)| {
            let (index, count) = (index.parse().ok()?, count.parse().ok()?);
            (1 <= index && index <= count).then_some(Self { index, count })
        });
        parsed.ok_or_else(|| "a shard is written `i/n` with 1 <= i <= n, for instance `2/4`".into())
    }
}

/// `run.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The name of the experiment or sweep.
    pub name: String,
    /// The hash of everything that was asked for.
    pub identity: Key,
    /// Where all parts together stand.
    pub state: State,
    /// The file that was asked for, as given.
    pub experiment: String,
    /// UTC.
    pub created: String,
    /// The processes that worked on it last, by shard.
    pub parts: BTreeMap<String, Part>,
}

/// One process's share of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// Where this share stands.
    pub state: State,
    /// Name of the machine that works or worked on it.
    pub host: String,
    /// The process on that machine.
    pub pid: u32,
    /// UTC.
    pub started: String,
    /// UTC; `None` while it runs, and where the process was killed.
    pub ended: Option<String>,
    /// The first failure, if there was one.
    pub error: Option<Failure>,
}

/// A line of `index.jsonl`.
#[derive(Debug, Serialize, Deserialize)]
pub struct IndexLine {
    /// UTC.
    pub time: String,
    /// The name of the run's directory.
    pub run: String,
    /// Where the run stands from then on.
    pub state: State,
    /// The part whose process wrote the line: `2/4`.
    pub shard: String,
    /// Name of the machine that wrote the line.
    pub host: String,
    /// The process that wrote the line.
    pub pid: u32,
}

/// The directory of one run.
#[derive(Debug, Clone)]
pub struct RunDirectory {
    path: PathBuf,
}

impl RunDirectory {
    /// The run directory at `path`, if there is one.
    pub fn at(path: &Path) -> Result<Self, RunError> {
        if path.join("run.json").is_file() {
            return Ok(Self { path: path.into() });
        }
        Err(RunError::Request {
            message: format!("`{}` is not a run directory", path.display()),
            help: "a run directory holds a `run.json`; `reviv list runs` shows all of them".into(),
        })
    }

    /// A run by its path, its name below `runs`, or, where only one fits, the beginning or end of that name or the experiment's.
    pub fn named(runs: &Path, name: impl AsRef<Path>) -> Result<Self, RunError> {
        let name = name.as_ref();
        let found = Self::fitting(runs, name)?;
        match found.as_slice() {
            [only] => Ok(only.clone()),
            _ => Err(RunError::Request {
                message: match found.len() {
                    0 => format!("no run `{}` in `{}`", name.display(), runs.display()),
                    n => format!("{n} runs fit `{}`", name.display()),
                },
                help: "`reviv list runs` shows all of them".into(),
            }),
        }
    }

    /// The runs that [`RunDirectory::named`] chooses from.
    pub fn fitting(runs: &Path, name: impl AsRef<Path>) -> Result<Vec<Self>, RunError> {
        let name = name.as_ref();
        if name.as_os_str().is_empty() {
            return Ok(Vec::new());
        }
        for path in [PathBuf::from(name), runs.join(name)] {
            if path.join("run.json").is_file() {
                return Ok(vec![Self { path }]);
            }
        }
        let mut all = Self::all(runs)?;
        let name = name.as_os_str().as_encoded_bytes();
        all.retain(|run| {
            let whole = run.path.file_name().unwrap_or_default().as_encoded_bytes();
            // `0131-EXPERIMENT-1a2b`
            let dash = |at: Option<usize>| at.unwrap_or(0);
            let first = dash(whole.iter().position(|byte| *byte == b'-'));
            let last = dash(whole.iter().rposition(|byte| *byte == b'-'));
            let experiment = whole.get(first + 1..last);
            whole.starts_with(name) || whole.ends_with(name) || experiment == Some(name)
        });
        Ok(all)
    }

    /// Every run below `runs`, sorted by name: each directory with a `run.json`, whether it can be read or not.
    pub fn all(runs: &Path) -> Result<Vec<Self>, RunError> {
        let entries = match std::fs::read_dir(runs) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(error).at("reading", runs),
        };
        let mut found = Vec::new();
        for entry in entries {
            let path = entry.at("reading", runs)?.path();
            if path.join("run.json").is_file() {
                found.push(Self { path });
            }
        }
        found.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(found)
    }

    /// The run of `identity`, or a new one.
    pub fn find_or_create(
        runs: &Path,
        name: &str,
        identity: Key,
        experiment: &str,
        interrupt: &Interrupt,
    ) -> Result<Self, RunError> {
        if let Some(run) = Self::of_identity(runs, &identity)? {
            return Ok(run);
        }
        files::create_directory(runs)?;
        // Two processes that ask for the same new experiment must end up in one directory.
        let _lock = Lock::wait(&runs.join(".lock"), interrupt, |_| {})?;
        if let Some(run) = Self::of_identity(runs, &identity)? {
            return Ok(run);
        }
        let day = environment::Utc::from_unix(environment::now() as i64).month_day();
        let digits = identity.to_string();
        let path = (4..=digits.len())
            .map(|n| runs.join(format!("{day}-{name}-{}", &digits[..n])))
            // A directory without its `run.json` was begun by a process that was killed: it is ours to finish.
            .find(|path| !path.join("run.json").exists())
            .ok_or_else(|| RunError::Request {
                message: format!("every name for this run is taken in `{}`", runs.display()),
                help: "move old run directories away".into(),
            })?;
        files::create_directory(&path.join("stages"))?;
        let run = Run {
            name: name.into(),
            identity,
            state: State::Queued,
            experiment: experiment.into(),
            created: environment::now_text(),
            parts: BTreeMap::new(),
        };
        files::write_json(&path.join("run.json"), &run)?;
        let created = Self { path };
        created.announce(State::Queued, Shard::WHOLE)?;
        Ok(created)
    }

    fn of_identity(runs: &Path, identity: &Key) -> Result<Option<Self>, RunError> {
        let all = Self::all(runs)?;
        Ok(all
            .into_iter()
            .find(|run| run.read().is_ok_and(|read| read.identity == *identity)))
    }

    /// Where the directory lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The directory's own name.
    pub fn name(&self) -> String {
        self.path
            .file_name()
            .map_or_else(String::new, |name| name.to_string_lossy().into_owned())
    }

    /// The directory that holds this run, its siblings and the cache.
    pub fn runs(&self) -> &Path {
        match self.path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        }
    }

    /// The HTML page about the run.
    pub fn report(&self) -> PathBuf {
        self.path.join("report").join("index.html")
    }

    /// `run.json` as it stands, with the state as it really is: a process that was killed could not write its end.
    pub fn read(&self) -> Result<Run, RunError> {
        let mut run: Run = files::read_json(&self.path.join("run.json"))?;
        let mut lost = false;
        for (shard, part) in &mut run.parts {
            if part.state == State::Running && !self.is_owned(shard) {
                part.state = State::Interrupted;
                lost = true;
            }
        }
        if lost && run.state == State::Running {
            run.state = overall(&run.parts, false);
        }
        Ok(run)
    }

    fn lock_path(&self, shard: &str) -> PathBuf {
        self.path
            .join(format!(".lock-{}", shard.replace('/', "-of-")))
    }

    fn is_owned(&self, shard: &str) -> bool {
        lock::is_held(&self.lock_path(shard))
    }

    /// Whether any process works on it now.
    pub fn is_busy(&self) -> bool {
        // Shards share the lock of the whole, which a look does not see: each holds its own.
        let running = |run: Run| run.parts.values().any(|part| part.state == State::Running);
        lock::is_held(&self.path.join(".lock")) || self.read().is_ok_and(running)
    }

    /// Makes this process the owner of a shard, or says who is.
    pub fn own(&self, shard: Shard) -> Result<Owned, RunError> {
        let whole = shard.count == 1;
        let mode = if whole { Mode::Exclusive } else { Mode::Shared };
        let held = |error| match error {
            // The lock on the whole is unsigned while shards share it; theirs are.
            RunError::Held { holder, .. } => RunError::Held {
                path: self.path.clone(),
                holder,
            },
            other => other,
        };
        let run = Lock::take(&self.path.join(".lock"), mode).map_err(held)?;
        let part =
            Lock::take(&self.lock_path(&shard.to_string()), Mode::Exclusive).map_err(held)?;
        Ok(Owned {
            directory: self.clone(),
            shard,
            _run: run,
            _part: part,
        })
    }

    fn announce(&self, state: State, shard: Shard) -> Result<(), RunError> {
        let line = IndexLine {
            time: environment::now_text(),
            run: self.name(),
            state,
            shard: shard.to_string(),
            host: environment::host(),
            pid: environment::pid(),
        };
        let line = serde_json::to_string(&line).map_err(|error| RunError::Malformed {
            path: self.path.clone(),
            reason: error.to_string(),
        })?;
        files::append_line(&self.runs().join("index.jsonl"), &line)
    }
}

/// What the parts and the cache say together.
fn overall(parts: &BTreeMap<String, Part>, complete: bool) -> State {
    let any = |state| parts.values().any(|part| part.state == state);
    if any(State::Running) {
        State::Running
    } else if complete {
        State::Done
    } else if any(State::Failed) {
        State::Failed
    } else if any(State::Interrupted) {
        State::Interrupted
    } else {
        State::Queued
    }
}

/// A run, or a shard of it, that belongs to this process until dropped.
#[derive(Debug)]
pub struct Owned {
    directory: RunDirectory,
    shard: Shard,
    _run: Lock,
    _part: Lock,
}

impl Owned {
    /// Space that is given back when the disk is full, so that the end of the run can still be written.
    const RESERVE: usize = 64 << 10;

    /// The run's directory.
    pub fn directory(&self) -> &RunDirectory {
        &self.directory
    }

    /// Marks the beginning of work.
    pub fn begin(&self) -> Result<(), RunError> {
        files::write(&self.reserve(), &vec![0xa5; Self::RESERVE])?;
        let part = Part {
            state: State::Running,
            host: environment::host(),
            pid: environment::pid(),
            started: environment::now_text(),
            ended: None,
            error: None,
        };
        self.update(
            || false,
            |parts| {
                if self.shard.count == 1 {
                    parts.clear();
                }
                parts.retain(|shard, _| shard.ends_with(&format!("/{}", self.shard.count)));
                parts.insert(self.shard.to_string(), part);
            },
        )
    }

    /// Marks the end of work. `complete` says whether every artifact of the run is there; it is asked when no other
    /// shard can write its end, so that the last to write knows what all have made.
    pub fn end(
        &self,
        state: State,
        error: Option<Failure>,
        complete: impl FnOnce() -> bool,
    ) -> Result<(), RunError> {
        files::remove(&self.reserve())?;
        self.update(complete, |parts| {
            if let Some(part) = parts.get_mut(&self.shard.to_string()) {
                part.state = state;
                part.ended = Some(environment::now_text());
                part.error = error;
            }
        })
    }

    fn reserve(&self) -> PathBuf {
        let name = format!(".reserve-{}-of-{}", self.shard.index, self.shard.count);
        self.directory.path.join(name)
    }

    /// Does what no other shard of the run may do at the same time.
    pub fn alone<T>(&self, action: impl FnOnce() -> Result<T, RunError>) -> Result<T, RunError> {
        let never = Interrupt::default();
        let _lock = Lock::wait(&self.directory.path.join(".lock-state"), &never, |_| {})?;
        action()
    }

    /// Changes `run.json` while no other shard does.
    fn update(
        &self,
        complete: impl FnOnce() -> bool,
        change: impl FnOnce(&mut BTreeMap<String, Part>),
    ) -> Result<(), RunError> {
        self.alone(|| {
            let mut run = self.directory.read()?;
            let before = run.state;
            change(&mut run.parts);
            run.state = overall(&run.parts, complete());
            files::write_json(&self.directory.path.join("run.json"), &run)?;
            if run.state != before || self.shard.count > 1 {
                self.directory.announce(run.state, self.shard)?;
            }
            Ok(())
        })
    }
}
