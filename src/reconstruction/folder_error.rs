//! Why a reconstruction folder cannot be written or read.

use crate::formats::FormatError;
use crate::view::ViewError;
use std::path::{Path, PathBuf};

/// Why a reconstruction folder cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// A file or a folder cannot be made, written or read.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system says.
        #[source]
        error: std::io::Error,
    },
    /// A file of arrays cannot be written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The page cannot be made, or a video frame cannot be stored for it.
    #[error(transparent)]
    View(#[from] ViewError),
    /// The manifest cannot be put into JSON, or is damaged.
    #[error("manifest: {0}")]
    Manifest(#[from] serde_json::Error),
}

impl FolderError {
    pub(super) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |error| Self::Io {
            path: path.to_owned(),
            error,
        }
    }
}
