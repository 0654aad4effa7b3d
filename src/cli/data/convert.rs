//! `reviv data convert`: recordings of any kind into shards of clips.

use super::super::terminal::{Failure, Terminal};
use super::{Cut, absolute, write};
use crate::datasets::convert::ConvertSettings;
use crate::formats::text::of_path;
use serde_json::json;
use std::path::PathBuf;

/// Convert recordings into shards of clips, on all cores; continue where it was interrupted
#[derive(Debug, clap::Args)]
pub(super) struct Convert {
    /// A recording, a video, or a folder of them
    #[arg(value_name = "PATH")]
    path: PathBuf,
    /// The folder of the shards
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    cut: Cut,
    /// Clips per shard
    #[arg(long, default_value_t = 100, value_name = "N")]
    clips_per_shard: usize,
    /// Leave out damaged clips and say which, instead of stopping at the first one
    #[arg(long)]
    skip_damaged: bool,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Convert {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let cut = self.cut.settings();
        let source = self.cut.open(&self.path, &cut)?;
        let settings = ConvertSettings {
            clips_per_shard: self.clips_per_shard,
            skip_damaged: self.skip_damaged,
        };
        let request = json!({
            "recordings": of_path(&absolute(&self.path)), "clips": source.len(), "cut": cut, "shards": settings,
            "decoders": source.decoders(),
        });
        write(
            terminal,
            source.as_ref(),
            request,
            &settings,
            &self.output,
            self.json,
        )
    }
}
