//! The loop: window by window from frames to a [`Reconstruction`] (Sec. 4.1, Supp. C and D).

use super::anchor;
use super::camera::CameraSettings;
use super::error::ReconstructError;
use super::floor::FloorFit;
use super::folder::Builder;
use super::frame_buffer::DepthFrames;
use super::recording::{Recording, SYNTHETIC};
use super::result::{Reconstruction, ReconstructionInfo};
use super::stitch::follows_camera;
use super::windows::{samples_of, windows};
use crate::clip::{CAMERA, Clip, RGB};
use crate::decoding::DecodingSettings;
use crate::flow::Flow;
use crate::labelling::DepthLabeller;
use crate::masking::PIXELS;
use crate::model::{GenerationRequest, Model};
use crate::video::Video;
use crate::view::Fact;
use crate::view::scene::{Badge, Tone};
use std::path::PathBuf;

/// What is reconstructed of a recording, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructOptions {
    /// Seconds of the video that are left out at its start.
    pub start: f64,
    /// At most so many seconds; `None`: to the end.
    pub seconds: Option<f64>,
    /// What of the video the model is given: `rgb` is its tokens, and raw video where the model takes it; `pixels` is raw video
    /// alone. Empty means `rgb`, or `pixels` for a model without tokens of video.
    pub inputs: Vec<String>,
    /// The modalities to generate; empty means everything but `rgb`.
    pub targets: Vec<String>,
    /// How tokens are generated.
    pub decoding: DecodingSettings,
    /// What the decoding is called among the assumptions.
    pub decoding_name: String,
    /// Seconds that neighbouring windows of two seconds have in common: 0.5, 1 or 1.5.
    pub overlap: f64,
    /// The camera, as far as it is known.
    pub camera: CameraSettings,
    /// How depth becomes metric from the floor.
    pub floor: FloorFit,
    /// Metric depth instead of the floor.
    pub anchor: Option<Anchor>,
    /// Of the decoding.
    pub seed: u64,
    /// How many samples are given beside the reconstruction, each from a seed of its own; below two, none.
    pub samples: usize,
}

/// Where metric depth at the frames of the model's video comes from (Supp. D).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Anchor {
    /// A file or folder of maps that another model made ([`anchor`]).
    Maps(PathBuf),
    /// The folder of a metric depth network ([`crate::labelling`]), which sees the video itself.
    Model(PathBuf),
}

impl Default for ReconstructOptions {
    fn default() -> Self {
        Self {
            start: 0.0,
            seconds: None,
            inputs: Vec::new(),
            targets: Vec::new(),
            decoding: DecodingSettings::default(),
            decoding_name: "default".to_owned(),
            overlap: 1.0,
            camera: CameraSettings::default(),
            floor: FloorFit::default(),
            anchor: None,
            seed: 0,
            samples: 1,
        }
    }
}

impl ReconstructOptions {
    /// What `model` is given.
    #[must_use]
    pub fn inputs_of(&self, model: &Model) -> Vec<String> {
        if !self.inputs.is_empty() {
            return self.inputs.clone();
        }
        let tokens = model.names().any(|name| name == "rgb");
        vec![if tokens { "rgb" } else { PIXELS }.to_owned()]
    }

    /// What `model` generates.
    #[must_use]
    pub fn targets_of(&self, model: &Model) -> Vec<String> {
        if !self.targets.is_empty() {
            return self.targets.clone();
        }
        let others = model.names().filter(|name| *name != "rgb");
        others.map(ToOwned::to_owned).collect()
    }
}

/// A part of the work on a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Its frames were read.
    Read,
    /// Its signals were generated.
    Decode,
    /// It was joined to the windows before it: the last part.
    Stitch,
}

/// What has just been done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WindowProgress {
    /// This part,
    pub part: Part,
    /// of this window (from 0),
    pub window: usize,
    /// of so many.
    pub windows: usize,
}

/// Reconstructs the wearer and the world of a video; everything is held in memory.
///
/// For a long video, [`reconstruct_recording`] holds depth on disk and tells how far it is.
///
/// # Errors
/// When the video cannot be read, the options do not fit it, or the model does not know a modality.
pub fn reconstruct(
    video: &Video,
    model: &Model,
    options: &ReconstructOptions,
) -> Result<Reconstruction, ReconstructError> {
    let range = [Some(options.start), options.seconds];
    let recording = Recording::of_video(video.clone(), range, &options.camera, model.format())?;
    let depth = DepthFrames::in_memory();
    reconstruct_recording(&recording, model, options, depth, &mut |_| Flow::Continue)
}

/// Whether the model knows the synthetic world alone, and the recording is not of it.
fn is_out_of_place(model: &Model, recording: &Recording) -> bool {
    model.trained_on() == [SYNTHETIC] && !recording.is_synthetic()
}

/// What the model was trained on, in a sentence.
fn trained_on(model: &Model, is_synthetic: bool) -> String {
    match model.trained_on() {
        [] => "its folder does not say what it was trained on".to_owned(),
        [only] if only == SYNTHETIC && is_synthetic => {
            "trained on the synthetic world, as this recording is".to_owned()
        }
        [only] if only == SYNTHETIC => "trained on the synthetic world alone; this recording is not of it, so what is \
                                        reconstructed shows that the program runs, not what happened"
            .to_owned(),
        sources => format!("trained on {}", sources.join(", ")),
    }
}

/// Reconstructs a recording. Depth is held in `depth`; `callback` hears of every part of every window.
///
/// # Errors
/// As [`reconstruct`], or when the callback stops it.
pub fn reconstruct_recording(
    recording: &Recording,
    model: &Model,
    options: &ReconstructOptions,
    depth: DepthFrames,
    callback: &mut dyn FnMut(WindowProgress) -> Flow,
) -> Result<Reconstruction, ReconstructError> {
    let format = model.format().clone();
    let (inputs, targets) = (options.inputs_of(model), options.targets_of(model));
    let list = windows(recording.seconds, options.overlap)?;
    let follower = targets.iter().find(|target| follows_camera(target));
    if let Some(modality) = follower
        && list.len() > 1
        && !targets.iter().any(|target| target == CAMERA.name())
    {
        let modality = modality.clone();
        return Err(ReconstructError::NoCameraPath { modality });
    }
    let rate = format.video_rate;
    let frames = ((recording.seconds * rate - 1e-6).ceil() as usize).max(1);
    let mut assumptions = recording.assumptions.clone();
    assumptions.push(Fact {
        label: "Decoding".into(),
        value: format!(
            "`{}`, seed {}, windows of 2 s ({}), {} s in common",
            options.decoding_name,
            options.seed,
            list.len(),
            options.overlap
        ),
    });
    let mut badges = recording.badges.clone();
    assumptions.push(Fact {
        label: "Model".into(),
        value: trained_on(model, recording.is_synthetic()),
    });
    if is_out_of_place(model, recording) {
        badges.push(Badge {
            text: "model of another world".into(),
            tone: Tone::Warn,
        });
    }
    let anchor = match &options.anchor {
        None => None,
        Some(Anchor::Maps(path)) => Some(anchor::read(path, frames)?),
        Some(Anchor::Model(folder)) => {
            let labeller = DepthLabeller::open(folder, model.mget().compute())?;
            let name = labeller.network().settings().name();
            let name = name.unwrap_or("of other sizes");
            assumptions.push(Fact {
                label: "Anchor".into(),
                value: format!(
                    "metric depth by Video Depth Anything {name} ({})",
                    folder.display()
                ),
            });
            Some(recording.anchor(&labeller, rate, frames)?)
        }
    };
    let info = ReconstructionInfo {
        title: recording.title.clone(),
        start: recording.start(),
        video_rate: rate,
        frames,
        samples: samples_of(recording.seconds),
        intrinsics: recording.intrinsics,
        first: recording.first,
        floor_fit: options.floor.clone(),
        anchor,
        assumptions,
        badges,
        truth: recording.truth.clone(),
    };
    let mut builder = Builder::new(info, depth).with_format(&format);
    let request = GenerationRequest {
        inputs: &inputs,
        targets: &targets,
        decoding: &options.decoding,
        seed: options.seed,
    };
    let mut stream = recording.stream(&list, &format)?;
    for window in &list {
        let mut done = |part| {
            let progress = WindowProgress {
                part,
                window: window.index,
                windows: list.len(),
            };
            match callback(progress) {
                Flow::Continue => Ok(()),
                Flow::Stop => Err(ReconstructError::Stopped),
            }
        };
        let rgb = stream.window(window.index)?;
        done(Part::Read)?;
        let mut clip = Clip::empty(format!("{}/{:06}", recording.title, window.index), "video");
        clip.set(RGB, rgb.clone());
        let ids = [window.index as u64];
        let (made, samples) = if options.samples > 1 {
            model.predict_samples(&[clip], &ids, &request, options.samples)?
        } else {
            (model.predict(&[clip], &ids, &request)?, Vec::new())
        };
        done(Part::Decode)?;
        for one in made {
            builder.push(window, rgb.frames.view(), &one.clip, &one.certainty)?;
        }
        builder.push_samples(window, samples.iter().flatten().map(|one| &one.clip));
        done(Part::Stitch)?;
    }
    Ok(builder.finish()?)
}
