//! The arguments that every command about an experiment has, and how its diagnostics are shown.

use super::terminal::{Failure, Terminal};
use crate::experiment::Experiment;
use crate::experiment::catalog::Catalog;
use crate::experiment::diagnostic::Report;
use crate::experiment::load::{Request, load};
use std::path::PathBuf;

/// Changes of an experiment from the command line.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct Changes {
    /// Change a value: `--set stages.mget.steps=10`
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// The seed of an experiment, or the only seed of a sweep
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
}

impl Changes {
    /// The request for a file with these changes, to run it.
    pub fn request(&self, file: &std::path::Path) -> Request {
        Request {
            path: PathBuf::from(file),
            set: self.set.clone(),
            seed: self.seed,
            data_may_be_absent: false,
        }
    }

    /// The request for a file with these changes, only to look at it: data sets may be elsewhere.
    pub fn look(&self, file: &std::path::Path) -> Request {
        Request {
            data_may_be_absent: true,
            ..self.request(file)
        }
    }
}

/// Loads an experiment and shows what is wrong with it.
///
/// # Errors
/// When it has errors; they have been reported.
pub fn open(
    catalog: &Catalog,
    request: &Request,
    terminal: &Terminal,
) -> Result<(Experiment, Report), Failure> {
    let (experiment, report) = load(catalog, request);
    terminal.note(report.render(terminal.colour));
    let Some(experiment) = experiment else {
        terminal.note(format_args!("{}\n", summary(&report)));
        return Err(Failure::Reported);
    };
    Ok((experiment, report))
}

/// `2 errors, 1 warning`.
pub fn summary(report: &Report) -> String {
    let errors = report.errors();
    let warnings = report.diagnostics.len() - errors;
    let mut parts = Vec::new();
    if errors > 0 {
        parts.push(count(errors, "error"));
    }
    if warnings > 0 {
        parts.push(count(warnings, "warning"));
    }
    if parts.is_empty() {
        "no errors".to_owned()
    } else {
        parts.join(", ")
    }
}

/// `1 stage`, `2 stages`.
pub fn count(number: usize, noun: &str) -> String {
    if number == 1 {
        format!("1 {noun}")
    } else {
        format!("{number} {noun}s")
    }
}
