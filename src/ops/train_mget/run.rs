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
    BatchSource, DataError, Loader, Sampler, Score, Shards, StepReport, TokenSource, Trainer,
    TrainingError, TrainingSettings, Unigram, Validation,
};
use serde_json::{Value, json};
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

/// A stage under way.
pub(super) struct Run {
    trainer: Trainer,
    feed: Arc<BatchSource>,
    validation: Validation,
    baseline: BTreeMap<String, Score>,
    settings: TrainingSettings,
    masking: Masking,
    tokenizers: Option<std::path::PathBuf>,
    /// The sizes of the clips the tokens were made of, where the tokens say it.
    clips: Option<ClipFormat>,
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
        let pixels = serde_json::from_value(first.contents[PIXELS].clone()).ok();
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
        let clips = serde_json::from_value(first.contents["format"].clone()).ok();
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
        let start = self.trainer.progress().step;
        let mut loader = Loader::start(&self.feed, start..total, self.settings.loader_threads);
        let watch = Stopwatch::start();
        let mut seconds = 0.0;
        while self.trainer.progress().step < total {
            if context.interrupted() {
                self.save(context)?;
                return Err(StageError::Interrupted);
            }
            let before = self.trainer.progress();
            let report = self
                .trainer
                .step(self.feed.micro_batches.len(), || {
                    loader.next(&|| watch.seconds())
                })
                .map_err(input_error)?;
            let tokens = report.progress.input_tokens + report.progress.target_tokens
                - before.input_tokens
                - before.target_tokens;
            let rate = tokens as f64 / (watch.seconds() - seconds).max(1e-9);
            seconds = watch.seconds();
            self.record(context, &report, rate)?;
            context.progress(report.step, total, "steps");
            let every = |interval: u64| {
                interval > 0 && report.step.is_multiple_of(interval) && report.step < total
            };
            if every(self.settings.validate_every) {
                self.validate(context)?;
            }
            if every(self.settings.checkpoint_every) {
                self.save(context)?;
            }
        }
        if watch.seconds() > 0.0 && start < total {
            let share = loader.waited() / watch.seconds();
            context.log(&format!(
                "{:.1}% of the time was spent waiting for data",
                100.0 * share
            ));
            context.record(total, &[("data/wait_share", share)])?;
        }
        drop(loader);
        let scores = self.validate(context)?;
        self.publish(context, &scores)
    }

    fn save(&self, context: &mut dyn StageContext) -> Result<(), StageError> {
        let step = self.trainer.progress().step;
        checkpoint::save(context, step, |_, directory| {
            self.trainer.save(directory).map_err(StageError::other)
        })
    }

    fn record(
        &self,
        context: &mut dyn StageContext,
        report: &StepReport,
        rate: f64,
    ) -> Result<(), StageError> {
        let names: Vec<String> = self
            .feed
            .spec
            .modalities
            .iter()
            .map(|m| format!("loss/{}", m.name))
            .collect();
        let (input, target) = self.masking.nominal_tokens();
        let nominal = report.progress.samples as f64 * (input + target) as f64;
        let real = (report.progress.input_tokens + report.progress.target_tokens) as f64;
        let mut scalars = vec![
            ("loss", report.loss),
            ("learning_rate", report.learning_rate),
            ("gradient_norm", report.gradient_norm),
            ("tokens/nominal", nominal),
            ("tokens/real", real),
            ("tokens/per_second", rate),
        ];
        for (name, loss) in names.iter().zip(&report.modalities) {
            if let Some((loss, _)) = loss {
                scalars.push((name, *loss));
            }
        }
        context.record(report.step, &scalars)
    }

    fn validate(
        &self,
        context: &mut dyn StageContext,
    ) -> Result<BTreeMap<String, Score>, StageError> {
        let scores = self.validation.run(self.trainer.model());
        let step = self.trainer.progress().step;
        let mut scalars = Vec::new();
        for (name, score) in &scores {
            scalars.push((format!("validation/{name}"), score.loss));
            scalars.push((format!("unigram/{name}"), self.unigram(name)));
        }
        if !scores.is_empty() {
            let mean = scores.values().map(|score| score.loss).sum::<f64>() / scores.len() as f64;
            scalars.push(("validation/mean".to_owned(), mean));
            let scalars: Vec<(&str, f64)> = scalars
                .iter()
                .map(|(name, value)| (name.as_str(), *value))
                .collect();
            context.record(step, &scalars)?;
            context.record_text(step, "validation", &self.table(&scores))?;
        }
        Ok(scores)
    }

    /// The held-out loss that token frequencies alone give.
    fn unigram(&self, modality: &str) -> f64 {
        let baseline = self.baseline.get(modality);
        baseline.map_or(f64::NAN, |score| score.loss)
    }

    /// Held-out losses beside the baseline, as Markdown.
    fn table(&self, scores: &BTreeMap<String, Score>) -> String {
        let mut text = String::from(
            "| modality | held-out loss (nats) | token frequencies alone | tokens |\n|---|---:|---:|---:|\n",
        );
        for (name, Score { loss, tokens }) in scores {
            let unigram = self.unigram(name);
            let _ = writeln!(text, "| {name} | {loss:.4} | {unigram:.4} | {tokens} |");
        }
        text
    }

    fn publish(
        self,
        context: &mut dyn StageContext,
        scores: &BTreeMap<String, Score>,
    ) -> Result<Value, StageError> {
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
        std::fs::write(&path, self.table(scores)).map_err(StageError::io(&path))?;
        if let Some(tokenizers) = &self.tokenizers {
            copy_tree(tokenizers, &output.join(TOKENIZERS)).map_err(StageError::other)?;
        }
        if let Some(clips) = self.clips {
            let binding = ModelManifest::of(&output, clips).map_err(StageError::other)?;
            binding.write(&output).map_err(StageError::other)?;
        }
        Ok(json!({
            "mget": self.feed.spec,
            "parameters": self.feed.spec.parameter_count(),
            "progress": self.trainer.progress(),
            "validation": scores,
            "unigram": self.baseline,
        }))
    }
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
