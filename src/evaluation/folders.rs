//! True clips, in shards or in folders of arrays, and predictions in folders: what an evaluation reads.

use super::evaluate::{LoadError, Pairs};
use crate::clip::Clip;
use crate::clip::store::ClipSet;
use crate::reconstruction::predictions::{Predictions, PredictionsError};
use std::collections::BTreeMap;

/// The reconstruction bound that predictions of a model bring with them.
#[derive(Debug)]
struct Bound {
    clips: Option<Predictions>,
    position: BTreeMap<String, usize>,
}

impl Bound {
    fn of(predictions: &Predictions) -> Result<Self, PredictionsError> {
        let clips = predictions.reconstruction_bound()?;
        let position = clips.as_ref().map(Predictions::positions);
        Ok(Self {
            clips,
            position: position.unwrap_or_default(),
        })
    }

    fn clip(&self, id: &str) -> Result<Option<Clip>, LoadError> {
        match (&self.clips, self.position.get(id)) {
            (Some(clips), Some(&position)) => Ok(Some(clips.load(position)?)),
            _ => Ok(None),
        }
    }
}

/// Samples that predictions of a model bring with them.
#[derive(Debug)]
struct Samples(Vec<(Predictions, BTreeMap<String, usize>)>);

impl Samples {
    fn of(predictions: &Predictions) -> Result<Self, PredictionsError> {
        let samples = predictions.samples()?.into_iter();
        Ok(Self(samples.map(|s| (s.clone(), s.positions())).collect()))
    }

    fn clips(&self, id: &str) -> Result<Vec<Clip>, LoadError> {
        let found = self.0.iter().filter_map(|(s, at)| Some((s, *at.get(id)?)));
        found
            .map(|(sample, position)| Ok(sample.load(position)?))
            .collect()
    }
}

/// True and predicted clips in folders, matched by clip id.
#[derive(Debug)]
pub struct Folders {
    ids: Vec<String>,
    truth: Predictions,
    predictions: Predictions,
    /// Position of a clip among the predictions.
    position: BTreeMap<String, usize>,
    bound: Bound,
    samples: Samples,
}

impl Folders {
    /// Every clip of `truth` is scored; predictions of other clips are left alone.
    ///
    /// # Errors
    /// When the predictions bring a reconstruction bound that cannot be opened.
    pub fn new(truth: Predictions, predictions: Predictions) -> Result<Self, PredictionsError> {
        let ids = truth
            .index
            .clips
            .iter()
            .map(|clip| clip.id.clone())
            .collect();
        Ok(Self {
            ids,
            truth,
            position: predictions.positions(),
            bound: Bound::of(&predictions)?,
            samples: Samples::of(&predictions)?,
            predictions,
        })
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

    fn reconstruction_bound(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        self.bound.clip(&self.ids[index])
    }

    fn samples(&self, index: usize) -> Result<Vec<Clip>, LoadError> {
        self.samples.clips(&self.ids[index])
    }
}

/// Why predictions cannot be scored against clips in shards.
#[derive(Debug, thiserror::Error)]
pub enum StoredError {
    /// A prediction has no true clip; holds its clip id.
    #[error("clip `{0}` was predicted but is not among the true clips")]
    NotTrue(String),
    /// The reconstruction bound that the predictions bring cannot be opened.
    #[error(transparent)]
    Bound(#[from] PredictionsError),
}

/// True clips in shards and predictions of them, matched by clip id.
#[derive(Debug)]
pub struct Stored {
    ids: Vec<String>,
    truth: ClipSet,
    /// Position of a scored clip in `truth` and among the predictions.
    positions: Vec<(usize, usize)>,
    predictions: Predictions,
    bound: Bound,
    samples: Samples,
}

impl Stored {
    /// Every clip that was predicted is scored.
    ///
    /// # Errors
    /// A prediction without a true clip, or a reconstruction bound that cannot be opened.
    pub fn new(truth: ClipSet, predictions: Predictions) -> Result<Self, StoredError> {
        let known: BTreeMap<&str, usize> = truth
            .ids()
            .iter()
            .enumerate()
            .map(|(position, id)| (id.as_str(), position))
            .collect();
        let mut positions = Vec::new();
        let mut ids = Vec::new();
        for (index, clip) in predictions.index.clips.iter().enumerate() {
            let position = *known
                .get(clip.id.as_str())
                .ok_or_else(|| StoredError::NotTrue(clip.id.clone()))?;
            positions.push((position, index));
            ids.push(clip.id.clone());
        }
        Ok(Self {
            ids,
            truth,
            positions,
            bound: Bound::of(&predictions)?,
            samples: Samples::of(&predictions)?,
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

    fn reconstruction_bound(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        self.bound.clip(&self.ids[index])
    }

    fn samples(&self, index: usize) -> Result<Vec<Clip>, LoadError> {
        self.samples.clips(&self.ids[index])
    }
}
