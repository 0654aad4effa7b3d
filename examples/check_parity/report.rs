//! What was compared, and how far off it was.

pub use super::checks::Row;
use std::fmt;

/// All compared tensors.
#[derive(Debug, Clone, Default)]
pub struct Report {
    rows: Vec<Row>,
}

impl Report {
    pub fn add(&mut self, row: Row) {
        self.rows.push(row);
    }

    /// Adds a row that fails for a reason other than an error.
    pub fn problem(&mut self, name: String, problem: String) {
        self.add(Row::failed(name, problem));
    }

    /// Compares numbers by `||a - b|| / ||b||` (or `||a - b||` if b is 0).
    pub fn relative(&mut self, name: String, found: &[f64], expected: &[f64], tolerance: f64) {
        if found.len() != expected.len() {
            let (n, m) = (found.len(), expected.len());
            return self.problem(name, format!("{n} values instead of {m}"));
        }
        if found.iter().any(|value| !value.is_finite()) {
            return self.problem(name, "a value is not finite".to_owned());
        }
        let square =
            |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
        let off = square(&mut found.iter().zip(expected).map(|(a, b)| a - b)).sqrt();
        let size = square(&mut expected.iter().copied()).sqrt();
        let error = if size == 0.0 { off } else { off / size };
        self.add(Row {
            name,
            error,
            tolerance,
            unit: "",
            problem: None,
        });
    }

    /// Compares things that must be equal one by one.
    pub fn exact<T: PartialEq>(&mut self, name: String, found: &[T], expected: &[T]) {
        if found.len() != expected.len() {
            let (n, m) = (found.len(), expected.len());
            return self.problem(name, format!("{n} values instead of {m}"));
        }
        let wrong = found.iter().zip(expected).filter(|(a, b)| a != b).count();
        self.add(Row {
            name,
            error: wrong as f64,
            tolerance: 0.0,
            unit: "",
            problem: None,
        });
    }

    /// Whether everything agrees (and anything was compared).
    pub fn passed(&self) -> bool {
        !self.rows.is_empty() && self.rows.iter().all(Row::passed)
    }
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rows: Vec<&Row> = self.rows.iter().collect();
        rows.sort_by(|a, b| a.badness().total_cmp(&b.badness()));
        for row in &rows {
            writeln!(out, "{row}")?;
        }
        let failed = rows.iter().filter(|row| !row.passed()).count();
        let worst = rows.last().map_or("", |row| row.name.as_str());
        writeln!(
            out,
            "{} compared, {failed} failed, worst: {worst}",
            rows.len()
        )
    }
}
