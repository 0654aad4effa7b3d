//! True clips, in shards or in folders of arrays, and predictions in folders: what an evaluation reads.

use super::evaluate::{LoadError, Pairs};
use crate::clip::Clip;
use crate::clip::store::ClipSet;
use crate::reconstruction::predictions::Predictions;
use std::collections::BTreeMap;

/// True and predicted clips in folders, matched by clip id.
#[derive(Debug)]
pub struct Folders {
    ids: Vec<String>,
    truth: Predictions,
    predictions: Predictions,
    /// Position of a clip among the predictions.
    position: BTreeMap<String, usize>,
}

impl Folders {
    /// Every clip of `truth` is scored; predictions of other clips are left alone.
    #[must_use]
    pub fn new(truth: Predictions, predictions: Predictions) -> Self {
        let ids = truth
            .index
            .clips
            .iter()
            .map(|clip| clip.id.clone())
            .collect();
        let clips = predictions.index.clips.iter().enumerate();
        let position = clips.map(|(i, clip)| (clip.id.clone(), i)).collect();
        Self {
            ids,
            truth,
            predictions,
            position,
        }
    }
}

impl Pairs for Folders {
    fn ids(&self) -> &[String] {
        &self.ids
    }

    fn truth(&self, index: usize) -> Result<Clip, LoadError> {
        Ok(self.truth.load(index)?)
    }

    fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        match self.position.get(&self.ids[index]) {
            Some(&position) => Ok(Some(self.predictions.load(position)?)),
            None => Ok(None),
        }
    }
}

/// True clips in shards and predictions of them, matched by clip id.
#[derive(Debug)]
pub struct Stored {
    ids: Vec<String>,
    truth: ClipSet,
    /// Position of a scored clip in `truth` and among the predictions.
    positions: Vec<(usize, usize)>,
    predictions: Predictions,
}

impl Stored {
    /// Every clip that was predicted is scored.
    ///
    /// # Errors
    /// The id of the first prediction without a true clip.
    pub fn new(truth: ClipSet, predictions: Predictions) -> Result<Self, String> {
        let known: BTreeMap<&str, usize> = truth
            .ids()
            .iter()
            .enumerate()
            .map(|(position, id)| (id.as_str(), position))
            .collect();
        let mut positions = Vec::new();
        let mut ids = Vec::new();
        for (index, clip) in predictions.index.clips.iter().enumerate() {
            let position = *known.get(clip.id.as_str()).ok_or_else(|| clip.id.clone())?;
            positions.push((position, index));
            ids.push(clip.id.clone());
        }
        Ok(Self {
            ids,
            truth,
            positions,
            predictions,
        })
    }
}

impl Pairs for Stored {
    fn ids(&self) -> &[String] {
        &self.ids
    }

    fn truth(&self, index: usize) -> Result<Clip, LoadError> {
        Ok(self.truth.clip(self.positions[index].0)?)
    }

    fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(Some(self.predictions.load(self.positions[index].1)?))
    }
}
