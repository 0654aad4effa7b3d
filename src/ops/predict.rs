//! `op: predict`: a model generates what it was not given, for every clip of a split (Supp. C).
//!
//! Writes a folder of [`crate::reconstruction::predictions`]: decoded signals with a confidence per sample.

use crate::clip::store::ClipSet;
use crate::clip::{Clip, Signal};
use crate::decoding::{DecodingSettings, GeneratedTokens, MgetTokens, Sample, Slot, generate};
use crate::engine::Compute;
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, InputArtifact, Inputs, Op, OpEntry, Port,
    Problem, StageContext, StageError, StagePlan,
};
use crate::masking::PIXELS;
use crate::mget::{Content, Mget};
use crate::modality::{self, ClipFormat, Modality};
use crate::reconstruction::predictions::{PredictionsWriter, ScaleStatus, SignalNote};
use crate::tokenizer::{self, TokenGrid, Tokenizer};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Clips that go through the model at once.
const BATCH: usize = 8;

/// Settings of [`Predict`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PredictSettings {
    /// Modalities the model is given; raw video is given whenever the model takes it and `rgb` is.
    pub given: Vec<String>,
    /// Modalities it generates; empty means all others.
    pub wanted: Vec<String>,
    /// How tokens are generated.
    pub decoding: Entry<DecodingSettings>,
    /// Which clips.
    pub split: String,
    /// At most this many clips, the first ones; absent means all.
    #[schemars(range(min = 1))]
    pub limit: Option<usize>,
}

impl Default for PredictSettings {
    fn default() -> Self {
        Self {
            given: vec!["rgb".to_owned()],
            wanted: Vec::new(),
            decoding: Entry {
                name: "fast".to_owned(),
                settings: DecodingSettings::default(),
            },
            split: "test".to_owned(),
            limit: None,
        }
    }
}

/// The op.
#[derive(Debug)]
pub struct Predict;
inventory::submit! { OpEntry(&Predict) }

impl PredictSettings {
    /// The modalities to generate, of those the model knows.
    fn targets<'a>(&self, known: impl Iterator<Item = &'a str>) -> Vec<String> {
        known
            .filter(|name| *name != PIXELS && !self.given.iter().any(|given| given == name))
            .filter(|name| self.wanted.is_empty() || self.wanted.iter().any(|w| w == name))
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
        1
    }

    fn about(&self) -> &'static str {
        "Generates the modalities a model was not given, for the clips of a split."
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
        for (key, names) in [("given", &settings.given), ("wanted", &settings.wanted)] {
            for (index, name) in names.iter().enumerate() {
                if !known.contains(&name.as_str()) {
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
        for (index, name) in settings.given.iter().enumerate() {
            if !clips.signals.is_empty() && !clips.signals.contains_key(name) {
                problems.push(Problem::new(
                    Code::E0203,
                    format!("given.{index}"),
                    format!("the clips have no `{name}`"),
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
                "wanted",
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

    fn run(
        &self,
        settings: &PredictSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let predictor = Predictor::open(settings, context)?;
        let root = artifact(context, "clips")?.path.join(&settings.split);
        let clips = ClipSet::open(&root).map_err(StageError::other)?;
        let total = clips.len().min(settings.limit.unwrap_or(usize::MAX));
        let mut writer = PredictionsWriter::create(context.output(), "reviv", predictor.notes())
            .map_err(StageError::other)?;
        let wanted: Vec<&str> = settings.given.iter().map(String::as_str).collect();
        let mut done = 0;
        while done < total {
            if context.interrupted() {
                return Err(StageError::Interrupted);
            }
            let batch = (done..total.min(done + BATCH))
                .map(|index| clips.clip_with(index, &wanted))
                .collect::<Result<Vec<Clip>, _>>()
                .map_err(StageError::other)?;
            let ids: Vec<u64> = (done..).take(batch.len()).map(|i| i as u64).collect();
            for (clip, confidence) in predictor.predict(&batch, &ids, context.seed())? {
                writer.add(&clip, &confidence).map_err(StageError::other)?;
            }
            done += batch.len();
            context.progress(done as u64, total as u64, "clips");
        }
        writer.finish().map_err(StageError::other)?;
        Ok(json!({
            "split": settings.split,
            "clips": total,
            "given": settings.given,
            "generated": predictor.targets,
            "decoding": settings.decoding.name,
        }))
    }
}

/// A model with everything around it: tokenizers in, decoding, tokenizers out.
pub(super) struct Predictor {
    model: Mget,
    format: ClipFormat,
    modalities: BTreeMap<String, Box<dyn Modality>>,
    tokenizers: BTreeMap<String, Box<dyn Tokenizer>>,
    given: Vec<String>,
    targets: Vec<String>,
    decoding: DecodingSettings,
}

/// A predicted clip, and per modality a confidence per sample.
pub(super) type Predicted = (Clip, BTreeMap<String, Vec<f32>>);

impl Predictor {
    fn open(settings: &PredictSettings, context: &dyn StageContext) -> Result<Self, StageError> {
        let model_artifact = artifact(context, "model")?;
        let clips = artifact(context, "clips")?;
        let format: ClipFormat =
            serde_json::from_value(clips.contents["format"].clone()).map_err(StageError::other)?;
        let model = Mget::open(&model_artifact.path, &Compute::cpu()).map_err(StageError::other)?;
        let names: Vec<&str> = model
            .spec()
            .modalities
            .iter()
            .map(|m| m.name.as_str())
            .collect();
        let targets = settings.targets(names.iter().copied());
        let mut tokenizers = BTreeMap::new();
        for name in names.iter().filter(|name| **name != PIXELS) {
            let path = model_artifact.path.join("tokenizers").join(name);
            let tokenizer = tokenizer::open(&path).map_err(|error| StageError::Input {
                code: Code::E0601,
                message: format!("the model's tokenizer of `{name}`: {error}"),
                help: "train the model again, or import it with its tokenizers".into(),
            })?;
            tokenizers.insert((*name).to_owned(), tokenizer);
        }
        let modalities = modality::all(&format)
            .into_iter()
            .map(|modality| (modality.name().to_owned(), modality))
            .collect();
        Ok(Self {
            given: settings.given.clone(),
            decoding: settings.decoding.settings.clone(),
            model,
            format,
            modalities,
            tokenizers,
            targets,
        })
    }

    /// What the numbers of every generated modality are.
    fn notes(&self) -> BTreeMap<String, SignalNote> {
        let note = |name: &String| {
            let modality = self.modalities.get(name)?;
            let scale = match name.as_str() {
                "camera" | "body" | "left_hand" | "right_hand" => ScaleStatus::Metric {
                    by: "learning from metric data".into(),
                },
                "depth" => ScaleStatus::Relative,
                _ => ScaleStatus::None,
            };
            let mut units = modality.units();
            units.dedup();
            let note = SignalNote {
                unit: units.join(" "),
                frame: modality.frame().to_owned(),
                rate: modality.rate(),
                scale,
            };
            Some((name.clone(), note))
        };
        self.targets.iter().filter_map(note).collect()
    }

    /// Predictions for a batch of clips that hold the given modalities. `ids` name their random numbers.
    pub(super) fn predict(
        &self,
        clips: &[Clip],
        ids: &[u64],
        seed: u64,
    ) -> Result<Vec<Predicted>, StageError> {
        let mut given: BTreeMap<&str, Vec<TokenGrid>> = BTreeMap::new();
        let mut pixels: Vec<Vec<f32>> = Vec::new();
        for name in &self.given {
            let signals = self.signals(name, clips)?;
            if name == "rgb" && self.model.spec().index(PIXELS).is_some() {
                pixels = signals
                    .iter()
                    .map(|s| s.values.iter().copied().collect())
                    .collect();
            }
            let tokens = self.tokenizers[name]
                .encode(&signals)
                .map_err(StageError::other)?;
            given.insert(name, tokens);
        }
        let samples: Vec<Sample<'_>> = ids
            .iter()
            .enumerate()
            .map(|(k, &id)| Sample {
                id,
                slots: self
                    .model
                    .spec()
                    .modalities
                    .iter()
                    .map(|m| match given.get(m.name.as_str()) {
                        Some(tokens) => Slot::given(tokens[k].ids.clone()),
                        None if m.name == PIXELS => Slot::Pixels(
                            pixels
                                .get(k)
                                .map_or(Content::Absent, |p| Content::Floats(p)),
                        ),
                        None => Slot::unknown(m.count()),
                    })
                    .collect(),
            })
            .collect();
        let targets: Vec<&str> = self.targets.iter().map(String::as_str).collect();
        let generated = generate(
            &MgetTokens::new(&self.model),
            &self.decoding,
            &samples,
            &targets,
            seed,
        )
        .map_err(StageError::other)?;

        let mut predicted: Vec<Predicted> = clips
            .iter()
            .map(|clip| {
                (
                    Clip::empty(clip.id.clone(), clip.source.clone()),
                    BTreeMap::new(),
                )
            })
            .collect();
        for name in &self.targets {
            let tokenizer = &self.tokenizers[name];
            let own: Vec<&GeneratedTokens> = generated
                .iter()
                .filter_map(|g| g.targets.get(name))
                .collect();
            let grids: Vec<TokenGrid> = own
                .iter()
                .map(|g| TokenGrid {
                    ids: g.ids.clone(),
                    grid: tokenizer.grid().to_vec(),
                })
                .collect();
            let signals = tokenizer.decode(&grids).map_err(StageError::other)?;
            let modality = self.modality(name)?;
            for (((clip, confidence), signal), tokens) in predicted.iter_mut().zip(signals).zip(own)
            {
                let samples = signal.values.shape()[0];
                confidence.insert(
                    name.clone(),
                    per_sample(&tokens.confidence, tokenizer.grid()[0], samples),
                );
                modality.insert(signal, clip).map_err(StageError::other)?;
            }
        }
        Ok(predicted)
    }

    fn signals(&self, name: &str, clips: &[Clip]) -> Result<Vec<Signal>, StageError> {
        let modality = self.modality(name)?;
        clips
            .iter()
            .map(|clip| {
                modality
                    .extract(clip)
                    .map_err(StageError::other)?
                    .ok_or_else(|| StageError::Input {
                        code: Code::E0601,
                        message: format!(
                            "clip `{}` has no {name}, which the model is to be given",
                            clip.id
                        ),
                        help: format!("leave `{name}` out of `given`, or use clips that have it"),
                    })
            })
            .collect()
    }

    fn modality(&self, name: &str) -> Result<&dyn Modality, StageError> {
        let missing = || StageError::Input {
            code: Code::E0203,
            message: format!("no modality `{name}` in clips of this format"),
            help: format!(
                "clips have {} frames of {} pixels",
                self.format.frames, self.format.size
            ),
        };
        self.modalities
            .get(name)
            .map(AsRef::as_ref)
            .ok_or_else(missing)
    }
}

/// The mean confidence of the tokens of each of `steps` time steps, spread over `samples`.
fn per_sample(tokens: &[f32], steps: usize, samples: usize) -> Vec<f32> {
    let each = (tokens.len() / steps.max(1)).max(1);
    let means: Vec<f32> = tokens
        .chunks(each)
        .map(|chunk| chunk.iter().sum::<f32>() / chunk.len() as f32)
        .collect();
    (0..samples)
        .map(|s| {
            means
                .get(s * steps / samples.max(1))
                .copied()
                .unwrap_or(f32::NAN)
        })
        .collect()
}

fn artifact<'a>(
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
    fn confidence_of_tokens_is_spread_over_samples() {
        let tokens = [1.0, 0.0, 0.5, 0.5];
        assert_eq!(per_sample(&tokens, 2, 6), [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]);
        assert_eq!(per_sample(&[0.25, 0.75], 2, 4), [0.25, 0.25, 0.75, 0.75]);
    }

    #[test]
    fn everything_that_is_not_given_is_wanted() {
        let settings = PredictSettings::default();
        let known = ["body", "pixels", "rgb"];
        assert_eq!(settings.targets(known.into_iter()), ["body"]);
    }
}
