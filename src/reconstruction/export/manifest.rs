//! npz arrays with a manifest: every array says its unit, frame of reference, rate, validity and scale status.

use crate::formats::FormatError;
use crate::formats::npy::NpyArray;
use crate::formats::npz::Npz;
use crate::reconstruction::predictions::ScaleStatus;
use serde::{Deserialize, Serialize};
use std::path::Path;

impl ScaleStatus {
    /// In words, for people.
    pub fn words(&self) -> String {
        match self {
            Self::Metric { by } => format!("metric by {by}"),
            Self::Relative => "relative".into(),
            Self::None => "no length".into(),
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
    /// Of the array.
    pub shape: Vec<usize>,
    /// In words: `m`, `image width and height`.
    pub unit: String,
    /// In words: `world (z up, origin at the first camera)`.
    pub frame: String,
    /// Hz; `None` for arrays without time.
    pub rate: Option<f64>,
    /// Whether its numbers are metric, and by what.
    pub scale: ScaleStatus,
    /// The array of the same file that says which entries are known; `None` means unknown entries are NaN.
    pub validity: Option<String>,
}

/// Arrays of one file and what they are.
#[derive(Debug, Clone, Default)]
pub struct ArrayFile {
    arrays: Npz,
    facts: Vec<ArrayFacts>,
}

impl ArrayFile {
    /// Adds an array with its facts; `file` and `shape` of the facts are filled in here and when the file is written.
    #[must_use]
    pub fn with(mut self, array: impl Into<NpyArray>, mut facts: ArrayFacts) -> Self {
        let array = array.into();
        facts.shape.clone_from(&array.shape);
        self.arrays = self.arrays.with(&facts.name, array);
        self.facts.push(facts);
        self
    }

    /// Writes `folder/name` and returns the facts with the file name in them; without arrays there is no file.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(mut self, folder: &Path, name: &str) -> Result<Vec<ArrayFacts>, FormatError> {
        if !self.facts.is_empty() {
            self.arrays.write(&folder.join(name))?;
        }
        for facts in &mut self.facts {
            name.clone_into(&mut facts.file);
        }
        Ok(self.facts)
    }
}
