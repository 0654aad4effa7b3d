//! What decoding needs of a model: encode the known tokens, decode masked ones. MGET is one; tests bring their own.

use crate::mget::Content;
use std::ops::Range;

/// One modality as decoding sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenModality {
    /// The modality.
    pub name: String,
    /// Tokens per sample.
    pub tokens: usize,
    /// `None` for raw video, which is never predicted.
    pub vocabulary: Option<usize>,
}

/// What is known of one sample.
#[derive(Debug, Clone)]
pub struct Sample<'a> {
    /// Names the sample's random numbers: the same id gives the same tokens in any batch.
    pub id: u64,
    /// One per modality of the model.
    pub slots: Vec<Slot<'a>>,
}

/// What is known of one modality.
#[derive(Debug, Clone)]
pub enum Slot<'a> {
    /// `ids[p]` counts where `known[p]`.
    Tokens { ids: Vec<u32>, known: Vec<bool> },
    /// Raw video, or [`Content::Absent`].
    Pixels(Content<'a>),
}

impl Slot<'_> {
    /// Nothing known of `tokens` tokens.
    #[must_use]
    pub fn masked(tokens: usize) -> Self {
        Self::Tokens {
            ids: vec![0; tokens],
            known: vec![false; tokens],
        }
    }

    /// All tokens known.
    #[must_use]
    pub fn input(ids: Vec<u32>) -> Self {
        Self::Tokens {
            known: vec![true; ids.len()],
            ids,
        }
    }

    /// Whether anything is known.
    #[must_use]
    pub fn is_known(&self) -> bool {
        match self {
            Self::Tokens { known, .. } => known.iter().any(|k| *k),
            Self::Pixels(content) => !matches!(content, Content::Absent),
        }
    }

    /// Positions of unknown tokens, ascending; empty for raw video.
    #[must_use]
    pub fn masked_positions(&self) -> Vec<u32> {
        match self {
            Self::Tokens { known, .. } => (0..known.len() as u32)
                .filter(|&p| !known[p as usize])
                .collect(),
            Self::Pixels(_) => Vec::new(),
        }
    }
}

/// Target positions of every sample: `[samples][modalities][positions]`.
pub type TargetPositions = Vec<Vec<Vec<u32>>>;

/// A masked model of tokens.
pub trait TokenModel {
    /// What the encoder made of the known tokens.
    type Context;
    /// What the decoder made of the target positions, before the output matrices.
    type DecoderOutput;

    /// Its modalities, in the order of every `slots` and `target_positions`.
    fn modalities(&self) -> &[TokenModality];

    /// Reads the known tokens of `samples`, without the modalities that `hidden` marks. It may be that nothing is left.
    ///
    /// # Errors
    /// When a sample does not fit the model.
    fn encode(
        &self,
        samples: &[Sample<'_>],
        hidden: &[bool],
    ) -> Result<Self::Context, DecodingError>;

    /// Decodes the target positions. Positions of different modalities do not see each other.
    ///
    /// # Errors
    /// When a position does not exist.
    fn decode(
        &self,
        context: &Self::Context,
        target_positions: &TargetPositions,
    ) -> Result<Self::DecoderOutput, DecodingError>;

    /// Logits `[rows, vocabulary]` of a range of the rows of one modality, samples in order, positions as in the targets.
    ///
    /// # Errors
    /// When the rows were not among the targets.
    fn logits(
        &self,
        decoder_output: &Self::DecoderOutput,
        modality: usize,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, DecodingError>;
}

/// Why tokens cannot be generated.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodingError {
    #[error("the model has no modality `{name}`; it has {known:?}")]
    UnknownModality { name: String, known: Vec<String> },
    #[error("`{name}` can only be an input, never generated")]
    NotPredicted { name: String },
    #[error("sample {sample}: {found} slots for {expected} modalities")]
    Slots {
        sample: usize,
        found: usize,
        expected: usize,
    },
    #[error("`{name}`: samples of one batch have {a} and {b} open tokens; generate them apart")]
    Uneven { name: String, a: usize, b: usize },
    #[error("sample {sample}, `{name}`: {found} tokens, expected {expected}")]
    Length {
        sample: usize,
        name: String,
        found: usize,
        expected: usize,
    },
    #[error(
        "the model answers with a value that is not a number for `{name}`; its weights are broken"
    )]
    NotFinite { name: String },
    #[error("{0}")]
    Model(String),
}
