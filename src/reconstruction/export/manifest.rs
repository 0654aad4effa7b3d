//! npz arrays with a manifest: every array says its unit, frame of reference, rate, validity and scale status.

use crate::formats::FormatError;
use crate::formats::npy::NpyArray;
use crate::formats::npz::Npz;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Whether lengths are metres, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// Metres as the tokenizer was trained on: camera, body, hands.
    Learned,
    /// Metres by the fit of the depth to the floor under the wearer's feet.
    MetricByFloor,
    /// Metres by the fit to a metric depth of another model.
    MetricByAnchor,
    /// Up to an unknown scale and shift.
    Relative,
    /// Has no length.
    None,
}

impl Scale {
    /// In words, for people.
    pub fn words(&self) -> &'static str {
        match self {
            Self::Learned => "metres as learned",
            Self::MetricByFloor => "metric by floor fit",
            Self::MetricByAnchor => "metric by anchor depth",
            Self::Relative => "relative",
            Self::None => "no length",
        }
    }
}

/// What one array of the reconstruction is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArrayFacts {
    /// File below the reconstruction folder.
    pub file: String,
    /// Name within the file.
    pub name: String,
    pub shape: Vec<usize>,
    /// In words: `m`, `rad`, `image width and height`.
    pub unit: String,
    /// In words: `world (z up, origin at the first camera)`.
    pub frame: String,
    /// Hz; `None` for arrays without time.
    pub rate: Option<f64>,
    pub scale: Scale,
    /// The array of the same file that says which entries are known; `None` means all are.
    pub validity: Option<String>,
}

/// Arrays of one file and what they are.
#[derive(Debug, Clone, Default)]
pub struct ArrayFile {
    pub arrays: Npz,
    pub facts: Vec<ArrayFacts>,
}

impl ArrayFile {
    /// Adds an array with its facts; `file` of the facts is filled in when the file is written.
    #[must_use]
    pub fn with(mut self, array: impl Into<NpyArray>, facts: ArrayFacts) -> Self {
        self.arrays = self.arrays.with(&facts.name, array);
        self.facts.push(facts);
        self
    }

    /// Writes `folder/name` and returns the facts with the file name in them.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(mut self, folder: &Path, name: &str) -> Result<Vec<ArrayFacts>, FormatError> {
        self.arrays.write(&folder.join(name))?;
        for facts in &mut self.facts {
            name.clone_into(&mut facts.file);
        }
        Ok(self.facts)
    }
}
