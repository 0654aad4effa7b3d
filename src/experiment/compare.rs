//! How the cells of a sweep are put beside each other.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How the cells of a sweep become a table: the `compare:` block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct Compare {
    /// The arm that the others are compared with.
    pub baseline: Option<String>,
    /// Arms that are compared with another arm instead: of each, the name of the arm that differs in the one thing it is about.
    pub baselines: BTreeMap<String, String>,
    /// Metric columns, in order; all where empty.
    pub columns: Vec<String>,
    /// Confidence intervals.
    pub interval: Interval,
    /// Published rows to print beside: an entry of `reviv list published`.
    pub against: Option<String>,
}

/// Confidence intervals of a comparison.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Interval {
    /// The share of the distribution inside the interval.
    #[schemars(range(min = 0.5, max = 0.9999))]
    pub level: f64,
    /// What is resampled, paired between arms.
    pub over: Vec<Resample>,
}

impl Default for Interval {
    fn default() -> Self {
        Self {
            level: 0.95,
            over: vec![Resample::Seeds, Resample::Clips],
        }
    }
}

/// What an interval resamples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Resample {
    /// Training seeds.
    Seeds,
    /// Evaluation clips.
    Clips,
}
