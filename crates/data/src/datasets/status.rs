//! What there is of a data set: recordings, hours, modalities, the split of its recordings, and what is left out and why.

use super::split::SplitSettings;
use super::{ClipSource, Excluded};
use crate::clip::clock::CLIP_SECONDS;
use serde::Serialize;
use std::collections::BTreeMap;

/// A data set at a glance; no picture is decoded for it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Status {
    /// The data set's own name, which clips carry.
    pub source: String,
    /// Recordings that can be read.
    pub recordings: usize,
    /// Clips that can be asked for, those that will be dropped included.
    pub clips: usize,
    /// Of the clips, at their stride.
    pub hours: f64,
    /// What its clips can have, by registry name.
    pub modalities: Vec<String>,
    /// `train`, `validation`, `test`.
    pub splits: Vec<Share>,
    /// Recordings that are here and cannot be read, each with its reason.
    pub excluded: Vec<Excluded>,
    /// What is absent, with the number of recordings it holds for.
    pub notes: Vec<(String, usize)>,
}

/// The recordings of one split.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Share {
    /// `train`, `validation` or `test`.
    pub split: &'static str,
    /// Recordings that the split has.
    pub recordings: usize,
    /// Clips of those recordings.
    pub clips: usize,
    /// What comes before the first `_`, `-` or `/` of their names, with its number of recordings: the participant in most data sets.
    pub groups: BTreeMap<String, usize>,
}

/// Looks at an opened source; clips start `stride` seconds apart.
pub fn status(source: &dyn ClipSource, split: &SplitSettings, stride: f64) -> Status {
    let mut splits: Vec<Share> = ["train", "validation", "test"]
        .map(|split| Share {
            split,
            recordings: 0,
            clips: 0,
            groups: BTreeMap::new(),
        })
        .into();
    let recordings = source.recordings();
    let official = source.splits();
    for (name, clips) in &recordings {
        let split = split.of(name, official.get(name).copied());
        if let Some(share) = splits.iter_mut().find(|share| share.split == split) {
            share.recordings += 1;
            share.clips += clips.len();
            let group = name.split(['_', '-', '/']).next().unwrap_or(name);
            *share.groups.entry(group.to_owned()).or_default() += 1;
        }
    }
    let seconds: f64 = recordings
        .iter()
        .filter(|(_, clips)| !clips.is_empty())
        .map(|(_, clips)| (clips.len() - 1) as f64 * stride.min(CLIP_SECONDS) + CLIP_SECONDS)
        // `sum` of nothing is -0.0, which prints as "-0.00 h".
        .fold(0.0, |sum, seconds| sum + seconds);
    Status {
        source: source.name().to_owned(),
        recordings: recordings.len(),
        clips: source.len(),
        hours: seconds / 3600.0,
        modalities: source.modalities(),
        splits,
        excluded: source.excluded(),
        notes: source.notes(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datasets::{Outcome, ReadError};

    struct Nothing;

    impl ClipSource for Nothing {
        fn name(&self) -> &'static str {
            "nothing"
        }
        fn len(&self) -> usize {
            0
        }
        fn modalities(&self) -> Vec<String> {
            Vec::new()
        }
        fn clip(&self, _: usize) -> Result<Outcome, ReadError> {
            Err(ReadError::Settings("there is none".to_owned()))
        }
    }

    #[test]
    fn a_data_set_without_clips_has_zero_hours_and_not_minus_zero() {
        let status = status(&Nothing, &SplitSettings::default(), 2.0);
        assert_eq!(format!("{:.2}", status.hours), "0.00");
    }
}
