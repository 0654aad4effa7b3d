//! Training: a resumed run has the bytes of an uninterrupted one, whatever the loader does; a small model learns.
#![allow(clippy::unwrap_used)] // a test that panics is a test that fails

use reviv::engine::{Communicator, Compute, Initialise, Parameters, Weights};
use reviv::masking::{Masking, MaskingSettings, TokenBudget};
use reviv::mget::{Batch, Mget, MgetSpec, ModalitySpec, Positions, Size};
use reviv::random::stream;
use reviv::tokenizer::TokenGrid;
use reviv::training::{
    BatchSource, DataError, DatasetSize, InMemory, Loader, MaskedPrediction, Sampler, TokenSample,
    TokenSource, Trainer, TrainingError, TrainingSettings, Unigram, Validation,
};
use std::ops::Range;
use std::sync::Arc;

pub fn spec() -> MgetSpec {
    MgetSpec {
        size: Size {
            width: 24,
            heads: 2,
            encoder_depth: 1,
            decoder_depth: 1,
            hidden: 0,
        },
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("camera", &[6], 16),
            ModalitySpec::tokens("gaze", &[6], 12),
            ModalitySpec::pixels("pixels", [2, 4, 4, 3], [1, 2, 2]),
        ],
    }
}

/// Clips whose camera counts up from a random start, whose gaze says the same in other words, and whose video is that bright.
pub fn clips(count: u64, seed: u64) -> InMemory {
    use rand::RngExt;
    let samples = (0..count)
        .map(|clip| {
            let start: u32 = stream(seed, "test.clips", 0, clip).random_range(0..12);
            let grid = |offset: u32, vocabulary: u32| TokenGrid {
                ids: (0..6).map(|i| (start + i + offset) % vocabulary).collect(),
                grid: vec![6],
            };
            TokenSample {
                key: format!("clip-{clip}"),
                // Every fifth clip has no gaze.
                tokens: [("camera", grid(0, 16)), ("gaze", grid(3, 12))]
                    .into_iter()
                    .filter(|(name, _)| *name != "gaze" || clip % 5 != 0)
                    .map(|(name, grid)| (name.to_owned(), grid))
                    .collect(),
                pixels: [("pixels".to_owned(), vec![(start * 20) as u8; 96])].into(),
                ..TokenSample::default()
            }
        })
        .collect();
    InMemory {
        name: "counting".into(),
        samples,
    }
}

pub struct Setup {
    settings: TrainingSettings,
    source: Arc<dyn TokenSource>,
    steps: u64,
}

impl Setup {
    pub fn new(steps: u64, micro_batch: usize, threads: usize) -> Self {
        Self {
            settings: TrainingSettings {
                steps: Some(steps),
                batch: 6,
                micro_batch,
                learning_rate: 4e-3,
                loader_threads: threads,
                ..Default::default()
            },
            source: Arc::new(clips(64, 1)),
            steps,
        }
    }

    pub fn masking() -> Masking {
        let settings = MaskingSettings {
            input_tokens: TokenBudget::Fixed(8),
            target_tokens: TokenBudget::Fixed(8),
            ..Default::default()
        };
        Masking::new(&settings, &spec().slots()).unwrap()
    }

    fn trainer(&self) -> Trainer<MaskedPrediction> {
        self.trainer_on(&Compute::cpu())
    }

    pub fn trainer_on(&self, compute: &Compute) -> Trainer<MaskedPrediction> {
        let model = Mget::new(&spec(), &Initialise::new(compute, 7)).unwrap();
        let measure = DatasetSize {
            clips: self.source.len() as u64,
            tokens_per_sample: 16,
        };
        Trainer::new(
            model,
            &self.settings,
            self.settings.learning_rates(measure).unwrap(),
        )
    }

    fn feed(&self) -> Arc<BatchSource> {
        Arc::new(BatchSource {
            spec: spec(),
            masking: Self::masking(),
            order: Sampler::new(3, &["counting"], &[self.source.len()], None).unwrap(),
            sources: vec![Arc::clone(&self.source)],
            seed: 3,
            micro_batches: self.settings.micro_batches(),
            repeat: 1,
        })
    }

    /// The first micro-batches.
    pub fn batches(&self, count: usize) -> Vec<Batch> {
        let mut loader = Loader::start(&self.feed(), 0..self.steps, &[0], 1);
        (0..count).map(|_| loader.next(&|| 0.0).unwrap()).collect()
    }

    fn run(
        &self,
        trainer: &mut Trainer<MaskedPrediction>,
        steps: Range<u64>,
    ) -> Result<Vec<f64>, TrainingError> {
        let mut loader = Loader::start(
            &self.feed(),
            steps.start..self.steps,
            &(0..self.settings.micro_batches().len()).collect::<Vec<_>>(),
            self.settings.loader_threads,
        );
        let mut next = |_| Ok::<_, TrainingError>(loader.next(&|| 0.0)?);
        steps.map(|_| Ok(trainer.step(&mut next)?.loss)).collect()
    }
}

fn bytes(trainer: &Trainer<MaskedPrediction>) -> Vec<u8> {
    let directory = tempfile::tempdir().unwrap();
    trainer.save(directory.path()).unwrap();
    let mut bytes = Vec::new();
    for file in [
        "weights.safetensors",
        "optimizer.safetensors",
        "progress.json",
    ] {
        bytes.extend(std::fs::read(directory.path().join(file)).unwrap());
    }
    bytes
}

#[test]
fn resuming_at_any_step_with_any_number_of_threads_gives_the_same_bytes() {
    for (micro_batch, muon) in [(0, false), (4, false), (4, true)] {
        let setup = |threads| {
            let mut setup = Setup::new(12, micro_batch, threads);
            setup.settings.optimizer.muon = muon;
            setup
        };
        let whole = setup(1);
        let mut trainer = whole.trainer();
        whole.run(&mut trainer, 0..12).unwrap();
        let expected = bytes(&trainer);
        for (cut, threads) in [(1, 2), (5, 3), (11, 1)] {
            let checkpoint = tempfile::tempdir().unwrap();
            let first = setup(threads);
            let mut trainer = first.trainer();
            first.run(&mut trainer, 0..cut).unwrap();
            trainer.save(checkpoint.path()).unwrap();
            drop(trainer);

            let second = setup(threads + 1);
            let mut trainer = second.trainer();
            trainer.resume(checkpoint.path()).unwrap();
            second.run(&mut trainer, cut..12).unwrap();
            assert!(
                bytes(&trainer) == expected,
                "cut at {cut}, micro-batch {micro_batch}, muon {muon}"
            );
        }
    }
}

#[test]
fn accumulation_is_the_mean_over_micro_batches() {
    let losses = |micro_batch| {
        let setup = Setup::new(4, micro_batch, 1);
        let feed = setup.feed();
        let trainer = setup.trainer();
        let model = trainer.model().frozen();
        let sizes = setup.settings.micro_batches();
        let mut total = 0.0;
        for (micro, size) in sizes.iter().enumerate() {
            let batch = feed.batch(0, micro).unwrap();
            assert_eq!(batch.samples(), *size);
            total +=
                model.losses(&batch, reviv::mget::Loss::Mod).values().total * *size as f64 / 6.0;
        }
        (total, setup.run(&mut setup.trainer(), 0..1).unwrap()[0])
    };
    for micro_batch in [0, 2, 4] {
        let (mean, step) = losses(micro_batch);
        assert!((mean - step).abs() < 1e-6, "{mean} {step}");
    }
}

#[test]
fn a_small_model_beats_the_unigram_baseline_on_every_modality() {
    let setup = Setup {
        settings: TrainingSettings {
            batch: 16,
            ..Setup::new(300, 0, 1).settings
        },
        ..Setup::new(300, 0, 1)
    };
    let mut trainer = setup.trainer();
    setup.run(&mut trainer, 0..300).unwrap();
    let held_out = clips(48, 2);
    let validation = Validation::new(&spec(), &Setup::masking(), &held_out, 48, 16, 0).unwrap();
    let unigram = Unigram::fit(&spec(), std::slice::from_ref(&setup.source), &[64], 64).unwrap();
    let baseline = validation.baseline(&unigram);
    let scores = validation
        .run(trainer.model(), &Communicator::alone())
        .unwrap();
    assert_eq!(scores.keys().collect::<Vec<_>>(), ["camera", "gaze"]);
    for (name, score) in scores {
        assert_eq!(score.tokens, baseline[&name].tokens);
        assert!(
            score.loss < 0.8 * baseline[&name].loss,
            "{name}: {score:?} {:?}",
            baseline[&name]
        );
    }
}

#[test]
fn the_unigram_baseline_counts_only_clips_that_are_trained_on() {
    let all = clips(64, 1);
    let first = InMemory {
        samples: all.samples[..10].to_vec(),
        ..all.clone()
    };
    let fit = |source: InMemory, length: usize, clips: usize| {
        let sources: [Arc<dyn TokenSource>; 1] = [Arc::new(source)];
        Unigram::fit(&spec(), &sources, &[length], clips).unwrap()
    };
    for clips in [4, 64] {
        assert_eq!(
            fit(all.clone(), 10, clips),
            fit(first.clone(), 10, clips),
            "{clips}"
        );
    }
    assert_ne!(fit(all.clone(), 10, 64), fit(all, 64, 64));
}

#[test]
fn a_loss_that_is_not_finite_stops_the_run_and_changes_nothing() {
    let setup = Setup::new(4, 0, 1);
    let mut trainer = setup.trainer();
    setup.run(&mut trainer, 0..2).unwrap();
    let checkpoint = tempfile::tempdir().unwrap();
    trainer.save(checkpoint.path()).unwrap();
    // A damaged checkpoint is refused by name; so break the model by an absurd learning rate instead.
    let broken = Setup {
        settings: TrainingSettings {
            learning_rate: 1e30,
            ..setup.settings.clone()
        },
        ..Setup::new(4, 0, 1)
    };
    let mut trainer = broken.trainer();
    trainer.resume(checkpoint.path()).unwrap();
    let error = broken.run(&mut trainer, 2..4).unwrap_err();
    let step = trainer.progress().step;
    assert!(
        error.to_string().contains("the last checkpoint is good"),
        "{error}"
    );
    assert!(step < 4);
}

#[test]
fn a_damaged_checkpoint_is_refused() {
    let setup = Setup::new(4, 0, 1);
    let checkpoint = tempfile::tempdir().unwrap();
    setup.trainer().save(checkpoint.path()).unwrap();
    let path = checkpoint.path().join("weights.safetensors");
    let mut weights = Weights::read(&path).unwrap();
    weights.tensors.remove("mask_token");
    weights.write(&path).unwrap();
    let error = setup.trainer().resume(checkpoint.path()).unwrap_err();
    assert!(error.to_string().contains("mask_token"), "{error}");
    std::fs::write(&path, b"short").unwrap();
    assert!(setup.trainer().resume(checkpoint.path()).is_err());
}

/// A data set one of whose shards goes away.
struct Vanishing(InMemory);

impl TokenSource for Vanishing {
    fn name(&self) -> &'static str {
        "vanishing"
    }
    fn len(&self) -> usize {
        self.0.len()
    }
    fn read(&self, index: usize) -> Result<TokenSample, DataError> {
        if index == 40 {
            return Err(DataError::Shard {
                shard: "train-000004.tar".into(),
                reason: "No such file".into(),
            });
        }
        self.0.read(index)
    }
}

#[test]
fn a_vanished_shard_is_named_and_the_run_continues_when_it_is_back() {
    let whole = Setup::new(12, 0, 1);
    let mut trainer = whole.trainer();
    whole.run(&mut trainer, 0..12).unwrap();
    let expected = bytes(&trainer);

    let mut setup = Setup::new(12, 0, 2);
    setup.source = Arc::new(Vanishing(clips(64, 1)));
    let mut trainer = setup.trainer();
    let error = setup.run(&mut trainer, 0..12).unwrap_err();
    assert!(error.to_string().contains("train-000004.tar"), "{error}");
    let step = trainer.progress().step;
    whole.run(&mut trainer, step..12).unwrap();
    assert!(bytes(&trainer) == expected);
}
