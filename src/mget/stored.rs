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
    /// The file of the spec cannot be read, is too large or does not hold a spec.
    #[error("{path}: {reason}")]
    File {
        /// The file of the spec.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file of the spec cannot be written.
    #[error("{path}: {error}")]
    Write {
        /// The file of the spec.
        path: PathBuf,
        /// What the operating system says.
        #[source]
        error: std::io::Error,
    },
    /// The spec that was read is of no model that can be built.
    #[error("{path}: {error}")]
    Spec {
        /// The file of the spec.
        path: PathBuf,
        /// Why the model cannot be built.
        error: SpecError,
    },
    /// The weights cannot be read or written, or do not belong to the spec.
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
        spec.check().map_err(|error| StoredError::Spec {
            path: path.clone(),
            error,
        })?;
        let weights = Weights::read(&directory.join(WEIGHTS))?;
        // The file has every table in full: a description that asks for more than is there is refused before it is built.
        for (name, shape) in spec.parameters() {
            weights.get(&name, &shape)?;
        }
        let mut model = Self::empty(&spec, compute).map_err(|error| StoredError::Spec {
            path: path.clone(),
            error,
        })?;
        model.load(&weights)?;
        Ok(model)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Initialise;
    use crate::mget::{ModalitySpec, Positions, Size};

    #[test]
    fn a_description_that_asks_for_the_moon_is_refused_before_anything_is_built() {
        let compute = Compute::cpu();
        let spec = MgetSpec {
            size: Size {
                width: 12,
                heads: 2,
                encoder_depth: 1,
                decoder_depth: 1,
                hidden: 0,
            },
            positions: Positions::Aligned,
            modalities: vec![ModalitySpec::tokens("rgb", &[2, 2, 2], 8)],
        };
        let folder = tempfile::tempdir().unwrap();
        let model = Mget::new(&spec, &Initialise::new(&compute, 0)).unwrap();
        model.save(folder.path()).unwrap();
        Mget::open(folder.path(), &compute).unwrap();
        let refused = |change: fn(&mut MgetSpec)| {
            let mut spec = spec.clone();
            change(&mut spec);
            let text = serde_json::to_vec(&spec).unwrap();
            std::fs::write(folder.path().join(SPEC), text).unwrap();
            Mget::open(folder.path(), &compute).unwrap_err().to_string()
        };
        let grid = refused(|s| {
            s.modalities[0] = ModalitySpec::tokens("rgb", &[3, 1_000_000, 1_000_000], 8);
        });
        assert!(
            grid.contains(SPEC) && grid.contains("1048576 tokens"),
            "{grid}"
        );
        assert!(refused(|s| s.size.decoder_depth = usize::MAX).contains("out of range"));
        let vocabulary = refused(|s| {
            s.modalities[0] = ModalitySpec::tokens("rgb", &[2, 2, 2], 1 << 40);
        });
        assert!(vocabulary.contains("has shape"), "{vocabulary}");
    }
}
