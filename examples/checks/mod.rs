//! What the checks of this folder share: a folder per subject, and a row per thing that was compared.

use std::fmt;
use std::path::{Path, PathBuf};

/// An error of the check itself: a file that cannot be read, a model that cannot be built.
pub type Outcome<T = ()> = Result<T, Box<dyn std::error::Error>>;

/// What is to be checked below `folder`, by subject: the folder itself where it has the name of one, else those that it holds.
pub fn subjects<C: Copy>(
    folder: &Path,
    known: &[(&'static str, C)],
) -> Outcome<Vec<(&'static str, C, PathBuf)>> {
    let folder = folder
        .canonicalize()
        .map_err(|error| format!("{}: {error}", folder.display()))?;
    let own = folder.file_name().and_then(|name| name.to_str());
    if let Some(&(name, check)) = known.iter().find(|(name, _)| Some(*name) == own) {
        return Ok(vec![(name, check, folder)]);
    }
    let present: Vec<_> = known
        .iter()
        .map(|&(name, check)| (name, check, folder.join(name)))
        .filter(|(_, _, folder)| folder.is_dir())
        .collect();
    if present.is_empty() {
        let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
        let (folder, names) = (folder.display(), names.join(" "));
        return Err(format!("{folder} is none of, and holds none of: {names}").into());
    }
    Ok(present)
}

/// One compared quantity.
#[derive(Debug, Clone)]
pub struct Row {
    /// `vq/body recon`, `nymeria golden camera`.
    pub name: String,
    /// How far off it is, or the number of wrong elements where everything must be equal.
    pub error: f64,
    /// The largest error that passes; 0 where everything must be equal.
    pub tolerance: f64,
    /// Of both; empty for shares.
    pub unit: &'static str,
    /// Why it fails whatever the error: a wrong shape, a value that is not finite, something that nobody compared.
    pub problem: Option<String>,
}

impl Row {
    /// A row that fails for a reason other than an error.
    pub fn failed(name: String, problem: String) -> Self {
        Row {
            name,
            error: 0.0,
            tolerance: 0.0,
            unit: "",
            problem: Some(problem),
        }
    }

    pub fn passed(&self) -> bool {
        self.problem.is_none() && self.error <= self.tolerance
    }

    /// The share of the tolerance that is used up.
    pub fn badness(&self) -> f64 {
        if self.passed() {
            self.error / self.tolerance.max(f64::MIN_POSITIVE)
        } else {
            f64::INFINITY
        }
    }
}

impl fmt::Display for Row {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = if self.passed() { "ok  " } else { "FAIL" };
        write!(out, "{verdict}  {:<60} ", self.name)?;
        match &self.problem {
            Some(problem) => write!(out, "{problem}"),
            None if self.tolerance == 0.0 => write!(out, "{} elements differ", self.error),
            None => {
                write!(out, "{:.2e} of {:.0e}", self.error, self.tolerance)?;
                match self.unit {
                    "" => Ok(()),
                    unit => write!(out, " {unit}"),
                }
            }
        }
    }
}
