//! Declared modalities of recordings: an array in an npz file of the recording's folder, from the recording's first moment on.

use super::ReadError;
use crate::clip::Signal;
use crate::clip::clock::CLIP_SECONDS;
use crate::formats::npz::Npz;
use crate::formats::read_error::Position;
use crate::modality::DeclaredSettings;
use crate::modality::declared::Missing;
use ndarray::{Array1, Array2, Ix2};
use std::path::Path;

/// One declared signal of one recording.
pub(super) struct DeclaredTrack {
    pub settings: DeclaredSettings,
    /// `[samples, channels]`, NaN where missing.
    values: Array2<f32>,
}

impl DeclaredTrack {
    /// Reads it; `None` where the declaration names no file or this recording does not have it.
    pub fn read(folder: &Path, settings: &DeclaredSettings) -> Result<Option<Self>, ReadError> {
        let Some(file) = &settings.source.npz else {
            return Ok(None);
        };
        let path = folder.join(file);
        if !path.is_file() {
            return Ok(None);
        }
        let key = settings.source.key.as_deref().unwrap_or(&settings.name);
        let values = Npz::read_some(&path, &[key])?
            .get(key)?
            .to_dim::<f32, Ix2>()
            .map_err(|error| error.in_file(&path))?;
        let wrong = |reason: String| Err(ReadError::malformed(&path, Position::File, reason));
        let channels = settings.signal.channels.len();
        if values.ncols() != channels {
            return wrong(format!(
                "`{key}` has {} columns; `{}` declares {channels} channels",
                values.ncols(),
                settings.name
            ));
        }
        if settings.signal.missing == Missing::Never
            && let Some(row) = values
                .rows()
                .into_iter()
                .position(|r| !r.iter().all(|v| v.is_finite()))
        {
            return wrong(format!("`{key}`, row {row}: a value that is not finite"));
        }
        Ok(Some(DeclaredTrack {
            settings: settings.clone(),
            values,
        }))
    }

    /// The two seconds from `start` on, seconds from the recording's first moment; what lies beyond the end is invalid.
    pub fn clip(&self, start: f64) -> Signal {
        let samples = (CLIP_SECONDS * self.settings.signal.rate).round_ties_even() as usize;
        let first = (start * self.settings.signal.rate).round() as usize;
        let values = Array2::from_shape_fn((samples, self.values.ncols()), |(k, channel)| {
            let row = first.saturating_add(k);
            self.values.get((row, channel)).copied().unwrap_or(f32::NAN)
        });
        let valid: Array1<bool> = values
            .rows()
            .into_iter()
            .map(|row| row.iter().all(|value| value.is_finite()))
            .collect();
        Signal {
            values: values.into_dyn(),
            valid: Some(valid.into_dyn()),
        }
    }
}
