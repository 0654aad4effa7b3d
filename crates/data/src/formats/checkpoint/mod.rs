//! The entries of any checkpoint file: names, types, shapes, shared memory; and their values, streamed.
//!
//! Four containers: torch's zip with a pickled dictionary (`.pth`), what torch wrote before 1.6 (pickles, then the storages),
//! TorchScript archives (`.jit`, `.pt`: a tree of objects whose tensors get dotted names), and safetensors. Opening reads no
//! tensor.

mod legacy;
mod memory;
mod safetensors;
mod sniff;
mod stream;
mod torch;
mod tree;
mod wrappers;

use crate::formats::pickle::{Scalar, TensorView};
use crate::formats::zip::ZipArchive;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

/// Why a checkpoint cannot be opened, or an entry of it read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file is no checkpoint, or has an entry that cannot be read.
    #[error("{}: {reason}", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is wrong, in words.
        reason: String,
    },
    /// The archive or the pickle does not follow its format.
    #[error(transparent)]
    Format(#[from] super::FormatError),
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the file system said.
        #[source]
        source: std::io::Error,
    },
}

impl CheckpointError {
    fn refused(path: &Path, reason: impl Into<String>) -> Self {
        Self::Refused {
            path: path.to_owned(),
            reason: reason.into(),
        }
    }

    fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io {
            path: path.to_owned(),
            source,
        }
    }
}

/// The container a checkpoint lies in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Pickles of torch: a zip archive, or one stream as torch wrote it before 1.6.
    Torch,
    /// A zip archive of code and a tree of objects.
    TorchScript,
    /// A JSON header, then the values.
    Safetensors,
}

/// The name of the tensor in a file that holds nothing else.
pub const BARE: &str = "tensor";

/// One named tensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Its name in the file, without the [`Checkpoint::wrappers`].
    pub name: String,
    /// Where its values lie, and of which type they are.
    pub view: TensorView,
    /// The first entry that is the same view of the same memory.
    pub same_as: Option<usize>,
}

impl Entry {
    /// Length of every axis; empty for a single number.
    pub fn shape(&self) -> Vec<usize> {
        self.view.shape.iter().map(|&d| d as usize).collect()
    }

    /// Element type of its values.
    pub fn scalar(&self) -> Scalar {
        self.view.storage.scalar
    }

    /// Size of the values in bytes.
    pub fn bytes(&self) -> u64 {
        self.view.elements() * self.scalar().width() as u64
    }
}

/// An open checkpoint.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    format: Format,
    entries: Vec<Entry>,
    arguments: Map<String, Value>,
    others: Vec<String>,
    source: Source,
    /// What the tensors' names lie in, from outside to inside: keys of dictionaries, and wrappers in front of all names.
    wrappers: Vec<String>,
    /// Tensors that are no strided numbers: name, and what it is.
    opaque: Vec<(String, &'static str)>,
    /// Why the tensors are not apart, where they are not.
    overlap: Option<String>,
    /// Archive members whose checksum has been verified.
    verified: BTreeSet<String>,
}

#[derive(Debug)]
enum Source {
    Archive {
        zip: Box<ZipArchive<BufReader<File>>>,
        root: String,
    },
    Flat {
        file: BufReader<File>,
        start: u64,
    },
    /// Storages behind each other: where each begins.
    Legacy {
        file: BufReader<File>,
        places: BTreeMap<String, u64>,
    },
}

/// How a file is packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Container {
    Archive,
    Legacy,
    Safetensors,
}

impl Checkpoint {
    /// Opens a checkpoint and checks its structure; no tensor is read.
    ///
    /// # Errors
    /// When it cannot be read, is of no known container, or breaks the rules of its own.
    pub fn open(path: &Path) -> Result<Self, CheckpointError> {
        let refused = |reason: String| CheckpointError::refused(path, reason);
        let facts = std::fs::metadata(path).map_err(CheckpointError::io(path))?;
        if !facts.is_file() {
            return Err(refused("no regular file".to_owned()));
        }
        let mut file = File::open(path).map_err(CheckpointError::io(path))?;
        let mut head = Vec::new();
        (&mut file)
            .take(sniff::HEAD as u64)
            .read_to_end(&mut head)
            .map_err(CheckpointError::io(path))?;
        file.rewind().map_err(CheckpointError::io(path))?;
        match sniff::container(&head, facts.len()).map_err(refused)? {
            Container::Archive => Self::archive(path, file),
            Container::Legacy => Self::legacy(path, file),
            Container::Safetensors => Self::safetensors(path, file),
        }
    }

    /// The file, as it was given to [`Checkpoint::open`].
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The container that the file turned out to be.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Named tensors, in the order of the file.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The `argparse.Namespace` under `args`, as plain values.
    pub fn arguments(&self) -> &Map<String, Value> {
        &self.arguments
    }

    /// The index of an entry.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.entries.iter().position(|entry| entry.name == name)
    }

    /// What was taken off around the names of the tensors, from outside to inside.
    pub fn wrappers(&self) -> &[String] {
        &self.wrappers
    }

    /// Which tensors share memory without being the same; such a file can be looked at, not imported.
    pub fn overlap(&self) -> Option<&str> {
        self.overlap.as_deref()
    }

    /// Tensors that cannot be read as numbers (sparse, without values, ...): their names, and what they are.
    pub fn opaque(&self) -> &[(String, &'static str)] {
        &self.opaque
    }

    /// What else lies at the top level of the file (`optimizer`, `epoch`, ...).
    pub fn others(&self) -> &[String] {
        &self.others
    }
}
