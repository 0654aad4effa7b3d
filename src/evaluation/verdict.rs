//! Which trivial baselines a system beats, in words: what a reader of a table asks first.

use super::columns::Better;
use super::samples::PREFIX;
use super::scores::RECONSTRUCTION_BOUND;
use super::table::{Cell, Row, RowKind, Table};

/// How a system stands against the best trivial baseline of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// Better, and the intervals have no value in common.
    Beats,
    /// Better, but the intervals overlap or one is missing.
    Unclear,
    Loses,
}

/// One sentence per system with the columns that have a trivial baseline; none for a table without such columns.
#[must_use]
pub fn against_trivial(table: &Table) -> Vec<String> {
    let systems = table.rows.iter().filter(|r| r.kind == RowKind::System);
    systems.filter_map(|row| sentence(table, row)).collect()
}

fn sentence(table: &Table, row: &Row) -> Option<String> {
    let (mut beats, mut unclear, mut loses) = (Vec::new(), Vec::new(), Vec::new());
    for (position, column) in table.columns.iter().enumerate() {
        let own = &row.cells[position];
        let Some((name, best)) = best_trivial(table, position) else {
            continue;
        };
        let Some(verdict) = verdict(own, best, column.better) else {
            continue;
        };
        match verdict {
            Verdict::Beats => beats.push(column.name.clone()),
            Verdict::Unclear => unclear.push(format!("{} ({name})", column.name)),
            Verdict::Loses => loses.push(format!("{} ({name})", column.name)),
        }
    }
    let parts: Vec<String> = [
        (beats, "beats every trivial baseline, intervals apart, on"),
        (
            unclear,
            "is better, but intervals overlap or are missing, on",
        ),
        (loses, "does not beat them on"),
    ]
    .into_iter()
    .filter(|(columns, _)| !columns.is_empty())
    .map(|(columns, says)| format!("{says} {}", columns.join(", ")))
    .collect();
    (!parts.is_empty()).then(|| format!("{} {}", row.label, parts.join("; ")))
}

/// The trivial baseline with the best value. The reconstruction bound is what can be reached, not what has to be beaten.
fn best_trivial(table: &Table, position: usize) -> Option<(&str, &Cell)> {
    let sign = table.columns[position].better.sign();
    table
        .rows
        .iter()
        .filter(|row| row.kind == RowKind::Baseline)
        .filter(|row| {
            !row.label.starts_with(RECONSTRUCTION_BOUND) && !row.label.starts_with(PREFIX)
        })
        .filter_map(|row| {
            let cell = &row.cells[position];
            cell.value.map(|value| (sign * value, row, cell))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, row, cell)| (row.label.as_str(), cell))
}

fn verdict(own: &Cell, best: &Cell, better: Better) -> Option<Verdict> {
    let (a, b) = (better.sign() * own.value?, better.sign() * best.value?);
    Some(match a < b {
        true if best.interval.is_some() && own.clears(best, better) => Verdict::Beats,
        true => Verdict::Unclear,
        false => Verdict::Loses,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::columns::Column;
    use crate::evaluation::statistics::{Interval, Over};

    fn cell(value: f64, half: Option<f64>) -> Cell {
        Cell {
            value: Some(value),
            interval: half.map(|half| Interval {
                low: value - half,
                high: value + half,
                over: Over::Clips,
            }),
            ..Cell::default()
        }
    }

    fn row(label: &str, kind: RowKind, cells: Vec<Cell>) -> Row {
        Row {
            label: label.to_owned(),
            kind,
            cells,
        }
    }

    #[test]
    fn every_column_with_a_trivial_baseline_is_judged() {
        let columns = [
            "body.ga_mpjpe",
            "camera.rte",
            "gaze.mse",
            "depth.delta@median",
        ];
        let columns = columns.map(|name| Column::named(name).unwrap()).to_vec();
        let table = Table {
            columns,
            rows: vec![
                row(
                    "full",
                    RowKind::System,
                    vec![
                        cell(150.0, Some(10.0)),
                        cell(0.02, Some(0.001)),
                        cell(0.019, Some(0.002)),
                        cell(60.0, Some(1.0)),
                    ],
                ),
                row(
                    "still",
                    RowKind::Baseline,
                    vec![
                        cell(190.0, Some(10.0)),
                        cell(0.018, Some(0.001)),
                        cell(0.020, Some(0.002)),
                        cell(50.0, Some(1.0)),
                    ],
                ),
                row(
                    "worse",
                    RowKind::Baseline,
                    vec![
                        cell(300.0, None),
                        Cell::default(),
                        Cell::default(),
                        Cell::default(),
                    ],
                ),
                row(
                    "reconstruction bound",
                    RowKind::Baseline,
                    vec![
                        cell(1.0, None),
                        cell(0.0, None),
                        cell(0.0, None),
                        cell(99.0, None),
                    ],
                ),
            ],
            ..Table::default()
        };
        assert_eq!(
            against_trivial(&table),
            [
                "full beats every trivial baseline, intervals apart, on body.ga_mpjpe, depth.delta@median; is better, but intervals \
                 overlap or are missing, on gaze.mse (still); does not beat them on camera.rte (still)"
            ]
        );
    }

    #[test]
    fn a_table_without_trivial_baselines_says_nothing() {
        let table = Table {
            columns: vec![Column::named("gaze.mse").unwrap()],
            rows: vec![row("full", RowKind::System, vec![cell(1.0, None)])],
            ..Table::default()
        };
        assert!(against_trivial(&table).is_empty());
    }
}
