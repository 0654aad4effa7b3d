//! A model on disk: its spec as JSON beside its weights.

use super::{Mget, MgetSpec, SpecError};
use crate::engine::{Compute, EngineError, Parameters, Weights};
use std::path::{Path, PathBuf};

/// The spec's file.
pub const SPEC: &str = "mget.json";
/// The weights' file.
pub const WEIGHTS: &str = "weights.safetensors";

/// The largest spec that is read.
const MAX_SPEC: u64 = 1 << 20;

/// Why a model cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum StoredError {
    #[error("{path}: {reason}")]
    File { path: PathBuf, reason: String },
    #[error("{path}: {error}")]
    Write {
        path: PathBuf,
        #[source]
        error: std::io::Error,
    },
    #[error("{path}: {error}")]
    Spec { path: PathBuf, error: SpecError },
    #[error(transparent)]
    Weights(#[from] EngineError),
}

/// Reads what the model in a directory is, without its weights.
///
/// # Errors
/// When the file is missing, too large or of another form.
pub fn read_spec(directory: &Path) -> Result<MgetSpec, StoredError> {
    let path = directory.join(SPEC);
    let file = |reason: String| StoredError::File {
        path: path.clone(),
        reason,
    };
    let length = std::fs::metadata(&path)
        .map_err(|error| file(error.to_string()))?
        .len();
    if length > MAX_SPEC {
        return Err(file(format!(
            "{length} bytes are too many for a description of a model"
        )));
    }
    let text = std::fs::read(&path).map_err(|error| file(error.to_string()))?;
    serde_json::from_slice(&text).map_err(|error| file(error.to_string()))
}

impl Mget {
    /// Writes the model into a directory.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, directory: &Path) -> Result<(), StoredError> {
        let path = directory.join(SPEC);
        let text = serde_json::to_vec_pretty(self.spec()).map_err(|error| StoredError::File {
            path: path.clone(),
            reason: error.to_string(),
        })?;
        std::fs::write(&path, text).map_err(|error| StoredError::Write { path, error })?;
        self.weights().write(&directory.join(WEIGHTS))?;
        Ok(())
    }

    /// Reads a model of [`Mget::save`].
    ///
    /// # Errors
    /// When a file is missing or damaged, or the two do not belong together.
    pub fn open(directory: &Path, compute: &Compute) -> Result<Self, StoredError> {
        let path = directory.join(SPEC);
        let spec = read_spec(directory)?;
        let weights = Weights::read(&directory.join(WEIGHTS))?;
        // The file has every table in full: a description that asks for more than is there is refused before it is built.
        for (name, shape) in spec.parameters() {
            weights.get(&name, &shape)?;
        }
        let mut model = Self::to_load(&spec, compute).map_err(|error| StoredError::Spec {
            path: path.clone(),
            error,
        })?;
        model.load(&weights)?;
        Ok(model)
    }
}
