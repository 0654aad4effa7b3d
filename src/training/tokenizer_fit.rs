//! From clips to a trained and scored tokenizer of one modality (Sec. 4.2, Supp. A), and to the tokenizers of a model.

use super::epochs::Epochs;
use super::fit::{Callback, Intervals, fit, progress};
use super::kmeans::KMeans;
use super::mixture::Mixture;
use super::settings::READ_EVERY;
use super::signals::extract;
use super::tokenizer::{TokenizerTraining, mirrored};
use super::tokenizer_scores::{Baselines, Example, Scores, score};
use super::trainer::ranks::Ranks;
use super::trainer::{HeldOut, Trainer, TrainingError};
use super::video_kmeans::VideoKMeans;
use super::{Event, Flow};
use crate::clip::Signal;
use crate::clip::source::ClipSource;
use crate::engine::{Communicator, Compute, Initialise, Parameters};
use crate::modality::declared::Normalize;
use crate::modality::{self, ClipFormat, Modality, Shape};
use crate::model::Tokenizers;
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::trained::{VqTokenizer, batch, prepare};
use crate::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use crate::tokenizer::vq::{VqSettings, VqVae};
use crate::tokenizer::{Tokenizer, TokenizerError, TokenizerSettings};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Clips read at a time.
const CHUNK: usize = 256;

/// Clips that a new network is calibrated on.
pub const CALIBRATE: usize = 64;

/// Clips whose mean is the trivial prediction of a video.
const MEAN_CLIPS: usize = 64;

/// Everything that makes a tokenizer of one modality.
pub struct TokenizerFit<'a> {
    /// The modality's name.
    pub modality: &'a str,
    /// The sizes of the clips.
    pub format: &'a ClipFormat,
    /// What it learns from.
    pub train: &'a dyn ClipSource,
    /// The data sets of which `train` is made.
    pub mixture: Mixture<'a>,
    /// What it is scored on.
    pub held_out: Option<&'a dyn ClipSource>,
    /// At most so many of them.
    pub held_out_clips: usize,
    /// Family and sizes.
    pub tokenizer: &'a TokenizerSettings,
    /// How it trains.
    pub training: TokenizerTraining,
    /// Held-out losses while it trains (0: none), and checkpoints.
    pub intervals: Intervals,
    /// Before the first step, fit the scales of the new network to the first clips.
    pub calibrate: bool,
    /// The hand whose mirror image trains too.
    pub mirror: Option<&'a str>,
    /// Also fit k-means with as many codes, the baseline of a codebook without a network.
    pub kmeans: bool,
    /// Where it trains.
    pub compute: &'a Compute,
    /// Who trains it together. Rank 0 alone scores it.
    pub ranks: Communicator,
    /// Of initial weights, order and codes.
    pub seed: u64,
    /// A checkpoint to continue from.
    pub resume: Option<PathBuf>,
}

/// A trained tokenizer.
pub struct FittedTokenizer {
    /// The tokenizer.
    pub tokenizer: Arc<dyn Tokenizer>,
    /// How many trainable numbers it has.
    pub parameters: usize,
    /// The step whose weights it has.
    pub held_out: HeldOut,
    /// Errors on held-out clips.
    pub scores: Scores,
    /// Some of them to look at.
    pub examples: Vec<Example>,
}

impl std::fmt::Debug for TokenizerFit<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TokenizerFit")
            .field("modality", &self.modality)
            .field("training", &self.training)
            .finish_non_exhaustive()
    }
}

impl std::fmt::Debug for FittedTokenizer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FittedTokenizer")
            .field("modality", &self.tokenizer.modality())
            .field("scores", &self.scores)
            .finish_non_exhaustive()
    }
}

impl TokenizerFit<'_> {
    /// Trains and scores it.
    ///
    /// # Errors
    /// When no clip has the modality, the tokenizer does not take it, a clip cannot be read, the loss is not finite, or
    /// `callback` stops it.
    pub fn run<E: From<TrainingError> + std::fmt::Display>(
        &self,
        callback: &mut Callback<'_, E>,
    ) -> Result<FittedTokenizer, E> {
        let modality = find(self.format, self.modality)?;
        match self.tokenizer {
            TokenizerSettings::Vq(sizes) => self.vq(modality.as_ref(), sizes, callback),
            TokenizerSettings::Video(sizes) => self.video(modality.as_ref(), sizes, callback),
        }
    }

    fn vq<E: From<TrainingError> + std::fmt::Display>(
        &self,
        modality: &dyn Modality,
        sizes: &VqSettings,
        callback: &mut Callback<'_, E>,
    ) -> Result<FittedTokenizer, E> {
        let shape = modality.shape();
        let init = Initialise::new(self.compute, self.seed);
        let mut model = VqVae::new(&init, sizes, &shape).map_err(TrainingError::from)?;
        let (signals, sets) = self.signals(modality, callback)?;
        let width = model.patches().values_per_sample();
        let normaliser = self
            .normaliser(&signals, width, sizes.root_relative)
            .map_err(TrainingError::from)?;
        let prepared =
            prepare(self.modality, &model, &normaliser, &signals).map_err(TrainingError::from)?;
        drop(signals);
        let parameters = model.count();
        if self.calibrate && !prepared.is_empty() {
            let first = &prepared[..prepared.len().min(CALIBRATE)];
            let batches: Vec<_> = first.chunks(16).map(|part| batch(&model, part)).collect();
            model.calibrate(&batches).map_err(TrainingError::from)?;
        }
        let mut held_out = Vec::new();
        if let Some((source, clips)) = self.validation() {
            let found = extract(source, modality, &[], 0..clips)?;
            let signals: Vec<Signal> = found.into_iter().map(|found| found.signal).collect();
            held_out = prepare(self.modality, &model, &normaliser, &signals)
                .map_err(TrainingError::from)?;
        }
        let trainer = Trainer::vq(model, &self.training, self.seed)?;
        let mut trainer = self.together(trainer)?;
        let epochs = Epochs::of(&trainer, self.seed);
        let mut epochs = self.mixture.epochs(epochs, &sets)?;
        let best = fit(
            &mut trainer,
            self.intervals,
            |step, micro| {
                let chosen = epochs.choose(step, micro, prepared.len())?;
                Ok(chosen.into_iter().map(|i| prepared[i].clone()).collect())
            },
            |objective| Ok(objective.held_out(&held_out, &self.ranks)?),
            callback,
        )?;
        let tokenizer = VqTokenizer::new(self.modality, shape, normaliser.clone(), trainer.model())
            .map_err(TrainingError::from)?;
        drop(trainer);
        let patches = tokenizer.model().patches();
        let kmeans = (self.kmeans && self.ranks.is_root())
            .then(|| KMeans::fit(patches, &prepared, sizes.codebook, self.seed))
            .flatten();
        let project = |signal: &Signal| {
            let kmeans = kmeans.as_ref()?;
            let one = std::slice::from_ref(signal);
            let prepared = prepare(self.modality, tokenizer.model(), &normaliser, one).ok()?;
            let mut values = kmeans.reconstruct(prepared.first()?);
            normaliser.undo(&mut values);
            Some(values)
        };
        let mut mean = vec![0.0; width];
        normaliser.undo(&mut mean);
        let baselines = Baselines {
            mean: mean.repeat(patches.valid_shape()[0]),
            codebook: &project,
        };
        let (scores, examples) = self.score(modality, &tokenizer, &baselines, callback)?;
        Ok(FittedTokenizer {
            tokenizer: Arc::new(tokenizer),
            parameters,
            held_out: best,
            scores,
            examples,
        })
    }

    fn video<E: From<TrainingError> + std::fmt::Display>(
        &self,
        modality: &dyn Modality,
        sizes: &VideoSettings,
        callback: &mut Callback<'_, E>,
    ) -> Result<FittedTokenizer, E> {
        let Shape::Video {
            frames,
            height,
            width,
        } = modality.shape()
        else {
            let reason = format!("a video tokenizer takes video, no `{}`", self.modality);
            return Err(TrainingError::from(TokenizerError::Other(reason)).into());
        };
        let init = Initialise::new(self.compute, self.seed);
        let network = Network::new(&init, sizes).map_err(TrainingError::from)?;
        let parameters = network.count();
        let clip = [frames, height, width];
        let mut model = VideoTokenizer::new(self.modality, clip, network, self.compute)
            .map_err(TrainingError::from)?;
        let mut having: Vec<usize> = Vec::new();
        let mut sets = Vec::new();
        for set in self.mixture.ranges(self.train.len()) {
            let before = having.len();
            having.extend(set.filter(|index| self.train.may_have(*index, self.modality)));
            sets.push(having.len() - before);
        }
        let one = |source: &dyn ClipSource, index: usize| {
            let found = extract(source, modality, &[], index..index + 1)?;
            Ok::<_, TrainingError>(found.into_iter().next().map(|found| found.signal))
        };
        let read = |index: usize| one(self.train, having[index]);
        if self.calibrate && !having.is_empty() {
            model.calibrate(having.len().min(CALIBRATE), read)?;
        }
        let validation = self.validation();
        let mut trainer = self.together(Trainer::video(model, &self.training)?)?;
        let epochs = Epochs::of(&trainer, self.seed);
        let mut epochs = self.mixture.epochs(epochs, &sets)?;
        let best = fit(
            &mut trainer,
            self.intervals,
            |step, micro| {
                let mut clips = Vec::new();
                for index in epochs.choose(step, micro, having.len())? {
                    clips.extend(read(index)?);
                }
                Ok(clips)
            },
            |objective| {
                let Some((source, count)) = validation else {
                    return Ok(BTreeMap::new());
                };
                Ok(objective.held_out(count, |index| one(source, index), &self.ranks)?)
            },
            callback,
        )?;
        let tokenizer = trainer.objective().tokenizer();
        drop(trainer);
        // What follows allocates other sizes than the steps did.
        crate::engine::memory::release();
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
        let kmeans = if self.kmeans && self.ranks.is_root() {
            VideoKMeans::fit(&tokenizer, having.len(), self.seed, read)?
        } else {
            None
        };
        let project = |signal: &Signal| {
            let values: Vec<f32> = signal.values.iter().copied().collect();
            kmeans.as_ref().map(|kmeans| kmeans.reconstruct(&values))
        };
        let mean = mean.iter().map(|sum| (sum / f64::max(seen, 1.0)) as f32);
        let baselines = Baselines {
            mean: mean.collect(),
            codebook: &project,
        };
        let (scores, examples) = self.score(modality, &tokenizer, &baselines, callback)?;
        Ok(FittedTokenizer {
            tokenizer: Arc::new(tokenizer),
            parameters,
            held_out: best,
            scores,
            examples,
        })
    }

    /// Shared with the other ranks, and from where it was.
    fn together<O: super::Objective>(
        &self,
        trainer: Trainer<O>,
    ) -> Result<Trainer<O>, TrainingError> {
        let ranks = Ranks::new(self.ranks.clone(), self.training.reduction);
        let mut trainer = trainer.shared(ranks, self.training.micro_batch)?;
        if let Some(checkpoint) = &self.resume {
            trainer.resume(checkpoint)?;
        }
        Ok(trainer)
    }

    /// The clips whose loss is computed while it trains, where that is asked for.
    fn validation(&self) -> Option<(&dyn ClipSource, usize)> {
        let asked = self.intervals.validate_every > 0 || self.training.keep == super::Keep::Best;
        let source = self.held_out.filter(|_| asked)?;
        Some((source, self.held_out_clips.min(source.len())))
    }

    /// All training signals of the modality, for hands also those of the other hand in a mirror, and how many each data set has.
    fn signals<E: From<TrainingError> + std::fmt::Display>(
        &self,
        modality: &dyn Modality,
        callback: &mut Callback<'_, E>,
    ) -> Result<(Vec<Signal>, Vec<usize>), E> {
        let mut signals = Vec::new();
        let mut sets = Vec::new();
        let other = self.mirror.and_then(|name| find(self.format, name).ok());
        let total = self.train.len();
        for set in self.mixture.ranges(total) {
            let before = signals.len();
            for start in set.clone().step_by(CHUNK) {
                progress(callback, start, total, "clips read")?;
                let range = start..(start + CHUNK).min(set.end);
                let own = extract(self.train, modality, &[], range.clone())?;
                signals.extend(own.into_iter().map(|found| found.signal));
                if let Some(other) = &other {
                    for found in &extract(self.train, other.as_ref(), &[], range)? {
                        let signal =
                            mirrored(&found.signal).map_err(|error| TrainingError::Clip {
                                clip: found.clip.id.clone(),
                                reason: error.to_string(),
                            })?;
                        signals.push(signal);
                    }
                }
            }
            sets.push(signals.len() - before);
        }
        Ok((signals, sets))
    }

    /// Statistics of the training signals, or the fixed ones where the reference has them: gaze becomes [-1, 1], and
    /// what is declared `normalize: none` stays.
    fn normaliser(
        &self,
        signals: &[Signal],
        width: usize,
        root_relative: bool,
    ) -> Result<Normaliser, TokenizerError> {
        if self.modality == "gaze" {
            return Normaliser::constant(width, 0.5, 0.5);
        }
        let mut declared = self.format.declared.iter();
        let declared = declared.find(|declared| declared.name == self.modality);
        if declared.is_some_and(|declared| declared.normalize == Normalize::None) {
            return Normaliser::constant(width, 0.0, 1.0)?.of_joints(root_relative);
        }
        Normaliser::fit(signals.iter(), width, root_relative)
    }

    fn score<E: From<TrainingError> + std::fmt::Display>(
        &self,
        modality: &dyn Modality,
        tokenizer: &dyn Tokenizer,
        baselines: &Baselines<'_>,
        callback: &mut Callback<'_, E>,
    ) -> Result<(Scores, Vec<Example>), E> {
        let Some(source) = self.held_out.filter(|_| self.ranks.is_root()) else {
            return Ok(Default::default());
        };
        let most = self.held_out_clips.min(source.len());
        score(source, most, modality, tokenizer, baselines, callback)
    }
}

/// A modality of `format` by name, built in or declared.
fn find(format: &ClipFormat, name: &str) -> Result<Box<dyn Modality>, TrainingError> {
    let mut all = modality::all(format).into_iter();
    let found = all.find(|modality| modality.name() == name);
    found.ok_or_else(|| TrainingError::UnknownModality(name.to_owned()))
}

/// Which tokenizers are trained, and how.
#[derive(Debug, Clone)]
pub struct TokenizerOptions {
    /// By modality: family and sizes, and how it trains.
    pub tokenizers: BTreeMap<String, (TokenizerSettings, TokenizerTraining)>,
    /// Of initial weights, order and codes.
    pub seed: u64,
    /// Where they train.
    pub compute: Compute,
}

impl TokenizerOptions {
    /// Small tokenizers of video, camera, gaze and body, as the experiment `quickstart` trains them: minutes on a CPU.
    #[must_use]
    pub fn small() -> Self {
        let training = |steps, batch, learning_rate, warmup| TokenizerTraining {
            steps,
            batch,
            learning_rate,
            warmup,
            ..TokenizerTraining::default()
        };
        let camera = VqSettings {
            velocity_weight: 50.0,
            ..VqSettings::temporal_small()
        };
        let body = VqSettings {
            root_relative: true,
            ..VqSettings::kinematic_small()
        };
        let (vq, gaze) = (TokenizerSettings::Vq, VqSettings::temporal_small());
        let video = TokenizerSettings::Video(VideoSettings::tiny());
        let tokenizers = [
            ("rgb", video, training(150, 2, 2e-3, 10)),
            ("camera", vq(camera), training(1200, 16, 3e-3, 20)),
            ("gaze", vq(gaze), training(600, 16, 3e-3, 20)),
            ("body", vq(body), training(1200, 16, 2e-3, 20)),
        ];
        let tokenizers = tokenizers.into_iter();
        Self {
            tokenizers: tokenizers
                .map(|(name, settings, training)| (name.to_owned(), (settings, training)))
                .collect(),
            seed: 0,
            compute: Compute::cpu(),
        }
    }

    /// With so many steps for every tokenizer.
    #[must_use]
    pub fn steps(mut self, steps: u64) -> Self {
        for (_, training) in self.tokenizers.values_mut() {
            training.steps = steps;
            training.warmup = training.warmup.min(steps);
        }
        self
    }
}

impl Tokenizers {
    /// Trains one tokenizer after the other on all of `clips`.
    ///
    /// # Errors
    /// When no clip has a modality, a tokenizer does not take it, a clip cannot be read, or a loss is not finite.
    pub fn fit(clips: &dyn ClipSource, options: &TokenizerOptions) -> Result<Self, TrainingError> {
        Self::fit_with(clips, options, |_, _| Flow::Continue)
    }

    /// As [`Tokenizers::fit`]; `callback` hears the modality and what happens.
    ///
    /// # Errors
    /// As [`Tokenizers::fit`], or when the callback stops it.
    pub fn fit_with(
        clips: &dyn ClipSource,
        options: &TokenizerOptions,
        mut callback: impl FnMut(&str, Event<'_>) -> Flow,
    ) -> Result<Self, TrainingError> {
        let format = clips.format().unwrap_or_default();
        let mut tokenizers = Tokenizers::new(format.clone());
        for (name, (settings, training)) in &options.tokenizers {
            let fit = TokenizerFit {
                modality: name,
                format: &format,
                train: clips,
                mixture: Mixture::default(),
                held_out: None,
                held_out_clips: 0,
                tokenizer: settings,
                training: training.clone(),
                intervals: Intervals {
                    read_every: READ_EVERY,
                    ..Intervals::default()
                },
                calibrate: true,
                mirror: match name.as_str() {
                    "left_hand" => Some("right_hand"),
                    "right_hand" => Some("left_hand"),
                    _ => None,
                },
                kmeans: false,
                compute: &options.compute,
                ranks: Communicator::alone(),
                seed: options.seed,
                resume: None,
            };
            let fitted = fit.run::<TrainingError>(&mut |event| Ok(callback(name, event)))?;
            tokenizers.insert(fitted.tokenizer);
        }
        Ok(tokenizers)
    }
}
