//! Tokenizers: every modality becomes a grid of discrete tokens and back (Sec. 4.2, Supp. A).

pub mod family;
pub mod normaliser;
pub mod open;
pub mod patches;
pub mod quantizer;
pub mod trained;
pub mod video;
pub mod vq;
pub mod whitening;

pub use family::TokenizerSettings;
pub use open::open;

use crate::clip::Signal;
use std::path::Path;

/// The tokens of one clip and modality.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenGrid {
    /// Row-major over `grid`, each below the tokenizer's vocabulary.
    pub ids: Vec<u32>,
    /// Camera and gaze `[30]`, body and hands `[30, 7]`, video `[5, 32, 32]` at the paper's sizes.
    pub grid: Vec<usize>,
}

/// Turns signals of one modality into tokens and back.
pub trait Tokenizer: Send + Sync {
    /// The modality it was trained for.
    fn modality(&self) -> &str;
    /// The shape of a token grid.
    fn grid(&self) -> &[usize];
    /// How many different tokens there are.
    fn vocabulary(&self) -> usize;
    /// Tokens of a batch of signals, in order.
    ///
    /// # Errors
    /// When a signal has another shape than the tokenizer was built for, or a value that is valid and not finite.
    fn encode(&self, signals: &[Signal]) -> Result<Vec<TokenGrid>, TokenizerError>;
    /// Signals of a batch of token grids, de-normalised, in order.
    ///
    /// # Errors
    /// When a grid has another shape, or a token is outside the vocabulary.
    fn decode(&self, tokens: &[TokenGrid]) -> Result<Vec<Signal>, TokenizerError>;
    /// Writes the tokenizer into `directory`, for [`open()`]; equal tokenizers give equal bytes.
    ///
    /// # Errors
    /// When a file cannot be written.
    fn write(&self, directory: &Path) -> Result<(), TokenizerError>;
}

/// Checks token grids before `tokenizer` decodes them.
fn check_tokens(tokenizer: &dyn Tokenizer, tokens: &[TokenGrid]) -> Result<(), TokenizerError> {
    let modality = || tokenizer.modality().to_owned();
    let (expected, vocabulary) = (tokenizer.grid(), tokenizer.vocabulary());
    for (index, grid) in tokens.iter().enumerate() {
        if grid.grid != expected || grid.ids.len() != expected.iter().product::<usize>() {
            return Err(TokenizerError::Shape {
                modality: modality(),
                index,
                found: grid.grid.clone(),
                expected: expected.to_vec(),
            });
        }
        if let Some(token) = grid.ids.iter().find(|id| **id as usize >= vocabulary) {
            return Err(TokenizerError::Vocabulary {
                modality: modality(),
                index,
                token: *token,
                vocabulary,
            });
        }
    }
    Ok(())
}

/// Why a tokenizer refuses its input.
#[derive(Debug, thiserror::Error)]
pub enum TokenizerError {
    /// A signal, its validity or a token grid has another shape than the tokenizer was built for.
    #[error("{modality}: signal {index} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// The modality of the tokenizer.
        modality: String,
        /// Index of the signal or grid in the batch.
        index: usize,
        /// Its shape.
        found: Vec<usize>,
        /// The shape that the tokenizer takes.
        expected: Vec<usize>,
    },
    /// A value is NaN or infinite and not marked as invalid.
    #[error("{modality}: signal {index} holds a value that is not finite at {position:?}")]
    NotFinite {
        /// The modality of the tokenizer.
        modality: String,
        /// Index of the signal in the batch.
        index: usize,
        /// Index of the value along every axis of the signal.
        position: Vec<usize>,
    },
    /// A token's id is not below the vocabulary.
    #[error("{modality}: token {token} of grid {index} is outside the vocabulary of {vocabulary}")]
    Vocabulary {
        /// The modality of the tokenizer.
        modality: String,
        /// Index of the token grid in the batch.
        index: usize,
        /// The token's id.
        token: u32,
        /// How many different tokens the tokenizer has.
        vocabulary: usize,
    },
    /// A tokenizer cannot be built, fitted, read or written, for this reason.
    #[error("{0}")]
    Other(String),
}
