//! The model that comes with the program: everything from video alone, trained on the built-in world by `experiments/world.yaml`.
//!
//! It shows what a reconstruction is before anybody has trained anything. It has never seen a real picture, and says so wherever it
//! is used (`trained_on`).

use super::ModelError;
use std::path::{Path, PathBuf};

mod embedded {
    include!(concat!(env!("OUT_DIR"), "/model.rs"));
}

/// Puts the model's folder into `parent`, if it is not there yet, and gives its path; [`Model::open`](super::Model::open) opens it.
///
/// # Errors
/// When the folder cannot be written.
pub fn unpack(parent: &Path) -> Result<PathBuf, ModelError> {
    let io = |path: &Path, error| ModelError::Io {
        path: path.to_owned(),
        error,
    };
    let mut hasher = blake3::Hasher::new();
    for (name, bytes) in embedded::WORLD {
        hasher.update(name.as_bytes());
        hasher.update(bytes);
    }
    let hash = hasher.finalize().to_hex();
    let folder = parent.join(format!("world-{}", &hash[..8]));
    if folder.is_dir() {
        return Ok(folder);
    }
    // Whole or not at all, also when two programs do it at once.
    let part = parent.join(format!(".world-{}-{}", &hash[..8], std::process::id()));
    for (name, bytes) in embedded::WORLD {
        let path = part.join(name);
        let above = path.parent().unwrap_or(&part);
        std::fs::create_dir_all(above).map_err(|error| io(above, error))?;
        std::fs::write(&path, bytes).map_err(|error| io(&path, error))?;
    }
    match std::fs::rename(&part, &folder) {
        Err(error) if !folder.is_dir() => Err(io(&folder, error)),
        Err(_) => {
            std::fs::remove_dir_all(&part).map_err(|error| io(&part, error))?;
            Ok(folder)
        }
        Ok(()) => Ok(folder),
    }
}
