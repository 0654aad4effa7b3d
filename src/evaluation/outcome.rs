//! What a metric can say about a clip: a number, nothing, "not unique" or "no".

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The score of one clip in one column. Only numbers enter averages; the others are counted beside them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
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
    #[error("{field}: not finite at {position:?} on a scored element")]
    NotFinite {
        field: &'static str,
        position: Vec<usize>,
    },
    #[error(
        "{field}: the rotation of pose {index} is not a rotation (off by {error:.1e}, at most 1e-4)"
    )]
    NotARotation {
        field: &'static str,
        index: usize,
        error: f64,
    },
    #[error("{field}: the fourth row of pose {index} is not 0 0 0 1")]
    NotAffine { field: &'static str, index: usize },
    #[error("{field}: shape {found:?} does not fit {expected:?}")]
    Shape {
        field: &'static str,
        found: Vec<usize>,
        expected: Vec<usize>,
    },
    #[error("embedding {row} has length zero: it has no direction")]
    ZeroEmbedding { row: usize },
    #[error("a motion of {found} frames; its features need at least {needed}")]
    TooShort { found: usize, needed: usize },
    #[error(
        "joints: the bone to joint {joint} has no length in frame {frame}: its direction is not known"
    )]
    NoBone { frame: usize, joint: usize },
    #[error("code {code} is outside the codebook of {size}")]
    CodeOutside { code: i64, size: usize },
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
