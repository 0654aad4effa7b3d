//! `reviv import`: released weights of others into our safetensors; and what `reviv show FILE` says of a checkpoint.

use super::terminal::{Failure, Terminal};
use crate::formats::checkpoint::CheckpointError;
use crate::formats::text::of_path;
use crate::import::cosmos::parse_compression;
use crate::import::{Checkpoint, ImportError, ImportOptions, import};
use crate::labelling::DepthLabelKind;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Import released weights (`.pth`, `.jit`, safetensors) and their statistics
///
/// Nothing in a file is executed, and nothing is dropped before it has been checked to be redundant. The weights stay under
/// their authors' licence.
#[derive(Debug, clap::Args)]
pub struct Import {
    /// Checkpoints and `norm_stats` files of one set, or their folder
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The folder to make
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Attention heads, where a checkpoint does not name its builder
    #[arg(long, value_name = "N")]
    heads: Option<usize>,
    /// Frames and pixels per token of a video tokenizer that is not named after them: 4x8x8 or 8x16x16
    #[arg(long, value_name = "TxHxW")]
    video: Option<String>,
    /// Clips of a video tokenizer that is imported without a transformer: 16x256x256 unless given
    #[arg(long, value_name = "FxHxW")]
    clip: Option<String>,
    /// What a depth network (Video Depth Anything) gives, which its file does not say: relative or metric
    #[arg(long, value_name = "KIND")]
    depth: Option<DepthLabelKind>,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
}

impl super::Run for Import {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let compression = match &self.video {
            Some(text) => Some(parse_compression(text).ok_or_else(|| {
                Failure::input(
                    format!("`--video {text}` is not a compression"),
                    "write it as `4x8x8`: frames, height and width per token",
                )
            })?),
            None => None,
        };
        let clip = match &self.clip {
            Some(text) => Some(parse_clip(text).ok_or_else(|| {
                Failure::input(
                    format!("`--clip {text}` is not a size"),
                    "write it as `16x256x256`: frames, height and width",
                )
            })?),
            None => None,
        };
        let options = ImportOptions {
            heads: self.heads,
            compression,
            clip,
            depth: self.depth,
        };
        let report = import(&self.files, &self.output, &options).map_err(failure)?;
        for notice in &report.notices {
            terminal.note(format_args!("note: {notice}\n"));
        }
        if self.json {
            let parts: Vec<_> = report
                .parts
                .iter()
                .map(|part| {
                    json!({
                        "name": part.name, "entries": part.entries, "written": part.written,
                        "values": part.values,
                    })
                })
                .collect();
            terminal.json(&json!({ "folder": of_path(&report.folder), "parts": parts }));
            return Ok(());
        }
        for part in &report.parts {
            terminal.data(format_args!(
                "{}: {} of {} entries written, {} values; the others were checked and are redundant\n",
                part.name, part.written, part.entries, part.values
            ));
        }
        terminal.data(format_args!("{}\n", report.folder.display()));
        Ok(())
    }
}

/// `16x256x256` as frames, height and width.
fn parse_clip(text: &str) -> Option<[usize; 3]> {
    let parts: Option<Vec<usize>> = text.split('x').map(|part| part.parse().ok()).collect();
    parts?
        .try_into()
        .ok()
        .filter(|clip: &[usize; 3]| !clip.contains(&0))
}

/// Lists the entries of a checkpoint, without loading them.
pub(super) fn show(path: &Path, as_json: bool, terminal: &Terminal) -> Result<(), Failure> {
    let checkpoint = Checkpoint::open(path).map_err(|error| failure(error.into()))?;
    let entries = checkpoint.entries();
    let same = |index: Option<usize>| index.map(|i| entries[i].name.as_str());
    if as_json {
        let entries: Vec<_> = entries
            .iter()
            .map(|entry| {
                json!({
                    "name": entry.name, "type": entry.scalar().name(), "shape": entry.shape(),
                    "bytes": entry.bytes(), "same_as": same(entry.same_as),
                })
            })
            .collect();
        terminal.json(&json!({
            "file": of_path(path), "format": format!("{:?}", checkpoint.format()), "entries": entries,
            "arguments": checkpoint.arguments(), "others": checkpoint.others(),
            "wrappers": checkpoint.wrappers(), "opaque": checkpoint.opaque(),
        }));
        return Ok(());
    }
    let mut text = String::new();
    for (name, what) in checkpoint.opaque() {
        let _ = writeln!(text, "{name}  {what}");
    }
    let width = entries.iter().map(|e| e.name.len()).max().unwrap_or(0);
    for entry in entries {
        let shape = format!("{:?}", entry.shape());
        let _ = write!(
            text,
            "{:<width$}  {:<4}  {shape}",
            entry.name,
            entry.scalar().name()
        );
        if let Some(owner) = same(entry.same_as) {
            let _ = write!(text, "  = {owner}");
        }
        text.push('\n');
    }
    let distinct = entries.iter().filter(|e| e.same_as.is_none());
    let bytes: u64 = distinct.map(crate::import::Entry::bytes).sum();
    let _ = writeln!(text, "{} entries, {bytes} bytes", entries.len());
    terminal.data(text);
    Ok(())
}

fn failure(error: ImportError) -> Failure {
    match error {
        ImportError::Io { .. } | ImportError::Checkpoint(CheckpointError::Io { .. }) => {
            Failure::machine(error)
        }
        other => Failure::input(other.to_string(), ""),
    }
}
