//! `reviv data`: recordings and the built-in world as clips: look at them, convert them, make them.

mod convert;
mod inspect;
mod label_depth;
mod status;
mod synthesize;

use super::run::{interruptible, progress};
use super::terminal::{Failure, Terminal};
use crate::datasets::convert::{ConvertSettings, Converted, convert};
use crate::datasets::open::{Dataset, OpenWith, open};
use crate::datasets::recording::CutSettings;
use crate::datasets::shards::{Folder, Header};
use crate::datasets::{ClipSource, ReadError};
use crate::experiment::catalog::Catalog;
use crate::experiment::load;
use crate::experiment::registry::Registry;
use crate::formats::text::of_path;
use crate::ops::clips::SourceSettings;
use crate::video::DecoderChoice;
use serde::Deserialize as _;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Look at recordings and clips, convert recordings, make clips of the built-in world
#[derive(Debug, clap::Args)]
pub struct Data {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Status(status::StatusCommand),
    Inspect(inspect::Inspect),
    Convert(convert::Convert),
    LabelDepth(label_depth::LabelDepth),
    Synthesize(synthesize::Synthesize),
}

impl super::Run for Data {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        match self.command {
            Command::Status(command) => command.run(terminal),
            Command::Inspect(command) => command.run(terminal),
            Command::Convert(command) => command.run(terminal),
            Command::LabelDepth(command) => command.run(terminal),
            Command::Synthesize(command) => command.run(terminal),
        }
    }
}

/// How clips are cut from recordings.
#[derive(Debug, Clone, clap::Args)]
struct Cut {
    /// What lies there: adt, hot3d_aria, hot3d_quest, nymeria, ego_exo4d, holoassist, egogen, aria, neutral, egom2p, video or shards; else what it
    /// looks like
    #[arg(long, value_name = "KIND", value_parser = kind)]
    kind: Option<Dataset>,
    /// Frames per second of colour and depth
    #[arg(long, default_value_t = 8.0, value_name = "HZ")]
    fps: f64,
    /// Side of the square frames
    #[arg(long, default_value_t = 256, value_name = "PIXELS")]
    side: u32,
    /// Make pinhole pictures of this field of view of a fisheye recording
    #[arg(long, value_name = "DEGREES")]
    undistort: Option<f64>,
    /// Seconds from the start of one clip to the start of the next
    #[arg(long, default_value_t = 2.0, value_name = "SECONDS")]
    stride: f64,
    /// Take a recording shorter than a clip as one clip: the last frame is repeated, signals after the end are invalid
    #[arg(long)]
    pad_short: bool,
    /// Who decodes videos
    #[arg(long, value_enum, default_value_t, value_name = "DECODER")]
    decoder: DecoderChoice,
}

fn kind(text: &str) -> Result<Dataset, String> {
    let names = Dataset::ALL.map(Dataset::name).join(", ");
    Dataset::from_name(text).ok_or_else(|| format!("not one of {names}"))
}

impl Cut {
    fn settings(&self) -> CutSettings {
        CutSettings {
            fps: self.fps,
            side: self.side,
            undistort: self.undistort,
            pad_short: self.pad_short,
            stride: self.stride,
            decoder: self.decoder,
            ..CutSettings::default()
        }
    }

    fn open(&self, path: &Path, settings: &CutSettings) -> Result<Arc<dyn ClipSource>, Failure> {
        settings.check().map_err(failure)?;
        open(path, self.kind, settings, OpenWith::default()).map_err(failure)
    }
}

/// The settings of a registry entry of kind `source`.
fn source_entry(name: &str) -> Result<SourceSettings, Failure> {
    let catalog = Catalog::linked();
    let here = Path::new("./x");
    let registry = Registry::new(&catalog, load::beside(here, "registry").as_deref());
    let Some(text) = registry.text("source", name) else {
        let names = registry.names("source").join(", ");
        return Err(Failure::input(
            format!("there is no file, no folder and no registry source `{name}`"),
            format!("registry sources: {names}"),
        ));
    };
    let Some(settings) = load::entry(&catalog, here, "source", name) else {
        return Err(Failure::input(
            format!("the registry source `{name}` has mistakes"),
            format!("`reviv check {}` shows them", text.place),
        ));
    };
    SourceSettings::deserialize(settings).map_err(|error| {
        Failure::input(
            format!("the registry source `{name}`: {error}"),
            format!("`reviv show source/{name}` shows its settings"),
        )
    })
}

/// What a source lacks, and which recordings it leaves out, one line each.
fn remarks(source: &dyn ClipSource) -> String {
    let recordings = source.recordings().len();
    let mut lines = String::new();
    for (note, count) in source.notes() {
        let share = if count < recordings {
            format!(" ({count} of {recordings} recordings)")
        } else {
            String::new()
        };
        lines.push_str(&format!("note: {note}{share}\n"));
    }
    for excluded in source.excluded() {
        let name = &excluded.recording;
        lines.push_str(&format!("excluded: `{name}`: {}\n", excluded.reason));
    }
    lines
}

/// The user's files are for the user to mend, the disk is not.
fn failure(error: ReadError) -> Failure {
    match error {
        ReadError::Io { .. } => Failure::machine(error),
        error => Failure::input(error.to_string(), ""),
    }
}

/// Converts into a folder with progress; says what became of it.
fn write(
    terminal: &Terminal,
    source: &dyn ClipSource,
    request: serde_json::Value,
    settings: &ConvertSettings,
    output: &Path,
    as_json: bool,
) -> Result<(), Failure> {
    let format = source.format().ok_or_else(|| {
        Failure::input(
            "the sizes of these clips are not known",
            "convert the recordings again",
        )
    })?;
    let header = Header {
        source: source.name().to_owned(),
        format,
        request,
        tally: None,
    };
    if source.is_empty() {
        return Err(Failure::input(
            format!("`{}` has no clip of two seconds", source.name()),
            "`--pad-short` takes shorter recordings as one clip each",
        ));
    }
    let folder = Folder::begin(output, header).map_err(failure)?;
    let sink = folder.sink().map_err(failure)?;
    let interrupt = interruptible(terminal)?;
    let progress = progress(terminal);
    let mut task = progress.task("clips");
    let converted = convert(source, &sink, settings, &mut |now| {
        task.update(now.done as u64, now.total as u64, "clips");
        if interrupt.requested() {
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    });
    drop(task);
    terminal.note(remarks(source));
    let converted = converted.map_err(failure)?;
    if converted.interrupted {
        terminal.note("interrupted; give the same command again and it continues\n");
        return Err(Failure::Ended(130));
    }
    let mut tally = converted.tally.clone();
    tally.excluded = source.excluded().into_iter().map(|e| e.reason).collect();
    let converted = Converted { tally, ..converted };
    folder.finish(converted.tally.clone()).map_err(failure)?;
    say(terminal, &converted, output, as_json);
    Ok(())
}

fn say(terminal: &Terminal, converted: &Converted, output: &Path, as_json: bool) {
    let tally = &converted.tally;
    if as_json {
        terminal.json(&serde_json::json!({
            "folder": of_path(output), "shards": converted.shards, "reused": converted.reused,
            "clips": tally.clips, "dropped": tally.dropped, "damaged": tally.damaged,
            "lost": tally.lost,
            "excluded": tally.excluded,
        }));
        return;
    }
    terminal.note(format_args!(
        "{} clips in {} shards ({} were there)\n",
        tally.clips, converted.shards, converted.reused
    ));
    for remark in tally.remarks() {
        terminal.note(format_args!("{remark}\n"));
    }
    terminal.data(format_args!("{}\n", output.display()));
}

/// The path in words that every machine agrees on, so that a conversion can be recognised.
fn absolute(path: &Path) -> PathBuf {
    std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}
