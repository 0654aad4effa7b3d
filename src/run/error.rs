//! What can go wrong while a run is executed and recorded, each with a code, a sentence and a way out.

use std::io;
use std::path::{Path, PathBuf};

/// Who has a lock, as its file says.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Holder {
    /// Name of the machine that its process runs on.
    pub host: String,
    /// Its process on that machine.
    pub pid: u32,
    /// UTC, ISO 8601.
    pub since: String,
}

/// Why something failed, as the record keeps it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Failure {
    /// As [`RunError::code`] gives it: `E0502`.
    pub code: String,
    /// What went wrong, in words.
    pub message: String,
    /// The stage whose op failed; `None` for every other failure.
    pub stage: Option<String>,
}

/// A failure of the record: the run directory, the cache, the locks, a stage.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The device of `path` is full, or a quota is used up.
    #[error("no space left while {action} `{path}`")]
    NoSpace {
        /// What was being done: `reading`, `writing`, ...
        action: &'static str,
        /// The file or directory that it was done to.
        path: PathBuf,
    },
    /// `path` cannot be written.
    #[error("`{path}` cannot be written: {reason}")]
    ReadOnly {
        /// The file or directory.
        path: PathBuf,
        /// What the file system said.
        reason: io::Error,
    },
    /// Any other failure of the file system.
    #[error("{action} `{path}` failed: {reason}")]
    Io {
        /// What was being done: `reading`, `writing`, ...
        action: &'static str,
        /// The file or directory that it was done to.
        path: PathBuf,
        /// What the file system said.
        reason: io::Error,
    },
    /// A live process owns what is asked for.
    #[error("`{path}` is in use by another process{}", holder_text(.holder.as_ref()))]
    Held {
        /// The lock file, or the directory of the run that is asked for.
        path: PathBuf,
        /// Who owns it, where its lock says so.
        holder: Option<Holder>,
    },
    /// A file of the record does not say what it must.
    #[error("`{path}` is not what this version writes: {reason}")]
    Malformed {
        /// The file or directory.
        path: PathBuf,
        /// What does not fit, in words.
        reason: String,
    },
    /// What was hashed once has other bytes now.
    #[error("{what} has changed: {detail}")]
    Changed {
        /// What was hashed, in words: a file, an artifact, a stage.
        what: String,
        /// How it is not as it was.
        detail: String,
    },
    /// Somebody asked to stop, and the stage did.
    #[error("interrupted")]
    Interrupted,
    /// A stage's own failure, in its op's words.
    #[error("stage `{stage}`: {message}")]
    Stage {
        /// The stage's name in the experiment.
        stage: String,
        /// The code that the op chose; `E0806` for a failure without one and for a bug.
        code: String,
        /// What went wrong, in the op's words.
        message: String,
        /// The way out; empty for none.
        help: String,
        /// Exit code of the process: 1 for what the user can mend, 2 for anything else.
        exit: u8,
    },
    /// The request names something that is not there, or makes no sense.
    #[error("{message}")]
    Request {
        /// What is not there or makes no sense.
        message: String,
        /// The way out.
        help: String,
    },
}

fn holder_text(holder: Option<&Holder>) -> String {
    holder.map_or_else(String::new, |h| {
        format!(": pid {} on `{}`, since {}", h.pid, h.host, h.since)
    })
}

impl RunError {
    /// Sorts an I/O error into the cases that a user mends differently.
    pub fn io(action: &'static str, path: &Path, reason: io::Error) -> Self {
        let path = path.to_path_buf();
        match reason.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                Self::NoSpace { action, path }
            }
            io::ErrorKind::ReadOnlyFilesystem | io::ErrorKind::PermissionDenied => {
                Self::ReadOnly { path, reason }
            }
            _ => Self::Io {
                action,
                path,
                reason,
            },
        }
    }

    /// The code printed in brackets. `E05` budgets, `E06` inputs missing or changed, `E08` the record.
    pub fn code(&self) -> &str {
        match self {
            Self::NoSpace { .. } => "E0502",
            Self::Changed { .. } => "E0602",
            Self::Held { .. } => "E0801",
            Self::ReadOnly { .. } => "E0802",
            Self::Io { .. } => "E0803",
            Self::Malformed { .. } => "E0804",
            Self::Interrupted => "E0805",
            Self::Stage { code, .. } => code,
            Self::Request { .. } => "E0807",
        }
    }

    /// What the user can do about it.
    pub fn help(&self) -> String {
        match self {
            Self::NoSpace { .. } => {
                "free some space (`reviv gc` prunes the cache), then ask for the same experiment \
                                     again: what was finished stays and it continues"
                    .into()
            }
            Self::Changed { .. } => {
                "the stages that read it have to run again: ask for the experiment again".into()
            }
            Self::Held { .. } => {
                "wait for that process or stop it; to work side by side, give each process its own \
                                  `--shard i/n`"
                    .into()
            }
            Self::ReadOnly { .. } => {
                "make it writable, or choose another place with `--runs DIR`".into()
            }
            Self::Io { .. } => {
                "the file system refused; the run continues when it is asked for again".into()
            }
            Self::Malformed { .. } => {
                "move the file away, or delete the run directory that holds it".into()
            }
            Self::Interrupted => "ask for the same experiment again and it continues".into(),
            Self::Stage { help, .. } | Self::Request { help, .. } => help.clone(),
        }
    }

    /// 1 for what the user asked or gave, 2 for the machine, 130 for an interrupt (as shells have it).
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Held { .. }
            | Self::ReadOnly { .. }
            | Self::Changed { .. }
            | Self::Malformed { .. }
            | Self::Request { .. } => 1,
            Self::NoSpace { .. } | Self::Io { .. } => 2,
            Self::Interrupted => 130,
            Self::Stage { exit, .. } => *exit,
        }
    }

    /// As the record keeps it.
    pub fn failure(&self) -> Failure {
        let stage = match self {
            Self::Stage { stage, .. } => Some(stage.clone()),
            _ => None,
        };
        Failure {
            code: self.code().into(),
            message: self.to_string(),
            stage,
        }
    }
}

impl From<RunError> for crate::experiment::StageError {
    fn from(error: RunError) -> Self {
        match error {
            RunError::Interrupted => Self::Interrupted,
            error => Self::Other(Box::new(error)),
        }
    }
}

/// Adds what was done to which file to an I/O error.
pub trait AtPath<T> {
    /// `action` is what was being done to `path`: `reading`, `writing`, ...
    fn at(self, action: &'static str, path: &Path) -> Result<T, RunError>;
}

impl<T> AtPath<T> for io::Result<T> {
    fn at(self, action: &'static str, path: &Path) -> Result<T, RunError> {
        self.map_err(|reason| RunError::io(action, path, reason))
    }
}
