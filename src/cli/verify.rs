//! `reviv verify`: does a run still hold?

use super::run::{RunsDir, find, interruptible, progress, tell};
use super::terminal::{Failure, Terminal};
use crate::run::verify::{How, Redo, Verdict, verify};
use std::path::PathBuf;

/// Re-hash a run's inputs and artifacts, redo its work from a checkpoint, and demand identical bytes
#[derive(Debug, clap::Args)]
#[expect(clippy::struct_excessive_bools, reason = "switches as they are typed")]
pub struct Verify {
    /// A run: its path, its name, or enough of it
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Only hash, redo nothing
    #[arg(long, conflicts_with = "all")]
    hash_only: bool,
    /// Redo everything, also long stages without a checkpoint
    #[arg(long)]
    all: bool,
    /// Make again what is damaged or gone
    #[arg(long)]
    repair: bool,
    /// Write the checks as JSON to stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    place: RunsDir,
}

impl super::Run for Verify {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let run = find(terminal, &self.place.runs, &self.run)?;
        let redo = match (self.hash_only, self.all) {
            (true, _) => Redo::Nothing,
            (_, true) => Redo::All,
            _ => Redo::Quick,
        };
        let interrupt = interruptible(terminal)?;
        let how = How {
            redo,
            repair: self.repair,
        };
        let checks = verify(&run, how, &progress(terminal), &interrupt)
            .map_err(|error| tell(terminal, &error))?;
        if self.json {
            terminal.json(&checks);
        } else {
            for check in &checks {
                let word = match check.verdict {
                    Verdict::Same => "same",
                    Verdict::Changed => "CHANGED",
                    Verdict::Skipped => "skipped",
                    Verdict::Repaired => "repaired",
                    Verdict::Failed => "FAILED",
                };
                terminal.data(format_args!("{word:9}{}: {}\n", check.what, check.detail));
            }
        }
        let bad = [Verdict::Changed, Verdict::Failed];
        let damaged = checks.iter().filter(|check| bad.contains(&check.verdict));
        let changed = damaged.count();
        if changed == 0 {
            return Ok(());
        }
        terminal.note(format_args!(
            "error[E0602]: {changed} of {} checks failed\n",
            checks.len()
        ));
        if !self.repair {
            terminal.note("hint: `--repair` makes damaged artifacts again\n");
        }
        Err(Failure::Ended(1))
    }
}
