//! Held-out loss per modality on fixed clips and fixed masks, and the baseline that needs no model.

use super::loader::pack;
use super::source::{DataError, TokenSource};
use crate::engine::{Communicator, Parameters, RankError};
use crate::masking::Masking;
use crate::mget::{Batch, Loss, Mget, MgetSpec};
use crate::random::stream;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Validation batches, always the same.
#[derive(Debug, Clone)]
pub struct Validation {
    names: Vec<String>,
    batches: Vec<Batch>,
}

/// Mean cross-entropy of one modality.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Nats per token.
    pub loss: f64,
    /// Over how many tokens.
    pub tokens: usize,
}

impl Validation {
    /// The first `clips` clips of `source` (all if there are fewer), each under one mask that depends on `seed` alone, in
    /// batches of `batch` clips.
    ///
    /// # Errors
    /// When a clip cannot be read or does not fit the model.
    pub fn new(
        spec: &MgetSpec,
        masking: &Masking,
        source: &dyn TokenSource,
        clips: usize,
        batch: usize,
        seed: u64,
    ) -> Result<Self, DataError> {
        let clips: Vec<usize> = (0..source.len().min(clips)).collect();
        let mut batches = Vec::new();
        for clips in clips.chunks(batch.max(1)) {
            let mut samples = Vec::new();
            let mut masks = Vec::new();
            for clip in clips {
                let sample = source.read(*clip)?;
                sample.check(spec)?;
                let mut rng = stream(seed, "validation.mask", 0, *clip as u64);
                masks.push(masking.draw(&sample.present(spec), &mut rng));
                samples.push(sample);
            }
            batches.push(pack(spec, &samples, &masks)?);
        }
        Ok(Self {
            names: spec
                .modalities
                .iter()
                .map(|modality| modality.name.clone())
                .collect(),
            batches,
        })
    }

    /// Whether there is no clip.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.batches.is_empty()
    }

    /// The mean loss per modality that was asked for; each rank computes some of the batches.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn run(
        &self,
        model: &Mget,
        ranks: &Communicator,
    ) -> Result<BTreeMap<String, Score>, RankError> {
        let model = model.frozen();
        let losses = ranks.map(self.batches.len(), |index| {
            let values = model.losses(&self.batches[index], Loss::Mod).values();
            let sums = values.modalities.into_iter();
            // As bits: a loss need not be a number.
            let sum = |(mean, tokens): (f64, usize)| ((mean * tokens as f64).to_bits(), tokens);
            Ok::<Vec<Option<(u64, usize)>>, RankError>(sums.map(|loss| loss.map(sum)).collect())
        })?;
        let number = |(bits, tokens): (u64, usize)| (f64::from_bits(bits), tokens);
        Ok(self.mean(losses.into_iter().map(|batch| {
            let numbers = batch.into_iter().map(|loss| loss.map(number));
            numbers.collect()
        })))
    }

    /// The loss of always answering with the token frequencies of the training data.
    #[must_use]
    pub fn baseline(&self, unigram: &Unigram) -> BTreeMap<String, Score> {
        let losses = self.batches.iter().map(|batch| {
            let modalities = batch.targets.ids.iter().zip(&self.names);
            modalities
                .map(|(ids, name)| {
                    let nats = unigram.nats.get(name)?;
                    let sum = ids.iter().map(|id| nats[*id as usize]).sum();
                    Some((sum, ids.len()))
                })
                .collect()
        });
        self.mean(losses)
    }

    fn mean(
        &self,
        losses: impl Iterator<Item = Vec<Option<(f64, usize)>>>,
    ) -> BTreeMap<String, Score> {
        let mut sums: BTreeMap<String, (f64, usize)> = BTreeMap::new();
        for batch in losses {
            for (name, loss) in self.names.iter().zip(batch) {
                if let Some((sum, tokens)) = loss.filter(|(_, tokens)| *tokens > 0) {
                    let entry = sums.entry(name.clone()).or_default();
                    entry.0 += sum;
                    entry.1 += tokens;
                }
            }
        }
        let score = |(sum, tokens): (f64, usize)| Score {
            loss: sum / tokens as f64,
            tokens,
        };
        sums.into_iter()
            .map(|(name, sums)| (name, score(sums)))
            .collect()
    }
}

/// Token frequencies, with one added to every count.
#[derive(Debug, Clone, PartialEq)]
pub struct Unigram {
    /// Per modality and token: `-ln frequency`.
    nats: BTreeMap<String, Vec<f64>>,
}

impl Unigram {
    /// Counts the tokens of at most `clips` clips, spread evenly over the first clips of each source that are trained on:
    /// `lengths`, one per source.
    ///
    /// # Errors
    /// When a clip cannot be read or does not fit the model.
    pub fn fit(
        spec: &MgetSpec,
        sources: &[std::sync::Arc<dyn TokenSource>],
        lengths: &[usize],
        clips: usize,
    ) -> Result<Self, DataError> {
        let mut counts: BTreeMap<String, Vec<u64>> = spec
            .modalities
            .iter()
            .filter_map(|modality| Some((modality.name.clone(), vec![1; modality.vocabulary()?])))
            .collect();
        for (source, length) in sources.iter().zip(lengths) {
            let length = source.len().min(*length);
            let stride = length.div_ceil(clips.max(1)).max(1);
            for clip in (0..length).step_by(stride) {
                let sample = source.read(clip)?;
                sample.check(spec)?;
                for (name, counts) in &mut counts {
                    for id in sample.tokens.get(name).iter().flat_map(|grid| &grid.ids) {
                        counts[*id as usize] += 1;
                    }
                }
            }
        }
        let nats = |counts: Vec<u64>| {
            let total = counts.iter().sum::<u64>() as f64;
            counts
                .iter()
                .map(|count| (total / *count as f64).ln())
                .collect()
        };
        Ok(Self {
            nats: counts
                .into_iter()
                .map(|(name, counts)| (name, nats(counts)))
                .collect(),
        })
    }
}
