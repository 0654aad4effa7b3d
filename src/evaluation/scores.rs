//! Scores: what an evaluation leaves behind. One value per clip and column, so that comparisons can pair on common clips.

use super::columns::Column;
use super::outcome::Outcome;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// The scores of one system on one suite of clips, with the trivial baselines on the same clips.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Version of this layout.
    pub format: u32,
    /// Name of the suite that was evaluated.
    pub suite: String,
    /// Who predicted.
    pub system: String,
    /// Clip ids, in the order of every column's values.
    pub clips: Vec<String>,
    /// The system's own scores.
    pub own: ScoreSet,
    /// `still camera`, `image centre`, `mean pose`, `mean depth image`, `mean value`, `reconstruction bound`: only the columns they have.
    pub baselines: BTreeMap<String, ScoreSet>,
    /// Clips that were not scored, by reason.
    pub left_out: BTreeMap<String, usize>,
    /// What a reader of the numbers must know: resampled timestamps, negative depth scales, ...
    pub notes: Vec<String>,
    /// How clips were drawn, if not all were taken.
    pub sample: Option<super::sample::Sample>,
}

/// The baseline that belongs to the system: the truth after a round trip through its tokenizers.
pub const RECONSTRUCTION_BOUND: &str = "reconstruction bound";

/// The current [`Scores::format`].
pub const FORMAT: u32 = 1;

/// Columns of one system.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ScoreSet {
    /// Columns with an outcome per clip, in the order of the suite.
    pub columns: Vec<ColumnScores>,
    /// Numbers of the whole set of clips.
    pub sets: Vec<SetScore>,
}

/// One column, one outcome per clip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ColumnScores {
    /// Name, unit and direction of the values.
    pub column: Column,
    /// One per clip, in the order of [`Scores::clips`].
    pub values: Vec<Outcome>,
}

/// A number that only a whole set of clips has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetScore {
    /// Name, unit and direction of the number.
    pub column: Column,
    /// The number, in the column's unit; `None` where it could not be computed.
    pub value: Option<f64>,
    /// Clips in the set: such numbers are comparable only at equal n.
    pub n: usize,
    /// Width of the embedding; below `n = 4 dim` the number is printed in brackets.
    pub dim: usize,
    /// The same number for two random halves of the ground truth.
    pub floor: Option<f64>,
    /// Why there is no value.
    pub unavailable: Option<String>,
}

impl SetScore {
    /// Too few clips for the width of the embedding: print in brackets.
    #[must_use]
    pub fn in_brackets(&self) -> bool {
        self.n < 4 * self.dim
    }
}

impl ScoreSet {
    /// The column of this full name, `@space` included.
    #[must_use]
    pub fn column(&self, name: &str) -> Option<&ColumnScores> {
        self.columns.iter().find(|c| c.column.name == name)
    }

    /// The set-wide number of this full name.
    #[must_use]
    pub fn set(&self, name: &str) -> Option<&SetScore> {
        self.sets.iter().find(|c| c.column.name == name)
    }
}

/// Why a scores file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScoresError {
    /// The file cannot be read or written.
    #[error("{path}: {error}")]
    Io {
        /// The scores file.
        path: String,
        /// What the file system said.
        #[source]
        error: std::io::Error,
    },
    /// The text is not JSON of this layout.
    #[error("{path}: not a scores file: {error}")]
    Json {
        /// The scores file.
        path: String,
        /// What is wrong, with line and column.
        error: serde_json::Error,
    },
    /// The file has another format version, or a column does not have one value per clip.
    #[error("{path}: {reason}")]
    Content {
        /// The scores file.
        path: String,
        /// What does not fit, in words.
        reason: String,
    },
}

/// The file of a scores artifact.
pub const FILE: &str = "scores.json";

impl Scores {
    /// Whether any of its own columns answers to one of `names`.
    #[must_use]
    pub fn has(&self, names: &[String]) -> bool {
        let columns = self.own.columns.iter().map(|scores| &scores.column);
        let mut all = columns.chain(self.own.sets.iter().map(|score| &score.column));
        all.any(|column| names.iter().any(|name| column.answers_to(name)))
    }

    /// Writes `scores.json` into `directory`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, directory: &Path) -> Result<(), ScoresError> {
        let path = directory.join(FILE);
        let text = serde_json::to_string(self).map_err(|error| ScoresError::Json {
            path: path.display().to_string(),
            error,
        })?;
        std::fs::write(&path, text).map_err(|error| ScoresError::Io {
            path: path.display().to_string(),
            error,
        })
    }

    /// Reads a scores file, or the `scores.json` of a directory.
    ///
    /// # Errors
    /// When it cannot be read, is of another format, or a column has another length than the list of clips.
    pub fn read(path: &Path) -> Result<Self, ScoresError> {
        let path = if path.is_dir() {
            path.join(FILE)
        } else {
            path.to_owned()
        };
        let name = || path.display().to_string();
        let text = std::fs::read_to_string(&path).map_err(|error| ScoresError::Io {
            path: name(),
            error,
        })?;
        let scores: Self = serde_json::from_str(&text).map_err(|error| ScoresError::Json {
            path: name(),
            error,
        })?;
        let content = |reason: String| ScoresError::Content {
            path: name(),
            reason,
        };
        if scores.format != FORMAT {
            return Err(content(format!(
                "format {}, this program reads {FORMAT}",
                scores.format
            )));
        }
        let sets = std::iter::once(&scores.own).chain(scores.baselines.values());
        if let Some(column) = sets
            .flat_map(|set| &set.columns)
            .find(|column| column.values.len() != scores.clips.len())
        {
            return Err(content(format!(
                "column `{}` has {} values for {} clips",
                column.column.name,
                column.values.len(),
                scores.clips.len()
            )));
        }
        Ok(scores)
    }
}
