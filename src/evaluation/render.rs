//! A [`Table`] as terminal text, Markdown, LaTeX or CSV. Strings only: whoever calls prints.

use super::columns::{Better, Column};
use super::table::{Cell, Row, RowKind, Table};
use std::fmt::Write as _;

/// How a table is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// Plain text with aligned columns.
    #[default]
    Terminal,
    /// A Markdown table.
    Markdown,
    /// A LaTeX table, special characters escaped.
    Latex,
    /// One line per cell, every number in full.
    Csv,
}

impl Format {
    /// By the names of `--format`: `term`, `md`, `latex` (or `tex`), `csv`.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "term" | "terminal" => Some(Self::Terminal),
            "md" | "markdown" => Some(Self::Markdown),
            "latex" | "tex" => Some(Self::Latex),
            "csv" => Some(Self::Csv),
            _ => None,
        }
    }
}

/// The table in a format; ends with a newline.
#[must_use]
pub fn render(table: &Table, format: Format) -> String {
    match format {
        Format::Terminal => terminal(table),
        Format::Markdown => markdown(table),
        Format::Latex => latex(table),
        Format::Csv => csv(table),
    }
}

/// Four significant digits, without an exponent for ordinary sizes.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-6..7).contains(&magnitude) {
        return format!("{value:.3e}");
    }
    let decimals = (3 - magnitude).clamp(0, 7) as usize;
    format!("{value:.decimals$}")
}

/// `111.5 [108.2, 114.9]`, with what qualifies it behind. `strong` wraps a number that is bold.
fn text(row: &Row, cell: &Cell, strong: impl Fn(&str) -> String) -> String {
    let Some(value) = cell.value else {
        return match &cell.reason {
            Some(reason) => reason.clone(),
            None if cell.n_null + cell.n_degenerate > 0 => qualified(String::from("-"), cell),
            None => String::from("-"),
        };
    };
    let mut text = number(value);
    if cell.bold {
        text = strong(&text);
    }
    if cell.in_brackets {
        text = format!("({text})");
    }
    if row.kind == RowKind::Published {
        return text;
    }
    if let Some(interval) = &cell.interval {
        let _ = write!(
            text,
            " [{}, {}]",
            number(interval.low),
            number(interval.high)
        );
    } else if cell.n == 1 || (cell.floor.is_none() && cell.n < 2) {
        text.push_str(" n=1, no interval");
    }
    if let Some(floor) = cell.floor {
        let _ = write!(text, " floor {}", number(floor));
    }
    if let Some(difference) = &cell.difference {
        let _ = write!(
            text,
            " {}{}",
            if difference.mean >= 0.0 { "+" } else { "" },
            number(difference.mean)
        );
        if let Some(p) = difference.p_holm {
            text.push_str(&probability(p));
        }
    }
    qualified(text, cell)
}

/// ` p=0.04`; no p-value of a bootstrap is 0, and none is printed as 0.
fn probability(p: f64) -> String {
    if p < 0.01 {
        " p<0.01".to_owned()
    } else {
        format!(" p={p:.2}")
    }
}

fn qualified(mut text: String, cell: &Cell) -> String {
    for (count, name) in [(cell.n_null, "null"), (cell.n_degenerate, "degenerate")] {
        if count > 0 {
            let _ = write!(text, " ({count} {name})");
        }
    }
    text
}

fn heading(column: &Column) -> String {
    let arrow = match column.better {
        Better::Lower => "↓",
        Better::Higher => "↑",
    };
    if column.unit.is_empty() {
        format!("{} {arrow}", column.name)
    } else {
        format!("{} ({}) {arrow}", column.name, column.unit)
    }
}

/// `n=40` or `n=40 x 3 seeds`; a range where columns differ.
fn counts(row: &Row) -> String {
    if row.kind == RowKind::Published {
        return String::from("published");
    }
    let counts = || row.cells.iter().filter(|c| c.value.is_some()).map(|c| c.n);
    let seeds = row.cells.iter().map(|c| c.seeds).max().unwrap_or(1);
    let n = match (counts().min(), counts().max()) {
        (Some(low), Some(high)) if low == high => low.to_string(),
        (Some(low), Some(high)) => format!("{low}-{high}"),
        _ => String::from("0"),
    };
    if seeds > 1 {
        format!("{n} x {seeds} seeds")
    } else {
        n
    }
}

/// Columns side by side while they fit; every column its own block of lines would hide the comparison, so wide tables are split
/// into bands of columns.
fn terminal(table: &Table) -> String {
    const WIDTH: usize = 140;
    let labels: Vec<String> = table.rows.iter().map(label).collect();
    let label_width = labels
        .iter()
        .map(|l| l.chars().count())
        .max()
        .unwrap_or(0)
        .max(6);
    let count_width = table
        .rows
        .iter()
        .map(|r| counts(r).chars().count())
        .max()
        .unwrap_or(0)
        .max(5);
    let cells: Vec<Vec<String>> = table
        .columns
        .iter()
        .enumerate()
        .map(|(i, column)| {
            std::iter::once(heading(column))
                .chain(
                    table
                        .rows
                        .iter()
                        .map(|row| text(row, &row.cells[i], |n| format!("*{n}"))),
                )
                .collect()
        })
        .collect();
    let widths: Vec<usize> = cells
        .iter()
        .map(|column| column.iter().map(|c| c.chars().count()).max().unwrap_or(0))
        .collect();
    let mut out = String::new();
    if !table.title.is_empty() {
        let _ = writeln!(out, "{}\n", table.title);
    }
    let mut start = 0;
    while start < cells.len() {
        let mut end = start;
        let mut used = label_width + count_width + 4;
        while end < cells.len() && (end == start || used + widths[end] + 3 <= WIDTH) {
            used += widths[end] + 3;
            end += 1;
        }
        for line in 0..=table.rows.len() {
            let (left, count) = match line.checked_sub(1) {
                None => (String::new(), String::from("clips")),
                Some(row) => (labels[row].clone(), counts(&table.rows[row])),
            };
            let mut text = format!("{left:<label_width$}  {count:>count_width$}");
            for (column, width) in cells[start..end].iter().zip(&widths[start..end]) {
                let _ = write!(text, "   {:<width$}", column[line]);
            }
            let _ = writeln!(out, "{}", text.trim_end());
        }
        out.push('\n');
        start = end;
    }
    if table.rows.iter().any(|r| r.cells.iter().any(|c| c.bold)) {
        out.push_str("* best, and its interval clears the runner-up\n");
    }
    for note in &table.notes {
        let _ = writeln!(out, "- {note}");
    }
    out
}

fn label(row: &Row) -> String {
    match row.kind {
        RowKind::System => row.label.clone(),
        RowKind::Baseline => format!("({})", row.label),
        RowKind::Published => format!("{} [published]", row.label),
    }
}

fn markdown(table: &Table) -> String {
    let escape = |text: &str| text.replace('|', "\\|");
    let mut out = String::new();
    if !table.title.is_empty() {
        let _ = writeln!(out, "**{}**\n", escape(&table.title));
    }
    out.push_str("| | clips |");
    for column in &table.columns {
        let _ = write!(out, " {} |", escape(&heading(column)));
    }
    out.push_str("\n|---|---:|");
    out.push_str(&"---:|".repeat(table.columns.len()));
    out.push('\n');
    for row in &table.rows {
        let name = match row.kind {
            RowKind::System => escape(&label(row)),
            _ => format!("*{}*", escape(&label(row))),
        };
        let _ = write!(out, "| {name} | {} |", counts(row));
        for cell in &row.cells {
            let _ = write!(
                out,
                " {} |",
                escape(&text(row, cell, |n| format!("**{n}**")))
            );
        }
        out.push('\n');
    }
    if !table.notes.is_empty() {
        out.push('\n');
    }
    for note in &table.notes {
        let _ = writeln!(out, "* {note}");
    }
    out
}

fn latex(table: &Table) -> String {
    let escape = |text: &str| {
        let mut out = String::new();
        for c in text.chars() {
            match c {
                '\\' => out.push_str("\\textbackslash{}"),
                '%' | '&' | '_' | '#' | '$' | '{' | '}' => {
                    out.push('\\');
                    out.push(c);
                }
                '~' => out.push_str("\\textasciitilde{}"),
                '^' => out.push_str("\\textasciicircum{}"),
                '<' => out.push_str("$<$"),
                '>' => out.push_str("$>$"),
                '↓' => out.push_str("$\\downarrow$"),
                '↑' => out.push_str("$\\uparrow$"),
                other => out.push(other),
            }
        }
        out
    };
    let mut out = String::from("% needs \\usepackage{booktabs}\n");
    let _ = writeln!(
        out,
        "\\begin{{tabular}}{{lr{}}}\n\\toprule",
        "r".repeat(table.columns.len())
    );
    out.push_str(" & clips");
    for column in &table.columns {
        let _ = write!(out, " & {}", escape(&heading(column)));
    }
    out.push_str(" \\\\\n\\midrule\n");
    let mut previous = RowKind::System;
    for row in &table.rows {
        if row.kind != previous {
            out.push_str("\\midrule\n");
            previous = row.kind;
        }
        let _ = write!(out, "{} & {}", escape(&label(row)), escape(&counts(row)));
        for cell in &row.cells {
            // The bold mark must survive the escaping of everything else.
            let plain = text(row, cell, |n| format!("\u{1}{n}\u{2}"));
            let written = escape(&plain)
                .replace('\u{1}', "\\textbf{")
                .replace('\u{2}', "}");
            let _ = write!(out, " & {written}");
        }
        out.push_str(" \\\\\n");
    }
    out.push_str("\\bottomrule\n\\end{tabular}\n");
    for note in &table.notes {
        let _ = writeln!(out, "% {}", note.replace('\n', " "));
    }
    out
}

fn csv(table: &Table) -> String {
    let quote = |text: &str| {
        if text.contains([',', '"', '\n']) {
            format!("\"{}\"", text.replace('"', "\"\""))
        } else {
            text.to_owned()
        }
    };
    let full = |value: Option<f64>| value.map_or_else(String::new, |v| v.to_string());
    let mut out = String::from(
        "row,kind,column,unit,better,value,low,high,interval_over,n,seeds,n_null,n_degenerate,floor,\
         difference,difference_low,difference_high,p_holm,bold,reason\n",
    );
    for row in &table.rows {
        for (column, cell) in table.columns.iter().zip(&row.cells) {
            if cell.value.is_none() && cell.n_null + cell.n_degenerate == 0 && cell.reason.is_none()
            {
                continue;
            }
            let kind = match row.kind {
                RowKind::System => "system",
                RowKind::Baseline => "baseline",
                RowKind::Published => "published",
            };
            let better = match column.better {
                Better::Lower => "lower",
                Better::Higher => "higher",
            };
            let over = cell.interval.map_or("", |i| match i.over {
                super::statistics::Over::Clips => "clips",
                super::statistics::Over::Seeds => "seeds",
            });
            let difference = cell.difference.as_ref();
            let inner = difference.and_then(|d| d.interval);
            let fields = [
                quote(&row.label),
                kind.to_owned(),
                quote(&column.name),
                quote(&column.unit),
                better.to_owned(),
                full(cell.value),
                full(cell.interval.map(|i| i.low)),
                full(cell.interval.map(|i| i.high)),
                over.to_owned(),
                cell.n.to_string(),
                cell.seeds.to_string(),
                cell.n_null.to_string(),
                cell.n_degenerate.to_string(),
                full(cell.floor),
                full(difference.map(|d| d.mean)),
                full(inner.map(|i| i.low)),
                full(inner.map(|i| i.high)),
                full(difference.and_then(|d| d.p_holm)),
                cell.bold.to_string(),
                quote(cell.reason.as_deref().unwrap_or("")),
            ];
            let _ = writeln!(out, "{}", fields.join(","));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::statistics::{Interval, Over};

    fn table() -> Table {
        let cell = |value: f64, half: f64| Cell {
            value: Some(value),
            interval: Some(Interval {
                low: value - half,
                high: value + half,
                over: Over::Clips,
            }),
            n: 40,
            seeds: 1,
            ..Cell::default()
        };
        let mut table = Table {
            title: "world".into(),
            columns: vec![
                Column::named("body.ga_mpjpe").unwrap(),
                Column::named("depth.delta@depth").unwrap(),
            ],
            rows: vec![
                Row {
                    label: "full_arm".into(),
                    kind: RowKind::System,
                    cells: vec![
                        cell(111.52, 3.0),
                        Cell {
                            n_degenerate: 2,
                            ..cell(56.5, 0.25)
                        },
                    ],
                },
                Row {
                    label: "mean pose".into(),
                    kind: RowKind::Baseline,
                    cells: vec![cell(200.0, 9.0), Cell::default()],
                },
                Row {
                    label: "one clip".into(),
                    kind: RowKind::System,
                    cells: vec![
                        Cell {
                            value: Some(300.0),
                            n: 1,
                            seeds: 1,
                            ..Cell::default()
                        },
                        Cell::default(),
                    ],
                },
            ],
            notes: vec!["40 common clips".into()],
        };
        table.mark_best();
        table
    }

    #[test]
    fn every_format_says_what_the_table_says() {
        insta::assert_snapshot!(render(&table(), Format::Markdown), @r#"
        **world**

        | | clips | body.ga_mpjpe (mm) ↓ | depth.delta@depth (%) ↑ |
        |---|---:|---:|---:|
        | full_arm | 40 | **111.5** [108.5, 114.5] | 56.50 [56.25, 56.75] (2 degenerate) |
        | *(mean pose)* | 40 | 200.0 [191.0, 209.0] | - |
        | one clip | 1 | 300.0 n=1, no interval | - |

        * 40 common clips
        "#);
        insta::assert_snapshot!(render(&table(), Format::Terminal), @r#"
        world

                     clips   body.ga_mpjpe (mm) ↓     depth.delta@depth (%) ↑
        full_arm        40   *111.5 [108.5, 114.5]    56.50 [56.25, 56.75] (2 degenerate)
        (mean pose)     40   200.0 [191.0, 209.0]     -
        one clip         1   300.0 n=1, no interval   -

        * best, and its interval clears the runner-up
        - 40 common clips
        "#);
        insta::assert_snapshot!(render(&table(), Format::Latex), @r#"
        % needs \usepackage{booktabs}
        \begin{tabular}{lrrr}
        \toprule
         & clips & body.ga\_mpjpe (mm) $\downarrow$ & depth.delta@depth (\%) $\uparrow$ \\
        \midrule
        full\_arm & 40 & \textbf{111.5} [108.5, 114.5] & 56.50 [56.25, 56.75] (2 degenerate) \\
        \midrule
        (mean pose) & 40 & 200.0 [191.0, 209.0] & - \\
        \midrule
        one clip & 1 & 300.0 n=1, no interval & - \\
        \bottomrule
        \end{tabular}
        % 40 common clips
        "#);
        insta::assert_snapshot!(render(&table(), Format::Csv), @r#"
        row,kind,column,unit,better,value,low,high,interval_over,n,seeds,n_null,n_degenerate,floor,difference,difference_low,difference_high,p_holm,bold,reason
        full_arm,system,body.ga_mpjpe,mm,lower,111.52,108.52,114.52,clips,40,1,0,0,,,,,,true,
        full_arm,system,depth.delta@depth,%,higher,56.5,56.25,56.75,clips,40,1,0,2,,,,,,false,
        mean pose,baseline,body.ga_mpjpe,mm,lower,200,191,209,clips,40,1,0,0,,,,,,false,
        one clip,system,body.ga_mpjpe,mm,lower,300,,,,1,1,0,0,,,,,,false,
        "#);
    }

    #[test]
    fn small_probabilities_are_not_printed_as_zero() {
        let shown = [0.0005, 0.0099, 0.01, 0.042, 1.0].map(probability);
        assert_eq!(
            shown,
            [" p<0.01", " p<0.01", " p=0.01", " p=0.04", " p=1.00"]
        );
    }

    #[test]
    fn numbers_keep_four_digits() {
        let shown: Vec<_> = [111.52, 0.015, 1.279, 0.0211, 0.0, 1e-12, -3.0]
            .map(number)
            .to_vec();
        assert_eq!(
            shown,
            [
                "111.5",
                "0.01500",
                "1.279",
                "0.02110",
                "0",
                "1.000e-12",
                "-3.000"
            ]
        );
    }
}
