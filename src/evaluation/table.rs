//! The one table: typed rows and cells, before anything is printed.

use super::columns::{Better, Column};
use super::samples::PREFIX;
use super::statistics::{Difference, Interval};
use serde::{Deserialize, Serialize};

/// A table of systems against columns.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Table {
    /// Printed above in text and Markdown; empty for none.
    pub title: String,
    /// In the order of every row's cells.
    pub columns: Vec<Column>,
    /// From top to bottom.
    pub rows: Vec<Row>,
    /// What must be read with the numbers; printed below.
    pub notes: Vec<String>,
}

/// Who a row is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RowKind {
    /// Computed by us on these clips.
    System,
    /// A trivial baseline, computed by us on these clips.
    Baseline,
    /// A number from a paper, on other clips: context, never compared.
    Published,
}

/// One line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// What the row is called: an arm, a system, a baseline.
    pub label: String,
    /// Where its numbers come from.
    pub kind: RowKind,
    /// One per column.
    pub cells: Vec<Cell>,
}

/// One number with everything that qualifies it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Cell {
    /// The number, in the column's unit: a mean over clips, then over seeds.
    pub value: Option<f64>,
    /// Its confidence interval; `None` where there are too few clips and seeds, or none was asked for.
    pub interval: Option<Interval>,
    /// Clips that the value is a mean of.
    pub n: usize,
    /// Seeds that the value is a mean of; 0 for published rows.
    pub seeds: usize,
    /// Clips with nothing valid to score; of several seeds, the largest count.
    pub n_null: usize,
    /// Clips whose alignment is not unique; of several seeds, the largest count.
    pub n_degenerate: usize,
    /// Against the table's baseline row, on common clips.
    pub difference: Option<Difference>,
    /// The number of the truth's own halves, for set-wide columns.
    pub floor: Option<f64>,
    /// Too few clips for the metric to mean much.
    pub in_brackets: bool,
    /// The best, and its interval clears the runner-up.
    pub bold: bool,
    /// Why there is no value.
    pub reason: Option<String>,
}

impl Table {
    /// Marks, per column, the best system whose interval does not reach the interval (or the value) of the runner-up. Baselines
    /// compete, published rows do not; without an interval nothing is bold.
    pub fn mark_best(&mut self) {
        for position in 0..self.columns.len() {
            let sign = self.columns[position].better.sign();
            let mut ranked: Vec<(f64, usize)> = self
                .rows
                .iter()
                .enumerate()
                .filter(|(_, row)| row.kind != RowKind::Published && !row.label.starts_with(PREFIX))
                .filter_map(|(i, row)| Some((sign * row.cells.get(position)?.value?, i)))
                .collect();
            ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
            let &[(_, best), (_, second), ..] = ranked.as_slice() else {
                continue;
            };
            let [first, runner_up] = [best, second].map(|row| &self.rows[row].cells[position]);
            let clears = first.clears(runner_up, self.columns[position].better);
            if clears
                && self.rows[best].kind == RowKind::System
                && !self.rows[best].cells[position].in_brackets
            {
                self.rows[best].cells[position].bold = true;
            }
        }
    }
}

impl Cell {
    /// Whether this interval lies wholly on the better side of the other's, or of its value where that has no interval.
    #[must_use]
    pub fn clears(&self, other: &Self, better: Better) -> bool {
        let value = other.value.map(|value| (value, value));
        let other = other.interval.map(|i| (i.low, i.high)).or(value);
        match (self.interval, other, better) {
            (Some(own), Some((low, _)), Better::Lower) => own.high < low,
            (Some(own), Some((_, high)), Better::Higher) => own.low > high,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::statistics::Over;

    fn table(cells: &[(f64, Option<(f64, f64)>)]) -> Table {
        let rows = cells
            .iter()
            .map(|&(value, interval)| Row {
                label: value.to_string(),
                kind: RowKind::System,
                cells: vec![Cell {
                    value: Some(value),
                    interval: interval.map(|(low, high)| Interval {
                        low,
                        high,
                        over: Over::Clips,
                    }),
                    ..Cell::default()
                }],
            })
            .collect();
        Table {
            columns: vec![Column::named("body.ga_mpjpe").unwrap()],
            rows,
            ..Table::default()
        }
    }

    fn bold(mut table: Table) -> Vec<bool> {
        table.mark_best();
        table.rows.iter().map(|r| r.cells[0].bold).collect()
    }

    #[test]
    fn only_a_winner_whose_interval_clears_the_runner_up_is_bold() {
        assert_eq!(
            bold(table(&[(1.0, Some((0.9, 1.1))), (2.0, Some((1.5, 2.5)))])),
            [true, false]
        );
        assert_eq!(
            bold(table(&[(1.0, Some((0.9, 1.6))), (2.0, Some((1.5, 2.5)))])),
            [false, false]
        );
        assert_eq!(
            bold(table(&[(1.0, None), (2.0, Some((1.5, 2.5)))])),
            [false, false]
        );
        assert_eq!(
            bold(table(&[(1.0, Some((0.9, 1.1))), (2.0, None)])),
            [true, false]
        );
        assert_eq!(bold(table(&[(1.0, Some((0.9, 1.1)))])), [false]);
        let mut higher = table(&[(1.0, Some((0.9, 1.1))), (2.0, Some((1.5, 2.5)))]);
        higher.columns[0].better = Better::Higher;
        assert_eq!(bold(higher), [false, true]);
    }
}
