//! What was compared, and how far off it was.

use super::checks::Row;
use std::fmt;

/// All compared quantities, set by set.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// What is added belongs to it.
    set: String,
    /// By set.
    rows: Vec<(String, Row)>,
}

impl Report {
    /// What is added from now on belongs to this set.
    pub fn begin(&mut self, set: &str) {
        set.clone_into(&mut self.set);
    }

    /// Adds the largest difference of numbers. NaN fails.
    pub fn difference(&mut self, name: &str, error: f64, tolerance: f64, unit: &'static str) {
        self.add(Row {
            name: format!("{} {name}", self.set),
            error,
            tolerance,
            unit,
            problem: None,
        });
    }

    /// Adds the number of elements that differ where all must be equal.
    pub fn wrong(&mut self, name: &str, wrong: usize, of: usize) {
        self.difference(name, wrong as f64, 0.0, "");
        if of == 0 {
            self.problem(name, "nothing to compare");
        }
    }

    /// Adds a row that fails for a reason other than a difference.
    pub fn problem(&mut self, name: &str, problem: &str) {
        let name = format!("{} {name}", self.set);
        self.add(Row::failed(name, problem.to_owned()));
    }

    fn add(&mut self, row: Row) {
        self.rows.push((self.set.clone(), row));
    }

    /// Whether everything agrees (and anything was compared).
    pub fn passed(&self) -> bool {
        !self.rows.is_empty() && self.rows.iter().all(|(_, row)| row.passed())
    }
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (_, row) in &self.rows {
            writeln!(out, "{row}")?;
        }
        writeln!(out)?;
        for rows in self.rows.chunk_by(|(a, _), (b, _)| a == b) {
            let rows = rows.iter().map(|(_, row)| row);
            let worst = rows.max_by(|a, b| a.badness().total_cmp(&b.badness()));
            if let Some(worst) = worst {
                writeln!(out, "worst: {worst}")?;
            }
        }
        let passed = self.rows.iter().filter(|(_, row)| row.passed()).count();
        writeln!(out, "{passed}/{} passed", self.rows.len())
    }
}
