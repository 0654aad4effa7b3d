//! The rows of a [`Table`] as dots with their intervals, a panel per column: one SVG without scripts or fonts of its own.
//!
//! What is computed on these clips is filled, published rows are hollow: they are context, on other clips. A row without an interval is
//! a dot alone.

use super::columns::Better;
use super::render::number;
use super::table::{Cell, RowKind, Table};
use std::fmt::Write as _;

/// Pixels.
const LABELS: f64 = 190.0;
const PLOT: f64 = 360.0;
const ROW: f64 = 22.0;
const HEAD: f64 = 34.0;
const FOOT: f64 = 30.0;
const MARGIN: f64 = 14.0;

/// One row of a panel.
struct Line<'a> {
    label: &'a str,
    kind: RowKind,
    value: f64,
    low: f64,
    high: f64,
    has_interval: bool,
}

/// The plot; `None` where no cell has a number.
#[must_use]
pub fn svg(table: &Table) -> Option<String> {
    let panels: Vec<(usize, Vec<Line<'_>>)> = (0..table.columns.len())
        .map(|position| (position, lines(table, position)))
        .filter(|(_, lines)| !lines.is_empty())
        .collect();
    if panels.is_empty() {
        return None;
    }
    let height: f64 = panels
        .iter()
        .map(|(_, lines)| HEAD + ROW * lines.len() as f64 + FOOT)
        .sum();
    let width = LABELS + PLOT + 2.0 * MARGIN;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\" role=\"img\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    let mut top = 0.0;
    for (position, lines) in &panels {
        panel(&mut out, table, *position, lines, top);
        top += HEAD + ROW * lines.len() as f64 + FOOT;
    }
    out.push_str("</svg>\n");
    Some(out)
}

fn lines(table: &Table, position: usize) -> Vec<Line<'_>> {
    let finite = |cell: &Cell| cell.value.filter(|value| value.is_finite());
    table
        .rows
        .iter()
        .filter_map(|row| {
            let cell = row.cells.get(position)?;
            let value = finite(cell)?;
            let interval = cell
                .interval
                .filter(|i| i.low.is_finite() && i.high.is_finite());
            Some(Line {
                label: &row.label,
                kind: row.kind,
                value,
                low: interval.map_or(value, |i| i.low),
                high: interval.map_or(value, |i| i.high),
                has_interval: interval.is_some(),
            })
        })
        .collect()
}

fn panel(out: &mut String, table: &Table, position: usize, lines: &[Line<'_>], top: f64) {
    let column = &table.columns[position];
    let low = lines.iter().map(|l| l.low).fold(f64::INFINITY, f64::min);
    let high = lines
        .iter()
        .map(|l| l.high)
        .fold(f64::NEG_INFINITY, f64::max);
    let span = high - low;
    let room = match (span > 1e-9 * high.abs(), high == 0.0) {
        (true, _) => 0.06 * span,
        (false, true) => 1.0,
        (false, false) => 0.1 * high.abs(),
    };
    let (low, high) = (low - room, high + room);
    let x = |value: f64| MARGIN + LABELS + PLOT * (value - low) / (high - low);
    let arrow = match column.better {
        Better::Lower => "lower is better",
        Better::Higher => "higher is better",
    };
    let unit = if column.unit.is_empty() {
        String::new()
    } else {
        format!("{}, ", column.unit)
    };
    let _ = writeln!(
        out,
        "<text x=\"{MARGIN}\" y=\"{:.1}\" font-weight=\"bold\">{} ({}{arrow})</text>",
        top + 22.0,
        escape(&column.name),
        escape(&unit)
    );
    let bottom = top + HEAD + ROW * lines.len() as f64;
    for tick in ticks(low, high) {
        let at = x(tick);
        let _ = writeln!(
            out,
            "<path d=\"M{at:.1} {:.1}V{bottom:.1}\" stroke=\"#ddd\"/>\
             <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"#555\">{}</text>",
            top + HEAD,
            bottom + 16.0,
            number(tick)
        );
    }
    for (i, line) in lines.iter().enumerate() {
        let y = top + HEAD + ROW * (i as f64 + 0.5);
        let (colour, label) = match line.kind {
            RowKind::System => ("#0072b2", escape(line.label)),
            RowKind::Baseline => ("#777", format!("({})", escape(line.label))),
            RowKind::Published => ("#d55e00", format!("{} (published)", escape(line.label))),
        };
        let _ = writeln!(
            out,
            "<g><title>{label}: {}</title><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            described(line),
            MARGIN + LABELS - 10.0,
            y + 4.0,
            short(&label)
        );
        if line.has_interval {
            let (a, b) = (x(line.low), x(line.high));
            let (up, down) = (y - 4.0, y + 4.0);
            let _ = writeln!(
                out,
                "<path d=\"M{a:.1} {y:.1}H{b:.1}M{a:.1} {up:.1}V{down:.1}M{b:.1} {up:.1}V{down:.1}\" \
                 stroke=\"{colour}\" stroke-width=\"1.5\" fill=\"none\"/>"
            );
        }
        let fill = if line.kind == RowKind::Published {
            "white"
        } else {
            colour
        };
        let _ = writeln!(
            out,
            "<circle cx=\"{:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"{colour}\" stroke-width=\"1.5\"/></g>",
            x(line.value)
        );
    }
}

fn described(line: &Line<'_>) -> String {
    let value = number(line.value);
    if line.has_interval {
        format!("{value} [{}, {}]", number(line.low), number(line.high))
    } else {
        format!("{value}, no interval")
    }
}

/// About four round numbers between the ends.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / 4.0;
    let magnitude = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * magnitude)
        .find(|step| *step >= rough)
        .unwrap_or(rough);
    let first = (low / step).ceil() as i64;
    (first..first + 12)
        .map(|k| k as f64 * step)
        .take_while(|tick| *tick <= high)
        .collect()
}

/// What fits beside the plot.
fn short(label: &str) -> String {
    if label.chars().count() <= 30 {
        return label.to_owned();
    }
    let start: String = label.chars().take(29).collect();
    // An entity that was cut in two is no text.
    let whole = match (start.rfind('&'), start.rfind(';')) {
        (Some(open), close) if close.is_none_or(|close| close < open) => &start[..open],
        _ => start.as_str(),
    };
    format!("{whole}…")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::columns::Column;
    use crate::evaluation::statistics::{Interval, Over};
    use crate::evaluation::table::Row;

    fn row(label: &str, kind: RowKind, value: Option<f64>, half: Option<f64>) -> Row {
        let interval = value.zip(half).map(|(value, half)| Interval {
            low: value - half,
            high: value + half,
            over: Over::Clips,
        });
        let cell = Cell {
            value,
            interval,
            ..Cell::default()
        };
        Row {
            label: label.to_owned(),
            kind,
            cells: vec![cell],
        }
    }

    #[test]
    fn every_row_with_a_number_is_drawn_and_names_are_text() {
        let table = Table {
            columns: vec![Column::named("body.ga_mpjpe").unwrap()],
            rows: vec![
                row("full <&>", RowKind::System, Some(111.5), Some(3.0)),
                row("mean pose", RowKind::Baseline, Some(200.0), Some(9.0)),
                row("ReViV", RowKind::Published, Some(88.6), None),
                row("nothing", RowKind::System, None, None),
            ],
            ..Table::default()
        };
        let svg = svg(&table).unwrap();
        assert_eq!(svg.matches("<circle").count(), 3);
        assert_eq!(svg.matches("stroke-width=\"1.5\" fill=\"none\"").count(), 2);
        assert!(svg.contains("full &lt;&amp;&gt;: 111.5 [108.5, 114.5]"));
        assert!(svg.contains("ReViV (published)") && !svg.contains("nothing"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }

    #[test]
    fn tables_without_numbers_have_no_plot_and_equal_numbers_have_one() {
        let mut table = Table {
            columns: vec![Column::named("gaze.mse").unwrap()],
            rows: vec![row("a", RowKind::System, None, None)],
            ..Table::default()
        };
        assert_eq!(svg(&table), None);
        for value in [0.0, 0.25, -1e12, f64::NAN] {
            table.rows = vec![row("a", RowKind::System, Some(value), None)];
            let drawn = svg(&table);
            assert_eq!(drawn.is_some(), value.is_finite());
            assert!(!drawn.unwrap_or_default().contains("NaN"));
        }
    }

    #[test]
    fn ticks_are_round_and_inside() {
        let shown = |low, high| ticks(low, high).into_iter().map(number).collect::<Vec<_>>();
        assert_eq!(shown(83.0, 207.0), ["100.0", "150.0", "200.0"]);
        assert!(ticks(0.0, 1.0).len() >= 3);
    }
}
