//! `reviv data convert`: recordings of any kind into shards of clips.

use super::super::terminal::{Failure, Terminal};
use super::{Cut, absolute, write};
use crate::datasets::convert::{ConvertSettings, Share};
use crate::formats::text::of_path;
use serde_json::json;
use std::path::PathBuf;

/// Convert recordings into shards of clips, on all cores; continue where it was interrupted
#[derive(Debug, clap::Args)]
pub(super) struct Convert {
    /// A recording, a video, or a folder of them
    #[arg(value_name = "PATH")]
    path: PathBuf,
    /// The folder of the shards, or `s3://bucket/prefix` (builds with the feature `s3`)
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    cut: Cut,
    /// Clips per shard
    #[arg(long, default_value_t = 100, value_name = "N")]
    clips_per_shard: usize,
    /// Make only this part of the shards: 1/8, 2/8 ... 8/8, one process each, into the same folder
    #[arg(long, default_value = "1/1", value_name = "I/N")]
    shard: Share,
    /// Stop at the first damaged clip; otherwise they are left out and listed
    #[arg(long)]
    strict: bool,
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
            skip_damaged: !self.strict,
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
            self.shard,
            &self.output,
            self.json,
        )
    }
}
