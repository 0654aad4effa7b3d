//! `reviv data`: recordings and the built-in world as clips: look at them, convert them, make them.

mod convert;
mod inspect;
mod label_depth;
mod status;
mod synthesize;
mod tokenize;
mod verify;

use super::run::{interruptible, progress};
use super::terminal::{Failure, Terminal};
use crate::datasets::convert::{ConvertSettings, Converted, Share, Tally, convert, whole};
use crate::datasets::open::{Dataset, HandModel, OpenWith, open};
use crate::datasets::recording::CutSettings;
use crate::datasets::shards::{Folder, Header};
use crate::datasets::{ClipSource, ReadError};
use crate::experiment::catalog::Catalog;
use crate::experiment::data::roots;
use crate::experiment::registry::Registry;
use crate::experiment::source::Sources;
use crate::experiment::{files, load};
use crate::formats::text::of_path;
use crate::ops::clips::SourceSettings;
use crate::video::DecoderChoice;
use std::fmt::Write as _;
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
    Tokenize(tokenize::Tokenize),
    Verify(verify::Verify),
}

impl super::Run for Data {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        match self.command {
            Command::Status(command) => command.run(terminal),
            Command::Inspect(command) => command.run(terminal),
            Command::Convert(command) => command.run(terminal),
            Command::LabelDepth(command) => command.run(terminal),
            Command::Synthesize(command) => command.run(terminal),
            Command::Tokenize(command) => command.run(terminal),
            Command::Verify(command) => command.run(terminal),
        }
    }
}

/// How clips are cut from recordings.
#[derive(Debug, Clone, clap::Args)]
struct Cut {
    /// What lies there: adt, hot3d_aria, hot3d_quest, hot3d_clips, nymeria, ego_exo4d, holoassist, arctic, taco, h2o, egogen, aria, neutral,
    /// egom2p, video or shards; else what it
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
    /// The folder of MANO_LEFT.pkl and MANO_RIGHT.pkl, for sets whose hands are MANO parameters [default: `mano` of data.yaml]
    #[arg(long, value_name = "DIR")]
    mano: Option<PathBuf>,
    /// Where a data set has the parameters of two models of a hand: auto, umetrack or mano
    #[arg(long, default_value = "auto", value_name = "MODEL", value_parser = hand_model)]
    hands: HandModel,
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

fn hand_model(text: &str) -> Result<HandModel, String> {
    serde_json::from_value(text.into()).map_err(|_| "not one of auto, umetrack, mano".to_owned())
}

/// The folder of a name in `data.yaml` of this folder, or in the environment.
fn data_root(name: &str) -> Option<PathBuf> {
    let environment = std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
        .collect();
    let roots = roots(
        Path::new("./x"),
        &environment,
        &mut Sources::default(),
        &mut Vec::new(),
    );
    roots.get(name).map(|root| root.path.clone())
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
        let mano = self.mano.clone().or_else(|| {
            let needed = HandModel::may_need_mano(self.kind);
            needed.then(|| data_root("mano")).flatten()
        });
        let with = OpenWith {
            mano: mano.as_deref(),
            hands: self.hands,
            ..OpenWith::default()
        };
        open(path, self.kind, settings, with).map_err(failure)
    }
}

/// The settings of a registry entry of kind `source`.
fn source_entry(name: &str) -> Result<SourceSettings, Failure> {
    let catalog = Catalog::linked();
    let here = Path::new("./x");
    let registry = Registry::new(&catalog, files::beside(here, "registry").as_deref());
    let Some(text) = registry.text("source", name) else {
        let names = registry.names("source").join(", ");
        return Err(Failure::input(
            format!("there is no file, no folder and no registry source `{name}`"),
            format!("registry sources: {names}"),
        ));
    };
    load::entry(&catalog, here, name).ok_or_else(|| {
        Failure::input(
            format!("the registry source `{name}` has mistakes"),
            format!("`reviv check {}` shows them", text.place),
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
        let _ = writeln!(lines, "note: {note}{share}");
    }
    for excluded in source.excluded() {
        let name = &excluded.recording;
        let _ = writeln!(lines, "excluded: `{name}`: {}", excluded.reason);
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
    share: Share,
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
    let converted = convert(source, &sink, settings, share, &mut |now| {
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
    let excluded: Vec<String> = source.excluded().into_iter().map(|e| e.reason).collect();
    let mut tally = converted.tally.clone();
    tally.excluded.clone_from(&excluded);
    let converted = Converted { tally, ..converted };
    // The process that ends last sums up.
    match whole(source.len(), &sink, settings) {
        Some(tally) if tally.clips == 0 => {
            say(terminal, &converted, output, as_json);
            return Err(Failure::input(
                "not one clip came out of it",
                "the lines above say why",
            ));
        }
        Some(tally) => folder
            .finish(Tally { excluded, ..tally })
            .map_err(failure)?,
        None => terminal.note(
            "other shares are not finished yet
",
        ),
    }
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
