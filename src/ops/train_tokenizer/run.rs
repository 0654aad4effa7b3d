//! Running `op: train_tokenizer`: reading, the loop, what leaves.

use super::super::clip_signals::{damaged, extract, format, modality, open_split};
use super::super::modality_entry::DEFAULTS;
use super::super::tokenizer_entry::TokenizerEntry;
use super::picture::{self, Example};
use super::scores::{Baselines, Scores, score};
use super::{TrainTokenizerSettings, compute, report, tokens};
use crate::clip::Signal;
use crate::clip::store::ClipSet;
use crate::engine::{Initialise, Parameters, Weights};
use crate::experiment::{Code, StageContext, StageError};
use crate::modality::declared::Normalize;
use crate::modality::{ClipFormat, Modality, Shape};
use crate::run::checkpoint;
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::trained::{Prepared, VqTokenizer, batch, prepare};
use crate::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use crate::tokenizer::vq::{VqSettings, VqVae};
use crate::tokenizer::{Tokenizer, TokenizerError};
use crate::training::kmeans::KMeans;
use crate::training::tokenizer::{Trainer, TrainingError, mirrored};
use crate::training::video_kmeans::VideoKMeans;
use crate::training::video_tokenizer::VideoTrainer;
use serde_json::{Value, json};
use std::path::Path;

/// The file of a checkpoint.
const STATE: &str = "state.safetensors";

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
    let trainer = Trainer::new(
        model,
        &settings.training(prepared.len() as u64),
        context.seed(),
    )
    .map_err(|error| failed(error, settings))?;
    let mut training = VqTraining {
        trainer,
        data: &prepared,
    };
    train(&mut training, settings, context)?;
    let tokenizer = VqTokenizer::new(
        &settings.modality,
        shape,
        normaliser.clone(),
        training.trainer.model(),
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
    let trainer = VideoTrainer::new(
        model,
        &settings.training(having.len() as u64),
        context.seed(),
    )
    .map_err(|error| failed(error, settings))?;
    let mut training = VideoTraining {
        trainer,
        data,
        having: &having,
    };
    train(&mut training, settings, context)?;
    let tokenizer = training.trainer.tokenizer();
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

/// What both families have in common between two steps.
trait Training {
    fn steps(&self) -> u64;
    /// Takes a step and says what to record.
    fn step(&mut self) -> Result<Vec<(&'static str, f64)>, Failure>;
    fn checkpoint(&self) -> Weights;
    fn restore(&mut self, state: &Weights) -> Result<(), TrainingError>;
}

enum Failure {
    Training(TrainingError),
    Stage(StageError),
}

impl From<TrainingError> for Failure {
    fn from(error: TrainingError) -> Self {
        Self::Training(error)
    }
}

struct VqTraining<'a> {
    trainer: Trainer,
    data: &'a [Prepared],
}

impl Training for VqTraining<'_> {
    fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    fn step(&mut self) -> Result<Vec<(&'static str, f64)>, Failure> {
        let report = self.trainer.step(self.data)?;
        Ok(vec![
            ("loss", report.loss),
            ("loss/reconstruction", report.reconstruction),
            ("loss/commitment", report.commitment),
            ("gradient_norm", report.gradient_norm),
            ("learning_rate", report.rate),
            ("codes/replaced", report.replaced as f64),
        ])
    }

    fn checkpoint(&self) -> Weights {
        self.trainer.checkpoint()
    }

    fn restore(&mut self, state: &Weights) -> Result<(), TrainingError> {
        self.trainer.restore(state)
    }
}

struct VideoTraining<'a> {
    trainer: VideoTrainer,
    data: &'a Data,
    having: &'a [usize],
}

impl Training for VideoTraining<'_> {
    fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    fn step(&mut self) -> Result<Vec<(&'static str, f64)>, Failure> {
        if self.having.is_empty() {
            return Err(TrainingError::NoData.into());
        }
        let mut clips = Vec::new();
        for choice in self.trainer.choose(self.having.len()) {
            let index = self.having[choice];
            let modality = self.data.modality.as_ref();
            let found = extract(&self.data.train, modality, &[], index..index + 1)
                .map_err(Failure::Stage)?;
            clips.extend(found.into_iter().map(|found| found.signal));
        }
        let report = self.trainer.step(&clips)?;
        Ok(vec![
            ("loss", report.loss),
            ("gradient_norm", report.gradient_norm),
            ("learning_rate", report.rate),
        ])
    }

    fn checkpoint(&self) -> Weights {
        self.trainer.checkpoint()
    }

    fn restore(&mut self, state: &Weights) -> Result<(), TrainingError> {
        self.trainer.restore(state)
    }
}

/// The loop: continues from the last checkpoint, and leaves one when interrupted.
fn train(
    training: &mut dyn Training,
    settings: &TrainTokenizerSettings,
    context: &mut dyn StageContext,
) -> Result<(), StageError> {
    if let Some((step, path)) = checkpoint::latest(context.checkpoints()) {
        let state = Weights::read(&path.join(STATE)).map_err(StageError::other)?;
        training.restore(&state).map_err(StageError::other)?;
        context.log(&format!("continues from step {step}"));
    }
    while training.steps() < settings.steps {
        if context.interrupted() {
            save(training, context)?;
            return Err(StageError::Interrupted);
        }
        let scalars = training.step().map_err(|failure| match failure {
            Failure::Training(error) => failed(error, settings),
            Failure::Stage(error) => error,
        })?;
        let step = training.steps();
        context.record(step, &scalars)?;
        context.progress(step, settings.steps, "steps");
        let every = settings.checkpoint_every;
        if every > 0 && step.is_multiple_of(every) && step < settings.steps {
            save(training, context)?;
        }
    }
    Ok(())
}

fn save(training: &dyn Training, context: &mut dyn StageContext) -> Result<(), StageError> {
    checkpoint::save(context, training.steps(), |_, folder: &Path| {
        training
            .checkpoint()
            .write(&folder.join(STATE))
            .map_err(StageError::other)
    })
}

fn failed(error: TrainingError, settings: &TrainTokenizerSettings) -> StageError {
    match error {
        error @ (TrainingError::NotFinite { .. } | TrainingError::Gradient(_)) => {
            StageError::Input {
                code: Code::E0206,
                message: error.to_string(),
                help: format!("try a `learning_rate` below {}", settings.learning_rate),
            }
        }
        TrainingError::NoData => StageError::Input {
            code: Code::E0401,
            message: format!("no training clip has the modality `{}`", settings.modality),
            help: "take other clips, or leave this tokenizer out".to_owned(),
        },
        error => StageError::other(error),
    }
}
