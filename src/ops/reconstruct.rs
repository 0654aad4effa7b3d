//! `op: reconstruct`: one video of any length, or one stored clip, becomes a reconstruction folder (Sec. 4.1, Supp. C and D).
//!
//! The artifact holds one folder, `reconstruction`, as [`crate::reconstruction::folder`] writes it: arrays, exports, manifest
//! and page.

mod run;

use super::device::{SMALLER_FORWARD, memory_is_full};
use super::predict::{artifact, takes_pixels};
use crate::decoding::DecodingSettings;
use crate::engine::{DeviceChoice, Precision};
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, FileInput, FilePath, Inputs, Op, OpEntry, Port,
    Problem, StageContext, StageError, StagePlan,
};
use crate::masking::PIXELS;
use crate::reconstruction::camera::CameraSettings;
use crate::reconstruction::floor::FloorFit;
use crate::reconstruction::windows::windows;
use crate::video::VideoSettings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::PathBuf;

/// Settings of [`Reconstruct`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReconstructSettings {
    /// The video, or a folder of pictures; absent: a clip of the stage in `clips`.
    pub video: Option<FilePath>,
    /// How the video is read.
    pub reading: VideoSettings,
    /// Seconds of the video that are left out at its start.
    #[schemars(range(min = 0.0))]
    pub start: f64,
    /// At most so many seconds; absent: to the end.
    #[schemars(range(min = 0.0))]
    pub seconds: Option<f64>,
    /// The split of the clip.
    pub split: String,
    /// The number of the clip.
    pub clip: usize,
    /// A model folder that no stage makes.
    pub model_folder: Option<FilePath>,
    /// What of the video the model is conditioned on: `rgb` is its tokens, and raw video where the model takes it; `pixels` is raw video
    /// alone. Empty means `rgb`, or `pixels` for a model without tokens of video.
    pub inputs: Vec<String>,
    /// What is generated; empty means everything but `rgb`.
    pub targets: Vec<String>,
    /// How tokens are generated.
    pub decoding: Entry<DecodingSettings>,
    /// How many samples are written beside the reconstruction, each from a seed of its own, with their spread; 1 writes none.
    #[schemars(range(min = 1, max = 64))]
    pub samples: usize,
    /// Seconds that neighbouring windows of two seconds have in common: 0.5, 1 or 1.5.
    pub overlap: f64,
    /// The camera, as far as it is known.
    pub camera: CameraSettings,
    /// How depth becomes metric from the floor.
    pub floor: FloorFit,
    /// Metric depth of another model at the frames of the model's video, instead of the floor: npz, or a folder of EXR or
    /// 16-bit PNG (millimetres).
    pub anchor: Option<FilePath>,
    /// The folder of a metric depth network (`reviv import --depth metric`) that makes the anchor from the video itself.
    pub anchor_model: Option<FilePath>,
    /// Where the models run.
    pub device: DeviceChoice,
    /// What operands of the transformer's products are rounded to.
    pub precision: Precision,
}

impl Default for ReconstructSettings {
    fn default() -> Self {
        Self {
            video: None,
            reading: VideoSettings::default(),
            start: 0.0,
            seconds: None,
            split: "test".to_owned(),
            clip: 0,
            model_folder: None,
            inputs: Vec::new(),
            targets: Vec::new(),
            decoding: Entry {
                name: "fast".to_owned(),
                settings: DecodingSettings::default(),
            },
            samples: 1,
            overlap: 1.0,
            camera: CameraSettings::default(),
            floor: FloorFit::default(),
            anchor: None,
            anchor_model: None,
            device: DeviceChoice::CPU,
            precision: Precision::F32,
        }
    }
}

/// The op.
#[derive(Debug)]
pub struct Reconstruct;
inventory::submit! { OpEntry(&Reconstruct) }

impl Op for Reconstruct {
    type Settings = ReconstructSettings;

    fn name(&self) -> &'static str {
        "reconstruct"
    }

    fn version(&self) -> u32 {
        8
    }

    fn about(&self) -> &'static str {
        "Reconstructs the wearer and the world from one video: arrays, exports and a page."
    }

    fn inputs(&self) -> &'static [Port] {
        &[
            Port {
                name: "model",
                kinds: &[ArtifactKind::Mget],
                arity: Arity::Optional,
                about: "the model, with its tokenizers; or name a folder in `model_folder`",
            },
            Port {
                name: "clips",
                kinds: &[ArtifactKind::Clips],
                arity: Arity::Optional,
                about: "where the clip is, when there is no `video`; its truth is shown beside the prediction",
            },
        ]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Export
    }

    fn files(&self, settings: &ReconstructSettings) -> Vec<FileInput> {
        [
            ("video", &settings.video),
            ("anchor", &settings.anchor),
            ("anchor_model", &settings.anchor_model),
            ("model_folder", &settings.model_folder),
        ]
        .into_iter()
        .filter_map(|(key, path)| {
            Some(FileInput {
                key: key.to_owned(),
                path: path.as_ref()?.0.clone().into(),
            })
        })
        .collect()
    }

    fn check(
        &self,
        settings: &ReconstructSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let model = inputs.one("model");
        match (model, &settings.model_folder) {
            (None, None) => problems.push(
                Problem::new(Code::E0301, "model", "no model")
                    .help("name a stage in `model`, or a folder in `model_folder`"),
            ),
            (Some(_), Some(_)) => problems.push(
                Problem::new(Code::E0301, "model_folder", "two models")
                    .help("leave out `model` or `model_folder`"),
            ),
            _ => {}
        }
        if settings.anchor.is_some() && settings.anchor_model.is_some() {
            problems.push(
                Problem::new(Code::E0301, "anchor_model", "two anchors")
                    .help("leave out `anchor` or `anchor_model`"),
            );
        }
        let clips = inputs.one("clips");
        match (clips, &settings.video) {
            (None, None) => problems.push(
                Problem::new(Code::E0301, "video", "nothing to reconstruct")
                    .help("name a file in `video`, or a stage in `clips`"),
            ),
            (Some(_), Some(_)) => problems.push(
                Problem::new(Code::E0301, "video", "a video and clips")
                    .help("leave out `video` or `clips`"),
            ),
            _ => {}
        }
        if let Some(&count) = clips.and_then(|clips| clips.clips.get(&settings.split))
            && settings.clip as u64 >= count
        {
            problems.push(Problem::new(
                Code::E0202,
                "clip",
                format!("split `{}` has {count} clips", settings.split),
            ));
        }
        if let Some(model) = model {
            let known: Vec<&str> = model.tokens.keys().map(String::as_str).collect();
            for (index, name) in settings.targets.iter().enumerate() {
                if !known.contains(&name.as_str()) {
                    problems.push(
                        Problem::new(
                            Code::E0203,
                            format!("targets.{index}"),
                            format!("the model has no modality `{name}`"),
                        )
                        .help(format!("it has: {}", known.join(", "))),
                    );
                }
            }
        }
        for (index, name) in settings.inputs.iter().enumerate() {
            let wrong = if name != "rgb" && name != PIXELS {
                Some((
                    format!("a video has no `{name}`"),
                    "it has `rgb` and `pixels`",
                ))
            } else if name == PIXELS && model.is_some_and(|model| !takes_pixels(model)) {
                Some(("the model takes no raw video".to_owned(), "give it `rgb`"))
            } else {
                None
            };
            if let Some((message, help)) = wrong {
                problems
                    .push(Problem::new(Code::E0203, format!("inputs.{index}"), message).help(help));
            }
        }
        if let Err(error) = windows(1.0, settings.overlap) {
            problems.push(Problem::new(Code::E0202, "overlap", error.to_string()));
        }
        if let Err(error) = settings.camera.first_pose() {
            problems.push(Problem::new(Code::E0202, "camera.up", error.to_string()));
        }
        Description::default()
    }

    fn plan(&self, _settings: &ReconstructSettings, _inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        StagePlan::default()
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        memory_is_full(text, SMALLER_FORWARD)
    }

    fn run(
        &self,
        settings: &ReconstructSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let _memory = crate::engine::memory::Stage;
        let model = match &settings.model_folder {
            Some(folder) => PathBuf::from(&folder.0),
            None => artifact(context, "model")?.path.clone(),
        };
        run::run(settings, &model, context)
    }
}
