//! What flows along an edge: the kinds of artifacts, and what is known of one before any compute.
//!
//! A [`Description`] is the static side of an artifact. It is computed by [`super::stage::Op::check`] from the settings
//! and the inputs' descriptions, so a vocabulary or a shape that does not fit is found before anything runs.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// The type of an artifact. An artifact is a directory with a `manifest.json`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ArtifactKind {
    /// Two-second clips in shards, by split.
    Clips,
    /// A trained (or imported) tokenizer of one modality.
    Tokenizer,
    /// Token grids of clips, by split and modality.
    Tokens,
    /// A trained (or imported) MGET model with the tokenizers it was trained on.
    Mget,
    /// Decoded signals per clip.
    Predictions,
    /// Metrics per clip.
    Scores,
    /// A table: of scores, of statistics.
    Table,
    /// Files for other programs.
    Export,
}

impl ArtifactKind {
    /// Every kind, in the order of the pipeline.
    pub const ALL: [Self; 8] = [
        Self::Clips,
        Self::Tokenizer,
        Self::Tokens,
        Self::Mget,
        Self::Predictions,
        Self::Scores,
        Self::Table,
        Self::Export,
    ];

    /// The name as written in diagnostics and manifests.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Clips => "clips",
            Self::Tokenizer => "tokenizer",
            Self::Tokens => "tokens",
            Self::Mget => "mget",
            Self::Predictions => "predictions",
            Self::Scores => "scores",
            Self::Table => "table",
            Self::Export => "export",
        }
    }
}

impl fmt::Display for ArtifactKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What is known of an artifact before it exists. Fields that do not apply to its kind stay empty.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Description {
    /// Number of clips by split (`train`, `validation`, `test`), where it is known.
    pub clips: BTreeMap<String, u64>,
    /// Signals present, by modality name: clips, predictions.
    pub signals: BTreeMap<String, SignalFacts>,
    /// Token grids, by modality name: a tokenizer has one, tokens and models have one per modality.
    pub tokens: BTreeMap<String, TokenFacts>,
    /// Metric columns: scores, tables.
    pub columns: Vec<String>,
    /// Anything else a later op may want to know (`size`, `pixels`, ...).
    pub extra: BTreeMap<String, serde_json::Value>,
}

/// The form of one signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SignalFacts {
    /// Shape of the signal's values: camera `[60, 9]`, body `[60, 21, 3]`, video `[16, 256, 256, 3]`.
    pub shape: Vec<usize>,
    /// Samples per second.
    pub rate: f64,
}

/// The form of one modality's tokens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenFacts {
    /// Camera and gaze `[30]`, body and hands `[30, 7]`, video `[5, 32, 32]` at the paper's sizes.
    pub grid: Vec<usize>,
    /// How many different tokens there are.
    pub vocabulary: u64,
}

impl TokenFacts {
    /// Tokens per clip.
    pub fn count(&self) -> u64 {
        self.grid.iter().map(|&n| n as u64).product()
    }
}
