//! Running `op: train_mget`: what arrives, the loop, what leaves.

use super::{TrainMgetSettings, measure, spec};
use crate::decoding::reconstructor::{ModelManifest, TOKENIZERS};
use crate::engine::{Compute, Initialise};
use crate::experiment::{Code, InputArtifact, StageContext, StageError, TokenFacts};
use crate::masking::{Masking, PIXELS};
use crate::mget::{Mget, MgetSpec};
use crate::modality::ClipFormat;
use crate::run::checkpoint;
use crate::run::environment::Stopwatch;
use crate::run::files::copy_tree;
use crate::training::{
    BatchSource, DataError, Event, Flow, HeldOut, Intervals, Keep, Loader, MaskedPrediction,
    Objective, Progress, Sampler, Score, Shards, StepReport, TokenSource, Trainer, TrainingError,
    TrainingSettings, Unigram, Validation, fit,
};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

/// The file of held-out losses.
const VALIDATION: &str = "validation.json";

/// Clips whose tokens are counted for the baseline.
const UNIGRAM_CLIPS: usize = 4096;

fn input_error(error: impl Into<TrainingError>) -> StageError {
    match error.into() {
        TrainingError::Data(error @ DataError::Shard { .. }) => StageError::Input {
            code: Code::E0601,
            message: error.to_string(),
            help: "bring the shard back and run again: training continues where it stopped".into(),
        },
        TrainingError::Data(error @ (DataError::Vocabulary { .. } | DataError::Length { .. })) => {
            StageError::Input {
                code: Code::E0401,
                message: error.to_string(),
                help: "make the tokens again with the tokenizers of this experiment".into(),
            }
        }
        TrainingError::Data(error @ DataError::Twice { .. }) => StageError::Input {
            code: Code::E0401,
            message: error.to_string(),
            help: "keep the data sets in folders of their own, or rename the clips of one".into(),
        },
        error => StageError::other(error),
    }
}

/// Why training ended early.
enum Failure {
    Training(TrainingError),
    Stage(StageError),
}

impl From<TrainingError> for Failure {
    fn from(error: TrainingError) -> Self {
        Self::Training(error)
    }
}

impl From<StageError> for Failure {
    fn from(error: StageError) -> Self {
        Self::Stage(error)
    }
}

impl From<Failure> for StageError {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Training(error) => input_error(error),
            Failure::Stage(error) => error,
        }
    }
}

/// A stage under way.
pub(super) struct Run {
    trainer: Trainer<MaskedPrediction>,
    feed: Arc<BatchSource>,
    validation: Validation,
    baseline: BTreeMap<String, Score>,
    settings: TrainingSettings,
    masking: Masking,
    tokenizers: Option<std::path::PathBuf>,
    /// The sizes of the clips the tokens were made of, where the tokens say it.
    clips: Option<ClipFormat>,
}

/// What a manifest may say; what it says wrongly is no less there.
fn stated<T: serde::de::DeserializeOwned>(
    contents: &serde_json::Value,
    key: &str,
) -> Result<Option<T>, StageError> {
    match contents.get(key) {
        None | Some(serde_json::Value::Null) => Ok(None),
        Some(value) => serde_json::from_value(value.clone())
            .map(Some)
            .map_err(|error| damaged(&format!("`{key}` of the manifest: {error}"))),
    }
}

impl Run {
    pub(super) fn prepare(
        settings: &TrainMgetSettings,
        context: &mut dyn StageContext,
    ) -> Result<Self, StageError> {
        let seed = context.seed();
        let artifacts: Vec<InputArtifact> = context.inputs("tokens").to_vec();
        let first = artifacts
            .first()
            .ok_or_else(|| damaged("no tokens arrived"))?;
        let facts: BTreeMap<String, TokenFacts> =
            serde_json::from_value(first.contents["tokens"].clone())
                .map_err(|error| damaged(&format!("`tokens` of the manifest: {error}")))?;
        let pixels = stated(&first.contents, PIXELS)?;
        let spec = spec(settings, &facts, pixels);
        let masking =
            Masking::new(&settings.masking.settings, &spec.slots()).map_err(StageError::other)?;

        same_tokenizers(&spec, &artifacts)?;
        let mut sources: Vec<Arc<dyn TokenSource>> = Vec::new();
        for artifact in &artifacts {
            let shards = Shards::open(&artifact.path.join("train"), &artifact.stage, &spec)
                .map_err(input_error)?;
            sources.push(Arc::new(shards));
        }
        let names: Vec<&str> = sources.iter().map(|source| source.name()).collect();
        let lengths: Vec<usize> = sources
            .iter()
            .map(|source| settings.used(source.len() as u64) as usize)
            .collect();
        let weights = (!settings.weights.is_empty()).then_some(settings.weights.as_slice());
        let order = Sampler::new(seed, &names, &lengths, weights).map_err(input_error)?;
        let training = &settings.training;
        let schedule = training
            .learning_rates(measure(settings, lengths.iter().sum::<usize>() as u64))
            .map_err(StageError::other)?;

        let held_out = Shards::open(&first.path.join("validation"), &first.stage, &spec)
            .map_err(input_error)?;
        let micro_batches = training.micro_batches();
        let validation = Validation::new(
            &spec,
            &masking,
            &held_out,
            training.validation_clips,
            micro_batches[0],
            seed,
        )
        .map_err(input_error)?;
        let unigram =
            Unigram::fit(&spec, &sources, &lengths, UNIGRAM_CLIPS).map_err(input_error)?;
        let baseline = validation.baseline(&unigram);

        let compute =
            Compute::new(settings.device, 0, settings.precision).map_err(StageError::other)?;
        let model =
            Mget::new(&spec, &Initialise::new(&compute, seed)).map_err(StageError::other)?;
        context.log(&format!(
            "{} parameters, {} training clips, {} steps of {} clips",
            spec.parameter_count(),
            lengths.iter().sum::<usize>(),
            schedule.total(),
            training.batch,
        ));
        let mut trainer = Trainer::new(model, training, schedule);
        if let Some((step, path)) = checkpoint::latest(context.checkpoints()) {
            trainer.resume(&path).map_err(StageError::other)?;
            context.log(&format!("continues from step {step}"));
        }
        let clips = stated(&first.contents, "format")?;
        let tokenizers = Some(first.path.join(TOKENIZERS)).filter(|path| path.is_dir());
        Ok(Self {
            trainer,
            feed: Arc::new(BatchSource {
                spec,
                masking: masking.clone(),
                sources,
                order,
                seed,
                micro_batches,
                repeat: training.repeat,
            }),
            validation,
            baseline,
            settings: training.clone(),
            masking,
            tokenizers,
            clips,
        })
    }

    pub(super) fn train(mut self, context: &mut dyn StageContext) -> Result<Value, StageError> {
        let total = self.trainer.total_steps();
        let start = self.trainer.progress();
        if context.interrupted() && start.step < total {
            save(&self.trainer, context)?;
            return Err(StageError::Interrupted);
        }
        let loader = Loader::start(&self.feed, start.step..total, self.settings.loader_threads);
        let loader = RefCell::new(loader);
        let watch = Stopwatch::start();
        let mut last = (start, 0.0);
        let (validation, baseline) = (&self.validation, &self.baseline);
        let (input, target) = self.masking.nominal_tokens();
        let fitted = fit(
            &mut self.trainer,
            Intervals {
                validate_every: self.settings.validate_every,
                checkpoint_every: self.settings.checkpoint_every,
            },
            |_, _| -> Result<_, Failure> {
                let batch = loader.borrow_mut().next(&|| watch.seconds());
                Ok(batch.map_err(TrainingError::from)?)
            },
            |objective| Ok(validation.run(objective.module())),
            |event| {
                match event {
                    Event::Step { report, total } => {
                        let tokens = real(report.progress) - real(last.0);
                        let rate = tokens as f64 / (watch.seconds() - last.1).max(1e-9);
                        last = (report.progress, watch.seconds());
                        record(context, report, input + target, rate)?;
                        context.progress(report.step, total, "steps");
                        if report.step == total {
                            waited(context, total, loader.borrow().waited() / watch.seconds())?;
                        }
                    }
                    Event::Validation(held_out) => held_out_losses(context, held_out, baseline)?,
                    Event::Checkpoint(trainer) => save(trainer, context)?,
                }
                let stop = context.interrupted();
                Ok(if stop { Flow::Stop } else { Flow::Continue })
            },
        )?;
        drop(loader);
        if fitted.flow == Flow::Stop {
            return Err(StageError::Interrupted);
        }
        self.publish(context, &fitted.held_out)
    }

    fn publish(
        self,
        context: &mut dyn StageContext,
        held_out: &HeldOut,
    ) -> Result<Value, StageError> {
        let scores = &held_out.scores;
        let output = context.output().to_path_buf();
        self.trainer
            .model()
            .save(&output)
            .map_err(StageError::other)?;
        let validation = json!({"validation": scores, "unigram": self.baseline});
        let path = output.join(VALIDATION);
        std::fs::write(&path, format!("{validation:#}\n")).map_err(StageError::io(&path))?;
        let report = output.join("report");
        std::fs::create_dir_all(&report).map_err(StageError::io(&report))?;
        let path = report.join("validation.md");
        std::fs::write(&path, table(scores, &self.baseline)).map_err(StageError::io(&path))?;
        if let Some(tokenizers) = &self.tokenizers {
            copy_tree(tokenizers, &output.join(TOKENIZERS)).map_err(StageError::other)?;
        }
        if let Some(clips) = self.clips {
            let binding = ModelManifest::of(&output, clips).map_err(StageError::other)?;
            binding.write(&output).map_err(StageError::other)?;
        }
        let mut made = json!({
            "mget": self.feed.spec,
            "parameters": self.feed.spec.parameter_count(),
            "progress": self.trainer.progress(),
            "validation": scores,
            "unigram": self.baseline,
        });
        if self.settings.keep == Keep::Best {
            made["best_step"] = json!(held_out.step);
        }
        Ok(made)
    }
}

fn save(
    trainer: &Trainer<MaskedPrediction>,
    context: &mut dyn StageContext,
) -> Result<(), StageError> {
    checkpoint::save(context, trainer.progress().step, |_, directory| {
        trainer.save(directory).map_err(StageError::other)
    })
}

/// Tokens that were there.
fn real(progress: Progress) -> u64 {
    progress.input_tokens + progress.target_tokens
}

/// Records a step.
fn record(
    context: &mut dyn StageContext,
    report: &StepReport,
    nominal: usize,
    rate: f64,
) -> Result<(), StageError> {
    let mut scalars = report.scalars();
    scalars.extend([
        (
            "tokens/nominal",
            report.progress.samples as f64 * nominal as f64,
        ),
        ("tokens/real", real(report.progress) as f64),
        ("tokens/per_second", rate),
    ]);
    context.record(report.step, &scalars)
}

fn waited(context: &mut dyn StageContext, step: u64, share: f64) -> Result<(), StageError> {
    context.log(&format!(
        "{:.1}% of the time was spent waiting for data",
        100.0 * share
    ));
    context.record(step, &[("data/wait_share", share)])
}

fn held_out_losses(
    context: &mut dyn StageContext,
    held_out: &HeldOut,
    baseline: &BTreeMap<String, Score>,
) -> Result<(), StageError> {
    let mut scalars = Vec::new();
    for (name, score) in &held_out.scores {
        scalars.push((format!("validation/{name}"), score.loss));
        scalars.push((format!("unigram/{name}"), unigram(baseline, name)));
    }
    scalars.extend(
        held_out
            .mean()
            .map(|mean| ("validation/mean".to_owned(), mean)),
    );
    let scalars: Vec<(&str, f64)> = scalars
        .iter()
        .map(|(name, value)| (name.as_str(), *value))
        .collect();
    context.record(held_out.step, &scalars)?;
    context.record_text(
        held_out.step,
        "validation",
        &table(&held_out.scores, baseline),
    )
}

/// The held-out loss that token frequencies alone give.
fn unigram(baseline: &BTreeMap<String, Score>, modality: &str) -> f64 {
    baseline.get(modality).map_or(f64::NAN, |score| score.loss)
}

/// Held-out losses beside the baseline, as Markdown.
fn table(scores: &BTreeMap<String, Score>, baseline: &BTreeMap<String, Score>) -> String {
    let mut text = String::from(
        "| modality | held-out loss (nats) | token frequencies alone | tokens |\n|---|---:|---:|---:|\n",
    );
    for (name, Score { loss, tokens }) in scores {
        let unigram = unigram(baseline, name);
        let _ = writeln!(text, "| {name} | {loss:.4} | {unigram:.4} | {tokens} |");
    }
    text
}

/// Refuses token sets of other tokenizers than the first one's: the same numbers would mean other signals, in grids that fit.
///
/// Sets that bring no tokenizer of a modality are believed.
fn same_tokenizers(spec: &MgetSpec, artifacts: &[InputArtifact]) -> Result<(), StageError> {
    let Some((first, others)) = artifacts.split_first().filter(|(_, o)| !o.is_empty()) else {
        return Ok(());
    };
    let digests = |artifact: &InputArtifact| ModelManifest::digests(&artifact.path);
    let known = digests(first).map_err(StageError::other)?;
    for other in others {
        let found = digests(other).map_err(StageError::other)?;
        for name in spec.modalities.iter().map(|modality| &modality.name) {
            if let (Some(known), Some(found)) = (known.get(name), found.get(name))
                && known != found
            {
                return Err(StageError::Input {
                    code: Code::E0401,
                    message: format!(
                        "`{}` and `{}` were made with different tokenizers of `{name}`",
                        first.stage, other.stage
                    ),
                    help: "make all tokens with the same tokenizers".into(),
                });
            }
        }
    }
    Ok(())
}

fn damaged(reason: &str) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: format!("the tokens artifact cannot be used: {reason}"),
        help: "run the stage that makes it again".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mget::{ModalitySpec, Positions, Size};
    use std::path::Path;

    fn tokens(root: &Path, stage: &str, tokenizer: Option<&[u8]>) -> InputArtifact {
        let path = root.join(stage);
        if let Some(bytes) = tokenizer {
            let folder = path.join(TOKENIZERS).join("camera");
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("weights.safetensors"), bytes).unwrap();
        }
        InputArtifact {
            stage: stage.to_owned(),
            op: "tokenize".to_owned(),
            path,
            contents: Value::Null,
        }
    }

    #[test]
    fn tokens_of_other_tokenizers_are_refused_and_both_stages_named() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let of = |name: &str| MgetSpec {
            size: Size::default(),
            positions: Positions::Released,
            modalities: vec![ModalitySpec::tokens(name, &[30], 64)],
        };
        let first = tokens(root, "first", Some(b"a"));
        let same = tokens(root, "same", Some(b"a"));
        let other = tokens(root, "other", Some(b"b"));
        let unknown = tokens(root, "unknown", None);
        let check = |spec: &str, sets: &[&InputArtifact]| {
            let sets: Vec<InputArtifact> = sets.iter().map(|set| (*set).clone()).collect();
            same_tokenizers(&of(spec), &sets)
        };
        check("camera", &[&first, &same, &unknown]).unwrap();
        check("gaze", &[&first, &other]).unwrap();
        check("camera", &[&other]).unwrap();
        match check("camera", &[&first, &same, &other]) {
            Err(StageError::Input { code, message, .. }) => {
                assert_eq!(code, Code::E0401);
                assert!(message.contains("`first` and `other`"), "{message}");
            }
            other => panic!("{other:?}"),
        }
    }
}
