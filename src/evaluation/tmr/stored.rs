//! The motion encoder as a folder: `weights.safetensors` with the weights, the statistics, and the sizes as metadata.

use std::collections::BTreeMap;
use std::path::Path;

use super::features::FEATURES;
use super::{MotionEncoder, MotionEncoderSettings, Tmr};
use crate::engine::{Compute, EngineError, Initialise, Parameters, Weights};

/// What the file says it is.
pub const FORMAT: &str = "reviv motion encoder 1";
/// The file of the folder.
pub const FILE: &str = "weights.safetensors";
/// The statistics' names in it.
pub const MEAN: &str = "statistics.mean";
/// Name of the tensor with the features' standard deviations.
pub const DEVIATION: &str = "statistics.std";

/// The metadata of a file of such an encoder.
#[must_use]
pub fn describe(settings: &MotionEncoderSettings) -> BTreeMap<String, String> {
    [
        ("format", FORMAT.to_owned()),
        (
            "settings",
            serde_json::to_string(settings).unwrap_or_default(),
        ),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

impl Tmr {
    /// Opens a folder that `reviv import` or [`Tmr::write`] made.
    ///
    /// # Errors
    /// When there is no such file, or it does not hold a motion encoder.
    pub fn open(folder: &Path, compute: &Compute) -> Result<Self, EngineError> {
        let path = folder.join(FILE);
        let refuse = |reason: String| EngineError::File {
            path: path.display().to_string(),
            reason,
        };
        let mut weights = Weights::read(&path)?;
        let metadata = std::mem::take(&mut weights.metadata);
        let text = |key: &str| metadata.get(key).map(String::as_str).unwrap_or_default();
        if text("format") != FORMAT {
            return Err(refuse(format!(
                "these are no weights of a motion encoder (`{}`)",
                text("format").escape_debug()
            )));
        }
        let settings: MotionEncoderSettings =
            serde_json::from_str(text("settings")).map_err(|error| refuse(error.to_string()))?;
        let mut statistics = Vec::new();
        for name in [MEAN, DEVIATION] {
            statistics.push(weights.get(name, &[FEATURES])?.f32(name)?.to_vec());
            weights.tensors.remove(name);
        }
        let [mean, deviation]: [Vec<f32>; 2] = statistics
            .try_into()
            .map_err(|_| refuse("no statistics".to_owned()))?;
        MotionEncoder::new(&Initialise::meta(compute), &settings)
            .map_err(&refuse)?
            .check_shapes(&weights)?;
        let mut encoder =
            MotionEncoder::new(&Initialise::empty(compute), &settings).map_err(&refuse)?;
        encoder.load(&weights)?;
        let mut tmr = Self::new(encoder, mean, deviation).map_err(&refuse)?;
        tmr.fingerprint = crate::formats::sha256_of(&path).map_err(|e| refuse(e.to_string()))?;
        Ok(tmr)
    }

    /// Writes the folder's file; equal encoders give equal bytes.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), EngineError> {
        let mut weights = self.encoder.weights();
        let [mean, deviation] = self.statistics();
        weights.insert_f32(MEAN, mean.to_vec(), &[FEATURES]);
        weights.insert_f32(DEVIATION, deviation.to_vec(), &[FEATURES]);
        weights.metadata = describe(self.encoder.settings());
        weights.write(&folder.join(FILE))
    }
}
