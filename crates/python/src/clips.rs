//! Clips and tokens: of folders, of runs, and of the built-in world.

use crate::arrays::{moved, owned};
use crate::error::{of_run, refused};
use ndarray::IxDyn;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use reviv::clip::shard::ShardIndex;
use reviv::clip::source::{ClipSource, Outcome};
use reviv::clip::store::ClipSet;
use reviv::formats::npy::{self, NpyArray};
use reviv::formats::npz::Npz;
use reviv::run::RunDirectory;
use reviv::world::{World, WorldSettings};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Where a kind of artifact lies that `path` names: a run by its path or name, the folder of an artifact, or the shards themselves;
/// of an artifact with splits, this split.
fn locate(py: Python<'_>, path: &Path, runs: &Path, kind: &str, split: &str) -> PyResult<PathBuf> {
    let root = if path.join("run.json").is_file() || !path.exists() {
        let run = RunDirectory::named(runs, path).map_err(|error| of_run(py, &error))?;
        reviv::cli::artifact_of(&run, kind).ok_or_else(|| {
            let message = format!("run `{}` has no finished {kind}", run.name());
            refused(py, message, "name a run with such a stage, or a folder")
        })?
    } else {
        path.to_owned()
    };
    let chosen = root.join(split);
    if chosen.is_dir() {
        return Ok(chosen);
    }
    let known = ["train", "validation", "test"];
    let there: Vec<&str> = known
        .into_iter()
        .filter(|split| root.join(split).is_dir())
        .collect();
    if there.is_empty() {
        return Ok(root);
    }
    let message = format!("`{}` has no split `{split}`", root.display());
    Err(refused(
        py,
        message,
        &format!("it has: {}", there.join(", ")),
    ))
}

/// A source of clips by number.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Clips {
    pub source: Arc<dyn ClipSource>,
    #[pyo3(get)]
    place: String,
}

#[pymethods]
impl Clips {
    fn __len__(&self) -> usize {
        self.source.len()
    }

    #[getter]
    fn modalities(&self) -> Vec<String> {
        self.source.modalities()
    }

    /// Clip `index` with these modalities, or with all; `None` where the recording does not allow the clip.
    fn clip(
        &self,
        py: Python<'_>,
        index: usize,
        modalities: Option<Vec<String>>,
    ) -> PyResult<Option<Clip>> {
        let made = py.detach(|| match &modalities {
            None => self.source.clip(index),
            Some(names) => {
                let names: Vec<&str> = names.iter().map(String::as_str).collect();
                self.source.clip_with(index, &names)
            }
        });
        let outcome = made.map_err(|error| refused(py, error, ""))?;
        let Some(mut clip) = Outcome::into_clip(outcome) else {
            return Ok(None);
        };
        if let Some(names) = &modalities {
            let others: Vec<String> = clip
                .modalities()
                .filter(|name| !names.iter().any(|wanted| wanted == name))
                .map(str::to_owned)
                .collect();
            for other in others {
                clip.remove(&other);
            }
        }
        Ok(Some(Clip { clip }))
    }
}

/// Clips in shards.
#[pyfunction]
pub fn open_clips(py: Python<'_>, path: PathBuf, split: &str, runs: PathBuf) -> PyResult<Clips> {
    let root = locate(py, &path, &runs, "clips", split)?;
    let set = py.detach(|| ClipSet::open(&root));
    let set = set.map_err(|error| {
        refused(
            py,
            error,
            "a folder of clips holds `<modality>/<data set>/shard-000000.tar`",
        )
    })?;
    Ok(Clips {
        source: Arc::new(set),
        place: root.display().to_string(),
    })
}

/// Clips `first..first + count` of the built-in world.
#[pyfunction]
pub fn world(
    py: Python<'_>,
    first: u64,
    count: u64,
    seed: u64,
    size: u32,
    rooms: Option<u64>,
) -> PyResult<Clips> {
    let settings = WorldSettings {
        size,
        rooms,
        ..WorldSettings::default()
    };
    if let Some((key, reason)) = settings.problem() {
        return Err(refused(py, format_args!("`{key}`: {reason}"), ""));
    }
    let clips = World::new(settings, seed).clips(first..first.saturating_add(count));
    Ok(Clips {
        source: Arc::new(clips),
        place: "world".to_owned(),
    })
}

/// Two seconds of one wearer.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Clip {
    pub clip: reviv::clip::Clip,
}

#[pymethods]
impl Clip {
    #[getter]
    fn id(&self) -> &str {
        &self.clip.id
    }

    #[getter]
    fn source(&self) -> &str {
        &self.clip.source
    }

    #[getter]
    fn modalities(&self) -> Vec<&str> {
        self.clip.modalities().collect()
    }

    /// The arrays of a modality: `values`, where known `valid` and `rate`, and whatever else it has.
    fn arrays<'py>(&self, py: Python<'py>, modality: &str) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some(held) = self.clip.held(modality) else {
            return Ok(None);
        };
        let arrays = held.to_arrays();
        let found = PyDict::new(py);
        for (name, array) in arrays.more.arrays {
            found.set_item(name, moved(py, array)?)?;
        }
        found.set_item("values", moved(py, arrays.values)?)?;
        if let Some(valid) = arrays.valid {
            found.set_item("valid", moved(py, valid)?)?;
        }
        if let Some(rate) = arrays.rate {
            found.set_item("rate", rate)?;
        }
        Ok(Some(found))
    }
}

/// Tokens in shards.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Tokens {
    shards: ShardIndex,
    #[pyo3(get)]
    place: String,
}

#[pymethods]
impl Tokens {
    fn __len__(&self) -> usize {
        self.shards.samples().len()
    }

    #[getter]
    fn modalities(&self) -> Vec<&str> {
        self.shards.modalities().collect()
    }

    /// The name of a clip.
    fn id(&self, index: usize) -> Option<&str> {
        self.shards.samples().get(index).map(String::as_str)
    }

    /// The tokens of a clip as they lie in the file; `None` where it has none of this modality.
    fn read<'py>(
        &self,
        py: Python<'py>,
        index: usize,
        modality: &str,
    ) -> PyResult<Option<Bound<'py, PyAny>>> {
        let read = py.detach(|| {
            let bytes = self.shards.read(index, modality)?;
            let array = bytes.as_deref().map(member).transpose();
            array.map_err(|reason| self.shards.member_error(index, modality, reason))
        });
        let array = read.map_err(|error| refused(py, error, ""))?;
        array.map(|array| moved(py, array)).transpose()
    }
}

/// The array of a member: an npy, or the first of an npz.
fn member(bytes: &[u8]) -> Result<NpyArray, String> {
    if !bytes.starts_with(b"PK") {
        return npy::parse(bytes).map_err(|error| error.to_string());
    }
    let arrays = Npz::parse(bytes).map_err(|error| error.to_string())?.arrays;
    let first = arrays.into_values().next();
    first.ok_or_else(|| "an empty archive".to_owned())
}

/// Tokens in shards.
#[pyfunction]
pub fn open_tokens(py: Python<'_>, path: PathBuf, split: &str, runs: PathBuf) -> PyResult<Tokens> {
    let root = locate(py, &path, &runs, "tokens", split)?;
    let shards = py.detach(|| ShardIndex::open(&root));
    let shards = shards.map_err(|error| {
        refused(
            py,
            error,
            "a folder of tokens holds `<modality>/.../shard-000000.tar`",
        )
    })?;
    Ok(Tokens {
        shards,
        place: root.display().to_string(),
    })
}

/// Token ids in the shape of their grid.
pub fn ids(py: Python<'_>, grid: reviv::tokenizer::TokenGrid) -> PyResult<Bound<'_, PyAny>> {
    let values: Vec<i64> = grid.ids.into_iter().map(i64::from).collect();
    owned(py, IxDyn(&grid.grid), values)
}
