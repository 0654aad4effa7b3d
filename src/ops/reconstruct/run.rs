//! Running `op: reconstruct`: the recording, one call, and where the time went.

use super::super::device::compute;
use super::ReconstructSettings;
use crate::clip::store::ClipSet;
use crate::experiment::{Code, StageContext, StageError};
use crate::flow::Flow;
use crate::modality::ClipFormat;
use crate::model::Model;
use crate::ops::predict::refused;
use crate::reconstruction::folder::FOLDER;
use crate::reconstruction::frame_buffer::DepthFrames;
use crate::reconstruction::{
    Anchor, Part, ReconstructError, ReconstructOptions, Recording, reconstruct_recording,
};
use crate::run::environment::Stopwatch;
use crate::video::Video;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::{Display, Write as _};
use std::path::Path;

/// Seconds by part of the work.
#[derive(Debug)]
struct Times {
    watch: Stopwatch,
    since: f64,
    parts: BTreeMap<&'static str, f64>,
}

impl Times {
    fn start() -> Self {
        Self {
            watch: Stopwatch::start(),
            since: 0.0,
            parts: BTreeMap::new(),
        }
    }

    /// The time since the last call was that of `part`.
    fn lap(&mut self, part: &'static str) {
        let now = self.watch.seconds();
        *self.parts.entry(part).or_default() += now - self.since;
        self.since = now;
    }

    fn record(&self, context: &mut dyn StageContext, windows: usize) -> Result<(), StageError> {
        let names: Vec<String> = self
            .parts
            .keys()
            .map(|part| format!("seconds/{part}"))
            .collect();
        let scalars: Vec<(&str, f64)> = names
            .iter()
            .map(String::as_str)
            .zip(self.parts.values().copied())
            .collect();
        context.record(windows as u64, &scalars)?;
        let mut text = String::from("| part | seconds | per window |\n|---|---|---|\n");
        for (part, seconds) in &self.parts {
            let each = seconds / windows.max(1) as f64;
            let _ = writeln!(text, "| {part} | {seconds:.2} | {each:.3} |");
        }
        context.record_text(windows as u64, "time", &text)
    }
}

pub(super) fn run(
    settings: &ReconstructSettings,
    model: &Path,
    context: &mut dyn StageContext,
) -> Result<Value, StageError> {
    let mut times = Times::start();
    let compute = compute(settings.device, settings.precision, context)?;
    let model = Model::open(model, &compute).map_err(refused)?;
    times.lap("open the model");
    let options = options(settings, context.seed());
    let recording = recording(settings, &options, context, model.format())?;
    let depth = DepthFrames::on_disk(context.output()).map_err(StageError::io(context.output()))?;
    let mut windows = 0;
    let result = reconstruct_recording(&recording, &model, &options, depth, &mut |progress| {
        times.lap(match progress.part {
            Part::Read => "read the video",
            Part::Decode => "decode",
            Part::Stitch => "stitch",
        });
        windows = progress.windows;
        if progress.part == Part::Stitch {
            context.progress(progress.window as u64 + 1, windows as u64, "windows");
        }
        let stop = context.interrupted();
        if stop { Flow::Stop } else { Flow::Continue }
    })
    .map_err(failed)?;
    let manifest = result
        .write(context.output().join(FOLDER))
        .map_err(StageError::other)?;
    times.lap("write");
    times.record(context, windows)?;
    Ok(json!({
        "seconds": recording.seconds,
        "windows": windows,
        "modalities": options.targets_of(&model),
        "scale": manifest.scale,
        "files": manifest.files,
    }))
}

fn options(settings: &ReconstructSettings, seed: u64) -> ReconstructOptions {
    ReconstructOptions {
        start: settings.start,
        seconds: settings.seconds,
        inputs: settings.inputs.clone(),
        targets: settings.targets.clone(),
        decoding: settings.decoding.settings.clone(),
        decoding_name: settings.decoding.name.clone(),
        overlap: settings.overlap,
        camera: settings.camera,
        floor: settings.floor.clone(),
        anchor: match (&settings.anchor, &settings.anchor_model) {
            (Some(path), _) => Some(Anchor::Maps(path.0.clone().into())),
            (None, Some(folder)) => Some(Anchor::Model(folder.0.clone().into())),
            (None, None) => None,
        },
        seed,
        samples: settings.samples,
    }
}

/// What the settings name.
fn recording(
    settings: &ReconstructSettings,
    options: &ReconstructOptions,
    context: &dyn StageContext,
    format: &ClipFormat,
) -> Result<Recording, StageError> {
    if let Some(path) = &settings.video {
        let video = Video::open_with(path, &settings.reading)
            .map_err(|error| failed(ReconstructError::Read(error)))?;
        let range = [Some(options.start), options.seconds];
        return Recording::of_video(video, range, &options.camera, format).map_err(failed);
    }
    let Some(artifact) = context.inputs("clips").first() else {
        return Err(input("nothing to reconstruct", "name a file in `video`"));
    };
    let clips = ClipSet::open(&artifact.path.join(&settings.split)).map_err(StageError::other)?;
    if settings.clip >= clips.len() {
        return Err(input(
            format_args!("split `{}` has {} clips", settings.split, clips.len()),
            "choose a smaller `clip`",
        ));
    }
    let clip = clips.clip(settings.clip).map_err(StageError::other)?;
    Recording::of_clip(clip, &options.camera, format).map_err(failed)
}

/// What stopped a reconstruction, with the way out.
fn failed(error: ReconstructError) -> StageError {
    let help = match error {
        ReconstructError::Stopped => return StageError::Interrupted,
        ReconstructError::Model(error) => return refused(error),
        error @ ReconstructError::Folder(_) => return StageError::other(error),
        ReconstructError::NothingLeft { .. } => "choose a smaller `start`, or another video",
        ReconstructError::NoColour { .. } => "choose another clip",
        ReconstructError::Ends { .. } | ReconstructError::Read(_) => {
            "check the file, or convert it with `ffmpeg`"
        }
        ReconstructError::NoCameraPath { .. } => "add `camera` to `targets`",
        ReconstructError::Camera(_) => "correct `camera`",
        ReconstructError::Windows(_) => "choose another `overlap`",
        ReconstructError::Anchor(_) => "see `anchor` in `reviv show reconstruct`",
        ReconstructError::AnchorModel(_) => {
            "`reviv import FILE --depth metric -o DIR` makes the folder of a depth network"
        }
    };
    input(error, help)
}

fn input(message: impl Display, help: &str) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: message.to_string(),
        help: help.to_owned(),
    }
}
