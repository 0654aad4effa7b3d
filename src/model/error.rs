//! Why a model cannot be used.

use crate::clip::Clip;
use crate::decoding::DecodingError;
use crate::mget::StoredError;
use crate::tokenizer::TokenizerError;
use std::path::{Path, PathBuf};

/// Why a model folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error("{path}: {error}")]
    Io {
        path: PathBuf,
        error: std::io::Error,
    },
    #[error("{}: no model folder: {reason}", path.display())]
    NotAModel { path: PathBuf, reason: String },
    #[error(
        "{}: the tokenizer of `{modality}` is not the one the model was trained on (expected {expected}, found {found})",
        path.display()
    )]
    OtherTokenizer {
        path: PathBuf,
        modality: String,
        expected: String,
        found: String,
    },
    #[error(
        "the tokenizer of `{modality}` has {found} tokens a clip of {vocabulary} kinds, the model expects {expected}"
    )]
    OtherGrid {
        modality: String,
        found: String,
        vocabulary: usize,
        expected: String,
    },
    #[error("no modality `{name}` in this model; it has: {known}")]
    UnknownModality { name: String, known: String },
    #[error("clip `{clip}` has no {modality}, which the model is to be given")]
    MissingInput { clip: String, modality: String },
    #[error("clip `{clip}`: {reason}")]
    Clip { clip: String, reason: String },
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    #[error(transparent)]
    Decoding(#[from] DecodingError),
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
