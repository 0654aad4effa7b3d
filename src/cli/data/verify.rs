//! `reviv data verify`: whether a folder of converted clips or of tokens is whole.

use super::super::terminal::{Failure, Terminal};
use super::failure;
use crate::datasets::ReadError;
use crate::datasets::shards;
use crate::datasets::verify::verify;
use crate::formats::place;
use crate::training::token_folder;
use std::path::PathBuf;

/// Check a folder of converted clips or of tokens: every shard there, every file as it was written, every clip counted
#[derive(Debug, clap::Args)]
pub(super) struct Verify {
    /// A folder that `reviv data convert`, `synthesize` or `tokenize` made, or its `s3://` address
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Verify {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let holds = |file: &str| {
            let path = self.folder.join(file);
            place::is_file(&path).map_err(|cause| failure(ReadError::io(&path, cause)))
        };
        let found = if holds(token_folder::FILE)? {
            token_folder::verify(&self.folder)
        } else if holds(shards::FILE)? {
            verify(&self.folder)
        } else {
            let folder = self.folder.display();
            return Err(Failure::input(
                format!(
                    "`{folder}` holds neither clips (`{}`) nor tokens (`{}`)",
                    shards::FILE,
                    token_folder::FILE
                ),
                "`reviv data convert`, `synthesize` and `tokenize` make such folders",
            ));
        };
        let found = found.map_err(failure)?;
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
