//! `op: train_tokenizer`: trains the tokenizer of one modality (Sec. 4.2, Supp. A).
//!
//! Signals over time and joints over time get a VQ-VAE, video gets the wavelet tokenizer. Statistics for normalisation come
//! from the training split, scores from the validation split. A hand's tokenizer also trains on the other hand in a mirror.
//! Writes `tokenizer.safetensors`, `scores.json`, `report/tokenizer.md` and a picture.

mod cost;
mod picture;
mod report;
mod run;

use super::clip_signals::{described_format, modality, unknown_modality};
use super::modality_entry::{DEFAULTS, read_defaults};
use super::tokenize::ENCODE_SECONDS;
use super::tokenizer_entry::TokenizerEntry;
use crate::engine::DeviceChoice;
use crate::engine::communicator::reduce::Reduction;
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, InputFacts, Inputs, Op, OpEntry, Port, Problem,
    StageContext, StageError, StagePlan, TokenFacts, TokenPlan,
};
use crate::modality::Shape;
use crate::tokenizer::video::padding::Padding;
use crate::training::settings::{READ_EVERY, is_usual};
use crate::training::tokenizer::TokenizerTraining;
use crate::training::{AdamWSettings, Duration, Keep};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Settings of [`TrainTokenizer`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TrainTokenizerSettings {
    /// The modality: `rgb depth camera gaze left_hand right_hand body`, or a declared one.
    pub modality: String,
    /// Family and sizes; absent: what the entry of a declared modality names.
    pub tokenizer: Option<Entry<TokenizerEntry>>,
    /// How often each data set of `clips` is drawn; empty means in proportion to its signals, those of mirrored hands counted.
    pub weights: Vec<f64>,
    /// Optimizer steps.
    #[schemars(range(min = 1))]
    pub steps: u64,
    /// Signals per step.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Signals per forward pass; a larger `batch` accumulates gradients, and ranks share them. 0 means `batch`, shared evenly.
    pub micro_batch: usize,
    /// In which order ranks add up gradients.
    pub reduction: Reduction,
    /// Peak learning rate; it falls along half a cosine.
    pub learning_rate: f64,
    /// Linear rise from 0: `{steps: n}` or `{epochs: x}`.
    pub warmup: Duration,
    /// The optimizer.
    pub optimizer: AdamWSettings,
    /// Before the first step, fit the scales of the new network to the first clips: latents become white, and a video
    /// tokenizer works on standardised wavelet coefficients. It learns in a fraction of the steps. The reference does not.
    pub calibrate: bool,
    /// Hands only: train on the other hand in a mirror, too.
    pub mirror: bool,
    /// Checkpoint after every so many steps; 0: only when interrupted.
    pub checkpoint_every: u64,
    /// Held-out loss after every so many steps; 0: not while it trains.
    pub validate_every: u64,
    /// Which weights the tokenizer has in the end.
    pub keep: Keep,
    /// At most so many held-out clips are scored.
    #[schemars(range(min = 1))]
    pub validation_clips: usize,
    /// Also fit k-means with as many codes, the baseline of a codebook without a network; where the codebook is not too large.
    pub kmeans: bool,
    /// Where to train.
    pub device: DeviceChoice,
    /// On a GPU, losses and norms of so many steps are read at once: reading waits for the device. Results do not depend on it. The
    /// processor has them after every step.
    #[schemars(range(min = 1))]
    #[serde(skip_serializing_if = "is_usual")]
    pub read_every: u64,
}

impl Default for TrainTokenizerSettings {
    fn default() -> Self {
        let training = TokenizerTraining::default();
        Self {
            modality: String::new(),
            tokenizer: None,
            weights: Vec::new(),
            steps: training.steps,
            batch: training.batch,
            micro_batch: training.micro_batch,
            reduction: training.reduction,
            learning_rate: training.learning_rate,
            warmup: Duration::Steps(training.warmup),
            optimizer: training.optimizer,
            calibrate: true,
            mirror: true,
            checkpoint_every: 500,
            validate_every: 0,
            keep: training.keep,
            validation_clips: 1000,
            kmeans: true,
            device: DeviceChoice::CPU,
            read_every: READ_EVERY,
        }
    }
}

impl TrainTokenizerSettings {
    /// Training on `signals` signals.
    fn training(&self, signals: u64) -> TokenizerTraining {
        TokenizerTraining {
            steps: self.steps,
            batch: self.batch,
            micro_batch: self.micro_batch,
            reduction: self.reduction,
            learning_rate: self.learning_rate,
            warmup: self.warmup_steps(signals).unwrap_or_default(),
            optimizer: self.optimizer.clone(),
            keep: self.keep,
        }
    }

    /// `None` where the warm-up is not measured in steps or epochs of signals.
    fn warmup_steps(&self, signals: u64) -> Option<u64> {
        match self.warmup {
            Duration::Steps(steps) => Some(steps),
            Duration::Epochs(epochs) if epochs.is_finite() && epochs >= 0.0 => {
                Some((epochs * (signals / self.batch.max(1) as u64).max(1) as f64).ceil() as u64)
            }
            Duration::Epochs(_) | Duration::Tokens(_) => None,
        }
    }

    /// The tokenizer that is named here, or else by the entry of the modality, as a clips artifact passes it on.
    fn entry(&self, defaults: Option<&Value>) -> Option<Entry<TokenizerEntry>> {
        let named = self.tokenizer.clone();
        named.or_else(|| read_defaults(defaults).remove(&self.modality)?.tokenizer)
    }

    /// The hand whose mirror image trains too.
    fn other_hand(&self) -> Option<&'static str> {
        match self.modality.as_str() {
            "left_hand" if self.mirror => Some("right_hand"),
            "right_hand" if self.mirror => Some("left_hand"),
            _ => None,
        }
    }
}

/// The op.
#[derive(Debug)]
pub struct TrainTokenizer;
inventory::submit! { OpEntry(&TrainTokenizer) }

impl Op for TrainTokenizer {
    type Settings = TrainTokenizerSettings;

    fn name(&self) -> &'static str {
        "train_tokenizer"
    }

    fn version(&self) -> u32 {
        7
    }

    fn together(&self) -> bool {
        true
    }

    fn about(&self) -> &'static str {
        "Trains the tokenizer of one modality, and scores it on held-out clips."
    }

    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "clips",
            kinds: &[ArtifactKind::Clips],
            arity: Arity::OneOrMore,
            about: "clips to train on (`train`) and to score on (`validation`), of one data set or of several, drawn by `weights`",
        }]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Tokenizer
    }

    fn check(
        &self,
        settings: &TrainTokenizerSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let Some(clips) = inputs.one("clips") else {
            return Description::default();
        };
        if settings.modality.is_empty() {
            problems.push(
                Problem::new(Code::E0204, "modality", "the modality is not named")
                    .help(format!("the clips have: {}", names(clips.signals.keys()))),
            );
            return Description::default();
        }
        let format = described_format(clips).unwrap_or_default();
        let (Some(facts), Some(modality)) = (
            clips.signals.get(&settings.modality),
            modality(&format, &settings.modality),
        ) else {
            problems.push(unknown_modality(
                "modality".to_owned(),
                &settings.modality,
                clips,
            ));
            return Description::default();
        };
        let all = inputs.all("clips");
        for (index, facts) in all.iter().enumerate().skip(1) {
            problems.extend(differs(&settings.modality, clips, facts, index));
        }
        if let Some(reason) = wrong_weights(&settings.weights, all.len()) {
            problems.push(Problem::new(Code::E0206, "weights", reason));
        }
        let signals = clips_of(all, "train");
        match settings.warmup_steps(signals) {
            Some(warmup) if warmup > settings.steps => {
                let message = format!("{warmup} warm-up steps in a run of {}", settings.steps);
                problems.push(Problem::new(Code::E0206, "warmup", message));
            }
            Some(_) => {}
            None => problems.push(
                Problem::new(Code::E0206, "warmup", "a tokenizer has no such warm-up")
                    .help("measure it in steps, `{steps: 50}`, or in passes, `{epochs: 5}`"),
            ),
        }
        if !(settings.learning_rate.is_finite() && settings.learning_rate > 0.0) {
            let message = format!("a learning rate of {}", settings.learning_rate);
            problems.push(Problem::new(Code::E0202, "learning_rate", message));
        }
        if let Some(name) = settings.optimizer.wrong() {
            let place = format!("optimizer.{name}");
            let message = format!("`{place}` is out of its range");
            problems.push(Problem::new(Code::E0206, place, message));
        }
        for facts in all {
            if facts.description.clips.get("train").is_none_or(|n| *n == 0) {
                let message = match all {
                    [_] => "the clips have no `train` split".to_owned(),
                    _ => format!("the clips of `{}` have no `train` split", facts.stage),
                };
                let problem = Problem::new(Code::E0401, "clips", message);
                problems.push(problem.help("give the clips stage `train:` a number"));
            }
        }
        if clips_of(all, "validation") == 0 {
            let problem = Problem::new(Code::W0701, "clips", "no held-out clips to score on");
            problems.push(problem.help("give the clips stage `validation:` a number"));
        }
        let family = match modality.shape() {
            Shape::Temporal { .. } => "signals over time take `vq_temporal_small` and its like",
            Shape::Kinematic { .. } => "joints take `vq_kinematic_small` and its like",
            Shape::Video { .. } => "video takes `video_small` and its like",
        };
        let Some(entry) = settings.entry(clips.extra.get(DEFAULTS)) else {
            let message = format!("no tokenizer is named for `{}`", settings.modality);
            problems.push(Problem::new(Code::E0204, "tokenizer", message).help(family));
            return Description::default();
        };
        match tokens(&entry.settings, &modality.shape()) {
            Ok(tokens) => Description {
                extra: [
                    ("tokenizer".to_owned(), json!(entry.name)),
                    (
                        ENCODE_SECONDS.to_owned(),
                        json!(cost::encode_seconds(
                            &entry.settings,
                            &modality.shape(),
                            &tokens
                        )),
                    ),
                ]
                .into(),
                tokens: [(settings.modality.clone(), tokens)].into(),
                signals: [(settings.modality.clone(), facts.clone())].into(),
                ..Description::default()
            },
            Err(message) => {
                problems.push(Problem::new(Code::E0401, "tokenizer", message).help(family));
                Description::default()
            }
        }
    }

    fn plan(
        &self,
        settings: &TrainTokenizerSettings,
        inputs: &Inputs<'_>,
        _seed: u64,
    ) -> StagePlan {
        let format = inputs
            .one("clips")
            .and_then(described_format)
            .unwrap_or_default();
        let Some(modality) = modality(&format, &settings.modality) else {
            return StagePlan::default();
        };
        let defaults = inputs
            .one("clips")
            .and_then(|clips| clips.extra.get(DEFAULTS));
        let Some(entry) = settings.entry(defaults) else {
            return StagePlan::default();
        };
        let (entry, shape) = (&entry.settings, modality.shape());
        let Ok(tokens) = tokens(entry, &shape) else {
            return StagePlan::default();
        };
        let parameters = cost::parameters(entry, &shape);
        let clips = clips_of(inputs.all("clips"), "train") as usize;
        let flop = cost::flop(settings, entry, &shape, &tokens, clips);
        let memory = cost::memory(settings, entry, &shape, &tokens, clips);
        StagePlan {
            shapes: vec![
                (
                    "signal".to_owned(),
                    super::clips::shape_of(modality.as_ref()),
                ),
                ("tokens".to_owned(), tokens.grid.clone()),
            ],
            parameters,
            tokens: vec![TokenPlan {
                modality: settings.modality.clone(),
                tokens: tokens.count(),
                vocabulary: tokens.vocabulary,
                mean_input: None,
                mean_target: None,
            }],
            work: Some((settings.steps, "steps".to_owned())),
            memory,
            disk: parameters.map(|count| 4 * count),
            flop,
            ..StagePlan::default()
        }
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        super::device::memory_is_full(text, super::device::SMALLER_MICRO_BATCH)
    }

    fn run(
        &self,
        settings: &TrainTokenizerSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let _memory = crate::engine::memory::Stage;
        run::run(settings, context)
    }
}

/// The clips of one split, of all data sets.
fn clips_of(sets: &[InputFacts<'_>], split: &str) -> u64 {
    let clips = |facts: &InputFacts<'_>| facts.description.clips.get(split).copied();
    sets.iter().filter_map(clips).sum()
}

/// Why a further data set cannot be mixed with the first one, if it cannot.
fn differs(
    modality: &str,
    first: &Description,
    facts: &InputFacts<'_>,
    index: usize,
) -> Option<Problem> {
    let key = format!("clips.{index}");
    let Some(own) = facts.description.signals.get(modality) else {
        return Some(unknown_modality(key, modality, facts.description));
    };
    // A pseudo-colour of depth means other metres where it is coded otherwise.
    let coded = |clips: &Description| described_format(clips).map(|format| format.depth);
    let known = first.signals.get(modality)?;
    if own == known && (modality != "depth" || coded(first) == coded(facts.description)) {
        return None;
    }
    let message = format!(
        "`{}` has `{modality}` of another form than the first data set: {:?} at {} Hz, not {:?} at {} Hz",
        facts.stage, own.shape, own.rate, known.shape, known.rate
    );
    let problem = Problem::new(Code::E0401, key, message);
    Some(problem.help("give all clips the same `cut`, size and coding of depth"))
}

/// Why `sets` data sets cannot be drawn by `weights`, if they cannot.
fn wrong_weights(weights: &[f64], sets: usize) -> Option<String> {
    if weights.is_empty() {
        return None;
    }
    if weights.len() != sets {
        return Some(format!("{} weights for {sets} data sets", weights.len()));
    }
    let usable = weights.iter().all(|w| w.is_finite() && *w >= 0.0);
    (!usable || weights.iter().sum::<f64>() <= 0.0)
        .then(|| format!("weights of {weights:?} are no shares: they must be positive"))
}

fn names<'a>(names: impl Iterator<Item = &'a String>) -> String {
    names.map(String::as_str).collect::<Vec<_>>().join(", ")
}

/// The tokens of signals of `shape`, or why the entry does not take them.
fn tokens(entry: &TokenizerEntry, shape: &Shape) -> Result<TokenFacts, String> {
    match (entry, shape) {
        (TokenizerEntry::Vq(settings), _) => {
            let patches = settings.patches(shape).map_err(|error| error.to_string())?;
            Ok(TokenFacts {
                grid: patches.grid(),
                vocabulary: settings.codebook as u64,
            })
        }
        (
            TokenizerEntry::Video(settings),
            Shape::Video {
                frames,
                height,
                width,
            },
        ) => {
            settings.check().map_err(|error| error.to_string())?;
            let clip = [*frames, *height, *width];
            if clip.contains(&0) {
                return Err(format!("clips of {clip:?} frames, height, width"));
            }
            let padding = Padding::of(clip, settings.temporal, settings.spatial);
            Ok(TokenFacts {
                grid: settings.grid(padding.padded).to_vec(),
                vocabulary: settings.vocabulary() as u64,
            })
        }
        (TokenizerEntry::Video(_), _) => {
            Err("a video tokenizer takes video; other signals have a VQ-VAE".to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::SignalFacts;
    use crate::modality::ClipFormat;

    fn clips() -> Description {
        let format = ClipFormat {
            size: 64,
            ..ClipFormat::default()
        };
        let facts = |shape: &[usize]| SignalFacts {
            shape: shape.to_vec(),
            rate: 30.0,
        };
        Description {
            clips: [("train".to_owned(), 10), ("validation".to_owned(), 4)].into(),
            signals: [
                ("rgb".to_owned(), facts(&[16, 64, 64, 3])),
                ("body".to_owned(), facts(&[60, 21, 3])),
            ]
            .into(),
            extra: [("format".to_owned(), json!(format))].into(),
            ..Description::default()
        }
    }

    fn check(settings: Value) -> (Description, Vec<Problem>) {
        let clips = clips();
        let inputs = Inputs::new(vec![(
            "clips",
            vec![InputFacts {
                stage: "clips",
                kind: ArtifactKind::Clips,
                description: &clips,
            }],
        )]);
        let settings: TrainTokenizerSettings = serde_json::from_value(settings).unwrap();
        let mut problems = Vec::new();
        let description = TrainTokenizer.check(&settings, &inputs, &mut problems);
        if problems.is_empty() {
            let plan = TrainTokenizer.plan(&settings, &inputs, 0);
            assert!(plan.parameters.unwrap() > 0);
        }
        (description, problems)
    }

    #[test]
    fn the_form_of_tokens_is_known_before_anything_runs() {
        let body = json!({"use": "b", "family": "vq", "codebook": 32, "compression": [2, 3], "width": 16, "depth": 1, "heads": 2});
        let (description, problems) = check(json!({"modality": "body", "tokenizer": body}));
        assert!(problems.is_empty(), "{problems:?}");
        assert_eq!(description.tokens["body"].grid, [30, 7]);
        assert_eq!(description.tokens["body"].vocabulary, 32);
        let video = json!({"use": "v", "family": "video", "channels": 4, "multipliers": [1, 2], "blocks": 1, "levels": [4, 4]});
        let (description, problems) = check(json!({"modality": "rgb", "tokenizer": video}));
        assert!(problems.is_empty(), "{problems:?}");
        assert_eq!(description.tokens["rgb"].grid, [5, 8, 8]);
    }

    #[test]
    fn a_modality_or_a_family_that_does_not_fit_is_refused_where_it_is_written() {
        let key = |settings| check(settings).1[0].key.clone();
        let vq = json!({"use": "vq", "family": "vq", "compression": [2]});
        assert_eq!(key(json!({"tokenizer": vq})), "modality");
        assert_eq!(
            key(json!({"modality": "bodi", "tokenizer": vq})),
            "modality"
        );
        assert_eq!(
            key(json!({"modality": "body", "tokenizer": vq})),
            "tokenizer"
        );
        assert_eq!(
            key(json!({"modality": "rgb", "tokenizer": vq})),
            "tokenizer"
        );
    }
}
