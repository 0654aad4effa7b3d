//! What was compared, and how far off it was.

use std::fmt;

/// One compared quantity of one golden file.
#[derive(Debug, Clone)]
struct Row {
    /// `nymeria`.
    set: String,
    /// `golden camera`.
    name: String,
    /// The largest difference, or the number of wrong elements where everything must be equal.
    error: f64,
    /// The largest difference that passes; 0 where everything must be equal.
    tolerance: f64,
    unit: &'static str,
    /// Why it fails whatever the difference.
    problem: Option<String>,
}

impl Row {
    fn passed(&self) -> bool {
        self.problem.is_none() && self.error <= self.tolerance
    }

    /// The share of the tolerance that is used up.
    fn badness(&self) -> f64 {
        if self.passed() {
            self.error / self.tolerance.max(f64::MIN_POSITIVE)
        } else {
            f64::INFINITY
        }
    }
}

/// All compared quantities, set by set.
#[derive(Debug, Clone, Default)]
pub struct Report {
    set: String,
    rows: Vec<Row>,
}

impl Report {
    /// What is added from now on belongs to this set.
    pub fn begin(&mut self, set: &str) {
        set.clone_into(&mut self.set);
    }

    /// Adds the largest difference of numbers. NaN fails.
    pub fn difference(&mut self, name: &str, error: f64, tolerance: f64, unit: &'static str) {
        self.rows.push(Row {
            set: self.set.clone(),
            name: name.to_owned(),
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
        self.rows.push(Row {
            set: self.set.clone(),
            name: name.to_owned(),
            error: 0.0,
            tolerance: 0.0,
            unit: "",
            problem: Some(problem.to_owned()),
        });
    }

    /// Whether everything agrees (and anything was compared).
    pub fn passed(&self) -> bool {
        !self.rows.is_empty() && self.rows.iter().all(Row::passed)
    }
}

impl fmt::Display for Row {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = if self.passed() { "ok  " } else { "FAIL" };
        let name = format!("{} {}", self.set, self.name);
        write!(out, "{verdict}  {name:<56} ")?;
        match &self.problem {
            Some(problem) => write!(out, "{problem}"),
            None if self.tolerance == 0.0 => write!(out, "{} elements differ", self.error),
            None => write!(
                out,
                "{:.2e} of {:.0e} {}",
                self.error, self.tolerance, self.unit
            ),
        }
    }
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for row in &self.rows {
            writeln!(out, "{row}")?;
        }
        writeln!(out)?;
        let mut sets: Vec<&str> = self.rows.iter().map(|row| row.set.as_str()).collect();
        sets.dedup();
        for set in sets {
            let rows = self.rows.iter().filter(|row| row.set == set);
            let worst = rows.max_by(|a, b| a.badness().total_cmp(&b.badness()));
            if let Some(worst) = worst {
                writeln!(out, "worst: {worst}")?;
            }
        }
        let passed = self.rows.iter().filter(|row| row.passed()).count();
        writeln!(out, "{passed}/{} passed", self.rows.len())
    }
}
