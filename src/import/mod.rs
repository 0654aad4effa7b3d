//! Weights released by others, read without executing anything and checked before anything is dropped.
//!
//! Read in this order: [`crate::formats::checkpoint`] (the entries of a `.pth`, a TorchScript archive or a safetensors file, streamed; its
//! pickles are read by an interpreter that can only describe data), [`rules`] (what may happen to an entry), [`mget`], [`vq`],
//! [`cosmos`], [`vda`] and [`tmr`] (which rule applies to which name of which release), [`statistics`] (normalisation files that travel with the
//! weights), `source` (one file, checked), `part` (one model of one or several files), `folder` (what our files of it are)
//! and [`convert`] (the whole import, and the manifest).
//!
//! Weights are never part of this product: users get them from their authors, under their authors' licences.

pub mod convert;
pub mod cosmos;
mod folder;
mod hash;
pub mod mget;
mod part;
pub mod rules;
mod source;
pub mod statistics;
pub mod tmr;
pub mod vda;
pub mod vq;

pub use crate::formats::checkpoint::{Checkpoint, Entry, Format};
pub use convert::{ImportOptions, ImportReport, PartReport, import};

use crate::formats::checkpoint::CheckpointError;
use std::path::{Path, PathBuf};

/// Why a file cannot be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file is not what it seems, has an entry nobody knows, or would lose something; or the folder cannot be made.
    #[error("{}: {reason}", path.display())]
    Refused {
        /// The file or the folder.
        path: PathBuf,
        /// What is wrong, in words.
        reason: String,
    },
    /// A checkpoint cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// An array does not follow its format.
    #[error(transparent)]
    Format(#[from] crate::formats::FormatError),
    /// A file or a folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or the folder.
        path: PathBuf,
        /// What the file system said.
        #[source]
        source: std::io::Error,
    },
}

impl ImportError {
    pub(crate) fn refused(path: &Path, reason: impl Into<String>) -> Self {
        Self::Refused {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }

    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io {
            path: path.to_owned(),
            source,
        }
    }
}
