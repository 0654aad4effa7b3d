//! `reviv data synthesize`: clips of the built-in world in shards.

use super::super::terminal::{Failure, Terminal};
use super::{source_entry, write};
use crate::datasets::convert::{ConvertSettings, Share};
use crate::world::{World, WorldClips};
use serde_json::json;
use std::path::PathBuf;

/// Make clips of the built-in world, on all cores; continue where it was interrupted
#[derive(Debug, clap::Args)]
pub(super) struct Synthesize {
    /// A registry source with a world: `world`, `world_small`
    #[arg(value_name = "SOURCE", default_value = "world")]
    source: String,
    /// How many clips
    #[arg(short = 'n', long, value_name = "N")]
    clips: u64,
    /// The folder of the shards, or `s3://bucket/prefix` (builds with the feature `s3`)
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Another seed is another world
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// The number of the first clip
    #[arg(long, default_value_t = 0, value_name = "N")]
    first: u64,
    /// Height and width of the images
    #[arg(long, value_name = "PIXELS")]
    size: Option<u32>,
    /// Clips per shard
    #[arg(long, default_value_t = 100, value_name = "N")]
    clips_per_shard: usize,
    /// Make only this part of the shards: 1/8, 2/8 ... 8/8, one process each, into the same folder
    #[arg(long, default_value = "1/1", value_name = "I/N")]
    shard: Share,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Synthesize {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let entry = source_entry(&self.source)?;
        if entry.data.is_some() {
            return Err(Failure::input(
                format!("the registry source `{}` reads recordings", self.source),
                "`reviv data convert` makes clips of them",
            ));
        }
        let mut world = entry.world;
        world.size = self.size.unwrap_or(world.size);
        if let Some((key, reason)) = world.problem() {
            return Err(Failure::input(format!("{key}: {reason}"), ""));
        }
        let last = self.first.checked_add(self.clips);
        let last = last.ok_or_else(|| Failure::input("there are not so many clips", ""))?;
        let settings = ConvertSettings {
            clips_per_shard: self.clips_per_shard,
            skip_damaged: false,
        };
        let request = json!({
            "world": world, "seed": self.seed, "first": self.first, "clips": self.clips,
            "shards": settings,
        });
        let source = WorldClips::new(World::new(world, self.seed), self.first..last);
        write(
            terminal,
            &source,
            request,
            &settings,
            self.shard,
            &self.output,
            self.json,
        )
    }
}
