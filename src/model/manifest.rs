//! What binds the parts of a model folder together: the clips it takes, and its tokenizers by their bytes.

use super::error::{ModelError, not_a_model};
use crate::modality::ClipFormat;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The file in a model folder that binds its parts together.
pub const FILE: &str = "model.json";
/// The folder of tokenizers in a model folder.
pub const TOKENIZERS: &str = "tokenizers";

/// What [`FILE`] holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelManifest {
    /// The sizes of the clips the model was trained on.
    pub clips: ClipFormat,
    /// blake3 of the files of every tokenizer, by modality.
    pub tokenizers: BTreeMap<String, String>,
    /// The data sets it was trained on, `world` for the synthetic one; empty where nobody said.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub trained_on: Vec<String>,
}

impl ModelManifest {
    /// Binds the tokenizers that lie in `folder` to the clips that their model was trained on.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn of(folder: &Path, clips: ClipFormat) -> Result<Self, ModelError> {
        let tokenizers = Self::digests(folder)?;
        Ok(Self {
            clips,
            tokenizers,
            trained_on: Vec::new(),
        })
    }

    /// With what the model was trained on.
    #[must_use]
    pub fn trained_on(mut self, mut sources: Vec<String>) -> Self {
        sources.sort();
        sources.dedup();
        self.trained_on = sources;
        self
    }

    /// What [`ModelManifest::tokenizers`] says of the tokenizers that lie in `folder`; nothing where there are none.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn digests(folder: &Path) -> Result<BTreeMap<String, String>, ModelError> {
        let root = folder.join(TOKENIZERS);
        let mut tokenizers = BTreeMap::new();
        for path in entries(&root)? {
            if let Some(name) = path.file_name().and_then(|name| name.to_str())
                && path.is_dir()
            {
                tokenizers.insert(name.to_owned(), digest(&path)?);
            }
        }
        Ok(tokenizers)
    }

    /// Writes [`FILE`] into `folder`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ModelError> {
        let path = folder.join(FILE);
        let text =
            serde_json::to_string_pretty(self).map_err(|error| not_a_model(folder, error))?;
        std::fs::write(&path, text + "\n").map_err(|error| ModelError::Io { path, error })
    }

    /// Reads [`FILE`] of `folder`.
    ///
    /// # Errors
    /// When it is not there or not of this form.
    pub fn read(folder: &Path) -> Result<Self, ModelError> {
        let text = std::fs::read_to_string(folder.join(FILE))
            .map_err(|error| not_a_model(folder, format_args!("`{FILE}`: {error}")))?;
        serde_json::from_str(&text)
            .map_err(|error| not_a_model(folder, format_args!("`{FILE}`: {error}")))
    }
}

/// What lies in a folder, by name; nothing where there is no folder.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, ModelError> {
    let wrong = |error| ModelError::Io {
        path: folder.to_owned(),
        error,
    };
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let mut paths = std::fs::read_dir(folder)
        .map_err(wrong)?
        .map(|entry| Ok(entry?.path()))
        .collect::<Result<Vec<_>, std::io::Error>>()
        .map_err(wrong)?;
    paths.sort();
    Ok(paths)
}

/// The hash of names and bytes of the files of a folder.
pub(super) fn digest(folder: &Path) -> Result<String, ModelError> {
    let mut hasher = blake3::Hasher::new();
    for path in entries(folder)?.into_iter().filter(|path| path.is_file()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        hasher.update(&(name.len() as u64).to_le_bytes());
        hasher.update(name.as_bytes());
        let wrong = |error| ModelError::Io {
            path: path.clone(),
            error,
        };
        let file = std::fs::File::open(&path).map_err(wrong)?;
        hasher.update(&file.metadata().map_err(wrong)?.len().to_le_bytes());
        hasher.update_reader(file).map_err(wrong)?;
    }
    Ok(hasher.finalize().to_hex()[..32].to_owned())
}
