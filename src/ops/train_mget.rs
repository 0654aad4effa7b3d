//! `op: train_mget`: trains a Masked Generative Egocentric Transformer on token grids (Sec. 4.3, Supp. B).
//!
//! Reads one or more `tokens` artifacts laid out as [`crate::training::shards`] says, `<split>/<modality>/shard-*.tar`, whose
//! manifests hold `tokens: {modality: {grid, vocabulary}}`. Writes `mget.json`, `weights.safetensors` and `validation.json`,
//! and copies the `tokenizers` folder of the first artifact, so that the model can be used on its own.

mod run;

use super::device::memory_is_full;
use crate::engine::{DeviceChoice, Precision};
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, Inputs, Op, OpEntry, Port, Problem,
    StageContext, StageError, StagePlan, TokenFacts, TokenPlan,
};
use crate::masking::statistics::ModalityStatistics;
use crate::masking::{MaskingError, MaskingSettings, PIXELS, simulate};
use crate::mget::{MgetSpec, ModalitySpec, Positions, Size, SpecError};
use crate::training::loader::held_batches;
use crate::training::{DatasetSize, TrainingSettings, memory};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Draws of the plan's simulation of masking.
const SIMULATED: usize = 500;

/// Whether raw video is an input beside the tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Pixels {
    /// Tokens alone.
    #[default]
    None,
    /// Colour video in tubelets (the paper's ViT branch); the tokens artifact must carry it as `pixels`.
    Rgb,
}

/// Settings of [`TrainMget`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainMgetSettings {
    /// Depth and width.
    pub size: Entry<Size>,
    /// Which tokens are inputs, and which are targets.
    pub masking: Entry<MaskingSettings>,
    /// The modalities that take part; empty means all that have tokens.
    pub modalities: Vec<String>,
    /// Raw video as an input beside the tokens.
    pub pixels: Pixels,
    /// Frames, height and width of a tubelet of raw video.
    pub tubelet: [usize; 3],
    /// Position tables of time-by-joints grids; `released` is needed only for imported weights.
    pub positions: Positions,
    /// How often each data set of `tokens` is drawn; empty means in proportion to its clips.
    pub weights: Vec<f64>,
    /// Share of the training clips of every data set that is used, the first ones.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub train_share: f64,
    /// Where to train.
    pub device: DeviceChoice,
    /// What operands of matrix products are rounded to; sums, weights, norms and losses are always f32.
    pub precision: Precision,
    /// How long, in what batches and with what learning rate to train, and when to validate and to checkpoint.
    #[serde(flatten)]
    pub training: TrainingSettings,
}

impl Default for TrainMgetSettings {
    fn default() -> Self {
        Self {
            size: Entry {
                name: "laptop".to_owned(),
                settings: Size::default(),
            },
            masking: Entry {
                name: "dirichlet_mixture".to_owned(),
                settings: MaskingSettings::default(),
            },
            modalities: Vec::new(),
            pixels: Pixels::None,
            tubelet: [4, 8, 8],
            positions: Positions::Released,
            weights: Vec::new(),
            train_share: 1.0,
            device: DeviceChoice::CPU,
            precision: Precision::F32,
            training: TrainingSettings::default(),
        }
    }
}

impl TrainMgetSettings {
    /// How many of `clips` training clips are used.
    fn used(&self, clips: u64) -> u64 {
        ((clips as f64 * self.train_share).round() as u64).clamp(1, clips.max(1))
    }
}

/// The op.
#[derive(Debug)]
pub struct TrainMget;
inventory::submit! { OpEntry(&TrainMget) }

impl Op for TrainMget {
    type Settings = TrainMgetSettings;

    fn name(&self) -> &'static str {
        "train_mget"
    }

    fn version(&self) -> u32 {
        4
    }

    fn together(&self) -> bool {
        true
    }

    fn about(&self) -> &'static str {
        "Trains a Masked Generative Egocentric Transformer on token grids."
    }

    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "tokens",
            kinds: &[ArtifactKind::Tokens],
            arity: Arity::Many,
            about: "the data sets' token grids: all are trained on, drawn by `weights`; the first is validated on",
        }]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Mget
    }

    fn check(
        &self,
        settings: &TrainMgetSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let Some(tokens) = inputs.one("tokens") else {
            return Description::default();
        };
        for name in &settings.modalities {
            if !tokens.tokens.contains_key(name) {
                let known: Vec<&str> = tokens.tokens.keys().map(String::as_str).collect();
                problems.push(
                    Problem::new(
                        Code::E0203,
                        "modalities",
                        format!("modality `{name}` has no tokenizer"),
                    )
                    .label("has no tokens")
                    .help(format!("tokens exist for: {}", known.join(", "))),
                );
            }
        }
        for facts in inputs.all("tokens").iter().skip(1) {
            for (name, own) in &facts.description.tokens {
                if tokens.tokens.get(name).is_some_and(|first| first != own) {
                    problems.push(Problem::new(
                        Code::E0401,
                        "tokens",
                        format!(
                            "`{}` has other `{name}` tokens than the first data set",
                            facts.stage
                        ),
                    ));
                }
            }
        }
        let sets = inputs.all("tokens").len();
        if !settings.weights.is_empty() && settings.weights.len() != sets {
            problems.push(Problem::new(
                Code::E0206,
                "weights",
                format!("{} weights for {sets} data sets", settings.weights.len()),
            ));
        }
        let shape = pixel_shape(tokens);
        if settings.pixels == Pixels::Rgb && shape.is_none() {
            problems.push(
                Problem::new(Code::E0401, "pixels", "the tokens carry no raw video")
                    .help("make them with raw video, or train with `pixels: none`"),
            );
            return Description::default();
        }
        let spec = spec(settings, &tokens.tokens, shape);
        if let Err(error) = spec.check() {
            problems.push(spec_problem(&error));
        }
        if let Err(error) = settings.masking.settings.check(&spec.slots()) {
            problems.push(masking_problem(&error));
        }
        let measure = measure(settings, training_clips(settings, inputs));
        if let Err(error) = settings.training.learning_rates(measure) {
            problems.push(Problem::new(Code::E0206, "", error.to_string()));
        }
        Description {
            tokens: tokens
                .tokens
                .iter()
                .filter(|(name, _)| spec.index(name).is_some())
                .map(|(name, facts)| (name.clone(), facts.clone()))
                .collect(),
            signals: tokens.signals.clone(),
            extra: [
                ("size".to_owned(), json!(settings.size.name)),
                ("mget".to_owned(), json!(spec)),
            ]
            .into(),
            ..Description::default()
        }
    }

    fn plan(&self, settings: &TrainMgetSettings, inputs: &Inputs<'_>, seed: u64) -> StagePlan {
        let Some(tokens) = inputs.one("tokens") else {
            return StagePlan::default();
        };
        let spec = spec(settings, &tokens.tokens, pixel_shape(tokens));
        let measure = measure(settings, training_clips(settings, inputs));
        let training = &settings.training;
        let Ok(steps) = training.total_steps(measure) else {
            return StagePlan::default();
        };
        let Ok(masking) = simulate(&settings.masking.settings, &spec.slots(), SIMULATED, seed)
        else {
            return StagePlan::default();
        };
        let parameters = spec.parameter_count() as u64;
        let trunk = spec.size.trunk_parameters() as u64;
        let samples = steps * training.batch as u64;
        let targets: Vec<usize> = masking
            .modalities
            .iter()
            .map(|m| m.target.mean as usize)
            .collect();
        let forward = spec.multiply_accumulates(masking.input_tokens as usize, &targets);
        let mean = |of: fn(&ModalityStatistics) -> f64| -> Vec<f64> {
            masking.modalities.iter().map(of).collect()
        };
        let visible = mean(|m| m.input.mean);
        let floats = memory::mget_floats(&spec, &visible, &mean(|m| m.target.mean));
        let at_once = training.largest_micro_batch() as f64;
        let waiting =
            held_batches(training.loader_threads) as f64 * memory::mget_pixels(&spec, &visible);
        let peak = memory::peak(parameters, floats * at_once, waiting * at_once);
        StagePlan {
            shapes: vec![
                (
                    "encoder input of a sample".into(),
                    vec![masking.input_tokens as usize, spec.size.width],
                ),
                (
                    "decoder input of a sample".into(),
                    vec![masking.target_tokens as usize, spec.size.width],
                ),
            ],
            parameters: Some(parameters),
            parameter_parts: vec![
                ("trunk".into(), trunk),
                ("tables of modalities".into(), parameters - trunk),
            ],
            tokens: masking
                .modalities
                .iter()
                .zip(&spec.modalities)
                .map(|(statistics, modality)| TokenPlan {
                    modality: statistics.name.clone(),
                    tokens: statistics.tokens as u64,
                    vocabulary: modality.vocabulary().unwrap_or(0) as u64,
                    mean_input: Some(statistics.input.mean),
                    mean_target: Some(statistics.target.mean),
                })
                .collect(),
            work: Some((steps, "steps".into())),
            memory: Some(peak),
            disk: Some(4 * parameters),
            // Backward costs twice the forward; a multiply-accumulate is two operations.
            flop: Some(6.0 * forward * samples as f64),
            seconds: None,
            core_seconds: None,
            tokens_per_step: Some(training.batch as f64 * measure.tokens_per_sample as f64),
            lines: vec![
                format!(
                    "{:.0}% of nominal tokens are real: {:.0} of {} visible, {:.0} of {} asked for per sample",
                    100.0 * masking.fill,
                    masking.input_tokens,
                    settings.masking.settings.input_tokens.bounds().1,
                    masking.target_tokens,
                    settings.masking.settings.target_tokens.bounds().1,
                ),
                format!(
                    "{:.1}% of samples ask for nothing",
                    100.0 * masking.no_target
                ),
            ],
        }
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        let lower = "lower `micro_batch` (gradients are accumulated, and `batch` stays), set `activation_checkpointing: true`, or take fewer `input_tokens` and `target_tokens`";
        memory_is_full(text, lower)
    }

    fn run(
        &self,
        settings: &TrainMgetSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let _memory = crate::engine::memory::Stage;
        run::run(settings, context)
    }
}

/// `[frames, height, width, channels]` of the raw video that a tokens artifact carries.
fn pixel_shape(tokens: &Description) -> Option<[usize; 4]> {
    serde_json::from_value(tokens.extra.get(PIXELS)?.clone()).ok()
}

fn spec(
    settings: &TrainMgetSettings,
    tokens: &BTreeMap<String, TokenFacts>,
    pixels: Option<[usize; 4]>,
) -> MgetSpec {
    let takes_part =
        |name: &String| settings.modalities.is_empty() || settings.modalities.contains(name);
    let mut modalities: Vec<ModalitySpec> = tokens
        .iter()
        .filter(|(name, _)| takes_part(name))
        .map(|(name, facts)| ModalitySpec::tokens(name, &facts.grid, facts.vocabulary as usize))
        .collect();
    if let (Pixels::Rgb, Some(clip)) = (settings.pixels, pixels) {
        modalities.push(ModalitySpec::pixels(PIXELS, clip, settings.tubelet));
    }
    modalities.sort_by(|a, b| a.name.cmp(&b.name));
    MgetSpec {
        size: settings.size.settings,
        positions: settings.positions,
        modalities,
    }
}

/// The training clips that are used, of all data sets.
fn training_clips(settings: &TrainMgetSettings, inputs: &Inputs<'_>) -> u64 {
    inputs
        .all("tokens")
        .iter()
        .map(|facts| facts.description.clips.get("train").copied().unwrap_or(1))
        .map(|clips| settings.used(clips))
        .sum()
}

fn measure(settings: &TrainMgetSettings, clips: u64) -> DatasetSize {
    let masking = &settings.masking.settings;
    DatasetSize {
        clips,
        tokens_per_sample: (masking.input_tokens.bounds().1 + masking.target_tokens.bounds().1)
            as u64,
    }
}

fn spec_problem(error: &SpecError) -> Problem {
    let (key, help) = match error {
        SpecError::Heads { .. } => (
            "size.heads",
            "the width must be divisible by the number of heads",
        ),
        SpecError::Width { .. } => ("size.width", "384 and 768 are the published widths"),
        SpecError::Tubelet { .. } => (
            "tubelet",
            "every side of the clip must be a multiple of the tubelet's",
        ),
        SpecError::ZeroSize(_) => ("size", ""),
        _ => ("tokens", ""),
    };
    Problem::new(Code::E0401, key, error.to_string()).help(help)
}

fn masking_problem(error: &MaskingError) -> Problem {
    let key = match error {
        MaskingError::ZeroBudget { setting, .. }
        | MaskingError::Range { setting, .. }
        | MaskingError::UnknownModality { setting, .. } => format!("masking.{setting}"),
        MaskingError::Value { setting, .. } | MaskingError::Components { setting, .. } => {
            format!("masking.{setting}")
        }
        _ => "masking".to_owned(),
    };
    Problem::new(Code::E0206, key, error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::InputFacts;

    #[test]
    fn epochs_are_of_all_data_sets_and_shares_of_each() {
        let described = |clips: u64| Description {
            clips: [("train".to_owned(), clips)].into(),
            ..Description::default()
        };
        let (a, b, c) = (described(100), described(31), described(5));
        let facts = |description| InputFacts {
            stage: "tokens",
            kind: ArtifactKind::Tokens,
            description,
        };
        let inputs = Inputs::new(vec![("tokens", vec![facts(&a), facts(&b), facts(&c)])]);
        let mut settings = TrainMgetSettings::default();
        assert_eq!(training_clips(&settings, &inputs), 136);
        settings.train_share = 0.5;
        assert_eq!(training_clips(&settings, &inputs), 50 + 16 + 3);
    }
}
