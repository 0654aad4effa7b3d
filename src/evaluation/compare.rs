//! Many scores, one table: entrants side by side, paired on common clips and seeds.

use super::columns::Column;
use super::published::Published;
pub use super::row_scores::IntervalSettings;
use super::row_scores::{AlignedScores, RowScores, add_differences};
use super::samples;
use super::scores::{RECONSTRUCTION_BOUND, Scores};
use super::statistics::{Over, least_p, least_p_of_trainings};
use super::table::{Cell, Row, RowKind, Table};
use super::verdict;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// One row to be: an arm, a run, another system. Several scores are the same thing under several seeds.
#[derive(Debug, Clone)]
pub struct Method {
    /// What its row is called; [`CompareSettings::baseline`] refers to it.
    pub label: String,
    /// One per seed, all of the same thing; without any the row has no values.
    pub seeds: Vec<Scores>,
}

/// How a comparison is made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CompareSettings {
    /// Columns in this order; `depth.abs_rel` stands for all its spaces. Empty: all that any entrant has.
    pub columns: Vec<String>,
    /// The entrant that all others are tested against.
    pub baseline: Option<String>,
    /// Entrants that are tested against another one: of each, the name of the entrant that differs in the one thing it is about.
    pub baselines: BTreeMap<String, String>,
    /// The confidence intervals: their level, what varies in them, and how they are drawn.
    pub interval: IntervalSettings,
    /// Show the trivial baselines.
    pub trivial_baselines: bool,
}

impl Default for CompareSettings {
    fn default() -> Self {
        Self {
            columns: Vec::new(),
            baseline: None,
            baselines: BTreeMap::new(),
            interval: IntervalSettings::default(),
            trivial_baselines: true,
        }
    }
}

/// Why scores cannot stand in one table.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum CompareError {
    /// No entrant has any scores.
    #[error("nothing to compare")]
    Nothing,
    /// The entrants have no clip in common: nothing can be paired.
    #[error("no clip is common to all: `{first}` and `{other}` were evaluated on different clips")]
    NoCommonClips {
        /// Label of the first entrant with scores, whose clips were the start.
        first: String,
        /// Label of the entrant at which no clip was left.
        other: String,
    },
    /// [`CompareSettings::baseline`] is the label of no entrant.
    #[error("no entrant is called `{name}`; there are {known:?}")]
    UnknownBaseline {
        /// The label that was asked for.
        name: String,
        /// Labels of all entrants.
        known: Vec<String>,
    },
    /// An element of [`CompareSettings::columns`] fits no column of any entrant.
    #[error("no entrant has a column `{name}`")]
    UnknownColumn {
        /// The column that was asked for, as written.
        name: String,
        /// Names of all columns that any entrant has.
        known: Vec<String>,
    },
}

/// The table of `entrants`, with `published` rows below.
///
/// # Errors
/// When there is nothing to compare, a name is unknown, or two entrants share no clip.
pub fn compare(
    title: &str,
    entrants: &[Method],
    settings: &CompareSettings,
    published: Option<&Published>,
) -> Result<Table, CompareError> {
    let first = entrants
        .iter()
        .find(|e| !e.seeds.is_empty())
        .ok_or(CompareError::Nothing)?;
    let columns = columns(entrants, &settings.columns)?;
    let reference = references(entrants, settings)?;
    let common = common_clips(first, entrants)?;
    let sides: Vec<RowScores> = entrants
        .iter()
        .map(|entrant| RowScores {
            sets: entrant
                .seeds
                .iter()
                .map(|s| AlignedScores::of(s, &s.own, &common))
                .collect(),
        })
        .collect();
    let mut rows = Vec::new();
    for (entrant, side) in entrants.iter().zip(&sides) {
        rows.push(Row {
            label: entrant.label.clone(),
            kind: RowKind::System,
            cells: columns
                .iter()
                .map(|column| side.cell(column, &settings.interval))
                .collect(),
        });
    }
    add_differences(&mut rows, &sides, &reference, &columns, &settings.interval);
    if settings.trivial_baselines {
        // They see only the truth, so any entrant's will do; the reconstruction bound is an entrant's own.
        let trivial = first.seeds[0].baselines.iter();
        let of_the_truth =
            |name: &str| name != RECONSTRUCTION_BOUND && !name.starts_with(samples::PREFIX);
        for (name, set) in trivial.filter(|(name, _)| of_the_truth(name)) {
            let side = RowScores {
                sets: vec![AlignedScores::of(&first.seeds[0], set, &common)],
            };
            let row = Row {
                label: name.clone(),
                kind: RowKind::Baseline,
                cells: columns
                    .iter()
                    .map(|column| side.cell(column, &settings.interval))
                    .collect(),
            };
            if row.cells.iter().any(|cell| cell.value.is_some()) {
                rows.push(row);
            }
        }
        rows.extend(sampled(entrants, &columns, &common, &settings.interval));
        rows.extend(bounds(entrants, &columns, &common, &settings.interval));
    }
    rows.extend(published.map(|p| p.rows(&columns)).unwrap_or_default());
    let mut table = Table {
        title: title.to_owned(),
        columns,
        rows,
        notes: notes(entrants, settings, &common, published),
    };
    let verdicts = verdict::against_trivial(&table);
    table.notes.splice(0..0, verdicts);
    table.mark_best();
    Ok(table)
}

/// The entrant that each entrant is tested against.
fn references(
    entrants: &[Method],
    settings: &CompareSettings,
) -> Result<Vec<Option<usize>>, CompareError> {
    let find = |name: &String| {
        let at = entrants.iter().position(|e| &e.label == name);
        at.ok_or_else(|| CompareError::UnknownBaseline {
            name: name.clone(),
            known: entrants.iter().map(|e| e.label.clone()).collect(),
        })
    };
    for name in settings.baselines.keys() {
        find(name)?;
    }
    let of = |(own, entrant): (usize, &Method)| {
        let name = settings.baselines.get(&entrant.label);
        let at = name.or(settings.baseline.as_ref()).map(find).transpose()?;
        Ok(at.filter(|at| *at != own))
    };
    entrants.iter().enumerate().map(of).collect()
}

/// What entrants that were asked several times give: named after them where there are others.
fn sampled(
    entrants: &[Method],
    columns: &[Column],
    common: &[String],
    settings: &IntervalSettings,
) -> Vec<Row> {
    let mut rows = Vec::new();
    for entrant in entrants {
        for name in [samples::ONE, samples::MEAN, samples::BEST] {
            let with = (entrant.seeds.iter()).filter(|scores| scores.baselines.contains_key(name));
            let sets: Vec<AlignedScores> = with
                .map(|scores| AlignedScores::of(scores, &scores.baselines[name], common))
                .collect();
            if sets.is_empty() {
                continue;
            }
            let side = RowScores { sets };
            let label = match entrants {
                [_] => name.to_owned(),
                _ => format!("{name}, {}", entrant.label),
            };
            rows.push(Row {
                label,
                kind: RowKind::Baseline,
                cells: columns.iter().map(|c| side.cell(c, settings)).collect(),
            });
        }
    }
    rows
}

/// The reconstruction bounds: one row for all entrants that share their tokenizers, named after them where not all do.
fn bounds<'a>(
    entrants: &'a [Method],
    columns: &[Column],
    common: &[String],
    settings: &IntervalSettings,
) -> Vec<Row> {
    let mut found: Vec<(Vec<&'a str>, Vec<Cell>)> = Vec::new();
    for entrant in entrants {
        let of = |scores: &'a Scores| {
            Some(AlignedScores::of(
                scores,
                scores.baselines.get(RECONSTRUCTION_BOUND)?,
                common,
            ))
        };
        let sets: Vec<AlignedScores> = entrant.seeds.iter().filter_map(of).collect();
        let side = RowScores { sets };
        let cells: Vec<Cell> = columns.iter().map(|c| side.cell(c, settings)).collect();
        if cells.iter().all(|cell| cell.value.is_none()) {
            continue;
        }
        // An entrant that predicts less has fewer columns of the same bound.
        let agrees = |known: &[Cell]| {
            let mut both = known.iter().zip(&cells);
            both.all(|(a, b)| a.value.is_none() || b.value.is_none() || a == b)
        };
        match found.iter_mut().find(|(_, known)| agrees(known)) {
            Some((names, known)) => {
                names.push(&entrant.label);
                for (known, cell) in known.iter_mut().zip(cells) {
                    if known.value.is_none() {
                        *known = cell;
                    }
                }
            }
            None => found.push((vec![&entrant.label], cells)),
        }
    }
    let row = |(names, cells): (Vec<&str>, Vec<Cell>)| Row {
        label: if names.len() == entrants.len() {
            RECONSTRUCTION_BOUND.to_owned()
        } else {
            format!("{RECONSTRUCTION_BOUND}: {}", names.join(", "))
        },
        kind: RowKind::Baseline,
        cells,
    };
    found.into_iter().map(row).collect()
}

fn columns(entrants: &[Method], wanted: &[String]) -> Result<Vec<Column>, CompareError> {
    let mut all: Vec<Column> = Vec::new();
    for set in entrants.iter().flat_map(|e| &e.seeds).map(|s| &s.own) {
        for column in set
            .columns
            .iter()
            .map(|c| &c.column)
            .chain(set.sets.iter().map(|s| &s.column))
        {
            if !all.contains(column) {
                all.push(column.clone());
            }
        }
    }
    if wanted.is_empty() {
        return Ok(all);
    }
    let mut chosen: Vec<Column> = Vec::new();
    for name in wanted {
        let found: Vec<&Column> = all.iter().filter(|c| c.answers_to(name)).collect();
        if found.is_empty() {
            return Err(CompareError::UnknownColumn {
                name: name.clone(),
                known: all.iter().map(|c| c.name.clone()).collect(),
            });
        }
        for column in found {
            if !chosen.contains(column) {
                chosen.push(column.clone());
            }
        }
    }
    Ok(chosen)
}

/// Clips that every scores file has, in the order of the first.
fn common_clips(first: &Method, entrants: &[Method]) -> Result<Vec<String>, CompareError> {
    let mut common = first.seeds[0].clips.clone();
    for entrant in entrants {
        for scores in &entrant.seeds {
            let present: BTreeSet<&String> = scores.clips.iter().collect();
            common.retain(|clip| present.contains(clip));
            if common.is_empty() {
                return Err(CompareError::NoCommonClips {
                    first: first.label.clone(),
                    other: entrant.label.clone(),
                });
            }
        }
    }
    Ok(common)
}

/// Which intervals the table prints, in words.
fn intervals(settings: &IntervalSettings) -> String {
    // Three digits, so that neither 0.999 becomes 100 % nor 0.55 shows how floats are stored.
    let percent = (1e5 * settings.level).round() / 1e3;
    let over = |what| settings.over.contains(&what);
    let how = match (over(Over::Clips), over(Over::Seeds)) {
        (true, true) => {
            "hierarchical bootstrap, seeds and clips drawn together, or Student's t over seeds where that is wider"
        }
        (true, false) => "bootstrap over clips",
        (false, true) => "Student's t over seeds",
        (false, false) => return "no intervals".to_owned(),
    };
    format!("[{percent} % interval]: {how}")
}

/// What the differences are to, how they are tested, and what the tests can say at most.
fn tests(entrants: &[Method], settings: &CompareSettings) -> Option<String> {
    let others = settings.baselines.iter();
    let mut to: Vec<String> = others
        .map(|(of, to)| format!("of `{of}` to `{to}`"))
        .collect();
    to.sort();
    let to = match (&settings.baseline, to.is_empty()) {
        (None, true) => return None,
        (Some(baseline), true) => format!("to `{baseline}`"),
        (Some(baseline), false) => format!("to `{baseline}`, {}", to.join(", ")),
        (None, false) => to.join(", "),
    };
    let draws = settings.interval.resamples;
    let least = least_p(draws);
    let text = format!(
        "differences {to}: bootstrap on common clips, p after Holm over the rows of a column; \
         no p is smaller than {least:.2e} before Holm ({draws} draws)"
    );
    let fewest = entrants.iter().map(|e| e.seeds.len()).min().unwrap_or(0);
    let seeds = match (fewest, settings.interval.over.contains(&Over::Seeds)) {
        (0 | 1, _) => "; with one seed, training again is in no interval and no p".to_owned(),
        (_, false) => "; seeds are averaged: training again is in no interval and no p".to_owned(),
        (n, true) => format!(
            "; seeds are drawn too, and dealing {n} of each arm anew could not give less than {:.2}",
            least_p_of_trainings(n, n)
        ),
    };
    Some(text + &seeds)
}

fn notes(
    entrants: &[Method],
    settings: &CompareSettings,
    common: &[String],
    published: Option<&Published>,
) -> Vec<String> {
    let mut notes = vec![format!(
        "{} common clips; {}",
        common.len(),
        intervals(&settings.interval)
    )];
    notes.extend(tests(entrants, settings));
    let mut seen = BTreeSet::new();
    for entrant in entrants {
        for scores in &entrant.seeds {
            if let Some(sample) = &scores.sample {
                seen.insert(format!(
                    "{}: {} clips drawn by SHA-256 with seed {}",
                    scores.suite, sample.clips, sample.seed
                ));
            }
            for (reason, count) in &scores.left_out {
                seen.insert(format!("{}: {reason} on {count} clips", entrant.label));
            }
            for note in &scores.notes {
                seen.insert(format!("{}: {note}", entrant.label));
            }
        }
    }
    notes.extend(seen);
    notes.extend(published.map(Published::note));
    notes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::outcome::Outcome;
    use crate::evaluation::scores::{ColumnScores, FORMAT, ScoreSet, SetScore};
    use rand::RngExt;
    use std::collections::BTreeMap;

    fn scores(seed: u64, clips: std::ops::Range<usize>, shift: f64) -> Scores {
        let values = clips
            .clone()
            .map(|i| {
                let mut clip = crate::random::stream(0, "compare.clip", i as u64, 0);
                let mut noise = crate::random::stream(seed, "compare.noise", i as u64, 0);
                Outcome::Number(100.0 * clip.random::<f64>() + shift + noise.random::<f64>())
            })
            .collect();
        Scores {
            format: FORMAT,
            suite: "test".into(),
            system: "reviv".into(),
            clips: clips.map(|i| format!("clip/{i}")).collect(),
            own: ScoreSet {
                columns: vec![ColumnScores {
                    column: Column::named("body.ga_mpjpe").unwrap(),
                    values,
                }],
                sets: Vec::new(),
            },
            baselines: BTreeMap::new(),
            left_out: BTreeMap::new(),
            notes: Vec::new(),
            sample: None,
        }
    }

    #[test]
    fn a_shift_that_the_intervals_hide_is_found_in_the_paired_difference() {
        let entrants = [
            Method {
                label: "full".into(),
                seeds: vec![scores(1, 0..60, 0.0), scores(2, 0..60, 0.0)],
            },
            Method {
                label: "uniform".into(),
                seeds: vec![scores(3, 10..60, 5.0), scores(4, 10..60, 5.0)],
            },
        ];
        let settings = CompareSettings {
            baseline: Some("full".into()),
            ..CompareSettings::default()
        };
        let table = compare("test", &entrants, &settings, None).unwrap();
        let cell = &table.rows[1].cells[0];
        assert_eq!((cell.n, cell.seeds), (50, 2));
        let difference = cell.difference.unwrap();
        assert!(difference.interval.unwrap().contains(5.0) && difference.p_holm.unwrap() < 0.01);
        assert!(!table.rows[0].cells[0].bold, "the intervals overlap");
        assert_eq!(table.rows[0].cells[0].n, 50, "only common clips count");
    }

    #[test]
    fn an_arm_can_be_tested_against_the_one_it_differs_from_in_one_thing() {
        let entrant = |label: &str, shift| Method {
            label: label.into(),
            seeds: (0..3).map(|seed| scores(seed, 0..60, shift)).collect(),
        };
        let entrants = [
            entrant("full", 0.0),
            entrant("mixture", 5.0),
            entrant("uniform", 7.0),
        ];
        let settings = CompareSettings {
            baseline: Some("full".into()),
            baselines: BTreeMap::from([("uniform".into(), "mixture".into())]),
            ..CompareSettings::default()
        };
        let table = compare("test", &entrants, &settings, None).unwrap();
        let found = |row: usize| table.rows[row].cells[0].difference.map(|d| d.mean.round());
        assert_eq!([found(0), found(1), found(2)], [None, Some(5.0), Some(2.0)]);
        let note = table.notes.join("\n");
        assert!(
            note.contains("to `full`, of `uniform` to `mixture`"),
            "{note}"
        );
        assert!(
            note.contains("no p is smaller than 1.00e-3") && note.contains("less than 0.10"),
            "{note}"
        );
        let unknown = CompareSettings {
            baselines: BTreeMap::from([("uniform".into(), "nobody".into())]),
            ..settings
        };
        assert!(compare("test", &entrants, &unknown, None).is_err());
    }

    #[test]
    fn the_note_says_which_intervals_are_printed() {
        let note = |level, over: &[Over]| {
            intervals(&IntervalSettings {
                level,
                over: over.to_vec(),
                ..IntervalSettings::default()
            })
        };
        assert_eq!(
            note(0.95, &[Over::Seeds, Over::Clips]),
            "[95 % interval]: hierarchical bootstrap, seeds and clips drawn together, or Student's t over seeds where that is wider"
        );
        assert_eq!(
            note(0.999, &[Over::Clips]),
            "[99.9 % interval]: bootstrap over clips"
        );
        assert_eq!(
            note(0.55, &[Over::Seeds]),
            "[55 % interval]: Student's t over seeds"
        );
        assert_eq!(note(0.9, &[]), "no intervals");
    }

    #[test]
    fn a_number_of_a_whole_set_is_shown_only_on_the_clips_that_are_common() {
        let entrant = |label: &str, clips: usize| {
            let mut own = scores(1, 0..clips, 0.0);
            own.own.sets.push(SetScore {
                column: Column::named("body.kin_fid").unwrap(),
                value: Some(0.5),
                n: clips,
                dim: 2,
                floor: None,
                unavailable: None,
            });
            Method {
                label: label.into(),
                seeds: vec![own],
            }
        };
        let cells = |entrants: &[Method]| -> Vec<(Option<f64>, Option<String>)> {
            let table = compare("", entrants, &CompareSettings::default(), None).unwrap();
            let cells = table.rows.into_iter().map(|row| row.cells[1].clone());
            cells.map(|cell| (cell.value, cell.reason)).collect()
        };
        let (whole, none) = ((Some(0.5), None), "of more clips than the common ones");
        assert_eq!(
            cells(&[entrant("a", 9), entrant("b", 9)]),
            [whole.clone(), whole.clone()]
        );
        assert_eq!(
            cells(&[entrant("a", 9), entrant("b", 12)]),
            [whole, (None, Some(none.to_owned()))]
        );
    }

    #[test]
    fn bounds_are_one_row_where_tokenizers_are_shared_and_named_where_they_are_not() {
        let entrant = |label: &str, bound: Option<f64>| {
            let mut own = scores(1, 0..9, 10.0);
            if let Some(shift) = bound {
                let set = scores(2, 0..9, shift).own;
                own.baselines.insert(RECONSTRUCTION_BOUND.to_owned(), set);
            }
            Method {
                label: label.into(),
                seeds: vec![own],
            }
        };
        let rows = |entrants: &[Method]| -> Vec<String> {
            let table = compare("", entrants, &CompareSettings::default(), None).unwrap();
            let bounds = table.rows.iter().filter(|r| r.kind == RowKind::Baseline);
            bounds.map(|row| row.label.clone()).collect()
        };
        let (a, b, c) = (
            entrant("a", Some(0.0)),
            entrant("b", Some(0.0)),
            entrant("c", Some(3.0)),
        );
        assert_eq!(rows(&[a.clone(), b.clone()]), ["reconstruction bound"]);
        assert_eq!(
            rows(&[a.clone(), b, c]),
            ["reconstruction bound: a, b", "reconstruction bound: c"]
        );
        assert_eq!(
            rows(&[entrant("theirs", None), a]),
            ["reconstruction bound: a"]
        );
    }

    #[test]
    fn what_cannot_be_compared_says_so() {
        let entrant = |label: &str, clips| Method {
            label: label.into(),
            seeds: vec![scores(0, clips, 0.0)],
        };
        let settings = CompareSettings::default();
        let apart = [entrant("a", 0..5), entrant("b", 5..9)];
        assert!(matches!(
            compare("", &apart, &settings, None),
            Err(CompareError::NoCommonClips { .. })
        ));
        assert_eq!(
            compare("", &[], &settings, None),
            Err(CompareError::Nothing)
        );
        let unknown = CompareSettings {
            columns: vec!["gaze.mse".into()],
            ..settings
        };
        assert!(matches!(
            compare("", &[entrant("a", 0..5)], &unknown, None),
            Err(CompareError::UnknownColumn { .. })
        ));
    }

    #[test]
    fn one_clip_has_a_value_and_no_interval() {
        let one = Method {
            label: "a".into(),
            seeds: vec![scores(0, 0..1, 0.0)],
        };
        let table = compare("", &[one], &CompareSettings::default(), None).unwrap();
        let cell = &table.rows[0].cells[0];
        assert!(cell.value.is_some() && cell.interval.is_none() && cell.n == 1);
    }
}
