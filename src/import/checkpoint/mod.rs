//! The entries of any checkpoint file: names, types, shapes, shared memory; and their values, streamed.
//!
//! Three containers: torch's zip with a pickled dictionary (`.pth`), TorchScript archives (`.jit`, `.pt`: a tree of objects
//! whose tensors get dotted names), and safetensors. Opening reads no tensor.

mod memory;
mod safetensors;
mod stream;
mod torch;

use super::ImportError;
use crate::formats::pickle::{Scalar, TensorView};
use crate::formats::zip::ZipArchive;
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

/// The container a checkpoint lies in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Torch,
    TorchScript,
    Safetensors,
}

/// One named tensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub name: String,
    pub view: TensorView,
    /// The first entry that is the same view of the same memory.
    pub same_as: Option<usize>,
}

impl Entry {
    pub fn shape(&self) -> Vec<usize> {
        self.view.shape.iter().map(|&d| d as usize).collect()
    }

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
}

impl Checkpoint {
    /// Opens a checkpoint and checks its structure; no tensor is read.
    pub fn open(path: &Path) -> Result<Self, ImportError> {
        let refused = |reason: String| ImportError::refused(path, reason);
        let mut file = File::open(path).map_err(ImportError::io(path))?;
        let mut magic = [0; 10];
        let got = file.read(&mut magic).map_err(ImportError::io(path))?;
        file.rewind().map_err(ImportError::io(path))?;
        if magic.starts_with(b"PK\x03\x04") {
            return Self::archive(path, file);
        }
        if got == 10 && magic[8..10] == *b"{\"" {
            return Self::safetensors(path, file);
        }
        Err(refused(if magic.starts_with(b"\x80\x02") {
            "a torch file older than version 1.6; save it again with a newer torch".to_owned()
        } else {
            "neither a torch archive (`.pth`, `.pt`, `.jit`) nor a safetensors file".to_owned()
        }))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

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

    /// What else lies at the top level of the file (`optimizer`, `epoch`, ...).
    pub fn others(&self) -> &[String] {
        &self.others
    }
}
