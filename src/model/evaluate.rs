//! Scoring a model on clips without anything on disk (Sec. 5).

use super::{GenerationRequest, Model, ModelError};
use crate::clip::Clip;
use crate::clip::source::{ClipSource, Outcome};
use crate::decoding::DecodingSettings;
use crate::evaluation::compare::{CompareError, CompareSettings, Method, compare};
use crate::evaluation::evaluate::{EvaluationError, LoadError, Pairs, evaluate as score};
use crate::evaluation::scores::Scores;
use crate::evaluation::suite::Suite;
use crate::evaluation::table::Table;
use crate::flow::Flow;
use crate::formats::ReadError;

/// Clips that go through the model at once.
const BATCH: usize = 8;

/// What a model is given, what it predicts, and what scores it.
#[derive(Debug, Clone)]
pub struct EvaluateOptions {
    /// Modalities it is given: `rgb` is the video's tokens, and raw video where the model takes it; `pixels` is raw video alone.
    pub inputs: Vec<String>,
    /// Modalities it generates; empty means all others.
    pub targets: Vec<String>,
    /// How tokens are generated.
    pub decoding: DecodingSettings,
    /// The columns; the default scores whatever of body, hands, camera, gaze and depth there is.
    pub suite: Suite,
    /// What the table calls the model.
    pub system: String,
    /// Also score the clips' own signals after a round trip through the tokenizers: no model of these tokens can do better.
    pub reconstruction_bound: bool,
    /// Of the decoding.
    pub seed: u64,
}

impl Default for EvaluateOptions {
    fn default() -> Self {
        Self {
            inputs: vec!["rgb".to_owned()],
            targets: Vec::new(),
            decoding: DecodingSettings::default(),
            suite: Suite::default(),
            system: "reviv".to_owned(),
            reconstruction_bound: true,
            seed: 0,
        }
    }
}

/// Why a model cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// A clip cannot be read.
    #[error(transparent)]
    Clips(#[from] ReadError),
    /// The model refuses a clip, or does not know a modality that is asked for.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The predictions cannot be scored, or the callback stopped it.
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    /// The scores cannot stand in one table.
    #[error(transparent)]
    Compare(#[from] CompareError),
}

/// Predicts every clip of `clips` and scores the predictions beside the trivial baselines on the same clips. `callback` hears how
/// many clips of how many were predicted.
///
/// # Errors
/// When a clip cannot be read or lacks what the model is given, a metric is unknown, or the callback stops it.
pub fn evaluate(
    model: &Model,
    clips: &dyn ClipSource,
    options: &EvaluateOptions,
    mut callback: impl FnMut(usize, usize) -> Flow,
) -> Result<Scores, EvaluateError> {
    let asked = |name: &&str| {
        !options.inputs.iter().any(|input| input == name)
            && (options.targets.is_empty() || options.targets.iter().any(|t| t == name))
    };
    let targets: Vec<String> = model.names().filter(asked).map(str::to_owned).collect();
    let request = GenerationRequest {
        inputs: &options.inputs,
        targets: &targets,
        decoding: &options.decoding,
        seed: options.seed,
    };
    let mut pairs = Predicted {
        clips,
        ids: Vec::new(),
        places: Vec::new(),
        predictions: Vec::new(),
        bounds: Vec::new(),
    };
    let mut batch: Vec<Clip> = Vec::new();
    for index in 0..clips.len() {
        if let Outcome::Clip(clip) = clips.clip(index)? {
            pairs.ids.push(clip.id.clone());
            pairs.places.push(index);
            batch.push(*clip);
        }
        if batch.len() == BATCH || index + 1 == clips.len() {
            let first = (pairs.ids.len() - batch.len()) as u64;
            let ids: Vec<u64> = (first..pairs.ids.len() as u64).collect();
            let made = model.predict(&batch, &ids, &request)?;
            pairs
                .predictions
                .extend(made.into_iter().map(|made| made.clip));
            if options.reconstruction_bound {
                pairs.bounds.extend(model.round_trip(&batch, &targets)?);
            }
            batch.clear();
            if callback(index + 1, clips.len()) == Flow::Stop {
                return Err(EvaluationError::Interrupted.into());
            }
        }
    }
    let (suite, system) = (&options.suite, options.system.as_str());
    Ok(score("clips", suite, system, &pairs, None, &mut |_, _| {
        true
    })?)
}

/// Scores beside each other, with their intervals and the trivial baselines: [`crate::evaluation::render::render`] prints it.
///
/// # Errors
/// When there are no scores, or they are of different clips.
pub fn table(title: &str, scores: &[Scores]) -> Result<Table, EvaluateError> {
    let methods: Vec<Method> = scores
        .iter()
        .map(|scores| Method {
            label: scores.system.clone(),
            seeds: vec![scores.clone()],
        })
        .collect();
    Ok(compare(title, &methods, &CompareSettings::default(), None)?)
}

/// Predictions in memory beside clips that are made again.
struct Predicted<'a> {
    clips: &'a dyn ClipSource,
    ids: Vec<String>,
    /// Where each is in `clips`.
    places: Vec<usize>,
    predictions: Vec<Clip>,
    bounds: Vec<Clip>,
}

impl Pairs for Predicted<'_> {
    fn ids(&self) -> &[String] {
        &self.ids
    }

    fn truth(&self, index: usize) -> Result<Clip, LoadError> {
        let found = self.clips.clip(self.places[index])?.into_clip();
        found.ok_or_else(|| "the clip was there a moment ago".into())
    }

    fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(self.predictions.get(index).cloned())
    }

    fn reconstruction_bound(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(self.bounds.get(index).cloned())
    }
}
