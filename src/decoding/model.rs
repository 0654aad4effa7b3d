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
    Tokens {
        /// One id per token, in the order of positions; any where the token is not known.
        ids: Vec<u32>,
        /// Per token: whether its id is given.
        known: Vec<bool>,
    },
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
    /// A target is not among the modalities of the model.
    #[error("the model has no modality `{name}`; it has {known:?}")]
    UnknownModality {
        /// The modality that was asked for.
        name: String,
        /// The model's modalities, in its order.
        known: Vec<String>,
    },
    /// A target is raw video, which has no vocabulary.
    #[error("`{name}` can only be an input, never generated")]
    NotPredicted {
        /// The target.
        name: String,
    },
    /// A sample does not have one slot per modality of the model.
    #[error("sample {sample}: {found} slots for {expected} modalities")]
    Slots {
        /// Index of the sample in the batch.
        sample: usize,
        /// Slots of the sample.
        found: usize,
        /// Modalities of the model.
        expected: usize,
    },
    /// Samples of one batch have different numbers of unknown tokens of a target.
    #[error("`{name}`: samples of one batch have {a} and {b} open tokens; generate them apart")]
    Uneven {
        /// The target.
        name: String,
        /// Unknown tokens of the first sample.
        a: usize,
        /// Unknown tokens of the sample that differs from it.
        b: usize,
    },
    /// A slot does not hold one id and one mark per token of its modality.
    #[error("sample {sample}, `{name}`: {found} tokens, expected {expected}")]
    Length {
        /// Index of the sample in the batch.
        sample: usize,
        /// The modality.
        name: String,
        /// Ids in the slot.
        found: usize,
        /// Tokens per sample of the modality.
        expected: usize,
    },
    /// A logit is NaN or infinite.
    #[error(
        "the model answers with a value that is not finite for `{name}`; its weights are broken"
    )]
    NotFinite {
        /// The modality that was being decoded.
        name: String,
    },
    /// The model refuses a sample, a position or a range of rows: its reason.
    #[error("{0}")]
    Model(String),
}
