//! The loop: window by window from frames to the folder.

use super::ReconstructSettings;
use super::recording::{Recording, input};
use crate::clip::{Clip, RGB};
use crate::decoding::{GenerationRequest, Reconstructor};
use crate::engine::Compute;
use crate::experiment::{StageContext, StageError};
use crate::labelling::DepthLabeller;
use crate::masking::PIXELS;
use crate::ops::predict::refused;
use crate::reconstruction::anchor;
use crate::reconstruction::folder::{FOLDER, Folder, ReconstructionInfo};
use crate::reconstruction::windows::{samples_of, windows};
use crate::run::environment::Stopwatch;
use crate::view::Fact;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Seconds by part of the work.
#[derive(Debug, Default)]
struct Times(BTreeMap<&'static str, f64>);

impl Times {
    fn take<T>(&mut self, part: &'static str, work: impl FnOnce() -> T) -> T {
        let watch = Stopwatch::start();
        let made = work();
        *self.0.entry(part).or_default() += watch.seconds();
        made
    }

    fn record(&self, context: &mut dyn StageContext, windows: usize) -> Result<(), StageError> {
        let names: Vec<String> = self
            .0
            .keys()
            .map(|part| format!("seconds/{part}"))
            .collect();
        let scalars: Vec<(&str, f64)> = names
            .iter()
            .map(String::as_str)
            .zip(self.0.values().copied())
            .collect();
        context.record(windows as u64, &scalars)?;
        let mut text = String::from("| part | seconds | per window |\n|---|---|---|\n");
        for (part, seconds) in &self.0 {
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
    let mut times = Times::default();
    let reconstructor = times
        .take("open the model", || {
            Reconstructor::open(model, &Compute::cpu())
        })
        .map_err(refused)?;
    let format = reconstructor.format().clone();
    let targets: Vec<String> = if settings.targets.is_empty() {
        let others = reconstructor.names().filter(|name| *name != "rgb");
        others.map(ToOwned::to_owned).collect()
    } else {
        settings.targets.clone()
    };
    let inputs = if settings.inputs.is_empty() {
        let tokens = reconstructor.names().any(|name| name == "rgb");
        vec![if tokens { "rgb" } else { PIXELS }.to_owned()]
    } else {
        settings.inputs.clone()
    };
    let clips = context.inputs("clips").first().cloned();
    let recording = Recording::open(settings, clips.as_ref(), &format)?;
    let list = windows(recording.seconds, settings.overlap)
        .map_err(|error| input(error, "choose another `overlap`"))?;
    let has = |name: &str| targets.iter().any(|target| target == name);
    if list.len() > 1 && has("body") && !has("camera") {
        return Err(input(
            "`body` over several windows needs the camera path, which says where each window starts",
            "add `camera` to `targets`",
        ));
    }
    let samples = samples_of(recording.seconds);
    let rate = format.video_rate;
    let frames = ((recording.seconds * rate - 1e-6).ceil() as usize).max(1);
    let mut assumptions = recording.assumptions.clone();
    assumptions.push(Fact {
        label: "Decoding".into(),
        value: format!(
            "`{}`, seed {}, windows of 2 s ({}), {} s in common",
            settings.decoding.name,
            context.seed(),
            list.len(),
            settings.overlap
        ),
    });
    let anchor = match (&settings.anchor, &settings.anchor_model) {
        (Some(path), _) => Some(
            anchor::read(path.as_ref(), frames)
                .map_err(|error| input(error, "see `anchor` in `reviv show reconstruct`"))?,
        ),
        (None, Some(folder)) => {
            let help = "`reviv import FILE --depth metric -o DIR` makes the folder";
            let network = DepthLabeller::open(folder.as_ref(), &Compute::cpu())
                .map_err(|error| input(error, help))?;
            assumptions.push(Fact {
                label: "Anchor".into(),
                value: format!(
                    "metric depth by Video Depth Anything {} ({})",
                    network
                        .network()
                        .settings()
                        .name()
                        .unwrap_or("of other sizes"),
                    folder.0
                ),
            });
            let maps = times.take("label the anchor", || {
                recording.anchor(&network, rate, frames)
            })?;
            Some(maps)
        }
        (None, None) => None,
    };
    let setting = ReconstructionInfo {
        title: recording.title.clone(),
        video_rate: rate,
        frames,
        samples,
        intrinsics: recording.intrinsics,
        first: recording.first,
        floor_fit: settings.floor.clone(),
        anchor,
        assumptions,
        badges: recording.badges.clone(),
        truth: recording.truth.clone(),
    };
    let mut folder = Folder::new(&context.output().join(FOLDER), setting)
        .map_err(StageError::other)?
        .with_format(&format);
    let request = GenerationRequest {
        inputs: &inputs,
        targets: &targets,
        decoding: &settings.decoding.settings,
        seed: context.seed(),
    };
    let mut stream = recording.stream(&list, &format)?;
    for window in &list {
        if context.interrupted() {
            return Err(StageError::Interrupted);
        }
        let rgb = times.take("read the video", || stream.window(window.index))?;
        let mut clip = Clip::empty(format!("{}/{:06}", recording.title, window.index), "video");
        clip.set(RGB, rgb.clone());
        let made = times
            .take("decode", || {
                reconstructor.reconstruct(&[clip], &[window.index as u64], &request)
            })
            .map_err(refused)?;
        for one in made {
            times
                .take("stitch", || {
                    folder.push(window, rgb.frames.view(), &one.clip, &one.confidence)
                })
                .map_err(StageError::other)?;
        }
        context.progress(window.index as u64 + 1, list.len() as u64, "windows");
    }
    let manifest = times
        .take("write", || folder.finish())
        .map_err(StageError::other)?;
    times.record(context, list.len())?;
    Ok(json!({
        "seconds": recording.seconds,
        "windows": list.len(),
        "modalities": targets,
        "scale": manifest.scale,
        "files": manifest.files,
    }))
}
