//! How well a tokenizer reconstructs clips it never saw, beside what is possible without one.

use super::fit::{Callback, progress};
use super::signals::{Extracted, extract};
use super::tokenizer_errors::{Errors, Gain};
use super::trainer::TrainingError;
use crate::clip::Signal;
use crate::clip::source::ClipSource;
use crate::evaluation::tokens::codebook_use;
use crate::modality::Modality;
use crate::tokenizer::Tokenizer;
use serde::Serialize;
use std::collections::BTreeMap;

/// Clips scored at a time.
const CHUNK: usize = 32;

/// Clips kept to look at.
const EXAMPLES: usize = 3;

/// What has to be beaten.
pub(super) struct Baselines<'a> {
    /// The mean of the training split, one value per value of a signal.
    pub mean: Vec<f32>,
    /// The signal as a codebook of the same size without a network gives it back, where there is one.
    pub codebook: &'a dyn Fn(&Signal) -> Option<Vec<f32>>,
}

/// Errors on held-out clips by metric; the name says the unit.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Scores {
    /// Held-out clips that have the modality.
    pub clips: usize,
    /// Of the tokenizer.
    pub reconstruction: BTreeMap<String, f64>,
    /// Of always predicting the mean of the training split.
    pub mean: BTreeMap<String, f64>,
    /// Of k-means with as many codes on the same patches; empty where there is none.
    pub kmeans: BTreeMap<String, f64>,
    /// How much better the tokenizer is than k-means on the same clips.
    pub gain: BTreeMap<String, Gain>,
    /// Tokens of all clips together.
    pub tokens: u64,
    /// Share of the codes that occur in them; bounded by `tokens / vocabulary`.
    pub usage: Option<f64>,
    /// `exp` of the entropy of their frequencies.
    pub perplexity: Option<f64>,
}

/// One held-out clip to look at.
#[derive(Debug, Clone)]
pub struct Example {
    /// The clip's own values.
    pub truth: Vec<f32>,
    /// Per sample or joint; `None`: all valid.
    pub valid: Option<Vec<bool>>,
    /// What comes back from its tokens.
    pub found: Vec<f32>,
    /// What comes back from k-means.
    pub kmeans: Option<Vec<f32>>,
}

/// Scores `tokenizer` on the first `most` clips of `source` that have the modality, and keeps some to look at.
pub(super) fn score<E: From<TrainingError>>(
    source: &dyn ClipSource,
    most: usize,
    modality: &dyn Modality,
    tokenizer: &dyn Tokenizer,
    baselines: &Baselines<'_>,
    callback: &mut Callback<'_, E>,
) -> Result<(Scores, Vec<Example>), E> {
    let beside: &[&str] = match modality.name() {
        "gaze" => &["camera"],
        _ => &[],
    };
    let (mut own, mut mean, mut kmeans) = (Errors::default(), Errors::default(), Errors::default());
    let mut ids = Vec::new();
    let mut clips = 0;
    let mut examples = Vec::new();
    for start in (0..most).step_by(CHUNK) {
        let end = (start + CHUNK).min(most);
        let found = extract(source, modality, beside, start..end)?;
        let signals: Vec<Signal> = found.iter().map(|found| found.signal.clone()).collect();
        let grids = tokenizer.encode(&signals).map_err(TrainingError::from)?;
        let decoded = tokenizer.decode(&grids).map_err(TrainingError::from)?;
        for (Extracted { clip, signal }, decoded) in found.iter().zip(decoded) {
            let values: Vec<f32> = decoded.values.iter().copied().collect();
            own.compare(modality, clip, signal, &values);
            mean.compare(modality, clip, signal, &baselines.mean);
            let codebook = (baselines.codebook)(signal);
            if let Some(values) = &codebook {
                kmeans.compare(modality, clip, signal, values);
            }
            if examples.len() < EXAMPLES {
                examples.push(Example {
                    truth: signal.values.iter().copied().collect(),
                    valid: signal.valid.as_ref().map(|v| v.iter().copied().collect()),
                    found: values,
                    kmeans: codebook,
                });
            }
        }
        ids.extend(grids.into_iter().flat_map(|grid| grid.ids).map(i64::from));
        clips += found.len();
        progress(callback, end, most, "held-out clips")?;
    }
    let used = codebook_use(ids, tokenizer.vocabulary()).map_err(|error| TrainingError::Clip {
        clip: "held out".to_owned(),
        reason: error.to_string(),
    })?;
    let scores = Scores {
        clips,
        reconstruction: own.means(),
        mean: mean.means(),
        kmeans: kmeans.means(),
        gain: own.gain(&kmeans),
        tokens: used.n_tokens as u64,
        usage: used.usage,
        perplexity: used.perplexity,
    };
    Ok((scores, examples))
}
