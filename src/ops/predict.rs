//! `op: predict`: a model generates the modalities that are not its inputs, for every clip of a split (Supp. C).
//!
//! Writes a folder of [`crate::reconstruction::predictions`]: decoded signals with a certainty per sample, and beside it the
//! reconstruction bound: the clips' own signals after a round trip through the model's tokenizers. Several ranks predict a batch each at a
//! time.

use super::device::{SMALLER_FORWARD, compute, memory_is_full};
use super::together::in_rounds;
use crate::clip::Clip;
use crate::clip::store::ClipSet;
use crate::decoding::DecodingSettings;
use crate::engine::{Communicator, DeviceChoice, Precision};
use crate::evaluation::runtime::runtime;
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, InputArtifact, Inputs, Op, OpEntry, Port,
    Problem, StageContext, StageError, StagePlan,
};
use crate::masking::PIXELS;
use crate::mget::MgetSpec;
use crate::model::{GenerationRequest, Model, ModelError};
use crate::reconstruction::predictions::{
    PredictedClip, PredictionsWriter, RECONSTRUCTION_BOUND, ScaleStatus, SignalNote, sample_folder,
};
use crate::run::environment::Stopwatch;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Clips that go through the model at once.
const BATCH: usize = 8;

/// By modality, one value per sample.
type Certainty = BTreeMap<String, Vec<f32>>;

/// Settings of [`Predict`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PredictSettings {
    /// Modalities the model is conditioned on: `rgb` is the video's tokens, and raw video where the model takes it; `pixels` is raw video
    /// alone.
    pub inputs: Vec<String>,
    /// Modalities it generates; empty means all others.
    pub targets: Vec<String>,
    /// How tokens are generated.
    pub decoding: Entry<DecodingSettings>,
    /// Which clips.
    pub split: String,
    /// At most this many clips, the first ones; absent means all.
    #[schemars(range(min = 1))]
    pub limit: Option<usize>,
    /// Also write the reconstruction bound, which `evaluate` shows beside every metric.
    pub reconstruction_bound: bool,
    /// Where the model runs.
    pub device: DeviceChoice,
    /// How many samples are written beside the predictions, each from a seed of its own; `evaluate` shows one, the mean score and the
    /// best of them. 1 writes none.
    #[schemars(range(min = 1, max = 64))]
    pub samples: usize,
    /// What operands of the transformer's products are rounded to.
    pub precision: Precision,
}

impl Default for PredictSettings {
    fn default() -> Self {
        Self {
            inputs: vec!["rgb".to_owned()],
            targets: Vec::new(),
            decoding: Entry {
                name: "fast".to_owned(),
                settings: DecodingSettings::default(),
            },
            split: "test".to_owned(),
            limit: None,
            reconstruction_bound: true,
            device: DeviceChoice::CPU,
            samples: 1,
            precision: Precision::F32,
        }
    }
}

/// The op.
#[derive(Debug)]
pub struct Predict;
inventory::submit! { OpEntry(&Predict) }

/// The signal of a clip that a modality of a model is made of.
fn signal_of(name: &str) -> &str {
    if name == PIXELS { "rgb" } else { name }
}

/// Whether a model takes raw video.
pub(super) fn takes_pixels(model: &Description) -> bool {
    let spec = model.extra.get("mget").cloned();
    spec.and_then(|spec| serde_json::from_value::<MgetSpec>(spec).ok())
        .is_some_and(|spec| spec.index(PIXELS).is_some())
}

impl PredictSettings {
    /// The modalities to generate, of those the model knows.
    fn targets<'a>(&self, known: impl Iterator<Item = &'a str>) -> Vec<String> {
        known
            .filter(|name| *name != PIXELS && !self.inputs.iter().any(|input| input == name))
            .filter(|name| self.targets.is_empty() || self.targets.iter().any(|w| w == name))
            .map(ToOwned::to_owned)
            .collect()
    }
}

impl Op for Predict {
    type Settings = PredictSettings;

    fn name(&self) -> &'static str {
        "predict"
    }

    fn version(&self) -> u32 {
        6
    }

    fn together(&self) -> bool {
        true
    }

    fn about(&self) -> &'static str {
        "Generates the modalities that are not inputs, for the clips of a split."
    }

    fn inputs(&self) -> &'static [Port] {
        &[
            Port {
                name: "model",
                kinds: &[ArtifactKind::Mget],
                arity: Arity::One,
                about: "the model, with its tokenizers",
            },
            Port {
                name: "clips",
                kinds: &[ArtifactKind::Clips],
                arity: Arity::One,
                about: "the clips whose given modalities it sees",
            },
        ]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Predictions
    }

    fn check(
        &self,
        settings: &PredictSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let (Some(model), Some(clips)) = (inputs.one("model"), inputs.one("clips")) else {
            return Description::default();
        };
        let known: Vec<&str> = model.tokens.keys().map(String::as_str).collect();
        for (key, names) in [("inputs", &settings.inputs), ("targets", &settings.targets)] {
            for (index, name) in names.iter().enumerate() {
                let video = key == "inputs" && name == PIXELS && takes_pixels(model);
                if !video && !known.contains(&name.as_str()) {
                    problems.push(
                        Problem::new(
                            Code::E0203,
                            format!("{key}.{index}"),
                            format!("the model has no modality `{name}`"),
                        )
                        .help(format!("it has: {}", known.join(", "))),
                    );
                }
            }
        }
        for (index, name) in settings.inputs.iter().enumerate() {
            let signal = signal_of(name);
            if !clips.signals.is_empty() && !clips.signals.contains_key(signal) {
                problems.push(Problem::new(
                    Code::E0203,
                    format!("inputs.{index}"),
                    format!("the clips have no `{signal}`"),
                ));
            }
        }
        if clips.clips.get(&settings.split).is_none_or(|&n| n == 0) && !clips.clips.is_empty() {
            problems.push(Problem::new(
                Code::E0206,
                "split",
                format!("the clips have no split `{}`", settings.split),
            ));
        }
        let targets = settings.targets(known.into_iter());
        if targets.is_empty() {
            problems.push(Problem::new(
                Code::E0206,
                "targets",
                "nothing is left to generate",
            ));
        }
        Description {
            clips: clips
                .clips
                .iter()
                .filter(|(split, _)| **split == settings.split)
                .map(|(split, &n)| {
                    (
                        split.clone(),
                        n.min(settings.limit.map_or(u64::MAX, |l| l as u64)),
                    )
                })
                .collect(),
            signals: clips
                .signals
                .iter()
                .filter(|(name, _)| targets.contains(name))
                .map(|(name, facts)| (name.clone(), facts.clone()))
                .collect(),
            ..Description::default()
        }
    }

    fn plan(&self, settings: &PredictSettings, inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let clips = inputs
            .one("clips")
            .and_then(|c| c.clips.get(&settings.split))
            .copied();
        StagePlan {
            work: clips.map(|n| {
                (
                    n.min(settings.limit.map_or(u64::MAX, |l| l as u64)),
                    "clips".to_owned(),
                )
            }),
            ..StagePlan::default()
        }
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        memory_is_full(text, SMALLER_FORWARD)
    }

    fn run(
        &self,
        settings: &PredictSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let _memory = crate::engine::memory::Stage;
        let compute = compute(settings.device, settings.precision, context)?;
        let model = artifact(context, "model")?;
        let model = Model::open(&model.path, &compute).map_err(refused)?;
        let root = artifact(context, "clips")?.path.join(&settings.split);
        let clips = ClipSet::open(&root).map_err(StageError::other)?;
        let total = clips.len().min(settings.limit.unwrap_or(usize::MAX));
        let targets = settings.targets(model.names());
        let request = GenerationRequest {
            inputs: &settings.inputs,
            targets: &targets,
            decoding: &settings.decoding.settings,
            seed: context.seed(),
        };
        let notes = notes(&model, &targets).map_err(refused)?;
        let create = |folder: &Path, system: &str| {
            PredictionsWriter::create(folder, system, notes.clone()).map_err(StageError::other)
        };
        // The predictions themselves, the reconstruction bound, and the samples; folders of one form.
        let mut writers = vec![create(context.output(), "reviv")?];
        if settings.reconstruction_bound {
            let folder = context.output().join(RECONSTRUCTION_BOUND);
            writers.push(create(&folder, "reconstruction bound")?);
        }
        let samples = if settings.samples > 1 {
            settings.samples
        } else {
            0
        };
        let first_sample = writers.len();
        for n in 0..samples {
            writers.push(create(&sample_folder(context.output(), n), "sample")?);
        }
        let mut read: Vec<&str> = settings.inputs.iter().map(|name| signal_of(name)).collect();
        if settings.reconstruction_bound {
            read.extend(targets.iter().map(String::as_str));
        }
        let mut times = Times::default();
        let ranks = Communicator::world();
        // By batch, of those that are this rank's: what the index of every writer says of its clips.
        let mut made: Vec<Vec<Vec<PredictedClip>>> = Vec::new();
        in_rounds(&ranks, total.div_ceil(BATCH), context, |index, context| {
            let range = index * BATCH..((index + 1) * BATCH).min(total);
            let count = range.len();
            let batch = times
                .take("read", count, || {
                    let clips = range.clone().map(|index| clips.clip_with(index, &read));
                    clips.collect::<Result<Vec<Clip>, _>>()
                })
                .map_err(StageError::other)?;
            let ids: Vec<u64> = range.clone().map(|i| i as u64).collect();
            let conditioning = times
                .take("encode", count, || {
                    model.encode_inputs(&batch, request.inputs)
                })
                .map_err(refused)?;
            let tokens = times
                .take("generate", count, || {
                    model.generate_rounds(&conditioning, &ids, &request, samples)
                })
                .map_err(refused)?;
            let decoded = times
                .take("detokenize", count, || {
                    model.decode(&batch, &tokens, &request)
                })
                .map_err(refused)?;
            let mut entries = vec![Vec::new(); writers.len()];
            let mut write = |writer: usize, at: usize, clip: &Clip, certainty: &Certainty| {
                let entry = writers[writer].write(range.start + at, clip, certainty);
                entries[writer].push(entry.map_err(StageError::other)?);
                Ok::<_, StageError>(())
            };
            for (at, one) in decoded.iter().enumerate() {
                write(0, at, &one.clip, &one.certainty)?;
            }
            let others = model
                .decode_samples(&batch, &tokens, &request, samples)
                .map_err(refused)?;
            for (n, decoded) in others.iter().enumerate() {
                for (at, one) in decoded.iter().enumerate() {
                    write(first_sample + n, at, &one.clip, &one.certainty)?;
                }
            }
            if settings.reconstruction_bound {
                let back = model.round_trip(&batch, &targets).map_err(refused)?;
                for (at, clip) in back.iter().enumerate() {
                    write(1, at, clip, &Certainty::new())?;
                }
            }
            made.push(entries);
            let done = ((index + ranks.size()) * BATCH).min(total);
            context.progress(done as u64, total as u64, "clips");
            Ok(())
        })?;
        let mut made = made.into_iter();
        let all = ranks.map(total.div_ceil(BATCH), |_| {
            made.next()
                .ok_or_else(|| ranks.odd(ranks.rank(), &"a batch is missing"))
        });
        if !ranks.is_root() {
            return all.map(|_| Value::Null).map_err(StageError::other);
        }
        for entries in all.map_err(StageError::other)? {
            for (writer, entries) in writers.iter_mut().zip(entries) {
                writer.list(entries);
            }
        }
        for writer in writers {
            writer.finish().map_err(StageError::other)?;
        }
        times.record(context, total, &compute.name())?;
        Ok(json!({
            "split": settings.split,
            "clips": total,
            "inputs": settings.inputs,
            "generated": targets,
            "decoding": settings.decoding.name,
            "samples": settings.samples,
        }))
    }
}

/// Seconds per clip by part of the work, one number per batch.
#[derive(Debug, Default)]
struct Times(BTreeMap<&'static str, Vec<f64>>);

impl Times {
    fn take<T>(&mut self, part: &'static str, clips: usize, work: impl FnOnce() -> T) -> T {
        let watch = Stopwatch::start();
        let made = work();
        let each = watch.seconds() / clips.max(1) as f64;
        self.0.entry(part).or_default().push(each);
        made
    }

    /// Into the record of the run: what the clock says is no part of an artifact.
    fn record(
        &self,
        context: &mut dyn StageContext,
        clips: usize,
        device: &str,
    ) -> Result<(), StageError> {
        let mut text = String::from(
            "| seconds per clip | median | mean | p90 | batches |\n|---|---|---|---|---|\n",
        );
        for (part, seconds) in &self.0 {
            // The first batch warms up, where there are others.
            let found = runtime(seconds, usize::from(seconds.len() > 1));
            if let (Some(median), Some(mean), Some(p90)) = (found.median, found.mean, found.p90) {
                let n = found.n;
                let _ = writeln!(
                    text,
                    "| {part} | {median:.4} | {mean:.4} | {p90:.4} | {n} |"
                );
                context.record(
                    clips as u64,
                    &[(&format!("seconds_per_clip/{part}"), median)],
                )?;
            }
        }
        let _ = writeln!(text, "\nBatches of {BATCH} clips on {device}.");
        context.record_text(clips as u64, "time", &text)
    }
}

/// What the numbers of every generated modality are.
fn notes(model: &Model, targets: &[String]) -> Result<BTreeMap<String, SignalNote>, ModelError> {
    let note = |name: &String| {
        let modality = model.modality(name)?;
        let scale = ScaleStatus::of(modality);
        let mut units = modality.units();
        units.dedup();
        let note = SignalNote {
            unit: units.join(" "),
            frame: modality.frame().to_owned(),
            rate: modality.rate(),
            scale,
        };
        Ok((name.clone(), note))
    };
    targets.iter().map(note).collect()
}

/// A model or a clip that the model refuses, with the way out.
pub(super) fn refused(error: ModelError) -> StageError {
    let help = match &error {
        ModelError::Io { .. } | ModelError::Decoding(_) | ModelError::Stored(_) => {
            return StageError::other(error);
        }
        ModelError::NotAModel { .. } => {
            "`reviv run experiments/quickstart.yaml` trains a model, `reviv import` reads released weights"
        }
        ModelError::OtherTokenizer { .. } | ModelError::OtherGrid { .. } => {
            "import or train the model together with its tokenizers"
        }
        ModelError::MissingInput { .. } => "leave it out of `inputs`, or use clips that have it",
        ModelError::UnknownModality { .. } | ModelError::Clip { .. } | ModelError::Tokenizer(_) => {
            "use clips of the form the model was trained on"
        }
    };
    StageError::Input {
        code: Code::E0601,
        message: error.to_string(),
        help: help.to_owned(),
    }
}

pub(super) fn artifact<'a>(
    context: &'a dyn StageContext,
    port: &str,
) -> Result<&'a InputArtifact, StageError> {
    context
        .inputs(port)
        .first()
        .ok_or_else(|| StageError::Input {
            code: Code::E0301,
            message: format!("nothing is connected to `{port}`"),
            help: format!("name a stage in `{port}`"),
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_that_is_not_given_is_wanted() {
        let settings = PredictSettings::default();
        let known = ["body", "pixels", "rgb"];
        assert_eq!(settings.targets(known.into_iter()), ["body"]);
    }
}
