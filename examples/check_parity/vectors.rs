//! One file of vectors: `X.json` (settings, tensors, tolerances) and `X.safetensors` (inputs and expected outputs).
// The folders of vectors differ in what they need of this.
#![allow(dead_code)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use reviv::engine::{HostTensor, Weights};
use serde_json::Value;

use super::Outcome;
use super::report::Report;

/// An expected tensor.
#[derive(Debug, Clone)]
struct Expected {
    shape: Vec<usize>,
    /// `None`: every element must be equal.
    tolerance: Option<f64>,
}

/// A file of vectors, and which of its outputs were compared so far.
#[derive(Debug)]
pub struct Vectors {
    /// `vq/body`.
    name: String,
    /// The `settings` of the JSON file.
    pub settings: Value,
    json: Value,
    folder: PathBuf,
    tensors: Weights,
    expected: BTreeMap<String, Expected>,
    compared: BTreeSet<String>,
}

/// Reads a JSON file.
pub fn json(path: &Path) -> Outcome<Value> {
    let text =
        std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(serde_json::from_str(&text)?)
}

/// The stems of the files of vectors in `folder` (those with both parts), sorted.
pub fn stems(folder: &Path) -> Outcome<Vec<String>> {
    let mut stems = BTreeSet::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let is_json = path
            .extension()
            .is_some_and(|extension| extension == "json");
        if is_json && path.with_extension("safetensors").is_file() {
            stems.extend(
                path.file_stem()
                    .and_then(|stem| stem.to_str())
                    .map(str::to_owned),
            );
        }
    }
    Ok(stems.into_iter().collect())
}

impl Vectors {
    /// Reads `folder/stem.json` and `folder/stem.safetensors`.
    pub fn read(folder: &Path, stem: &str) -> Outcome<Self> {
        let json = json(&folder.join(format!("{stem}.json")))?;
        let tensors = Weights::read(&folder.join(format!("{stem}.safetensors")))?;
        let parent = folder
            .file_name()
            .and_then(|name| name.to_str())
            .unwrap_or_default();
        let mut expected = BTreeMap::new();
        for (name, entry) in json["outputs"].as_object().into_iter().flatten() {
            let tolerance = match entry["compare"].as_str() {
                Some("exact") => None,
                // A tolerance of 0 marks what is stored for orientation only.
                Some("rel") => match entry["tol"].as_f64() {
                    Some(tolerance) if tolerance > 0.0 => Some(tolerance),
                    _ => continue,
                },
                _ => continue,
            };
            let shape = entry["shape"].as_array().into_iter().flatten();
            let shape = shape
                .filter_map(Value::as_u64)
                .map(|size| size as usize)
                .collect();
            expected.insert(name.clone(), Expected { shape, tolerance });
        }
        Ok(Self {
            name: format!("{parent}/{stem}"),
            settings: json["settings"].clone(),
            json,
            folder: folder.to_path_buf(),
            tensors,
            expected,
            compared: BTreeSet::new(),
        })
    }

    /// The weights that the file names as its checkpoint.
    pub fn checkpoint(&self) -> Outcome<Weights> {
        let name = self.json["checkpoint"]
            .as_str()
            .ok_or("no checkpoint is named")?;
        let set = self
            .folder
            .parent()
            .ok_or("a folder of vectors lies in a set")?;
        Ok(Weights::read(&set.join(format!("{name}.safetensors")))?)
    }

    /// A tensor of the file, input or output.
    pub fn tensor(&self, name: &str) -> Outcome<&HostTensor> {
        Ok(self
            .tensors
            .tensors
            .get(name)
            .ok_or_else(|| format!("{}: no tensor `{name}`", self.name))?)
    }

    /// The names of the outputs to compare.
    pub fn outputs(&self) -> Vec<String> {
        self.expected.keys().cloned().collect()
    }

    /// Whether `name` is an output to compare.
    pub fn has_output(&self, name: &str) -> bool {
        self.expected.contains_key(name)
    }

    fn start(&mut self, report: &mut Report, name: &str, shape: &[usize]) -> Option<Expected> {
        let full = format!("{} {name}", self.name);
        let Some(expected) = self.expected.get(name) else {
            report.problem(full, "is no output of the file".to_owned());
            return None;
        };
        self.compared.insert(name.to_owned());
        if expected.shape != shape {
            report.problem(
                full,
                format!("has shape {shape:?} instead of {:?}", expected.shape),
            );
            return None;
        }
        Some(expected.clone())
    }

    /// Compares an output of floats.
    pub fn compare(
        &mut self,
        report: &mut Report,
        name: &str,
        shape: &[usize],
        found: &[f32],
    ) -> Outcome {
        let Some(expected) = self.start(report, name, shape) else {
            return Ok(());
        };
        let wide =
            |values: &[f32]| -> Vec<f64> { values.iter().map(|value| f64::from(*value)).collect() };
        let values = self.tensor(name)?.f32(name)?;
        let full = format!("{} {name}", self.name);
        match expected.tolerance {
            Some(tolerance) => {
                let allowed = super::allowed(tolerance);
                report.relative(full, &wide(found), &wide(values), allowed);
            }
            None => report.exact(full, found, values),
        }
        Ok(())
    }

    /// Compares an output of integers, which must all be equal.
    pub fn compare_ids(
        &mut self,
        report: &mut Report,
        name: &str,
        shape: &[usize],
        found: &[i64],
    ) -> Outcome {
        if self.start(report, name, shape).is_some() {
            let values = self.tensor(name)?.i64(name)?;
            report.exact(format!("{} {name}", self.name), found, values);
        }
        Ok(())
    }

    /// Compares an output of bytes, which must all be equal.
    pub fn compare_bytes(
        &mut self,
        report: &mut Report,
        name: &str,
        shape: &[usize],
        found: &[u8],
    ) -> Outcome {
        if self.start(report, name, shape).is_some() {
            let values = self.tensor(name)?.u8(name)?;
            report.exact(format!("{} {name}", self.name), found, values);
        }
        Ok(())
    }

    /// Compares an output of flags, which must all be equal.
    pub fn compare_flags(
        &mut self,
        report: &mut Report,
        name: &str,
        shape: &[usize],
        found: &[bool],
    ) -> Outcome {
        if self.start(report, name, shape).is_some() {
            let values: Vec<bool> = self
                .tensor(name)?
                .u8(name)?
                .iter()
                .map(|flag| *flag != 0)
                .collect();
            report.exact(format!("{} {name}", self.name), found, &values);
        }
        Ok(())
    }

    /// Adds a failure for every output that was not compared.
    pub fn finish(self, report: &mut Report) {
        for name in self
            .expected
            .keys()
            .filter(|name| !self.compared.contains(*name))
        {
            report.problem(
                format!("{} {name}", self.name),
                "was not compared".to_owned(),
            );
        }
    }
}
