//! What can be wrong with a recording: every error names the file, and the place in it where there is one.

use std::fmt;
use std::path::{Path, PathBuf};

/// A place in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Position {
    /// Byte offset from the start of the file.
    Offset(u64),
    /// Line, counted from 1.
    Line(u64),
    /// Frame or record, counted from 0.
    Frame(u64),
    /// The file as a whole.
    File,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Position::Offset(offset) => write!(f, ", byte {offset}"),
            Position::Line(line) => write!(f, ", line {line}"),
            Position::Frame(frame) => write!(f, ", frame {frame}"),
            Position::File => Ok(()),
        }
    }
}

/// Why a recording, a video or a table cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The operating system says no.
    #[error("`{}`: {cause}", path.display())]
    Io {
        /// The file or folder it refuses.
        path: PathBuf,
        /// What it says.
        #[source]
        cause: std::io::Error,
    },
    /// The file is not what it claims to be: truncated, damaged or hostile.
    #[error("`{}`{place}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where in it, as far as that is known.
        place: Position,
        /// What is wrong there.
        reason: String,
    },
    /// The file is fine, but of a kind that is not read here; the reason says what to do instead.
    #[error("`{}`: {reason}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What it is, and what to do instead.
        reason: String,
    },
    /// A file or a part of it that is needed is not there.
    #[error("`{}`: {reason}", path.display())]
    Missing {
        /// The file or folder that is not there, or that lacks something.
        path: PathBuf,
        /// What is not there.
        reason: String,
    },
    /// Nothing of the kind that was looked for is here; something of another kind may be.
    #[error("`{}`: {reason}", path.display())]
    Absent {
        /// The file or folder that was looked into.
        path: PathBuf,
        /// What was looked for.
        reason: String,
    },
    /// An index beyond the end.
    #[error("clip {index} of `{source_name}`, which has {len}")]
    OutOfRange {
        /// Whose index it is: a data set, a recording, or a stream of a file.
        source_name: String,
        /// The index that was asked for, from 0.
        index: usize,
        /// How many there are.
        len: usize,
    },
    /// An array file that cannot be read.
    #[error(transparent)]
    Format(#[from] crate::formats::FormatError),
    /// Settings that contradict each other or the recording.
    #[error("{0}")]
    Settings(String),
}

impl ReadError {
    /// An input or output error of `path`.
    #[must_use]
    pub fn io(path: &Path, cause: std::io::Error) -> Self {
        ReadError::Io {
            path: path.to_owned(),
            cause,
        }
    }

    /// `path` is damaged at `place`.
    pub fn malformed(path: &Path, place: Position, reason: impl Into<String>) -> Self {
        ReadError::Malformed {
            path: path.to_owned(),
            place,
            reason: reason.into(),
        }
    }

    /// `path` is of a kind that is not read here.
    pub fn unsupported(path: &Path, reason: impl Into<String>) -> Self {
        ReadError::Unsupported {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }

    /// Something needed is not there.
    pub fn missing(path: &Path, reason: impl Into<String>) -> Self {
        ReadError::Missing {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }

    /// Nothing of the kind that was looked for is there.
    pub fn absent(path: &Path, reason: impl Into<String>) -> Self {
        ReadError::Absent {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }
}
