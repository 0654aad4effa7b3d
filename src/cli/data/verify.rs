//! `reviv data verify`: whether a folder of converted clips is whole.

use super::super::terminal::{Failure, Terminal};
use super::failure;
use crate::datasets::verify::verify;
use std::path::PathBuf;

/// Check a folder of converted clips: every shard there, every file as it was written, every clip counted
#[derive(Debug, clap::Args)]
pub(super) struct Verify {
    /// A folder that `reviv data convert` or `synthesize` made
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Verify {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let found = verify(&self.folder).map_err(failure)?;
        if self.json {
            terminal.json(&found);
        } else {
            terminal.data(format_args!(
                "{} of {} shards, {} clips in {} files, {:.1} MB\n",
                found.finished,
                found.shards,
                found.tally.clips,
                found.files,
                found.bytes as f64 / 1e6
            ));
            for (reason, count) in &found.tally.dropped {
                terminal.data(format_args!("{count} dropped: {reason}\n"));
            }
            for reason in &found.tally.damaged {
                terminal.data(format_args!("left out: {reason}\n"));
            }
            for problem in &found.problems {
                terminal.data(format_args!("problem: {problem}\n"));
            }
        }
        if found.problems.is_empty() {
            Ok(())
        } else {
            Err(Failure::Reported)
        }
    }
}
