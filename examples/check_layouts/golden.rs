//! Golden answers: arrays `[clips, ...]` in an npz file.

use std::path::{Path, PathBuf};

use ndarray::{Array, Dimension};
use reviv::formats::npy::Element;
use reviv::formats::npz::Npz;

use super::Outcome;

/// One `golden*.npz`.
#[derive(Debug)]
pub struct Golden {
    /// `golden`, or `golden_scene0_00012`.
    pub name: String,
    npz: Npz,
}

impl Golden {
    pub fn read(path: &Path) -> Outcome<Self> {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok(Self {
            name: name.into_owned(),
            npz: Npz::read(path)?,
        })
    }

    /// What follows `golden_`: part of the name of its recording; empty where the folder has only one.
    pub fn recording(&self) -> &str {
        self.name
            .strip_prefix("golden")
            .map_or("", |rest| rest.trim_start_matches('_'))
    }

    pub fn has(&self, key: &str) -> bool {
        self.npz.arrays.contains_key(key)
    }

    pub fn array<T: Element, D: Dimension>(&self, key: &str) -> Outcome<Array<T, D>> {
        Ok(self.npz.get(key)?.to_dim()?)
    }

    /// How many clips it answers for.
    pub fn clips(&self) -> Outcome<usize> {
        let key = if self.has("camera") {
            "camera"
        } else {
            "start_ns"
        };
        Ok(self.npz.get(key)?.shape.first().copied().unwrap_or(0))
    }
}

/// The golden files in the folder of a set, by name.
pub fn golden_files(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with("golden") && name.ends_with(".npz") {
            found.push(path);
        }
    }
    found.sort();
    if found.is_empty() {
        return Err(format!("{}: there is no golden*.npz", folder.display()).into());
    }
    Ok(found)
}
