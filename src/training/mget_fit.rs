//! From tokens to a trained MGET (Sec. 4.3, Supp. B), and from clips and tokenizers to a [`Model`].

use super::fit::{Callback, Event, Intervals, fit};
use super::loader::{BatchSource, Loader};
use super::sampler::Sampler;
use super::settings::{DatasetSize, TrainingSettings};
use super::source::{InMemory, TokenSample, TokenSource};
use super::trainer::ranks::Ranks;
use super::trainer::{HeldOut, Progress, StepReport, Trainer, TrainingError};
use super::validation::{Score, Unigram, Validation};
use super::{Duration, Objective};
use crate::clip::source::{ClipSource, Outcome};
use crate::engine::{Communicator, Compute, Initialise};
use crate::flow::Flow;
use crate::masking::{Alphas, Masking, MaskingSettings, PIXELS, TokenBudget};
use crate::mget::{Mget, MgetSpec, ModalitySpec, Positions, Size};
use crate::model::{Model, Tokenizers};
use rayon::prelude::*;
use std::cell::RefCell;
use std::path::PathBuf;
use std::sync::Arc;

/// Clips whose tokens are counted for the baseline.
const UNIGRAM_CLIPS: usize = 4096;

/// Everything that makes an MGET of tokens.
pub struct MgetFit<'a> {
    /// The transformer.
    pub spec: MgetSpec,
    /// What is given and what is asked for.
    pub masking: Masking,
    /// The data sets it learns from.
    pub sources: Vec<Arc<dyn TokenSource>>,
    /// How many clips of each, the first ones.
    pub lengths: Vec<usize>,
    /// How often each data set is drawn; `None`: in proportion to its clips.
    pub weights: Option<&'a [f64]>,
    /// What its losses are computed on.
    pub held_out: &'a dyn TokenSource,
    /// How it trains.
    pub settings: &'a TrainingSettings,
    /// Where it trains.
    pub compute: &'a Compute,
    /// Who trains it together.
    pub ranks: Communicator,
    /// Of initial weights, order and masks.
    pub seed: u64,
    /// A checkpoint to continue from.
    pub resume: Option<PathBuf>,
    /// Seconds, to say how long steps wait for data.
    pub clock: &'a dyn Fn() -> f64,
}

/// A trained MGET.
#[derive(Debug)]
pub struct FittedMget {
    /// The transformer.
    pub model: Mget,
    /// The step whose weights it has, and its held-out losses.
    pub held_out: HeldOut,
    /// Totals of the run.
    pub progress: Progress,
}

impl std::fmt::Debug for MgetFit<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MgetFit")
            .field("spec", &self.spec)
            .field("settings", &self.settings)
            .finish_non_exhaustive()
    }
}

impl MgetFit<'_> {
    /// Trains it.
    ///
    /// # Errors
    /// When settings or tokens do not fit the model, a clip cannot be read, the loss is not finite, or `callback` stops it.
    pub fn run<E: From<TrainingError> + std::fmt::Display>(
        self,
        callback: &mut Callback<'_, E>,
    ) -> Result<FittedMget, E> {
        let Self {
            spec,
            masking,
            sources,
            lengths,
            settings,
            ranks,
            seed,
            clock,
            ..
        } = self;
        let names: Vec<&str> = sources.iter().map(|source| source.name()).collect();
        let order = Sampler::new(seed, &names, &lengths, self.weights).map_err(wrap)?;
        let (input, target) = masking.nominal_tokens();
        let size = DatasetSize {
            clips: lengths.iter().sum::<usize>() as u64,
            tokens_per_sample: (input + target) as u64,
        };
        let schedule = settings.learning_rates(size).map_err(TrainingError::from)?;
        let validation = Validation::new(
            &spec,
            &masking,
            self.held_out,
            settings.validation_clips,
            settings.micro_batches().first().copied().unwrap_or(1),
            seed,
        )
        .map_err(wrap)?;
        let unigram = Unigram::fit(&spec, &sources, &lengths, UNIGRAM_CLIPS).map_err(wrap)?;
        let baseline = validation.baseline(&unigram);
        let model =
            Mget::new(&spec, &Initialise::new(self.compute, seed)).map_err(TrainingError::from)?;
        let together = Ranks::new(ranks.clone(), settings.reduction);
        let mut trainer = Trainer::new(model, settings, schedule)
            .shared(together, settings.micro_batch)
            .map_err(TrainingError::from)?;
        if let Some(checkpoint) = &self.resume {
            trainer.resume(checkpoint)?;
        }
        let micro_batches = trainer.micro_batches().to_vec();
        let own: Vec<usize> = ranks.own(micro_batches.len()).collect();
        let batches = Arc::new(BatchSource {
            spec,
            masking,
            sources,
            order,
            seed,
            micro_batches,
            repeat: settings.repeat,
        });
        let steps = trainer.progress().step..trainer.total_steps();
        let loader = Loader::start(&batches, steps, &own, settings.loader_threads);
        let loader = RefCell::new(loader);
        let mut tell = |event: Event<'_>| match event {
            Event::Step { report, total } => {
                let waited = loader.borrow().waited();
                let report = &StepReport {
                    waited,
                    ..report.clone()
                };
                callback(Event::Step { report, total })
            }
            Event::Validation(held_out) => callback(Event::Validation(&HeldOut {
                baseline: baseline.clone(),
                ..held_out.clone()
            })),
            event => callback(event),
        };
        let held_out = fit(
            &mut trainer,
            Intervals {
                validate_every: settings.validate_every,
                checkpoint_every: settings.checkpoint_every,
                read_every: settings.read_every,
            },
            |_, _| Ok(loader.borrow_mut().next(clock).map_err(wrap)?),
            |objective| {
                let losses = validation.run(objective.module(), &ranks);
                Ok(losses.map_err(TrainingError::from)?)
            },
            &mut tell,
        )?;
        Ok(FittedMget {
            held_out: HeldOut {
                baseline,
                ..held_out
            },
            progress: trainer.progress(),
            model: trainer.model().clone(),
        })
    }
}

fn wrap(error: super::DataError) -> TrainingError {
    error.into()
}

/// How [`Model::train`] trains.
#[derive(Debug, Clone)]
pub struct TrainOptions {
    /// Depth and width.
    pub size: Size,
    /// What is given and what is asked for.
    pub masking: MaskingSettings,
    /// Frames, height and width of a tubelet of raw video, which is an input beside the tokens; `None`: tokens alone.
    pub tubelet: Option<[usize; 3]>,
    /// Position tables of time-by-joints grids.
    pub positions: Positions,
    /// Length, batch and learning rate.
    pub training: TrainingSettings,
    /// The last so many clips are not trained on, but held out.
    pub held_out: usize,
    /// Of initial weights, order and masks.
    pub seed: u64,
    /// Where it trains.
    pub compute: Compute,
}

impl Default for TrainOptions {
    /// As the experiment `quickstart`: minutes on a CPU.
    fn default() -> Self {
        // The paper's mixture with a fifth component, four samples in eight: all raw video is given, and anything but video is
        // asked for. In minutes, the mixture alone shows whole videos too rarely.
        let alphas = |last: f64| Alphas::Mixture(vec![0.01, 0.1, 1.0, 10.0, last]);
        let never = |name: &str| (name.to_owned(), alphas(0.0));
        Self {
            size: Size::LAPTOP_SMALL,
            masking: MaskingSettings {
                alpha: alphas(1.0),
                weights: vec![1.0, 1.0, 1.0, 1.0, 4.0],
                input_alpha: ["rgb", "camera", "gaze", "body"].map(never).into(),
                target_alpha: ["rgb"].map(never).into(),
                input_tokens: TokenBudget::Fixed(128),
                target_tokens: TokenBudget::Fixed(128),
                ..MaskingSettings::default()
            },
            tubelet: Some([4, 16, 16]),
            positions: Positions::Aligned,
            training: TrainingSettings {
                steps: Some(1100),
                batch: 8,
                learning_rate: 3e-3,
                warmup: Duration::Steps(30),
                ..TrainingSettings::default()
            },
            held_out: 0,
            seed: 0,
            compute: Compute::cpu(),
        }
    }
}

impl TrainOptions {
    /// With so many steps.
    #[must_use]
    pub fn steps(mut self, steps: u64) -> Self {
        self.training.steps = Some(steps);
        if let Duration::Steps(warmup) = &mut self.training.warmup {
            *warmup = (*warmup).min(steps);
        }
        self
    }
}

impl Model {
    /// Trains an MGET on the tokens of `clips`, which are held in memory, and puts it between the tokenizers. `callback` hears of
    /// every step.
    ///
    /// # Errors
    /// When options, tokenizers and clips do not fit together, a clip cannot be read, the loss is not finite, or the callback
    /// stops it.
    pub fn train(
        tokenizers: &Tokenizers,
        clips: &dyn ClipSource,
        options: &TrainOptions,
        mut callback: impl FnMut(Event<'_>) -> Flow,
    ) -> Result<Self, TrainingError> {
        let spec = spec(tokenizers, options);
        let masking = Masking::new(&options.masking, &spec.slots())?;
        let mut all = tokenize(tokenizers, clips, options.tubelet.is_some())?;
        let trained = all.samples.len().saturating_sub(options.held_out);
        let held_out = InMemory {
            name: all.name.clone(),
            samples: all.samples.split_off(trained),
        };
        let fitted = MgetFit {
            spec,
            masking,
            sources: vec![Arc::new(all)],
            lengths: vec![trained],
            weights: None,
            held_out: &held_out,
            settings: &options.training,
            compute: &options.compute,
            ranks: Communicator::alone(),
            seed: options.seed,
            resume: None,
            clock: &|| 0.0,
        }
        .run::<TrainingError>(&mut |event| Ok(callback(event)))?;
        let model = Model::new(fitted.model, tokenizers.clone())?;
        Ok(model.with_trained_on(vec![clips.name().to_owned()]))
    }
}

fn spec(tokenizers: &Tokenizers, options: &TrainOptions) -> MgetSpec {
    let format = tokenizers.format();
    let of = |name: &str| {
        let tokenizer = tokenizers.get(name)?;
        let (grid, vocabulary) = (tokenizer.grid(), tokenizer.vocabulary());
        Some(ModalitySpec::tokens(name, grid, vocabulary))
    };
    let mut modalities: Vec<ModalitySpec> = tokenizers.names().filter_map(of).collect();
    if let Some(tubelet) = options.tubelet {
        let clip = [format.frames, format.size, format.size, 3];
        modalities.push(ModalitySpec::pixels(PIXELS, clip, tubelet));
    }
    modalities.sort_by(|a, b| a.name.cmp(&b.name));
    MgetSpec {
        size: options.size,
        positions: options.positions,
        modalities,
    }
}

/// The tokens of all clips, and their raw video where it is an input.
fn tokenize(
    tokenizers: &Tokenizers,
    clips: &dyn ClipSource,
    pixels: bool,
) -> Result<InMemory, TrainingError> {
    let samples: Result<Vec<Option<TokenSample>>, TrainingError> = (0..clips.len())
        .into_par_iter()
        .map(|index| {
            let Outcome::Clip(clip) = clips.clip(index)? else {
                return Ok(None);
            };
            let raw = clip.rgb().filter(|_| pixels);
            let raw = raw.map(|rgb| (PIXELS.to_owned(), rgb.frames.iter().copied().collect()));
            Ok(Some(TokenSample {
                key: clip.id.clone(),
                tokens: tokenizers.encode(&clip)?,
                pixels: raw.into_iter().collect(),
                ..TokenSample::default()
            }))
        })
        .collect();
    Ok(InMemory {
        name: clips.name().to_owned(),
        samples: samples?.into_iter().flatten().collect(),
    })
}

/// Held-out losses beside the baseline, as Markdown.
#[must_use]
pub fn held_out_table(held_out: &HeldOut) -> String {
    use std::fmt::Write;
    let mut text = String::from(
        "| modality | held-out loss (nats) | token frequencies alone | tokens |\n|---|---:|---:|---:|\n",
    );
    for (name, Score { loss, tokens }) in &held_out.scores {
        let unigram = held_out.baseline_of(name);
        let _ = writeln!(text, "| {name} | {loss:.4} | {unigram:.4} | {tokens} |");
    }
    text
}
