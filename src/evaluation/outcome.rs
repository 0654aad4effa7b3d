//! What a metric can say about a clip: a number, nothing, "not unique" or "no".

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The score of one clip in one column. Only numbers enter averages; the others are counted beside them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// A value, in the column's unit.
    Number(f64),
    /// Nothing valid to score.
    Null,
    /// The alignment has no unique optimum (a camera that stands still, points on a line).
    Degenerate,
}

impl Outcome {
    /// `Null` for `None`.
    #[must_use]
    pub fn of(value: Option<f64>) -> Self {
        value.map_or(Self::Null, Self::Number)
    }

    /// `Degenerate` if `degenerate`, else [`Outcome::of`].
    #[must_use]
    pub fn unless(degenerate: bool, value: Option<f64>) -> Self {
        if degenerate && value.is_some() {
            Self::Degenerate
        } else {
            Self::of(value)
        }
    }

    /// The value of a number; `None` of the others.
    #[must_use]
    pub fn number(self) -> Option<f64> {
        match self {
            Self::Number(value) => Some(value),
            Self::Null | Self::Degenerate => None,
        }
    }
}

/// In files: a JSON number, `null`, or the word `"degenerate"`.
impl Serialize for Outcome {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Number(value) => serializer.serialize_f64(*value),
            Self::Null => serializer.serialize_none(),
            Self::Degenerate => serializer.serialize_str("degenerate"),
        }
    }
}

impl<'de> Deserialize<'de> for Outcome {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Word(String),
            Nothing(()),
        }
        match Written::deserialize(deserializer)? {
            Written::Number(value) => Ok(Self::Number(value)),
            Written::Nothing(()) => Ok(Self::Null),
            Written::Word(word) if word == "degenerate" => Ok(Self::Degenerate),
            Written::Word(word) => Err(serde::de::Error::custom(format!(
                "`{word}` is not an outcome: expected a number, null or \"degenerate\""
            ))),
        }
    }
}

/// Why a metric refuses to score. A refusal ends the evaluation: silently skipped garbage would look like a good score.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MetricError {
    /// A value that would be scored is NaN or infinite.
    #[error("{field}: not finite at {position:?} on a scored element")]
    NotFinite {
        /// What holds it, in words: `depth prediction`, `estimated camera`, ...
        field: &'static str,
        /// Its index, frame (or row) first; for a pose or a joint, the index of the whole.
        position: Vec<usize>,
    },
    /// The rotation part of a pose is not orthonormal, or mirrors.
    #[error(
        "{field}: the rotation of pose {index} is not a rotation (off by {error:.1e}, at most 1e-4)"
    )]
    NotARotation {
        /// Which trajectory the pose belongs to.
        field: &'static str,
        /// Its index in the trajectory, from 0.
        index: usize,
        /// Largest deviation of an entry of `RᵀR` from the identity, or of `det R` from 1.
        error: f64,
    },
    /// A pose matrix is no rigid motion in homogeneous coordinates.
    #[error("{field}: the fourth row of pose {index} is not 0 0 0 1")]
    NotAffine {
        /// Which trajectory the pose belongs to.
        field: &'static str,
        /// Its index in the trajectory, from 0.
        index: usize,
    },
    /// Arrays that are compared do not fit.
    #[error("{field}: shape {found:?} does not fit {expected:?}")]
    Shape {
        /// What has the shape: `joints`, `gaze`, `embeddings`, ...
        field: &'static str,
        /// The shape that was given, usually the prediction's.
        found: Vec<usize>,
        /// The shape that was needed, usually the truth's.
        expected: Vec<usize>,
    },
    /// An argument beside the arrays is outside its range.
    #[error("`{name}` is {found}; it must be {allowed}")]
    Argument {
        /// Its name: `root`, `delta`, `rate`.
        name: &'static str,
        /// What was given.
        found: f64,
        /// The range, in words: `below 21, the number of joints`.
        allowed: String,
    },
    /// An embedding is all zeros, so that it has no cosine with another.
    #[error("embedding {row} has length zero: it has no direction")]
    ZeroEmbedding {
        /// Its row, from 0.
        row: usize,
    },
    /// A motion is too short for the features of the motion encoder.
    #[error("a motion of {found} frames; its features need at least {needed}")]
    TooShort {
        /// Frames that it has, at the rate of the features.
        found: usize,
        /// Frames that it must have at least.
        needed: usize,
    },
    /// A joint lies within a micrometre of its parent: features need the bone's direction.
    #[error(
        "joints: the bone to joint {joint} has no length in frame {frame}: its direction is not known"
    )]
    NoBone {
        /// Index of the frame, at the rate of the features.
        frame: usize,
        /// Index among the 22 joints that features are made of.
        joint: usize,
    },
    /// A token is negative, or not below the size of its codebook.
    #[error("code {code} is outside the codebook of {size}")]
    CodeOutside {
        /// The token.
        code: i64,
        /// Number of codes in the codebook.
        size: usize,
    },
}

/// Mean of the numbers that `values` yields; `None` when there is none.
pub(crate) fn mean(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0_usize);
    for value in values {
        sum += value;
        count += 1;
    }
    (count > 0).then(|| sum / count as f64)
}

/// Root of the mean square.
pub(crate) fn rms(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    mean(values.into_iter().map(|v| v * v)).map(f64::sqrt)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outcomes_survive_a_file() {
        let all = vec![Outcome::Number(1.5), Outcome::Null, Outcome::Degenerate];
        let text = serde_json::to_string(&all).unwrap();
        assert_eq!(text, r#"[1.5,null,"degenerate"]"#);
        assert_eq!(serde_json::from_str::<Vec<Outcome>>(&text).unwrap(), all);
        assert!(serde_json::from_str::<Outcome>("\"fine\"").is_err());
    }
}
