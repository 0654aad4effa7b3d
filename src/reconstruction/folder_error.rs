//! Why a reconstruction folder cannot be written.

use crate::formats::FormatError;
use crate::view::ViewError;
use std::path::{Path, PathBuf};

/// Why a reconstruction folder cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error("{path}: {error}")]
    Io {
        path: PathBuf,
        #[source]
        error: std::io::Error,
    },
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error(transparent)]
    View(#[from] ViewError),
    #[error("{0}")]
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
