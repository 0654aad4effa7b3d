//! Running `op: train_tokenizer`: settings in, one call, scores and pictures out.

use super::super::clip_signals::{damaged, format, modality, open_split};
use super::super::device::{compute, ranks};
use super::super::modality_entry::DEFAULTS;
use super::{TrainTokenizerSettings, picture, report, tokens};
use crate::clip::joined::Joined;
use crate::clip::source::ClipSource;
use crate::engine::Precision;
use crate::experiment::{Code, StageContext, StageError};
use crate::run::checkpoint;
use crate::training::tokenizer_scores::Scores;
use crate::training::{
    DataError, Event, Flow, Intervals, Keep, Mixture, TokenizerFit, TrainingError,
};
use serde_json::{Value, json};
use std::sync::Arc;

pub(super) fn run(
    settings: &TrainTokenizerSettings,
    context: &mut dyn StageContext,
) -> Result<Value, StageError> {
    let artifacts = context.inputs("clips").to_vec();
    let clips = artifacts
        .first()
        .ok_or_else(|| damaged("no clips arrived"))?;
    let format = format(clips)?;
    let name = &settings.modality;
    let modality = modality(&format, name)
        .ok_or_else(|| damaged(&format!("the clips have no modality `{name}`")))?;
    let entry = settings
        .entry(clips.contents.get(DEFAULTS))
        .ok_or_else(|| damaged("no tokenizer is named"))?;
    let mut sources: Vec<Arc<dyn ClipSource>> = Vec::new();
    let mut held_out: Vec<Arc<dyn ClipSource>> = Vec::new();
    for clips in &artifacts {
        let train = open_split(&clips.path, "train")?;
        sources.push(Arc::new(train.ok_or_else(|| {
            damaged(&format!(
                "the clips of `{}` have no `train` split",
                clips.stage
            ))
        })?));
        if let Some(validation) = open_split(&clips.path, "validation")? {
            held_out.push(Arc::new(validation));
        }
    }
    let names = artifacts.iter().map(|clips| clips.stage.as_str());
    let sets: Vec<(&str, usize)> = names.zip(sources.iter().map(|set| set.len())).collect();
    let train = Joined::new(sources);
    let held_out = Joined::at_most(held_out, settings.validation_clips);
    let having = (0..train.len()).filter(|index| train.may_have(*index, name));
    let having = having.count();
    let resume = checkpoint::latest(context.checkpoints());
    let compute = compute(settings.device, Precision::F32, context)?;
    let training = settings.training(having as u64);
    let ranks = ranks(&compute, training.reduction, context)?;
    let root = ranks.is_root();
    let fit = TokenizerFit {
        modality: name,
        format: &format,
        train: &train,
        mixture: Mixture {
            sets: &sets,
            weights: (!settings.weights.is_empty()).then_some(settings.weights.as_slice()),
        },
        held_out: (!held_out.is_empty()).then_some(&held_out),
        held_out_clips: settings.validation_clips,
        tokenizer: &entry.settings,
        training,
        intervals: Intervals {
            validate_every: settings.validate_every,
            checkpoint_every: settings.checkpoint_every,
            read_every: settings.read_every,
        },
        calibrate: settings.calibrate,
        mirror: settings.other_hand(),
        kmeans: settings.kmeans,
        compute: &compute,
        ranks,
        seed: context.seed(),
        resume: resume.map(|(_, path)| path),
    };
    let mut checkpoints = checkpoint::Background::default();
    let fitted = fit
        .run(&mut |event| {
            if root {
                heard(event, having, settings, &mut checkpoints, context)
            } else {
                Ok(Flow::Continue)
            }
        })
        .map_err(|failure: Failure| match failure {
            Failure::Training(error) => failed(error, settings),
            Failure::Stage(error) => error,
        });
    let fitted = checkpoints.end(fitted)?;
    // Rank 0 alone writes.
    if !root {
        return Ok(Value::Null);
    }
    if settings.keep == Keep::Best {
        context.log(&format!(
            "keeps the weights of step {}",
            fitted.held_out.step
        ));
    }
    let tokenizer = fitted.tokenizer.as_ref();
    tokenizer
        .write(context.output())
        .map_err(StageError::other)?;
    let scores = &fitted.scores;
    record(scores, settings.steps, context)?;
    let path = context.output().join("scores.json");
    let text = format!("{:#}\n", json!(scores));
    std::fs::write(&path, text).map_err(StageError::io(&path))?;
    let shape = modality.shape();
    let facts = tokens(&entry.settings, &shape).map_err(|reason| damaged(&reason))?;
    let page = report::markdown(
        settings,
        &entry.name,
        &facts,
        fitted.parameters,
        &shape,
        scores,
    );
    super::super::evaluate::write_text(context.output(), "report/tokenizer.md", &page)?;
    if let Some((name, bytes)) = picture::draw(&shape, &fitted.examples) {
        let path = context.output().join("report").join(name);
        std::fs::write(&path, bytes).map_err(StageError::io(&path))?;
    }
    Ok(json!({
        "modality": name,
        "tokenizer": entry.name,
        "tokens": {(name.clone()): facts},
        "parameters": fitted.parameters,
        "steps": settings.steps,
        "scores": scores,
    }))
}

/// Why training ended early.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error(transparent)]
    Training(#[from] TrainingError),
    #[error(transparent)]
    Stage(#[from] StageError),
}

/// Into the record of the run.
fn heard(
    event: Event<'_>,
    signals: usize,
    settings: &TrainTokenizerSettings,
    checkpoints: &mut checkpoint::Background,
    context: &mut dyn StageContext,
) -> Result<Flow, Failure> {
    match event {
        Event::Start {
            parameters, step, ..
        } => {
            let name = &settings.modality;
            context.log(&format!(
                "{parameters} parameters, {signals} training clips with `{name}`"
            ));
            if step > 0 {
                context.log(&format!("continues from step {step}"));
            }
        }
        Event::Step { report, total } => {
            context.record(report.step, &report.scalars())?;
            context.progress(report.step, total, "steps");
        }
        Event::Validation(held_out) => {
            let loss = held_out.mean().map(|mean| ("validation/loss", mean));
            context.record(held_out.step, loss.as_slice())?;
        }
        Event::Checkpoint(state) => {
            let snapshot = state.snapshot()?;
            checkpoints.save(context, state.step(), move |folder| {
                snapshot.write(folder).map_err(StageError::other)
            })?;
        }
        Event::Progress { done, total, unit } => {
            context.progress(done as u64, total as u64, unit);
        }
    }
    let stop = context.interrupted();
    Ok(if stop { Flow::Stop } else { Flow::Continue })
}

/// Into the metrics of the stage, at its last step.
fn record(scores: &Scores, step: u64, context: &mut dyn StageContext) -> Result<(), StageError> {
    let mut scalars = Vec::new();
    for (kind, errors) in [
        ("validation", &scores.reconstruction),
        ("baseline_mean", &scores.mean),
        ("baseline_kmeans", &scores.kmeans),
    ] {
        let each = errors.iter();
        scalars.extend(each.map(|(name, v)| (format!("{kind}/{name}"), *v)));
    }
    for (name, value) in [("usage", scores.usage), ("perplexity", scores.perplexity)] {
        scalars.extend(value.map(|value| (format!("codes/{name}"), value)));
    }
    let scalars: Vec<(&str, f64)> = scalars.iter().map(|(n, v)| (n.as_str(), *v)).collect();
    if scalars.is_empty() {
        return Ok(());
    }
    context.record(step, &scalars)
}

fn failed(error: TrainingError, settings: &TrainTokenizerSettings) -> StageError {
    match error {
        TrainingError::Stopped => StageError::Interrupted,
        error @ (TrainingError::Loss { .. } | TrainingError::Gradient(_)) => StageError::Input {
            code: Code::E0206,
            message: error.to_string(),
            help: format!("try a `learning_rate` below {}", settings.learning_rate),
        },
        TrainingError::NoData => StageError::Input {
            code: Code::E0401,
            message: format!("no training clip has the modality `{}`", settings.modality),
            help: "take other clips, or leave this tokenizer out".to_owned(),
        },
        TrainingError::Data(DataError::Empty(set)) => StageError::Input {
            code: Code::E0401,
            message: format!(
                "no training clip of `{set}` has the modality `{}`",
                settings.modality
            ),
            help: "leave this data set out, or give it a weight of 0".to_owned(),
        },
        error @ (TrainingError::Clips(_) | TrainingError::Clip { .. }) => {
            damaged(&error.to_string())
        }
        error => StageError::other(error),
    }
}
