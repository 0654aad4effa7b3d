//! Taking the signals of one modality out of clips, on all cores.

use super::trainer::TrainingError;
use crate::clip::source::{ClipSource, Outcome};
use crate::clip::{Clip, Signal};
use crate::modality::Modality;
use rayon::prelude::*;
use std::ops::Range;

/// A clip with one signal taken out.
#[derive(Debug, Clone)]
pub struct Extracted {
    /// The clip, with at least what was asked for.
    pub clip: Clip,
    /// Its signal.
    pub signal: Signal,
}

/// The clips `range` of `source` that have `modality`, in order. `beside` names modalities to read too.
///
/// # Errors
/// When a clip cannot be read, or a signal has another form than its modality.
pub fn extract(
    source: &dyn ClipSource,
    modality: &dyn Modality,
    beside: &[&str],
    range: Range<usize>,
) -> Result<Vec<Extracted>, TrainingError> {
    let mut needed = vec![modality.name()];
    needed.extend(beside.iter().filter(|name| **name != modality.name()));
    let found: Result<Vec<Option<Extracted>>, TrainingError> = range
        .into_par_iter()
        .map(|index| {
            let Outcome::Clip(clip) = source.clip_with(index, &needed)? else {
                return Ok(None);
            };
            let signal = modality.extract(&clip).map_err(|error| {
                let (clip, reason) = (clip.id.clone(), error.to_string());
                TrainingError::Clip { clip, reason }
            })?;
            Ok(signal.map(|signal| Extracted {
                clip: *clip,
                signal,
            }))
        })
        .collect();
    Ok(found?.into_iter().flatten().collect())
}
