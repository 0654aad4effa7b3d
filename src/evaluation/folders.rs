//! True and predicted clips in folders of arrays: how other systems' predictions are evaluated.

use super::evaluate::{LoadError, Pairs};
use crate::clip::Clip;
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
