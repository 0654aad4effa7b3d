//! Running `op: train_tokenizer`: reading, the loop, what leaves.

use super::super::clip_signals::{damaged, extract, format, modality, open_split};
use super::super::modality_entry::DEFAULTS;
use super::super::tokenizer_entry::TokenizerEntry;
use super::picture::{self, Example};
use super::scores::{Baselines, Scores, score};
use super::{TrainTokenizerSettings, compute, report, tokens};
use crate::clip::Signal;
use crate::clip::store::ClipSet;
use crate::engine::{Initialise, Parameters};
use crate::experiment::{Code, StageContext, StageError};
use crate::modality::declared::Normalize;
use crate::modality::{ClipFormat, Modality, Shape};
use crate::run::checkpoint;
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::trained::{VqTokenizer, batch, prepare};
use crate::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use crate::tokenizer::vq::{VqSettings, VqVae};
use crate::tokenizer::{Tokenizer, TokenizerError};
use crate::training::kmeans::KMeans;
use crate::training::tokenizer::{Epochs, mirrored};
use crate::training::video_kmeans::VideoKMeans;
use crate::training::{
    Event, Flow, Intervals, Keep, Objective, Score, Trainer, TrainingError, fit,
};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Clips read at a time.
const CHUNK: usize = 256;

/// Clips that a new network is calibrated on.
const CALIBRATE: usize = 64;

/// Clips whose mean is the trivial prediction of a video.
const MEAN_CLIPS: usize = 64;

/// What arrives.
struct Data {
    train: ClipSet,
    validation: Option<ClipSet>,
    format: ClipFormat,
    modality: Box<dyn Modality>,
}

pub(super) fn run(
    settings: &TrainTokenizerSettings,
    context: &mut dyn StageContext,
) -> Result<Value, StageError> {
    let clips = context
        .inputs("clips")
        .first()
        .cloned()
        .ok_or_else(|| damaged("no clips arrived"))?;
    let format = format(&clips)?;
    let modality = modality(&format, &settings.modality).ok_or_else(|| {
        damaged(&format!(
            "the clips have no modality `{}`",
            settings.modality
        ))
    })?;
    let entry = settings
        .entry(clips.contents.get(DEFAULTS))
        .ok_or_else(|| damaged("no tokenizer is named"))?;
    let data = Data {
        train: open_split(&clips.path, "train")?
            .ok_or_else(|| damaged("the clips have no `train` split"))?,
        validation: open_split(&clips.path, "validation")?,
        format,
        modality,
    };
    let (scores, examples, count) = match &entry.settings {
        TokenizerEntry::Vq(sizes) => train_vq(settings, sizes, &data, context)?,
        TokenizerEntry::Video(sizes) => train_video(settings, sizes, &data, context)?,
    };
    scores.record(settings.steps, context)?;
    let path = context.output().join("scores.json");
    let text = format!("{:#}\n", json!(scores));
    std::fs::write(&path, text).map_err(StageError::io(&path))?;
    let facts =
        tokens(&entry.settings, &data.modality.shape()).map_err(|reason| damaged(&reason))?;
    let page = report::markdown(
        settings,
        &entry.name,
        &facts,
        count,
        &data.modality.shape(),
        &scores,
    );
    super::super::evaluate::write_text(context.output(), "report/tokenizer.md", &page)?;
    if let Some((name, bytes)) = picture::draw(&data.modality.shape(), &examples) {
        let path = context.output().join("report").join(name);
        std::fs::write(&path, bytes).map_err(StageError::io(&path))?;
    }
    Ok(json!({
        "modality": settings.modality,
        "tokenizer": entry.name,
        "tokens": {(settings.modality.clone()): facts},
        "parameters": count,
        "steps": settings.steps,
        "scores": scores,
    }))
}

fn train_vq(
    settings: &TrainTokenizerSettings,
    sizes: &VqSettings,
    data: &Data,
    context: &mut dyn StageContext,
) -> Result<(Scores, Vec<Example>, usize), StageError> {
    let modality = data.modality.as_ref();
    let shape = modality.shape();
    let compute = compute(settings)?;
    let mut model = VqVae::new(&Initialise::new(&compute, context.seed()), sizes, &shape)
        .map_err(StageError::other)?;
    let signals = read_signals(settings, data, context)?;
    let normaliser = normaliser(
        settings,
        data,
        &signals,
        model.patches().values_per_sample(),
    )
    .map_err(StageError::other)?;
    let prepared = prepare(&settings.modality, &model, &normaliser, &signals)
        .map_err(|error| damaged(&error.to_string()))?;
    drop(signals);
    let count = model.count();
    context.log(&format!(
        "{count} parameters, {} training signals of `{}`",
        prepared.len(),
        settings.modality
    ));
    if settings.calibrate && !prepared.is_empty() {
        let first = &prepared[..prepared.len().min(CALIBRATE)];
        let batches: Vec<_> = first.chunks(16).map(|part| batch(&model, part)).collect();
        model.calibrate(&batches).map_err(StageError::other)?;
    }
    let held_out = match &data.validation {
        Some(set) if settings.validates() => {
            let most = settings.validation_clips.min(set.len());
            let found = extract(set, modality, &[], 0..most)?;
            let signals: Vec<Signal> = found.into_iter().map(|found| found.signal).collect();
            prepare(&settings.modality, &model, &normaliser, &signals)
                .map_err(|error| damaged(&error.to_string()))?
        }
        _ => Vec::new(),
    };
    let mut trainer = Trainer::vq(
        model,
        &settings.training(prepared.len() as u64),
        context.seed(),
    )
    .map_err(|error| failed(error, settings))?;
    train(
        &mut trainer,
        settings,
        context,
        |chosen| Ok(chosen.iter().map(|i| prepared[*i].clone()).collect()),
        |objective| Ok(objective.held_out(&held_out)),
        prepared.len(),
    )?;
    let tokenizer = VqTokenizer::new(
        &settings.modality,
        shape,
        normaliser.clone(),
        trainer.model(),
    )
    .map_err(StageError::other)?;
    tokenizer
        .write(context.output())
        .map_err(StageError::other)?;
    let kmeans = if settings.kmeans {
        let patches = tokenizer.model().patches();
        KMeans::fit(patches, &prepared, sizes.codebook, context.seed())
    } else {
        None
    };
    let samples = tokenizer.model().patches().valid_shape()[0];
    let project = |signal: &Signal| {
        let kmeans = kmeans.as_ref()?;
        let one = std::slice::from_ref(signal);
        let prepared = prepare(&settings.modality, tokenizer.model(), &normaliser, one).ok()?;
        let mut values = kmeans.reconstruct(prepared.first()?);
        normaliser.undo(&mut values);
        Some(values)
    };
    let baselines = Baselines {
        mean: normaliser.mean().repeat(samples),
        codebook: &project,
    };
    let (scores, examples) = hold_out(settings, data, &tokenizer, &baselines, context)?;
    Ok((scores, examples, count))
}

fn train_video(
    settings: &TrainTokenizerSettings,
    sizes: &VideoSettings,
    data: &Data,
    context: &mut dyn StageContext,
) -> Result<(Scores, Vec<Example>, usize), StageError> {
    let modality = data.modality.as_ref();
    let Shape::Video {
        frames,
        height,
        width,
    } = modality.shape()
    else {
        return Err(damaged("a video tokenizer takes video"));
    };
    let compute = compute(settings)?;
    let network = Network::new(&Initialise::new(&compute, context.seed()), sizes)
        .map_err(StageError::other)?;
    let count = network.count();
    let mut model = VideoTokenizer::new(
        &settings.modality,
        [frames, height, width],
        network,
        &compute,
    )
    .map_err(StageError::other)?;
    let having: Vec<usize> = (0..data.train.len())
        .filter(|index| data.train.shards().has(*index, &settings.modality))
        .collect();
    context.log(&format!(
        "{count} parameters, {} training videos",
        having.len()
    ));
    let read = |index: usize| -> Result<Option<Signal>, StageError> {
        let at = having[index];
        let found = extract(&data.train, modality, &[], at..at + 1)?;
        Ok(found.into_iter().next().map(|found| found.signal))
    };
    if settings.calibrate && !having.is_empty() {
        let mut first = Vec::new();
        for index in 0..having.len().min(CALIBRATE) {
            first.extend(read(index)?);
        }
        model.calibrate(&first).map_err(StageError::other)?;
    }
    let held_out = match &data.validation {
        Some(set) if settings.validates() => settings.validation_clips.min(set.len()),
        _ => 0,
    };
    let mut trainer = Trainer::video(model, &settings.training(having.len() as u64))
        .map_err(|error| failed(error, settings))?;
    train(
        &mut trainer,
        settings,
        context,
        |chosen| {
            let found = chosen.iter().map(|index| read(*index));
            let found: Result<Vec<_>, StageError> = found.collect();
            Ok(found?.into_iter().flatten().collect())
        },
        |objective| {
            let clips = (0..held_out).map(|index| {
                let set = data.validation.as_ref().ok_or(TrainingError::NoData)?;
                let found = extract(set, modality, &[], index..index + 1)?;
                Ok(found.into_iter().next().map(|found| found.signal))
            });
            objective.held_out(clips)
        },
        having.len(),
    )?;
    let tokenizer = trainer.objective().tokenizer();
    tokenizer
        .write(context.output())
        .map_err(StageError::other)?;
    let mut mean = vec![0.0_f64; frames * height * width * 3];
    let mut seen = 0.0;
    for index in 0..having.len().min(MEAN_CLIPS) {
        if let Some(signal) = read(index)? {
            seen += 1.0;
            mean.iter_mut()
                .zip(signal.values.iter())
                .for_each(|(mean, value)| *mean += f64::from(*value));
        }
    }
    let kmeans = if settings.kmeans {
        VideoKMeans::fit(&tokenizer, having.len(), context.seed(), read)?
    } else {
        None
    };
    let project = |signal: &Signal| {
        let values: Vec<f32> = signal.values.iter().copied().collect();
        kmeans.as_ref().map(|kmeans| kmeans.reconstruct(&values))
    };
    let baselines = Baselines {
        mean: mean
            .iter()
            .map(|sum| (sum / f64::max(seen, 1.0)) as f32)
            .collect(),
        codebook: &project,
    };
    let (scores, examples) = hold_out(settings, data, &tokenizer, &baselines, context)?;
    Ok((scores, examples, count))
}

/// All training signals of the modality; for hands also those of the other hand in a mirror.
fn read_signals(
    settings: &TrainTokenizerSettings,
    data: &Data,
    context: &mut dyn StageContext,
) -> Result<Vec<Signal>, StageError> {
    let mut signals = Vec::new();
    let other = settings
        .other_hand()
        .and_then(|name| modality(&data.format, name));
    for start in (0..data.train.len()).step_by(CHUNK) {
        if context.interrupted() {
            return Err(StageError::Interrupted);
        }
        let range = start..(start + CHUNK).min(data.train.len());
        let own = extract(&data.train, data.modality.as_ref(), &[], range.clone())?;
        signals.extend(own.into_iter().map(|found| found.signal));
        if let Some(other) = &other {
            let found = extract(&data.train, other.as_ref(), &[], range)?;
            for found in &found {
                signals.push(mirrored(&found.signal).map_err(StageError::other)?);
            }
        }
    }
    Ok(signals)
}

/// Statistics of the training signals, or the fixed ones where the reference has them: gaze becomes [-1, 1], and
/// what is declared `normalize: none` stays.
fn normaliser(
    settings: &TrainTokenizerSettings,
    data: &Data,
    signals: &[Signal],
    width: usize,
) -> Result<Normaliser, TokenizerError> {
    if settings.modality == "gaze" {
        return Normaliser::constant(width, 0.5, 0.5);
    }
    let declared = data
        .format
        .declared
        .iter()
        .find(|declared| declared.name == settings.modality);
    if declared.is_some_and(|declared| declared.normalize == Normalize::None) {
        return Normaliser::constant(width, 0.0, 1.0);
    }
    Normaliser::fit(signals.iter(), width)
}

fn hold_out(
    settings: &TrainTokenizerSettings,
    data: &Data,
    tokenizer: &dyn Tokenizer,
    baselines: &Baselines<'_>,
    context: &mut dyn StageContext,
) -> Result<(Scores, Vec<Example>), StageError> {
    let Some(set) = &data.validation else {
        return Ok(Default::default());
    };
    let most = settings.validation_clips.min(set.len());
    score(
        set,
        most,
        data.modality.as_ref(),
        tokenizer,
        baselines,
        context,
    )
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

/// Trains from the last checkpoint on, and leaves one when interrupted.
fn train<O: Objective>(
    trainer: &mut Trainer<O>,
    settings: &TrainTokenizerSettings,
    context: &mut dyn StageContext,
    mut batch: impl FnMut(&[usize]) -> Result<O::Batch, StageError>,
    validate: impl FnMut(&O) -> Result<BTreeMap<String, Score>, Failure>,
    signals: usize,
) -> Result<(), StageError> {
    if let Some((step, path)) = checkpoint::latest(context.checkpoints()) {
        trainer.resume(&path).map_err(StageError::other)?;
        context.log(&format!("continues from step {step}"));
    }
    let save = |trainer: &Trainer<O>, context: &mut dyn StageContext| {
        checkpoint::save(context, trainer.progress().step, |_, folder: &Path| {
            trainer.save(folder).map_err(StageError::other)
        })
    };
    if context.interrupted() && trainer.progress().step < trainer.total_steps() {
        save(trainer, context)?;
        return Err(StageError::Interrupted);
    }
    let mut epochs = Epochs::of(trainer, context.seed());
    let fitted = fit(
        trainer,
        Intervals {
            validate_every: settings.validate_every,
            checkpoint_every: settings.checkpoint_every,
        },
        |step, micro| Ok::<_, Failure>(batch(&epochs.choose(step, micro, signals)?)?),
        validate,
        |event| {
            match event {
                Event::Step { report, total } => {
                    context.record(report.step, &report.scalars())?;
                    context.progress(report.step, total, "steps");
                }
                Event::Validation(held_out) => {
                    let loss = held_out.mean().map(|mean| ("validation/loss", mean));
                    context.record(held_out.step, loss.as_slice())?;
                }
                Event::Checkpoint(trainer) => save(trainer, context)?,
            }
            let stop = context.interrupted();
            Ok(if stop { Flow::Stop } else { Flow::Continue })
        },
    )
    .map_err(|failure| match failure {
        Failure::Training(error) => failed(error, settings),
        Failure::Stage(error) => error,
    })?;
    if settings.keep == Keep::Best {
        context.log(&format!(
            "keeps the weights of step {}",
            fitted.held_out.step
        ));
    }
    match fitted.flow {
        Flow::Continue => Ok(()),
        Flow::Stop => Err(StageError::Interrupted),
    }
}

fn failed(error: TrainingError, settings: &TrainTokenizerSettings) -> StageError {
    match error {
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
        error => StageError::other(error),
    }
}
