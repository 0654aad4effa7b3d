//! Where training samples come from: token grids (and raw clips) of one data set, by index.

use crate::mget::{Content, MgetSpec, ModalitySpec};
use crate::tokenizer::TokenGrid;
use std::collections::BTreeMap;

/// The tokens of one clip.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TokenSample {
    /// The shard that each modality was read from, for messages; nothing for samples that are made in memory.
    pub shards: BTreeMap<String, String>,
    /// The clip's name, for messages.
    pub key: String,
    /// By modality; a modality the clip does not have (or that is invalid throughout) is absent.
    pub tokens: BTreeMap<String, TokenGrid>,
    /// Raw clips `[frames, height, width, channels]` of bytes, by the name of the raw modality.
    pub pixels: BTreeMap<String, Vec<u8>>,
}

/// A data set of tokens. Reading the same index gives the same sample, from any thread.
pub trait TokenSource: Send + Sync {
    /// The data set's name.
    fn name(&self) -> &str;
    /// How many clips there are.
    fn len(&self) -> usize;
    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// The clip `index`, below [`TokenSource::len`].
    ///
    /// # Errors
    /// When its shard has vanished or cannot be read.
    fn read(&self, index: usize) -> Result<TokenSample, DataError>;
}

/// Why a sample cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DataError {
    /// A shard or a clip in it cannot be read.
    #[error(
        "shard {shard} cannot be read: {reason}; the run continues from its last checkpoint once it is back"
    )]
    Shard {
        /// The path of the shard, or the name of a data set that is held in memory.
        shard: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A token's id is not below the vocabulary.
    #[error(
        "shard {shard}, sample `{sample}`, {modality}: token {token} is outside the vocabulary of {vocabulary}"
    )]
    Vocabulary {
        /// The shard of the modality, or `in memory`.
        shard: String,
        /// The clip's name.
        sample: String,
        /// The modality's name.
        modality: String,
        /// The token's id.
        token: u32,
        /// How many different tokens the model has for the modality.
        vocabulary: usize,
    },
    /// A modality has another number of tokens or tubelets than the model.
    #[error(
        "shard {shard}, sample `{sample}`, {modality}: {found} values, the model expects {expected}"
    )]
    Length {
        /// The shard of the modality, or `in memory`.
        shard: String,
        /// The clip's name.
        sample: String,
        /// The modality's name.
        modality: String,
        /// Tokens or tubelets of the clip.
        found: usize,
        /// Tokens or tubelets that the model takes.
        expected: usize,
    },
    /// The shards of a modality hold two clips of one name.
    #[error(
        "{modality}: clip `{clip}` is in shard {first} and in shard {second}; the clips of one folder need names of their own"
    )]
    Twice {
        /// The modality's name.
        modality: String,
        /// The name that both clips have.
        clip: String,
        /// Path of the shard that was read first.
        first: String,
        /// Path of the shard that repeats the name.
        second: String,
    },
    /// The data set of this name has no clips.
    #[error("data set `{0}` has no clips")]
    Empty(String),
    /// A weight is negative or not finite, all are 0, or there is not one per data set.
    #[error("the weights of the data sets are not finite and positive")]
    Weights,
    /// A sample does not fit the model or its mask.
    #[error("a batch could not be packed: {0}")]
    Batch(#[from] crate::mget::BatchError),
    /// A loader thread ended before the batch that was due.
    #[error("a loader thread has stopped")]
    Stopped,
}

impl TokenSample {
    /// Checks lengths and vocabularies of every modality of the model that the sample has.
    ///
    /// # Errors
    /// When one does not fit; the error names the modality, its shard and the sample.
    pub fn check(&self, spec: &MgetSpec) -> Result<(), DataError> {
        let shard = |modality: &ModalitySpec| {
            let shard = self.shards.get(&modality.name);
            shard.map_or_else(|| "in memory".to_owned(), Clone::clone)
        };
        for modality in &spec.modalities {
            let expected = modality.count();
            let found = match self.content(modality) {
                Content::Absent => continue,
                Content::Ids(ids) => {
                    let vocabulary = modality.vocabulary().unwrap_or(0);
                    if let Some(token) = ids.iter().find(|id| **id as usize >= vocabulary) {
                        return Err(DataError::Vocabulary {
                            shard: shard(modality),
                            sample: self.key.clone(),
                            modality: modality.name.clone(),
                            token: *token,
                            vocabulary,
                        });
                    }
                    ids.len()
                }
                Content::Bytes(bytes) => bytes.len() / modality.tubelet_values().unwrap_or(1),
                Content::Floats(floats) => floats.len() / modality.tubelet_values().unwrap_or(1),
            };
            if found != expected {
                return Err(DataError::Length {
                    shard: shard(modality),
                    sample: self.key.clone(),
                    modality: modality.name.clone(),
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }

    /// What the sample has of one modality of a model.
    #[must_use]
    pub fn content(&self, modality: &ModalitySpec) -> Content<'_> {
        match modality.vocabulary() {
            Some(_) => self
                .tokens
                .get(&modality.name)
                .map_or(Content::Absent, |grid| Content::Ids(&grid.ids)),
            None => self
                .pixels
                .get(&modality.name)
                .map_or(Content::Absent, |clip| Content::Bytes(clip)),
        }
    }

    /// What the sample has of every modality of a model.
    #[must_use]
    pub fn contents(&self, spec: &MgetSpec) -> Vec<Content<'_>> {
        spec.modalities
            .iter()
            .map(|modality| self.content(modality))
            .collect()
    }

    /// Which modalities of a model the sample has.
    #[must_use]
    pub fn present(&self, spec: &MgetSpec) -> Vec<bool> {
        self.contents(spec)
            .iter()
            .map(|content| !matches!(content, Content::Absent))
            .collect()
    }
}

/// A data set held in memory.
#[derive(Debug, Clone, Default)]
pub struct InMemory {
    /// The data set's name.
    pub name: String,
    /// Its clips.
    pub samples: Vec<TokenSample>,
}

impl TokenSource for InMemory {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.samples.len()
    }

    fn read(&self, index: usize) -> Result<TokenSample, DataError> {
        self.samples
            .get(index)
            .cloned()
            .ok_or_else(|| DataError::Shard {
                shard: self.name.clone(),
                reason: format!("no clip {index}"),
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mget::{Positions, Size};

    #[test]
    fn a_token_out_of_its_vocabulary_names_shard_sample_and_modality() {
        let spec = MgetSpec {
            size: Size::default(),
            positions: Positions::Released,
            modalities: vec![ModalitySpec::tokens("gaze", &[3], 10)],
        };
        let sample = |ids: &[u32]| TokenSample {
            shards: [("gaze".to_owned(), "train-000002.tar".to_owned())].into(),
            key: "world/0017".into(),
            tokens: [(
                "gaze".to_owned(),
                TokenGrid {
                    ids: ids.to_vec(),
                    grid: vec![ids.len()],
                },
            )]
            .into(),
            ..TokenSample::default()
        };
        assert!(sample(&[0, 9, 3]).check(&spec).is_ok());
        let message = sample(&[0, 10, 3]).check(&spec).unwrap_err().to_string();
        for part in [
            "train-000002.tar",
            "world/0017",
            "gaze",
            "token 10",
            "vocabulary of 10",
        ] {
            assert!(message.contains(part), "{message}");
        }
        assert!(sample(&[1, 2]).check(&spec).is_err());
        assert_eq!(TokenSample::default().present(&spec), [false]);
    }
}
