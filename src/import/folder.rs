//! Our folder of a model: which file every part becomes, as [`crate::mget::Mget::open`] and [`crate::tokenizer::open()`] read
//! it.
//!
//! ```text
//! DIR/mget.json  weights.safetensors               the transformer
//! DIR/tokenizers/camera/tokenizer.safetensors      weights and statistics of one modality, in one file
//! DIR/model.json                                   which clips it takes, and which tokenizers belong to it
//! DIR/weights.safetensors                          a depth network or a motion encoder, alone in its folder
//! DIR/manifest.json                                every input with its SHA-256, every entry with what became of it
//! ```

use super::ImportError;
use super::part::{Part, Tensor, Values};
use super::statistics::Statistics;
use crate::clip::clock;
use crate::clip::depth_video::DepthCoding;
use crate::engine::{Compute, Initialise, Parameters};
use crate::evaluation::tmr::features::FEATURES;
use crate::evaluation::tmr::{MotionEncoder, MotionEncoderSettings, stored as tmr};
use crate::labelling::{self, DepthLabelKind, DepthNetwork, NetworkSettings};
use crate::masking::PIXELS;
use crate::mget::stored::{SPEC, WEIGHTS};
use crate::mget::{Input, MgetSpec, ModalitySpec};
use crate::modality::{ClipFormat, Shape};
use crate::tokenizer::trained::{DEVIATION, FILE, MEAN, VqTokenizer};
use crate::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use crate::tokenizer::vq::{VqSettings, VqVae};
use serde_json::Value;
use std::collections::BTreeMap;

/// One file of weights to write, with what stands beside and in it.
pub(super) struct Model {
    /// `mget`, or the modality of a tokenizer.
    pub name: String,
    /// Below the model's folder, with `/`.
    pub folder: String,
    pub file: &'static str,
    pub metadata: BTreeMap<String, String>,
    pub more: BTreeMap<String, Tensor>,
    /// Another file of the folder.
    pub beside: Option<(&'static str, Vec<u8>)>,
    pub settings: Value,
    pub statistics: Option<Statistics>,
    /// Frames, height and width that a video tokenizer takes.
    pub clip: Option<[usize; 3]>,
}

impl Model {
    /// The tokenizer of `modality`.
    fn tokenizer(modality: &str, metadata: BTreeMap<String, String>, settings: Value) -> Self {
        Self {
            name: modality.to_owned(),
            folder: format!("tokenizers/{modality}"),
            file: FILE,
            metadata,
            more: BTreeMap::new(),
            beside: None,
            settings,
            statistics: None,
            clip: None,
        }
    }
}

/// The clips of a set: of the size that its tokenizer of RGB takes, else that of its raw video, else the paper's. With the video
/// tokenizer of the 512 pathway they are that pathway's, whose depth is in metres.
pub(super) fn clips<'a>(spec: &MgetSpec, models: impl Iterator<Item = &'a Model>) -> ClipFormat {
    let mut rgb = None;
    for model in models {
        match model.name.as_str() {
            "rgb_512" if model.clip.is_some() => {
                return ClipFormat {
                    depth: DepthCoding::metric(),
                    ..sized(model.clip, ClipFormat::default())
                };
            }
            "rgb" => rgb = Some(model),
            _ => {}
        }
    }
    let pixels = spec
        .modalities
        .iter()
        .find_map(|modality| match modality.input {
            Input::Pixels { clip, .. } if modality.name == PIXELS => {
                Some([clip[0], clip[1], clip[2]])
            }
            _ => None,
        });
    let clip = rgb.and_then(|model| model.clip).or(pixels);
    sized(clip, ClipFormat::default())
}

/// Clips of two seconds with video of `clip` frames, height and width.
fn sized(clip: Option<[usize; 3]>, format: ClipFormat) -> ClipFormat {
    match clip {
        Some([frames, size, _]) => ClipFormat {
            frames,
            size,
            video_rate: frames as f64 / clock::CLIP_SECONDS,
            ..format
        },
        None => format,
    }
}

/// The transformer.
pub(super) fn transformer(part: &Part) -> Result<(Model, MgetSpec), ImportError> {
    let source = part.first();
    let spec: MgetSpec = serde_json::from_value(source.plan.settings.clone())
        .map_err(|e| source.refuse(format!("incomplete model: {e}")))?;
    spec.check().map_err(|e| source.refuse(e.to_string()))?;
    part.complete(&spec.parameters().into_iter().collect())?;
    let text = serde_json::to_vec_pretty(&spec).map_err(|e| source.refuse(e.to_string()))?;
    let model = Model {
        name: "mget".to_owned(),
        folder: String::new(),
        file: WEIGHTS,
        metadata: BTreeMap::new(),
        more: BTreeMap::new(),
        beside: Some((SPEC, text)),
        settings: source.plan.settings.clone(),
        statistics: None,
        clip: None,
    };
    Ok((model, spec))
}

/// The tokenizer of camera, gaze, hands or body; without statistics it is written, but cannot be opened.
pub(super) fn signals(part: &Part, statistics: Option<Statistics>) -> Result<Model, ImportError> {
    let source = part.first();
    let refuse = |reason: String| source.refuse(reason);
    let settings: VqSettings = serde_json::from_value(source.plan.settings.clone())
        .map_err(|e| refuse(format!("incomplete model: {e}")))?;
    let conv = source.checkpoint.find("encoder.conv.weight");
    let channels = conv.map_or(0, |conv| source.checkpoint.entries()[conv].shape()[1]);
    let grid = source.plan.grid.as_deref().unwrap_or_default();
    let shape = match (grid, settings.compression.as_slice()) {
        ([rows], [time]) => Shape::Temporal {
            samples: rows * time,
            channels,
        },
        ([rows, columns], [time, joints]) => Shape::Kinematic {
            samples: rows * time,
            joints: columns * joints,
        },
        _ => return Err(refuse("its position tables are missing".to_owned())),
    };
    let compute = Compute::cpu();
    let planned = VqVae::new(&Initialise::meta(&compute), &settings, &shape)
        .map_err(|e| refuse(e.to_string()))?;
    part.complete(&shapes(&planned))?;
    let modality = source.plan.part.as_str();
    let metadata = VqTokenizer::describe(modality, &shape, &settings);
    let mut model = Model::tokenizer(modality, metadata, source.plan.settings.clone());
    if let Some(statistics) = statistics {
        let expected = planned.patches().values_per_sample();
        if statistics.mean.len() != expected {
            let found = statistics.mean.len();
            return Err(refuse(format!(
                "its samples have {expected} values, its statistics {found}"
            )));
        }
        for (name, values) in [
            (MEAN, statistics.mean.clone()),
            (DEVIATION, statistics.deviation.clone()),
        ] {
            let tensor = Tensor {
                shape: vec![values.len()],
                values: Values::Given(values),
            };
            model.more.insert(name.to_owned(), tensor);
        }
        if !statistics.sha256.is_empty() {
            let files = statistics.sha256.join(" ");
            model.metadata.insert("statistics_sha256".to_owned(), files);
        }
        model.statistics = Some(statistics);
    }
    Ok(model)
}

/// Video tokenizers: the same weights for RGB and depth, of the pathway that the transformer has for them.
pub(super) fn video(
    part: &Part,
    spec: Option<&MgetSpec>,
    clip: Option<[usize; 3]>,
) -> Result<Vec<Model>, ImportError> {
    let source = part.first();
    let refuse = |reason: String| source.refuse(reason);
    let settings: VideoSettings = serde_json::from_value(source.plan.settings.clone())
        .map_err(|e| refuse(format!("incomplete model: {e}")))?;
    let compute = Compute::cpu();
    let planned =
        Network::new(&Initialise::meta(&compute), &settings).map_err(|e| refuse(e.to_string()))?;
    for side in ["encoder", "decoder"] {
        if !part.tensors.keys().any(|name| name.starts_with(side)) {
            return Err(refuse(format!("give the {side} of this tokenizer too")));
        }
    }
    part.complete(&shapes(&planned))?;
    let wide = settings.temporal > VideoSettings::default().temporal;
    let wanted = match spec {
        // Without a transformer they are for one's own clips.
        None => {
            let clip = clip.unwrap_or_else(|| default_clip(&settings));
            vec![("rgb".to_owned(), clip), ("depth".to_owned(), clip)]
        }
        Some(spec) => {
            let takes = |m: &&ModalitySpec| {
                m.vocabulary().is_some() && m.grid().len() == 3 && m.name.ends_with("_512") == wide
            };
            let modalities = spec.modalities.iter().filter(takes);
            modalities
                .map(|m| (m.name.clone(), clip_of(&m.grid(), &settings)))
                .collect()
        }
    };
    if wanted.is_empty() {
        return Err(refuse(format!(
            "the transformer has no modality of video at {0}x{1}x{1} pixels per token: leave this tokenizer out",
            settings.temporal, settings.spatial
        )));
    }
    let model = |(modality, clip): (String, [usize; 3])| {
        let metadata = VideoTokenizer::describe(&modality, clip, &settings);
        Model {
            clip: Some(clip),
            ..Model::tokenizer(&modality, metadata, source.plan.settings.clone())
        }
    };
    Ok(wanted.into_iter().map(model).collect())
}

/// Weights that are a folder of their own.
fn folder_of_its_own(part: &Part, file: &'static str, metadata: BTreeMap<String, String>) -> Model {
    let plan = &part.first().plan;
    Model {
        name: plan.part.clone(),
        folder: String::new(),
        file,
        metadata,
        more: BTreeMap::new(),
        beside: None,
        settings: plan.settings.clone(),
        statistics: None,
        clip: None,
    }
}

/// A depth network, with the kind that it was said to be and its sizes.
pub(super) fn depth_network(
    part: &Part,
) -> Result<(Model, DepthLabelKind, NetworkSettings), ImportError> {
    let source = part.first();
    let refuse = |reason: String| source.refuse(reason);
    let settings = &source.plan.settings;
    let kind: DepthLabelKind =
        serde_json::from_value(settings["kind"].clone()).map_err(|e| refuse(e.to_string()))?;
    let network: NetworkSettings =
        serde_json::from_value(settings["network"].clone()).map_err(|e| refuse(e.to_string()))?;
    let compute = Compute::cpu();
    let planned = DepthNetwork::new(&Initialise::meta(&compute), &network)
        .map_err(|e| refuse(e.to_string()))?;
    part.complete(&shapes(&planned))?;
    let metadata = labelling::stored::describe(kind, &network);
    let model = folder_of_its_own(part, labelling::stored::FILE, metadata);
    Ok((model, kind, network))
}

/// TMR's motion encoder with its statistics.
pub(super) fn motion_encoder(part: &Part) -> Result<Model, ImportError> {
    let source = part.first();
    let refuse = |reason: String| source.refuse(reason);
    if source.plan.settings.is_null() {
        return Err(refuse(
            "statistics without their encoder; give `motion_encoder.pt` too".to_owned(),
        ));
    }
    let settings: MotionEncoderSettings =
        serde_json::from_value(source.plan.settings.clone()).map_err(|e| refuse(e.to_string()))?;
    let compute = Compute::cpu();
    let planned = MotionEncoder::new(&Initialise::meta(&compute), &settings).map_err(&refuse)?;
    let mut expected = shapes(&planned);
    for (name, file) in [(tmr::MEAN, "mean.pt"), (tmr::DEVIATION, "std.pt")] {
        if !part.tensors.contains_key(name) {
            return Err(refuse(format!(
                "its statistics are missing: give `{file}` of `stats/humanml3d/guoh3dfeats` in TMR's repository too"
            )));
        }
        expected.insert(name.to_owned(), vec![FEATURES]);
    }
    part.complete(&expected)?;
    Ok(folder_of_its_own(part, tmr::FILE, tmr::describe(&settings)))
}

/// Frames, height and width of the clips that become a grid of tokens.
fn clip_of(grid: &[usize], settings: &VideoSettings) -> [usize; 3] {
    [
        (grid[0].max(2) - 1) * settings.temporal,
        grid[1] * settings.spatial,
        grid[2] * settings.spatial,
    ]
}

/// Two seconds in 5 x 32 x 32 tokens, as the releases have them.
fn default_clip(settings: &VideoSettings) -> [usize; 3] {
    clip_of(&[5, 32, 32], settings)
}

/// Names and shapes of a model that is only looked at.
fn shapes(model: &impl Parameters) -> BTreeMap<String, Vec<usize>> {
    let all = model.inventory().into_iter();
    all.map(|(name, shape, _)| (name, shape)).collect()
}
