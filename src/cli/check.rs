//! `reviv check`: every error at once, before any compute.

use super::request::{Changes, count, summary};
use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::load;
use crate::formats::text::of_path;
use serde_json::json;
use std::path::PathBuf;

/// Check experiments and registry entries: every error at once, no compute
#[derive(Debug, clap::Args)]
pub struct Check {
    /// Experiments, sweeps or registry entries
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    changes: Changes,
    /// Write diagnostics as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl super::Run for Check {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let catalog = Catalog::linked();
        let mut failed = false;
        let mut records = Vec::new();
        for file in &self.files {
            let (experiment, report) = load::check(&catalog, &self.changes.look(file));
            failed |= report.failed();
            if self.json {
                records.push(json!({
                    "file": of_path(file),
                    "ok": !report.failed(),
                    "diagnostics": report.records(),
                }));
                continue;
            }
            terminal.note(report.render(terminal.colour));
            let file = file.display();
            if report.failed() {
                terminal.note(format_args!("{file}: {}\n", summary(&report)));
                continue;
            }
            let size = experiment.map_or_else(
                || "a registry entry".to_owned(),
                |experiment| {
                    let stages = experiment
                        .cells
                        .first()
                        .map_or(0, |cell| cell.graph.stages.len());
                    let mut size = count(stages, "stage");
                    if experiment.sweep {
                        size = format!("{size} in {}", count(experiment.cells.len(), "run"));
                    }
                    size
                },
            );
            terminal.data(format_args!("{file}: ok, {size}\n"));
        }
        if self.json {
            terminal.json(&records);
        }
        if failed {
            Err(Failure::Reported)
        } else {
            Ok(())
        }
    }
}
