//! `op: label_depth`: clips without depth get pseudo labels from a depth network (Sec. 3.1).
//!
//! The frames of a clip are a video of their own. Measured depth is kept unless it is to be replaced. What the labels are of
//! (the network's kind, size and hash) stands in the artifact, and the clips' coding of depth follows the kind. Several ranks label a
//! shard each at a time.

use super::clip_signals::{SPLITS, damaged, described_format, format};
use super::clips::shape_of;
use super::device::{compute, memory_is_full};
use super::together::{in_rounds, unseen};
use crate::clip::depth_video::{DepthCoding, DepthKind, DepthRange};
use crate::datasets::ClipSource;
use crate::datasets::convert::{ConvertSettings, Share, convert, whole};
use crate::datasets::shards::{ShardClips, TarSink};
use crate::engine::{Communicator, DeviceChoice, Precision};
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, FileInput, FilePath, Inputs, Op, OpEntry, Port,
    Problem, SignalFacts, StageContext, StageError, StagePlan,
};
use crate::labelling::clips::LabelledClips;
use crate::labelling::{DepthLabelKind, DepthLabeller, LabelOptions, stored};
use crate::modality::{self, ClipFormat};
use crate::run::files::size_below;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::ops::ControlFlow;
use std::path::Path;

/// Where the markers of finished shards are while a stage runs.
const MARKERS: &str = "depth_finished";
const SHARDS: &str = "depth";

/// Settings of [`LabelDepth`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LabelDepthSettings {
    /// The folder of a depth network, as `reviv import --depth KIND` makes it.
    pub network: FilePath,
    /// Pixels of the shorter side as the network sees it.
    #[serde(default = "input_size")]
    #[schemars(range(min = 14, max = 4096))]
    pub input_size: usize,
    /// Label clips that have depth too, in place of what they have.
    #[serde(default)]
    pub replace: bool,
    /// How the labels become video; left out, as the paper's: relative labels as disparity between the clip's extremes, metric
    /// ones as depth from 0 to 15 m.
    #[serde(default)]
    pub depth: Option<DepthCoding>,
    /// Where the network runs.
    #[serde(default)]
    pub device: DeviceChoice,
}

fn input_size() -> usize {
    LabelOptions::default().input_size
}

impl LabelDepthSettings {
    fn coding(&self, kind: DepthLabelKind) -> DepthCoding {
        self.depth.unwrap_or(match kind {
            DepthLabelKind::Relative => DepthCoding::relative(),
            DepthLabelKind::Metric => DepthCoding::metric(),
        })
    }
}

/// The op.
#[derive(Debug)]
pub struct LabelDepth;
inventory::submit! { OpEntry(&LabelDepth) }

impl Op for LabelDepth {
    type Settings = LabelDepthSettings;

    fn name(&self) -> &'static str {
        "label_depth"
    }

    fn version(&self) -> u32 {
        1
    }

    fn about(&self) -> &'static str {
        "Gives clips pseudo labels of depth, by imported weights of Video Depth Anything."
    }

    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "clips",
            kinds: &[ArtifactKind::Clips],
            arity: Arity::One,
            about: "what to label",
        }]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Clips
    }

    fn seeded(&self) -> bool {
        false
    }

    fn together(&self) -> bool {
        true
    }

    fn files(&self, settings: &LabelDepthSettings) -> Vec<FileInput> {
        let path: &Path = settings.network.as_ref();
        // A folder that is not there is refused by `check`, once.
        path.exists()
            .then(|| FileInput {
                key: "network".to_owned(),
                path: path.to_owned(),
            })
            .into_iter()
            .collect()
    }

    fn check(
        &self,
        settings: &LabelDepthSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let found = stored::described(settings.network.as_ref());
        if let Err(error) = &found {
            problems.push(
                Problem::new(Code::E0601, "network", error.to_string())
                    .help("`reviv import FILE --depth relative|metric -o DIR` makes a folder of the released file"),
            );
        }
        let Some(clips) = inputs.one("clips") else {
            return Description::default();
        };
        if !clips.signals.is_empty() && !clips.signals.contains_key("rgb") {
            problems.push(Problem::new(
                Code::E0401,
                "clips",
                "the clips have no `rgb` to label",
            ));
        }
        let mut description = clips.clone();
        let Ok((kind, _)) = found else {
            return description;
        };
        let coding = settings.coding(kind);
        if let Some(reason) = coding.problem() {
            problems.push(Problem::new(Code::E0206, "depth", reason));
        }
        if kind == DepthLabelKind::Relative && coding.range == DepthRange::Fixed {
            problems.push(Problem::new(
                Code::E0206,
                "depth.range",
                "labels of a relative network have no metres: `range: clip_minmax` suits them",
            ));
        }
        if let Some(format) = described_format(clips) {
            let format = ClipFormat {
                depth: coding,
                ..format
            };
            for modality in modality::all(&format) {
                if modality.name() == "depth" {
                    let facts = SignalFacts {
                        shape: shape_of(modality.as_ref()),
                        rate: modality.rate(),
                    };
                    description.signals.insert("depth".to_owned(), facts);
                }
            }
            description.extra.insert("format".to_owned(), json!(format));
        }
        description
    }

    fn plan(&self, settings: &LabelDepthSettings, inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let clips = inputs
            .one("clips")
            .map_or(0, |clips| clips.clips.values().sum());
        StagePlan {
            work: Some((clips, "clips".to_owned())),
            memory: size_below(settings.network.as_ref())
                .ok()
                .map(|bytes| bytes + (1 << 30)),
            ..StagePlan::default()
        }
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        let lower = "lower `input_size`, end what else runs on the device, or take `device: cpu`";
        memory_is_full(text, lower)
    }

    fn run(
        &self,
        settings: &LabelDepthSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let clips = context
            .inputs("clips")
            .first()
            .cloned()
            .ok_or_else(|| damaged("no clips arrived"))?;
        let folder: &Path = settings.network.as_ref();
        let refused = |error: &dyn std::fmt::Display| StageError::Input {
            code: Code::E0601,
            message: error.to_string(),
            help: String::new(),
        };
        let compute = compute(settings.device, Precision::F32, context)?;
        let labeller = DepthLabeller::open(folder, &compute).map_err(|error| refused(&error))?;
        let kind = labeller.kind();
        let format = ClipFormat {
            depth: settings.coding(kind),
            ..format(&clips)?
        };
        let options = LabelOptions {
            input_size: settings.input_size,
        };
        let mut sources = Vec::new();
        for split in SPLITS {
            let path = clips.path.join(split);
            if path.is_dir() {
                let source =
                    ShardClips::open(&path).map_err(|error| damaged(&error.to_string()))?;
                sources.push((split, source));
            }
        }
        let total: u64 = sources.iter().map(|(_, source)| source.len() as u64).sum();
        let how = ConvertSettings {
            clips_per_shard: 32,
            skip_damaged: false,
        };
        let ranks = Communicator::world();
        let mut labelled = Vec::new();
        let mut pieces = Vec::new();
        for (split, source) in sources {
            let source = LabelledClips::new(
                source,
                labeller.clone(),
                options,
                Some(format.clone()),
                settings.replace,
            );
            let shards = context.checkpoints().join(SHARDS).join(split);
            let markers = context.checkpoints().join(MARKERS).join(split);
            let sink = TarSink::new(&shards, &markers).map_err(|error| refused(&error))?;
            let count = source.len().div_ceil(how.clips_per_shard);
            pieces.extend((0..count).map(|shard| (labelled.len(), Share::new(shard, count))));
            labelled.push((split, source, sink, count));
        }
        let mut done = 0;
        in_rounds(&ranks, pieces.len(), context, |index, context| {
            let (place, share) = pieces[index];
            let (_, source, sink, _) = &labelled[place];
            let mut own = 0;
            let converted = convert(source, sink, &how, share, &mut |progress| {
                own = progress.done as u64;
                let others = ranks.size() as u64;
                context.progress((done + own * others).min(total), total, "clips");
                if context.interrupted() {
                    return ControlFlow::Break(());
                }
                ControlFlow::Continue(())
            })
            .map_err(|error| refused(&error))?;
            if converted.interrupted {
                return Err(StageError::Interrupted);
            }
            // About: the others are as far.
            done += own * ranks.size() as u64;
            Ok(())
        })?;
        if !ranks.is_root() {
            return Ok(Value::Null);
        }
        let mut splits = serde_json::Map::new();
        for (split, source, sink, shards) in &labelled {
            let tally = whole(source.len(), sink, &how)
                .ok_or_else(|| unseen(&context.checkpoints().join(MARKERS).join(split)))?;
            splits.insert(
                (*split).to_owned(),
                json!({ "clips": tally.clips, "shards": shards }),
            );
        }
        for split in splits.keys() {
            let from = context.checkpoints().join(SHARDS).join(split);
            let to = context.output().join(split);
            crate::run::files::copy_tree(&from, &to).map_err(StageError::other)?;
        }
        let sha256 = stored::fingerprint(folder).map_err(|error| refused(&error))?;
        let mut contents = clips.contents.as_object().cloned().unwrap_or_default();
        contents.insert("format".to_owned(), json!(format));
        contents.insert("splits".to_owned(), Value::Object(splits));
        contents.insert(
            "depth_labels".to_owned(),
            json!({
                "kind": kind,
                "quantity": match format.depth.depth_kind {
                    DepthKind::Depth => "depth",
                    DepthKind::Disparity => "disparity",
                },
                "network": labeller.network().settings().name(),
                "weights_sha256": sha256,
                "input_size": settings.input_size,
                "precision": "f32",
                "per_clip": true,
                "replaced_measured": settings.replace,
            }),
        );
        Ok(Value::Object(contents))
    }
}
