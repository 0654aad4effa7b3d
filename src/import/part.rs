//! One model from one or several files (NVIDIA's encoder and decoder come apart): which entry becomes which tensor.

use super::source::Source;
use super::{ImportError, hash::HashedFile};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// A tensor to write.
#[derive(Debug, Clone)]
pub(super) struct Tensor {
    pub shape: Vec<usize>,
    pub values: Values,
}

#[derive(Debug, Clone)]
pub(super) enum Values {
    /// An entry of a file of the part.
    Entry { source: usize, index: usize },
    /// Values that come from elsewhere.
    Given(Vec<f32>),
}

/// All files of one model, of equal settings.
pub(super) struct Part {
    pub sources: Vec<Source>,
    /// By our names.
    pub tensors: BTreeMap<String, Tensor>,
}

impl Part {
    /// Puts the files of a part together. A tensor that two of them hold must be the same in both.
    pub fn new(mut sources: Vec<Source>) -> Result<Self, ImportError> {
        let mut tensors: BTreeMap<String, Tensor> = BTreeMap::new();
        for second in 0..sources.len() {
            // Statistics that lie in files of their own have no sizes to compare.
            let settings = &sources[second].plan.settings;
            if !settings.is_null() && *settings != sources[0].plan.settings {
                let first = sources[0].path().display();
                return Err(sources[second].refuse(format!("differs in its sizes from {first}")));
            }
            for index in 0..sources[second].plan.rules.len() {
                let entry = sources[second].checkpoint.entries()[index].clone();
                let written = sources[second].plan.rules[index].written(&entry);
                let Some((name, shape)) = written else {
                    continue;
                };
                let twice = match tensors.get(&name).map(|tensor| &tensor.values) {
                    Some(Values::Entry { source, index }) => Some((*source, *index)),
                    _ => None,
                };
                let Some((first, of)) = twice else {
                    let values = Values::Entry {
                        source: second,
                        index,
                    };
                    tensors.insert(name, Tensor { shape, values });
                    continue;
                };
                let path = sources[first].path().display().to_string();
                if !same(&mut sources, (first, of), (second, index))? {
                    let reason = format!("its `{name}` differs from the one in {path}");
                    return Err(sources[second].refuse(reason));
                }
                let action = format!("left out: equal to the one in {path}");
                sources[second].accounts.insert(entry.name, action);
            }
        }
        Ok(Self { sources, tensors })
    }

    /// What the files are of: all agree.
    pub fn first(&self) -> &Source {
        &self.sources[0]
    }

    /// Entries of all files.
    pub fn entries(&self) -> usize {
        let count = |source: &Source| source.checkpoint.entries().len();
        self.sources.iter().map(count).sum()
    }

    /// The tensors must be those that the model expects.
    pub fn complete(&self, expected: &BTreeMap<String, Vec<usize>>) -> Result<(), ImportError> {
        for (name, shape) in expected {
            let found = self.tensors.get(name).map(|tensor| &tensor.shape);
            if found != Some(shape) {
                let found = found.map_or("it is missing".to_owned(), |found| {
                    format!("the file has {found:?}")
                });
                let reason = format!("`{name}` should have shape {shape:?}: {found}");
                return Err(self.first().refuse(reason));
            }
        }
        match self
            .tensors
            .keys()
            .find(|name| !expected.contains_key(*name))
        {
            Some(name) => Err(self
                .first()
                .refuse(format!("`{name}` has no place in the model"))),
            None => Ok(()),
        }
    }

    /// Writes a safetensors file, tensor by tensor: its SHA-256 and how many numbers it holds.
    pub fn write(
        &mut self,
        path: &Path,
        metadata: &BTreeMap<String, String>,
        more: &BTreeMap<String, Tensor>,
    ) -> Result<(String, u64), ImportError> {
        let tensors: BTreeMap<&String, &Tensor> = self.tensors.iter().chain(more).collect();
        let mut header = Map::new();
        if !metadata.is_empty() {
            header.insert("__metadata__".to_owned(), json!(metadata));
        }
        let mut end = 0u64;
        for (name, tensor) in &tensors {
            let bytes = 4 * tensor.shape.iter().map(|d| *d as u64).product::<u64>();
            let entry = json!({
                "dtype": "F32",
                "shape": tensor.shape,
                "data_offsets": [end, end + bytes],
            });
            header.insert((*name).clone(), entry);
            end += bytes;
        }
        let io = |result: std::io::Result<()>| result.map_err(ImportError::io(path));
        let mut text = serde_json::to_vec(&Value::Object(header))
            .map_err(|e| ImportError::refused(path, e.to_string()))?;
        while !text.len().is_multiple_of(8) {
            text.push(b' ');
        }
        let mut out = HashedFile::create(path).map_err(ImportError::io(path))?;
        io(out.put(&(text.len() as u64).to_le_bytes()))?;
        io(out.put(&text))?;
        let mut bytes = Vec::new();
        let mut put = |values: &[f32]| {
            bytes.resize(4 * values.len(), 0);
            for (bytes, value) in bytes.as_chunks_mut().0.iter_mut().zip(values) {
                *bytes = value.to_le_bytes();
            }
            io(out.put(&bytes))
        };
        for (name, tensor) in &tensors {
            match &tensor.values {
                Values::Given(values) => put(values)?,
                Values::Entry { source, index } => {
                    let checkpoint = &mut self.sources[*source].checkpoint;
                    let from = checkpoint.path().to_owned();
                    checkpoint.stream(*index, &mut |values| {
                        if !values.iter().all(|v| v.is_finite()) {
                            let reason = format!("`{name}` holds a value that is not finite");
                            return Err(ImportError::refused(&from, reason));
                        }
                        put(values)
                    })?;
                }
            }
        }
        let sha256 = out.finish().map_err(ImportError::io(path))?;
        Ok((sha256, end / 4))
    }
}

/// Whether two entries of two files are equal. One is held in memory.
fn same(
    sources: &mut [Source],
    (first, of): (usize, usize),
    (second, index): (usize, usize),
) -> Result<bool, ImportError> {
    let entry = |sources: &[Source], source: usize, index: usize| {
        sources[source].checkpoint.entries()[index].shape()
    };
    if entry(sources, first, of) != entry(sources, second, index) {
        return Ok(false);
    }
    let held = sources[first].checkpoint.values(of)?;
    let (mut at, mut same) = (0, true);
    sources[second]
        .checkpoint
        .stream::<ImportError>(index, &mut |values| {
            same &= held[at..at + values.len()] == *values;
            at += values.len();
            Ok(())
        })?;
    Ok(same)
}
