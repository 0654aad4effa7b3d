//! A metric as a column of scores and tables: its name, its unit and the direction that is better.

use serde::{Deserialize, Serialize};

/// Which way is up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Better {
    /// Smaller values are better: errors and distances.
    Lower,
    /// Larger values are better: accuracies and similarities.
    Higher,
}

impl Better {
    /// 1 or -1: what values are multiplied by so that lower is better.
    #[must_use]
    pub fn sign(self) -> f64 {
        match self {
            Self::Lower => 1.0,
            Self::Higher => -1.0,
        }
    }
}

/// A metric as a column of scores and tables.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Column {
    /// `modality.metric`, and `@space` where the alignment is part of the metric: `depth.abs_rel@depth`.
    pub name: String,
    /// Empty for numbers without a unit.
    pub unit: String,
    /// Which direction of its values is an improvement.
    pub better: Better,
}

impl Column {
    /// The part before the dot.
    #[must_use]
    pub fn modality(&self) -> &str {
        self.name.split('.').next().unwrap_or_default()
    }

    /// The part after the dot.
    #[must_use]
    pub fn metric(&self) -> &str {
        self.name.split_once('.').map_or("", |(_, metric)| metric)
    }

    /// Whether `pattern` names this column: exactly, or without its `@space`.
    #[must_use]
    pub fn answers_to(&self, pattern: &str) -> bool {
        self.name == pattern || self.name.split('@').next() == Some(pattern)
    }
}

/// A column that a set of metrics fills.
#[derive(Debug, Clone, Copy)]
pub struct ColumnInfo {
    /// As in [`Column::name`], `@space` included: `depth.abs_rel@depth`.
    pub name: &'static str,
    /// Empty for numbers without a unit.
    pub unit: &'static str,
    /// Which direction of its values is an improvement.
    pub better: Better,
    /// One line about it.
    pub about: &'static str,
    /// One number for a whole set of clips, comparable only at equal n, instead of one per clip.
    pub per_set: bool,
}

impl ColumnInfo {
    /// One number per clip, lower is better.
    #[must_use]
    pub const fn lower(name: &'static str, unit: &'static str, about: &'static str) -> Self {
        Self {
            name,
            unit,
            better: Better::Lower,
            about,
            per_set: false,
        }
    }

    /// One number per clip, higher is better.
    #[must_use]
    pub const fn higher(name: &'static str, unit: &'static str, about: &'static str) -> Self {
        Self {
            better: Better::Higher,
            ..Self::lower(name, unit, about)
        }
    }

    /// One number per set of clips.
    #[must_use]
    pub const fn per_set(self) -> Self {
        Self {
            per_set: true,
            ..self
        }
    }

    /// As a column.
    #[must_use]
    pub fn column(&self) -> Column {
        Column {
            name: self.name.to_owned(),
            unit: self.unit.to_owned(),
            better: self.better,
        }
    }
}
