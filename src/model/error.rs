//! Why a model cannot be used.

use crate::clip::Clip;
use crate::decoding::DecodingError;
use crate::mget::StoredError;
use crate::tokenizer::TokenizerError;
use std::path::{Path, PathBuf};

/// Why a model folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file or folder of the model cannot be read or written.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// A file of the model is missing or damaged, or does not belong to the others.
    #[error("{}: no model folder: {reason}", path.display())]
    NotAModel {
        /// The folder of the model.
        path: PathBuf,
        /// What is missing or wrong.
        reason: String,
    },
    /// The files of a tokenizer have another hash than the manifest of the model names.
    #[error(
        "{}: the tokenizer of `{modality}` is not the one the model was trained on (expected {expected}, found {found})",
        path.display()
    )]
    OtherTokenizer {
        /// The folder of the tokenizer.
        path: PathBuf,
        /// The modality of the tokenizer.
        modality: String,
        /// The hash in the manifest, 32 hexadecimal digits.
        expected: String,
        /// The hash of the files, 32 hexadecimal digits.
        found: String,
    },
    /// A tokenizer gives other tokens than the transformer was built for: another number per clip, or of other kinds.
    #[error(
        "the tokenizer of `{modality}` has {found} tokens a clip of {vocabulary} kinds, the model expects {expected} of {expected_vocabulary}"
    )]
    OtherGrid {
        /// The modality of the tokenizer.
        modality: String,
        /// Tokens per clip of the tokenizer.
        found: usize,
        /// How many different tokens the tokenizer has.
        vocabulary: usize,
        /// Tokens per clip of the transformer.
        expected: usize,
        /// How many different tokens the transformer knows.
        expected_vocabulary: usize,
    },
    /// The model does not know a modality that is asked for.
    #[error("no modality `{name}` in this model; it has: {known}")]
    UnknownModality {
        /// The modality that is asked for.
        name: String,
        /// The modalities of the model, separated by commas.
        known: String,
    },
    /// A clip lacks a modality that the model is given.
    #[error("clip `{clip}` has no {modality}, which the model is to be given")]
    MissingInput {
        /// The id of the clip.
        clip: String,
        /// The modality that is missing.
        modality: String,
    },
    /// A signal cannot be taken from a clip or put into one.
    #[error("clip `{clip}`: {reason}")]
    Clip {
        /// The id of the clip.
        clip: String,
        /// What is wrong with the signal.
        reason: String,
    },
    /// A tokenizer cannot be read or written, or refuses a signal or tokens.
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    /// Tokens cannot be generated.
    #[error(transparent)]
    Decoding(#[from] DecodingError),
    /// The transformer cannot be read from its files or written to them.
    #[error(transparent)]
    Stored(#[from] StoredError),
}

pub(super) fn not_a_model(path: &Path, reason: impl std::fmt::Display) -> ModelError {
    ModelError::NotAModel {
        path: path.to_owned(),
        reason: reason.to_string(),
    }
}

pub(super) fn wrong_clip(clip: &Clip, reason: impl std::fmt::Display) -> ModelError {
    ModelError::Clip {
        clip: clip.id.clone(),
        reason: reason.to_string(),
    }
}
