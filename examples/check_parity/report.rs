//! What was compared, and how far off it was.

use std::fmt;

/// One compared tensor.
#[derive(Debug, Clone)]
pub struct Row {
    /// `vq/body recon`.
    pub name: String,
    /// Relative error, or the number of wrong elements where everything must be equal.
    pub error: f64,
    /// The largest error that passes; 0 where everything must be equal.
    pub tolerance: f64,
    /// Why it fails whatever the error: a wrong shape, a value that is not finite, a tensor nobody compared.
    pub problem: Option<String>,
}

impl Row {
    fn passed(&self) -> bool {
        self.problem.is_none() && self.error <= self.tolerance
    }

    /// How bad it is: the share of the tolerance that is used up.
    fn badness(&self) -> f64 {
        if self.passed() {
            self.error / self.tolerance.max(f64::MIN_POSITIVE)
        } else {
            f64::INFINITY
        }
    }
}

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
        self.add(Row {
            name,
            error: 0.0,
            tolerance: 0.0,
            problem: Some(problem),
        });
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
            let verdict = if row.passed() { "ok  " } else { "FAIL" };
            write!(out, "{verdict}  {:<60} ", row.name)?;
            match &row.problem {
                Some(problem) => writeln!(out, "{problem}")?,
                None if row.tolerance == 0.0 => writeln!(out, "{} elements differ", row.error)?,
                None => writeln!(out, "{:.2e} of {:.0e}", row.error, row.tolerance)?,
            }
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
