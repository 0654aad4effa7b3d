//! `reviv data tokenize`: clips into shards of tokens, by as many processes as there are.

use super::super::run::{interruptible, progress};
use super::super::terminal::{Failure, Terminal};
use super::failure;
use crate::clip::store::ClipSet;
use crate::datasets::convert::Share;
use crate::datasets::shards::ShardClips;
use crate::datasets::{ClipSource, ReadError};
use crate::engine::Compute;
use crate::flow::Flow;
use crate::formats::place;
use crate::formats::text::of_path;
use crate::modality;
use crate::tokenizer;
use crate::training::TrainingError;
use crate::training::token_folder::{ModalityTokens, TokenHeader, Tokenization};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Turn converted clips into shards of tokens, as the op `tokenize` does; continue where it was interrupted
#[derive(Debug, clap::Args)]
pub(super) struct Tokenize {
    /// Clips: an artifact of the op `clips`, or what `reviv data convert` made, in a folder or at an `s3://` address
    #[arg(value_name = "CLIPS")]
    clips: PathBuf,
    /// The folder of the tokens, or `s3://bucket/prefix` (builds with the feature `s3`)
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// The folders of tokenizers, one per modality: artifacts of `train_tokenizer`, or imported ones
    #[arg(short, long, value_name = "DIR", required = true, num_args = 1..)]
    tokenizers: Vec<PathBuf>,
    /// Raw colour video beside the tokens, for models that see pixels
    #[arg(long)]
    pixels: bool,
    /// The split that clips without splits become
    #[arg(long, default_value = "train", value_name = "SPLIT", value_parser = ["train", "validation", "test"])]
    split: String,
    /// Clips per shard
    #[arg(long, default_value_t = 1000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    clips_per_shard: u32,
    /// Make only this part of the shards: 1/8, 2/8 ... 8/8, one process each, into the same folder
    #[arg(long, default_value = "1/1", value_name = "I/N")]
    shard: Share,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Tokenize {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let whole = ShardClips::open(&self.clips).map_err(failure)?;
        let format = whole.format().ok_or_else(|| {
            let message = format!(
                "`{}` does not say the sizes of its clips",
                self.clips.display()
            );
            Failure::input(message, "convert the recordings again")
        })?;
        let mut modalities = Vec::new();
        for folder in &self.tokenizers {
            let tokenizer = tokenizer::open(folder, &Compute::cpu())
                .map_err(|error| Failure::input(format!("{}: {error}", folder.display()), ""))?;
            let name = tokenizer.modality().to_owned();
            let known = modality::all(&format)
                .into_iter()
                .find(|m| m.name() == name);
            let modality = known.ok_or_else(|| {
                let message = format!(
                    "{}: a tokenizer of `{name}`, which these clips do not have",
                    folder.display()
                );
                Failure::input(message, "leave it out")
            })?;
            if modalities
                .iter()
                .any(|other: &ModalityTokens| other.modality.name() == name)
            {
                return Err(Failure::input(
                    format!("two tokenizers of `{name}`"),
                    "name one",
                ));
            }
            modalities.push(ModalityTokens {
                modality,
                tokenizer,
            });
        }
        let sets = self.splits()?;
        let names = sets.iter().map(|(name, set)| (name.clone(), set.ids()));
        let per_shard = self.clips_per_shard as usize;
        let header = TokenHeader::of(
            &format,
            &modalities,
            self.pixels,
            &names.collect(),
            per_shard,
        )
        .map_err(Failure::machine)?;
        let work = Tokenization {
            header: &header,
            splits: &sets
                .iter()
                .map(|(name, set)| (name.clone(), set as &dyn ClipSource))
                .collect(),
            modalities: &modalities,
            share: self.shard,
        };
        let interrupt = interruptible(terminal)?;
        let progress = progress(terminal);
        let mut task = progress.task("clips");
        let made = work.run(&self.output, &mut |done, total| {
            task.update(done as u64, total as u64, "clips");
            if interrupt.requested() {
                Flow::Stop
            } else {
                Flow::Continue
            }
        });
        drop(task);
        let made = made.map_err(|error| match error {
            TrainingError::Clips(error) => failure(error),
            error => Failure::input(error.to_string(), ""),
        })?;
        if made.interrupted {
            terminal.note("interrupted; give the same command again and it continues\n");
            return Err(Failure::Ended(130));
        }
        if !made.whole {
            terminal.note("other shares are not finished yet\n");
        }
        if self.json {
            terminal.json(&serde_json::json!({ "folder": of_path(&self.output), "made": made }));
            return Ok(());
        }
        terminal.note(format_args!(
            "{} clips in {} shards ({} were there)\n",
            made.clips, made.shards, made.reused
        ));
        terminal.data(format_args!("{}\n", self.output.display()));
        Ok(())
    }

    /// The clips of every split that is there.
    fn splits(&self) -> Result<BTreeMap<String, ClipSet>, Failure> {
        let open = |folder: &Path| ClipSet::open(folder).map_err(|error| failure(error.into()));
        let mut sets = BTreeMap::new();
        for split in ["train", "validation", "test"] {
            let folder = self.clips.join(split);
            let there = place::is_folder(&folder);
            if there.map_err(|cause| failure(ReadError::io(&folder, cause)))? {
                sets.insert(split.to_owned(), open(&folder)?);
            }
        }
        if sets.is_empty() {
            sets.insert(self.split.clone(), open(&self.clips)?);
        }
        Ok(sets)
    }
}
