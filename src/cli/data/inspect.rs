//! `reviv data inspect`: what is in recordings, shards, an artifact or the world, in numbers and pictures.

use super::super::run::{interruptible, progress};
use super::super::terminal::{Failure, Terminal};
use super::{Cut, failure, remarks, source_entry};
use crate::datasets::ClipSource;
use crate::datasets::survey::{Survey, survey};
use crate::formats::place;
use crate::formats::png;
use crate::formats::text::of_path;
use crate::modality::inventory::Row;
use crate::view::contact::contact_sheet;
use crate::view::paths::paths;
use crate::world::{World, WorldClips};
use serde_json::json;
use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Show what is in recordings or clips: counts, validity, ranges and units; a contact sheet and the camera's paths as PNG
#[derive(Debug, clap::Args)]
pub(super) struct Inspect {
    /// A recording, a video, a data set, converted clips, an artifact of the op `clips`, or a registry source (`world`)
    #[arg(value_name = "PATH|SOURCE")]
    path: PathBuf,
    /// The folder of the pictures (otherwise `inspect-<name>`)
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    cut: Cut,
    /// Look at so many clips, spread over all
    #[arg(
        short = 'n',
        long,
        default_value_t = 32,
        value_name = "N",
        conflicts_with = "all"
    )]
    clips: usize,
    /// Look at every clip
    #[arg(long)]
    all: bool,
    /// Clips in the pictures
    #[arg(long, default_value_t = 4, value_name = "N")]
    examples: usize,
    /// The seed of a world
    #[arg(long, default_value_t = 0, value_name = "N")]
    seed: u64,
    /// Write the numbers as JSON to stdout
    #[arg(long)]
    json: bool,
}

impl Inspect {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let source = self.source(terminal)?;
        let interrupt = interruptible(terminal)?;
        let progress = progress(terminal);
        let mut task = progress.task("clips");
        let most = (!self.all).then_some(self.clips.max(1));
        let found = survey(source.as_ref(), most, self.examples, &mut |done, total| {
            task.update(done as u64, total as u64, "clips");
            if interrupt.requested() {
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        });
        drop(task);
        let found = found.map_err(failure)?;
        let output = self.output.clone().unwrap_or_else(|| {
            let name = self.path.file_name().unwrap_or(self.path.as_os_str());
            PathBuf::from(format!("inspect-{}", name.to_string_lossy()))
        });
        let files = pictures(&found, &output)?;
        if self.json {
            let files: Vec<String> = files.iter().map(|file| of_path(file)).collect();
            terminal.json(&json!({ "survey": found, "pictures": files }));
        } else {
            terminal.data(words(&found, source.as_ref()));
            for file in &files {
                terminal.data(format_args!("{}\n", file.display()));
            }
        }
        if found.interrupted {
            return Err(Failure::Ended(130));
        }
        Ok(())
    }

    fn source(&self, terminal: &Terminal) -> Result<Arc<dyn ClipSource>, Failure> {
        if self.path.exists() || place::is_remote(&self.path) {
            let mut settings = self.cut.settings();
            let source = self.cut.open(&self.path, &settings)?;
            if !source.is_empty() || settings.pad_short {
                return Ok(source);
            }
            terminal.note(
                "note: nothing here is two seconds long; the last frame is repeated (`--pad-short`)\n",
            );
            settings.pad_short = true;
            return self.cut.open(&self.path, &settings);
        }
        let name = self.path.to_string_lossy();
        let entry = source_entry(&name)?;
        if let Some(data) = entry.data {
            return Err(Failure::input(
                format!("the registry source `{name}` reads the data set `{data}`"),
                "give the folder of the data set",
            ));
        }
        if let Some((key, reason)) = entry.world.problem() {
            return Err(Failure::input(format!("{key}: {reason}"), ""));
        }
        let clips = self.clips.max(1) as u64;
        Ok(Arc::new(WorldClips::new(
            World::new(entry.world, self.seed),
            0..clips,
        )))
    }
}

/// Writes the pictures and the numbers.
fn pictures(found: &Survey, output: &Path) -> Result<Vec<PathBuf>, Failure> {
    std::fs::create_dir_all(output)
        .map_err(|error| Failure::machine(format!("{}: {error}", output.display())))?;
    let mut files = Vec::new();
    if !found.examples.is_empty() {
        for (name, canvas) in [
            ("contact_sheet.png", contact_sheet(&found.examples)),
            ("paths.png", paths(&found.examples)),
        ] {
            let file = output.join(name);
            png::write(&file, &canvas.into_picture()).map_err(Failure::machine)?;
            files.push(file);
        }
    }
    let file = output.join("inventory.json");
    let text = serde_json::to_string_pretty(found).map_err(Failure::machine)?;
    std::fs::write(&file, text)
        .map_err(|error| Failure::machine(format!("{}: {error}", file.display())))?;
    files.push(file);
    Ok(files)
}

fn words(found: &Survey, source: &dyn ClipSource) -> String {
    let mut text = format!(
        "{}: {} clips in {} recordings; looked at {}\n",
        found.source, found.clips, found.recordings, found.looked_at
    );
    let f = &found.format;
    let _ = writeln!(
        text,
        "format: {} frames of {}x{} at {} Hz, {} samples at {} Hz; modalities: {}",
        f.frames,
        f.size,
        f.size,
        f.video_rate,
        f.samples,
        f.signal_rate,
        source.modalities().join(" ")
    );
    text.push_str(&remarks(source));
    for (decoder, count) in &found.decoders {
        let _ = writeln!(text, "videos: {count} read by {decoder}");
    }
    for (reason, count) in &found.tally.dropped {
        let _ = writeln!(text, "dropped: {count}, {reason}");
    }
    for (reason, count) in &found.tally.lost {
        let _ = writeln!(text, "{count} clips without {reason}");
    }
    for error in &found.tally.damaged {
        let _ = writeln!(text, "damaged: {error}");
    }
    text.push('\n');
    let head = [
        "modality", "clips", "without", "valid", "Hz", "shape", "channel", "unit", "min", "mean",
        "max", "std",
    ];
    let mut rows: Vec<Vec<String>> = vec![head.map(str::to_owned).to_vec()];
    for row in &found.inventory.modalities {
        lines(row, &mut rows);
    }
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max();
    let widths: Vec<usize> = (0..head.len()).map(|c| width(c).unwrap_or(0)).collect();
    for row in &rows {
        let mut line = String::new();
        for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
            // Words to the left, numbers to the right.
            let _ = if [0, 5, 7].contains(&column) {
                write!(line, "{cell:<width$}  ")
            } else {
                write!(line, "{cell:>width$}  ")
            };
        }
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text.push('\n');
    for row in &found.inventory.modalities {
        if row.statistics.clips > 0 && !row.frame.is_empty() {
            let _ = writeln!(text, "{}: {}", row.modality, row.frame);
        }
        for (reason, count) in &row.refused {
            let _ = writeln!(text, "{}: {count} clips refused: {reason}", row.modality);
        }
    }
    text
}

/// One line per channel; the first one says what is the same for all.
fn lines(row: &Row, rows: &mut Vec<Vec<String>>) {
    let s = &row.statistics;
    let shapes: Vec<&str> = row.shapes.keys().map(String::as_str).collect();
    let mut front = vec![
        row.modality.clone(),
        s.clips.to_string(),
        s.without.to_string(),
        if s.samples > 0 {
            format!("{:.1} %", 100.0 * s.valid_share())
        } else {
            "-".to_owned()
        },
        format!("{}", row.rate),
        shapes.join(" "),
    ];
    if s.channels.is_empty() {
        front.resize(12, "-".to_owned());
        rows.push(front);
        return;
    }
    for (number, channel) in s.channels.iter().enumerate() {
        let mut cells = front.clone();
        cells.push(number.to_string());
        cells.push(channel.unit.clone());
        let numbers = [channel.min, channel.mean, channel.max, channel.std];
        if channel.count > 0 {
            cells.extend(numbers.map(|value| format!("{value:.3}")));
        } else {
            cells.extend(numbers.map(|_| "-".to_owned()));
        }
        rows.push(cells);
        front = vec![String::new(); 6];
    }
}
