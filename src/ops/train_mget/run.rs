//! Running `op: train_mget`: tokens in, one call, a model folder out.

use super::super::device::{compute, ranks};
use super::super::evaluate::write_text;
use super::{TrainMgetSettings, spec};
use crate::experiment::{Code, InputArtifact, StageContext, StageError, TokenFacts};
use crate::masking::{Masking, PIXELS};
use crate::mget::MgetSpec;
use crate::model::{ModelManifest, TOKENIZERS};
use crate::run::checkpoint;
use crate::run::environment::Stopwatch;
use crate::run::files::copy_tree;
use crate::training::mget_fit::held_out_table;
use crate::training::{
    DataError, Event, FittedMget, Flow, HeldOut, Keep, MgetFit, StepReport, TokenShards,
    TokenSource, TrainingError, TrainingSettings,
};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The file of held-out losses.
const VALIDATION: &str = "validation.json";

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
        TrainingError::Stopped => StageError::Interrupted,
        error => StageError::other(error),
    }
}

pub(super) fn run(
    settings: &TrainMgetSettings,
    context: &mut dyn StageContext,
) -> Result<Value, StageError> {
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
    let open = |artifact: &InputArtifact, split: &str| {
        TokenShards::open(&artifact.path.join(split), &artifact.stage, &spec).map_err(input_error)
    };
    let mut sources: Vec<Arc<dyn TokenSource>> = Vec::new();
    for artifact in &artifacts {
        sources.push(Arc::new(open(artifact, "train")?));
    }
    let lengths: Vec<usize> = sources
        .iter()
        .map(|source| settings.used(source.len() as u64) as usize)
        .collect();
    let held_out = open(first, "validation")?;
    let compute = compute(settings.device, settings.precision, context)?;
    let ranks = ranks(&compute, settings.training.reduction, context)?;
    let root = ranks.is_root();
    let watch = Stopwatch::start();
    let (input, target) = masking.nominal_tokens();
    let mut record = Record {
        watch: &watch,
        clips: lengths.iter().sum(),
        batch: settings.training.batch,
        nominal: input + target,
        last: None,
        checkpoints: checkpoint::Background::default(),
    };
    let fit = MgetFit {
        spec: spec.clone(),
        masking,
        sources,
        lengths,
        weights: (!settings.weights.is_empty()).then_some(settings.weights.as_slice()),
        held_out: &held_out,
        settings: &settings.training,
        compute: &compute,
        ranks,
        seed: context.seed(),
        resume: checkpoint::latest(context.checkpoints()).map(|(_, path)| path),
        clock: &|| watch.seconds(),
    };
    let fitted = fit
        .run(&mut |event| {
            if root {
                record.heard(event, context)
            } else {
                Ok(Flow::Continue)
            }
        })
        .map_err(|failure| match failure {
            Failure::Training(error) => input_error(error),
            Failure::Stage(error) => error,
        });
    let fitted = record.checkpoints.end(fitted)?;
    // Rank 0 alone writes.
    if !root {
        return Ok(Value::Null);
    }
    let sources: Vec<String> = context
        .inputs("tokens")
        .iter()
        .filter_map(|tokens| stated(&tokens.contents, "source").transpose())
        .collect::<Result<_, _>>()?;
    publish(&fitted, first, sources, &settings.training, context)
}

/// Why training ended early.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error(transparent)]
    Training(#[from] TrainingError),
    #[error(transparent)]
    Stage(#[from] StageError),
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

/// What goes into the record of the run.
struct Record<'a> {
    watch: &'a Stopwatch,
    clips: usize,
    batch: usize,
    /// Nominal tokens of a sample.
    nominal: usize,
    /// Totals and time of the step before.
    last: Option<(u64, f64)>,
    checkpoints: checkpoint::Background,
}

impl Record<'_> {
    fn heard(&mut self, event: Event<'_>, context: &mut dyn StageContext) -> Result<Flow, Failure> {
        match event {
            Event::Start {
                parameters,
                step,
                total,
            } => {
                let (clips, batch) = (self.clips, self.batch);
                context.log(&format!(
                    "{parameters} parameters, {clips} training clips, {total} steps of {batch} clips"
                ));
                if step > 0 {
                    context.log(&format!("continues from step {step}"));
                }
            }
            Event::Step { report, total } => {
                self.step(report, context)?;
                context.progress(report.step, total, "steps");
                if report.step == total {
                    let share = report.waited / self.watch.seconds().max(1e-9);
                    let percent = 100.0 * share;
                    context.log(&format!(
                        "{percent:.1}% of the time was spent waiting for data"
                    ));
                    context.record(total, &[("data/wait_share", share)])?;
                }
            }
            Event::Validation(held_out) => held_out_losses(held_out, context)?,
            Event::Checkpoint(state) => {
                let snapshot = state.snapshot()?;
                self.checkpoints
                    .save(context, state.step(), move |folder| {
                        snapshot.write(folder).map_err(StageError::other)
                    })?;
            }
            Event::Progress { .. } => {}
        }
        let stop = context.interrupted();
        Ok(if stop { Flow::Stop } else { Flow::Continue })
    }

    fn step(
        &mut self,
        report: &StepReport,
        context: &mut dyn StageContext,
    ) -> Result<(), StageError> {
        let used = &report.progress;
        let real = used.input_tokens + used.target_tokens;
        let nominal = used.samples as f64 * self.nominal as f64;
        let now = self.watch.seconds();
        let mut scalars = report.scalars();
        scalars.push(("tokens/nominal", nominal));
        scalars.push(("tokens/real", real as f64));
        // Of steps that were read at once, all have ended now.
        if report.behind > 0 {
            return context.record(report.step, &scalars);
        }
        if let Some((before, then)) = self.last.replace((real, now)) {
            let rate = (real - before) as f64 / (now - then).max(1e-9);
            scalars.push(("tokens/per_second", rate));
        }
        context.record(report.step, &scalars)
    }
}

fn held_out_losses(held_out: &HeldOut, context: &mut dyn StageContext) -> Result<(), StageError> {
    let mut scalars = Vec::new();
    for (name, score) in &held_out.scores {
        scalars.push((format!("validation/{name}"), score.loss));
        scalars.push((format!("unigram/{name}"), held_out.baseline_of(name)));
    }
    let mean = held_out
        .mean()
        .map(|mean| ("validation/mean".to_owned(), mean));
    scalars.extend(mean);
    let scalars: Vec<(&str, f64)> = scalars
        .iter()
        .map(|(name, value)| (name.as_str(), *value))
        .collect();
    context.record(held_out.step, &scalars)?;
    context.record_text(held_out.step, "validation", &held_out_table(held_out))
}

fn publish(
    fitted: &FittedMget,
    tokens: &InputArtifact,
    sources: Vec<String>,
    settings: &TrainingSettings,
    context: &mut dyn StageContext,
) -> Result<Value, StageError> {
    let output = context.output().to_path_buf();
    let (model, held_out) = (&fitted.model, &fitted.held_out);
    model.save(&output).map_err(StageError::other)?;
    let validation = json!({"validation": held_out.scores, "unigram": held_out.baseline});
    let path = output.join(VALIDATION);
    std::fs::write(&path, format!("{validation:#}\n")).map_err(StageError::io(&path))?;
    write_text(&output, "report/validation.md", &held_out_table(held_out))?;
    let tokenizers = tokens.path.join(TOKENIZERS);
    if tokenizers.is_dir() {
        copy_tree(&tokenizers, &output.join(TOKENIZERS)).map_err(StageError::other)?;
    }
    // The sizes of the clips the tokens were made of, where the tokens say it.
    if let Some(clips) = stated(&tokens.contents, "format")? {
        let manifest = ModelManifest::of(&output, clips).map_err(StageError::other)?;
        let manifest = manifest.trained_on(sources);
        manifest.write(&output).map_err(StageError::other)?;
    }
    let mut made = json!({
        "mget": model.spec(),
        "parameters": model.spec().parameter_count(),
        "progress": fitted.progress,
        "validation": held_out.scores,
        "unigram": held_out.baseline,
    });
    if settings.keep == Keep::Best {
        made["best_step"] = json!(held_out.step);
    }
    Ok(made)
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
