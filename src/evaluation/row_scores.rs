//! One row's scores on the common clips: its cells, and its differences from another row.

use super::columns::Column;
use super::outcome::{Outcome, mean};
use super::scores::{ScoreSet, Scores};
use super::statistics::{
    Difference, Interval, Over, RESAMPLES, Summary, bootstrap_mean, hierarchical_interval, holm,
    paired_difference, student_interval, summarise,
};
use super::table::{Cell, Row};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Which intervals are printed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct IntervalSettings {
    /// Confidence level.
    #[schemars(range(min = 0.5, max = 0.999))]
    pub level: f64,
    /// What varies. With both, seeds and clips are drawn together, and where few seeds make Student's t over them wider, that is
    /// printed.
    pub over: Vec<Over>,
    /// Bootstrap draws.
    #[schemars(range(min = 100))]
    pub resamples: usize,
    /// Seed of the bootstrap.
    pub seed: u64,
}

impl Default for IntervalSettings {
    fn default() -> Self {
        Self {
            level: 0.95,
            over: vec![Over::Seeds, Over::Clips],
            resamples: RESAMPLES,
            seed: 0,
        }
    }
}

/// A score set seen on the common clips.
pub(super) struct AlignedScores<'a> {
    set: &'a ScoreSet,
    /// Position of every common clip in the set.
    order: Vec<usize>,
    /// The set has clips that are not common.
    is_larger: bool,
}

impl<'a> AlignedScores<'a> {
    pub(super) fn of(scores: &Scores, set: &'a ScoreSet, common: &[String]) -> Self {
        let position: BTreeMap<&String, usize> = scores
            .clips
            .iter()
            .enumerate()
            .map(|(i, c)| (c, i))
            .collect();
        Self {
            set,
            order: common.iter().map(|clip| position[clip]).collect(),
            is_larger: scores.clips.len() > common.len(),
        }
    }

    fn values(&self, column: &str) -> Option<Vec<Outcome>> {
        let values = &self.set.column(column)?.values;
        Some(self.order.iter().map(|&i| values[i]).collect())
    }
}

/// One row's score sets, one per seed.
pub(super) struct RowScores<'a> {
    pub(super) sets: Vec<AlignedScores<'a>>,
}

impl RowScores<'_> {
    pub(super) fn cell(&self, column: &Column, settings: &IntervalSettings) -> Cell {
        if column.is_per_set() {
            return self.set_cell(column, settings);
        }
        let per_seed: Vec<Vec<Outcome>> = self
            .sets
            .iter()
            .filter_map(|s| s.values(&column.name))
            .collect();
        if per_seed.is_empty() {
            return Cell::default();
        }
        let summaries: Vec<Summary> = per_seed.iter().map(|values| summarise(values)).collect();
        let seed_means: Vec<f64> = summaries.iter().filter_map(|s| s.mean).collect();
        let least = summaries.iter().map(|s| s.n).min().unwrap_or(0);
        let over = |what| settings.over.contains(&what);
        let seeds = over(Over::Seeds)
            .then(|| student_interval(&seed_means, settings.level))
            .flatten();
        let clips = match (over(Over::Clips), over(Over::Seeds)) {
            (false, _) => None,
            (true, true) => hierarchical_interval(
                &numbers(&per_seed),
                settings.level,
                settings.resamples,
                settings.seed,
            ),
            (true, false) => {
                let means = over_seeds(&numbers(&per_seed));
                let means: Vec<f64> = means.into_iter().flatten().collect();
                bootstrap_mean(&means, settings.level, settings.resamples, settings.seed)
            }
        };
        Cell {
            value: mean(seed_means.iter().copied()),
            interval: wider(seeds, clips),
            n: least,
            seeds: per_seed.len(),
            n_null: summaries.iter().map(|s| s.n_null).max().unwrap_or(0),
            n_degenerate: summaries.iter().map(|s| s.n_degenerate).max().unwrap_or(0),
            ..Cell::default()
        }
    }

    /// Set-wide numbers belong to the set they were computed on and are comparable only at equal n: a set that has more than
    /// the common clips has none here. Only seeds can vary.
    fn set_cell(&self, column: &Column, settings: &IntervalSettings) -> Cell {
        let scores: Vec<_> = self
            .sets
            .iter()
            .filter_map(|s| s.set.set(&column.name))
            .collect();
        if !scores.is_empty() && self.sets.iter().any(|s| s.is_larger) {
            return Cell {
                reason: Some("of more clips than the common ones".to_owned()),
                ..Cell::default()
            };
        }
        let values: Vec<f64> = scores.iter().filter_map(|s| s.value).collect();
        let interval = settings
            .over
            .contains(&Over::Seeds)
            .then(|| student_interval(&values, settings.level))
            .flatten();
        Cell {
            value: mean(values.iter().copied()),
            interval,
            n: scores.iter().map(|s| s.n).min().unwrap_or(0),
            seeds: scores.len(),
            floor: scores.first().and_then(|s| s.floor),
            in_brackets: scores.iter().any(|s| s.in_brackets()),
            reason: scores.iter().find_map(|s| s.unavailable.clone()),
            ..Cell::default()
        }
    }
}

fn numbers(per_seed: &[Vec<Outcome>]) -> Vec<Vec<Option<f64>>> {
    let of = |values: &Vec<Outcome>| values.iter().map(|v| v.number()).collect();
    per_seed.iter().map(of).collect()
}

fn wider(a: Option<Interval>, b: Option<Interval>) -> Option<Interval> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if a.width() >= b.width() { a } else { b }),
        (a, b) => a.or(b),
    }
}

/// Paired differences of every row against the row that `reference` names for it, Holm-corrected over the rows of each column.
pub(super) fn add_differences(
    rows: &mut [Row],
    sides: &[RowScores],
    reference: &[Option<usize>],
    columns: &[Column],
    settings: &IntervalSettings,
) {
    for (position, column) in columns.iter().enumerate() {
        if column.is_per_set() {
            continue;
        }
        let trainings: Vec<Vec<Vec<Option<f64>>>> = sides
            .iter()
            .map(|side| {
                let sets = side.sets.iter().filter_map(|s| s.values(&column.name));
                numbers(&sets.collect::<Vec<_>>())
            })
            .collect();
        let mut found: Vec<(usize, Difference)> = Vec::new();
        for (i, side) in trainings.iter().enumerate() {
            let Some(base) = reference[i].map(|reference| &trainings[reference]) else {
                continue;
            };
            let (level, draws) = (settings.level, settings.resamples);
            let difference = if settings.over.contains(&Over::Seeds) {
                paired_difference(side, base, level, draws, settings.seed)
            } else {
                let one = |all: &[Vec<Option<f64>>]| [over_seeds(all)];
                paired_difference(&one(side), &one(base), level, draws, settings.seed)
            };
            found.extend(difference.map(|d| (i, d)));
        }
        let p: Vec<f64> = found.iter().filter_map(|(_, d)| d.p).collect();
        let mut corrected = holm(&p).into_iter();
        for (i, mut difference) in found {
            if difference.p.is_some() {
                difference.p_holm = corrected.next();
            }
            rows[i].cells[position].difference = Some(difference);
        }
    }
}

/// Every clip's mean over the seeds that have a number; `None` where no seed has one.
fn over_seeds(trainings: &[Vec<Option<f64>>]) -> Vec<Option<f64>> {
    let clips = trainings.first().map_or(0, Vec::len);
    (0..clips)
        .map(|clip| mean(trainings.iter().filter_map(|values| values[clip])))
        .collect()
}
