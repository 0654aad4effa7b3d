//! What a comparison shows, in words: what a reader of a sweep's table asks first.

use super::columns::Better;
use super::render::number;
use super::table::{Row, RowKind, Table};

/// One sentence per arm against the baseline row, or, without one, per column the arm that stands out; for a table whose
/// comparison is that. `level` is the confidence level of its intervals; a difference is called shown where its p-value, corrected
/// for the number of arms, is below `1 - level`.
#[must_use]
pub fn conclusion(table: &Table, baseline: Option<&str>, level: f64) -> Vec<String> {
    let systems: Vec<&Row> = table
        .rows
        .iter()
        .filter(|row| row.kind == RowKind::System)
        .collect();
    if systems.len() < 2 {
        return Vec::new();
    }
    match baseline {
        Some(baseline) => against(table, &systems, baseline, level),
        None => winners(table, &systems),
    }
}

fn against(table: &Table, systems: &[&Row], baseline: &str, level: f64) -> Vec<String> {
    let others: Vec<&&Row> = systems.iter().filter(|r| r.label != baseline).collect();
    let judged: Vec<(&str, [Vec<String>; 3])> = others
        .iter()
        .map(|row| (row.label.as_str(), judge(table, row, 1.0 - level)))
        .collect();
    let differs = |(_, [better, worse, _]): &&(&str, [Vec<String>; 3])| {
        !better.is_empty() || !worse.is_empty()
    };
    let mut said = Vec::new();
    let shown = judged.iter().filter(differs).count();
    said.push(match shown {
        0 => format!("No arm is shown to differ from `{baseline}`."),
        _ => format!("{shown} of {} arms differ from `{baseline}`.", judged.len()),
    });
    for (arm, [better, worse, unclear]) in judged.iter().filter(differs) {
        let parts: Vec<String> = [
            ("is better in", better),
            ("is worse in", worse),
            ("is not shown to differ in", unclear),
        ]
        .into_iter()
        .filter(|(_, columns)| !columns.is_empty())
        .map(|(says, columns)| format!("{says} {}", columns.join(", ")))
        .collect();
        said.push(format!("`{arm}` {}.", parts.join("; it ")));
    }
    said
}

/// The columns in which an arm is better, worse, or neither.
fn judge(table: &Table, row: &Row, alpha: f64) -> [Vec<String>; 3] {
    let mut found = [Vec::new(), Vec::new(), Vec::new()];
    for (column, cell) in table.columns.iter().zip(&row.cells) {
        let Some(difference) = &cell.difference else {
            continue;
        };
        if difference.p_holm.is_none_or(|p| p >= alpha) {
            found[2].push(column.name.clone());
            continue;
        }
        let worse = column.better.sign() * difference.mean > 0.0;
        let unit = match column.unit.as_str() {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        let by = number(difference.mean.abs());
        found[usize::from(worse)].push(format!("{} by {by}{unit}", column.name));
    }
    found
}

fn winners(table: &Table, systems: &[&Row]) -> Vec<String> {
    let mut said = Vec::new();
    let mut open = Vec::new();
    for (position, column) in table.columns.iter().enumerate() {
        let least = match column.better {
            Better::Lower => "lowest",
            Better::Higher => "highest",
        };
        match systems.iter().find(|row| row.cells[position].bold) {
            Some(row) => said.push(format!(
                "`{}` has the {least} {}, and its interval clears the runner-up.",
                row.label, column.name
            )),
            None => open.push(column.name.clone()),
        }
    }
    if !open.is_empty() {
        said.push(format!("No arm stands out in {}.", open.join(", ")));
    }
    said
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::columns::Column;
    use crate::evaluation::statistics::Difference;
    use crate::evaluation::table::Cell;

    fn row(label: &str, differences: &[Option<(f64, f64)>]) -> Row {
        let cell = |difference: &Option<(f64, f64)>| Cell {
            value: Some(1.0),
            difference: difference.map(|(mean, p)| Difference {
                n: 9,
                mean,
                interval: None,
                p: Some(p),
                p_holm: Some(p),
            }),
            ..Cell::default()
        };
        Row {
            label: label.to_owned(),
            kind: RowKind::System,
            cells: differences.iter().map(cell).collect(),
        }
    }

    fn table(rows: Vec<Row>) -> Table {
        Table {
            columns: ["body.ga_mpjpe", "camera.rte"]
                .map(|name| Column::named(name).unwrap())
                .to_vec(),
            rows,
            ..Table::default()
        }
    }

    #[test]
    fn only_a_difference_that_survives_the_correction_is_called_one() {
        let table = table(vec![
            row("full", &[None, None]),
            row("small", &[Some((12.5, 0.01)), Some((0.1, 0.3))]),
            row("other", &[Some((-1.0, 0.06)), Some((0.2, 0.9))]),
        ]);
        assert_eq!(
            conclusion(&table, Some("full"), 0.95),
            [
                "1 of 2 arms differ from `full`.",
                "`small` is worse in body.ga_mpjpe by 12.50 mm; it is not shown to differ in camera.rte.",
            ]
        );
        assert_eq!(
            conclusion(&table, Some("full"), 0.999),
            ["No arm is shown to differ from `full`."]
        );
    }

    #[test]
    fn without_a_baseline_the_arm_that_clears_the_others_is_named() {
        let mut rows = vec![row("a", &[None, None]), row("b", &[None, None])];
        rows[1].cells[0].bold = true;
        assert_eq!(
            conclusion(&table(rows), None, 0.95),
            [
                "`b` has the lowest body.ga_mpjpe, and its interval clears the runner-up.",
                "No arm stands out in camera.rte.",
            ]
        );
        assert!(conclusion(&table(vec![row("a", &[None, None])]), None, 0.95).is_empty());
    }
}
