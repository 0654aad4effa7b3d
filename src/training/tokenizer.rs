//! Training VQ-VAE and video tokenizers (Supp. A; the paper takes Cosmos as released) as [`Objective`]s.

use ndarray::Ix3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use super::optimizer::AdamWSettings;
use super::schedule::{Schedule, Shape};
use super::settings::{Keep, micro_batches};
use super::trainer::ranks::Told;
use super::trainer::{Found, Named, Objective, Progress, Trainer, TrainingError};
use super::validation::Score;
use crate::clip::Signal;
use crate::engine::communicator::reduce::Reduction;
use crate::engine::gradients::Complete;
use crate::engine::ops::Norm;
use crate::engine::parameters::to_host;
use crate::engine::{Communicator, Cuts, Gradients, Parameters, Reading, Tensor};
use crate::geometry::skeleton::HAND;
use crate::tokenizer::quantizer::{Assigned, Assignment};
use crate::tokenizer::trained::{Prepared, batch};
use crate::tokenizer::video::{Network, VideoTokenizer};
use crate::tokenizer::vq::VqVae;

/// Weight of the latents' unevenness beside the error of pixels.
const EVENNESS: f64 = 0.01;

/// Held-out signals per forward pass.
const HELD_OUT: usize = 16;

/// How a tokenizer trains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TokenizerTraining {
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
    /// Peak learning rate.
    pub learning_rate: f64,
    /// Steps until the peak.
    pub warmup: u64,
    /// The optimizer.
    pub optimizer: AdamWSettings,
    /// Which weights the tokenizer has in the end.
    pub keep: Keep,
}

impl Default for TokenizerTraining {
    fn default() -> Self {
        Self {
            steps: 1000,
            batch: 16,
            micro_batch: 0,
            reduction: Reduction::default(),
            learning_rate: 1e-3,
            warmup: 50,
            optimizer: AdamWSettings {
                betas: [0.9, 0.99],
                ..AdamWSettings::default()
            },
            keep: Keep::Last,
        }
    }
}

impl TokenizerTraining {
    fn start<O: Objective>(&self, objective: O) -> Result<Trainer<O>, TrainingError> {
        let (peak, steps) = (self.learning_rate, self.steps);
        Ok(Trainer::start(
            objective,
            self.optimizer.clone(),
            Schedule::new(Shape::Cosine, peak, 0.0, self.warmup, steps)?,
            micro_batches(self.batch, self.micro_batch),
            self.keep,
        ))
    }
}

/// A VQ-VAE, trained to reconstruct signals; its codes follow running means of their latents.
#[derive(Debug, Clone)]
pub struct VqReconstruction {
    model: VqVae,
    seed: u64,
}

impl VqReconstruction {
    /// The reconstruction loss of held-out signals; nothing where there are none. Each rank computes some of them.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn held_out(
        &self,
        signals: &[Prepared],
        ranks: &Communicator,
    ) -> Result<BTreeMap<String, Score>, TrainingError> {
        let model = self.model.frozen();
        let chunks: Vec<&[Prepared]> = signals.chunks(HELD_OUT).collect();
        let losses = ranks.map(chunks.len(), |index| {
            let chunk = chunks[index];
            let batch = batch(&model, chunk);
            let found = model.decode(&model.encode(&batch), chunk.len());
            // As bits: a loss need not be a number.
            let loss = to_host(model.loss(found, &batch))[0];
            Ok::<_, TrainingError>((loss.to_bits(), chunk.len()))
        })?;
        let losses = losses.into_iter();
        Ok(mean_of(
            losses.map(|(bits, n)| (f64::from(f32::from_bits(bits)), n)),
        ))
    }
}

/// The mean over signals, as the score of what is reconstructed.
fn mean_of(losses: impl Iterator<Item = (f64, usize)>) -> BTreeMap<String, Score> {
    let (sum, signals) = losses.fold((0.0, 0), |(sum, count), (loss, n)| {
        (sum + loss * n as f64, count + n)
    });
    let score = (signals > 0).then(|| Score {
        loss: sum / signals as f64,
        tokens: signals,
    });
    score
        .map(|score| ("reconstruction".to_owned(), score))
        .into_iter()
        .collect()
}

impl Trainer<VqReconstruction> {
    /// Starts to train a VQ-VAE; `seed` draws the latents that replace dead codes.
    ///
    /// # Errors
    /// When warm-up is longer than the run.
    pub fn vq(
        model: VqVae,
        settings: &TokenizerTraining,
        seed: u64,
    ) -> Result<Self, TrainingError> {
        settings.start(VqReconstruction { model, seed })
    }
}

impl Told for Assigned {
    fn to_bytes(&self) -> Vec<u8> {
        self.to_host().to_bytes()
    }

    fn of_bytes(bytes: &[u8]) -> Option<Self> {
        Assignment::of_bytes(bytes).map(Self::Host)
    }
}

impl Objective for VqReconstruction {
    type Module = VqVae;
    type Batch = Vec<Prepared>;
    type Trace = Assigned;

    fn module(&self) -> &VqVae {
        &self.model
    }

    fn module_mut(&mut self) -> &mut VqVae {
        &mut self.model
    }

    fn backward_order(&self) -> Vec<String> {
        self.model.backward_order()
    }

    fn micro_step(
        &self,
        signals: &Vec<Prepared>,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> Result<Found<Assigned>, TrainingError> {
        let mut cuts = Cuts::wanted(complete.is_some());
        let batch = batch(&self.model, signals);
        let trained = self.model.forward_training(&batch, &mut cuts);
        let samples = signals.len() as f64;
        let bad = is_known_bad(&trained.numbers);
        Ok(Found {
            numbers: trained.numbers,
            parts: vec![
                ("loss/reconstruction".into(), samples),
                ("loss/commitment".into(), samples),
            ],
            gradients: (!bad)
                .then(|| gradients(cuts, &(trained.loss * share), &self.model, complete)),
            used: used(signals.len()),
            trace: trained.assigned,
        })
    }

    fn finish_step(&mut self, traces: Vec<Assigned>, norm: &Norm, step: u64) -> Named {
        let quantizer = self.model.quantizer_mut();
        Named {
            names: vec!["codes/replaced".into()],
            numbers: quantizer.follow(traces, norm, self.seed, step),
        }
    }
}

/// Whether the first number, a loss, is known and not finite.
fn is_known_bad(numbers: &Reading) -> bool {
    let loss = numbers.known().and_then(<[f64]>::first);
    loss.is_some_and(|loss| !loss.is_finite())
}

/// A video tokenizer, trained on the squared error of pixels and on even use of the codes.
#[derive(Debug, Clone)]
pub struct VideoReconstruction {
    model: VideoTokenizer,
}

impl VideoReconstruction {
    /// The tokenizer as it is now; it records nothing.
    #[must_use]
    pub fn tokenizer(&self) -> VideoTokenizer {
        let mut tokenizer = self.model.clone();
        *tokenizer.network_mut() = self.model.network().frozen();
        tokenizer
    }

    /// The squared error of pixels of `count` held-out clips; nothing where there are none. Each rank computes some of them.
    ///
    /// # Errors
    /// What `clip` says, or when a clip has another size.
    pub fn held_out(
        &self,
        count: usize,
        clip: impl Fn(usize) -> Result<Option<Signal>, TrainingError>,
        ranks: &Communicator,
    ) -> Result<BTreeMap<String, Score>, TrainingError> {
        let tokenizer = self.tokenizer();
        let losses = ranks.map(count, |index| {
            let Some(clip) = clip(index)? else {
                return Ok(None);
            };
            let trained = tokenizer.train(&[clip], &mut Cuts::none())?;
            // As bits: a loss need not be a number.
            Ok::<_, TrainingError>(Some(trained.loss.into_scalar::<f32>().to_bits()))
        })?;
        let losses = losses.into_iter().flatten();
        Ok(mean_of(
            losses.map(|bits| (f64::from(f32::from_bits(bits)), 1)),
        ))
    }
}

impl Trainer<VideoReconstruction> {
    /// Starts to train a video tokenizer.
    ///
    /// # Errors
    /// When warm-up is longer than the run.
    pub fn video(
        model: VideoTokenizer,
        settings: &TokenizerTraining,
    ) -> Result<Self, TrainingError> {
        settings.start(VideoReconstruction { model })
    }
}

impl Objective for VideoReconstruction {
    type Module = Network;
    type Batch = Vec<Signal>;
    type Trace = ();

    fn module(&self) -> &Network {
        self.model.network()
    }

    fn module_mut(&mut self) -> &mut Network {
        self.model.network_mut()
    }

    fn backward_order(&self) -> Vec<String> {
        self.model.network().backward_order()
    }

    fn micro_step(
        &self,
        clips: &Vec<Signal>,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> Result<Found<()>, TrainingError> {
        if clips.is_empty() {
            return Err(TrainingError::NoData);
        }
        let mut cuts = Cuts::wanted(complete.is_some());
        let trained = self.model.train(clips, &mut cuts)?;
        let numbers = Reading::of([trained.loss.clone()]);
        let gradients = (!is_known_bad(&numbers)).then(|| {
            let total = trained.loss + trained.unevenness * EVENNESS;
            gradients(cuts, &(total * share), self.model.network(), complete)
        });
        Ok(Found {
            numbers,
            parts: Vec::new(),
            gradients,
            used: used(clips.len()),
            trace: (),
        })
    }
}

/// The gradients of a loss; `complete` hears of those of a block while backward goes on with the one before it.
fn gradients<M: Parameters>(
    cuts: Cuts,
    loss: &Tensor<1>,
    model: &M,
    complete: Option<&mut Complete<'_>>,
) -> Gradients {
    match complete {
        Some(complete) => cuts.gradients(loss, model, complete),
        None => Gradients::of(loss, model),
    }
}

fn used(signals: usize) -> Progress {
    Progress {
        samples: signals as u64,
        ..Progress::default()
    }
}

/// Joints seen in a mirror: x (right) is negated, in the camera's frame. Left and right hands use the same list of joints, so
/// a mirrored left hand is a right hand (Supp. A).
///
/// # Errors
/// When the signal is not `[samples, joints, 3]`.
pub fn mirrored(signal: &Signal) -> Result<Signal, ndarray::ShapeError> {
    let joints = signal.values.clone().into_dimensionality::<Ix3>()?;
    Ok(Signal {
        values: HAND.mirrored(&joints).into_dyn(),
        valid: signal.valid.clone(),
    })
}

#[cfg(test)]
mod tests {
    use super::super::epochs::Epochs;
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::flow::Flow;
    use crate::tokenizer::video::testing::small;
    use crate::tokenizer::vq::VqSettings;
    use crate::training::Ranks;
    use crate::training::fit::{Event, Intervals, fit};
    use ndarray::{ArrayD, IxDyn};

    const SHAPE: crate::modality::Shape = crate::modality::Shape::Temporal {
        samples: 8,
        channels: 2,
    };

    fn settings(steps: u64, micro_batch: usize) -> TokenizerTraining {
        TokenizerTraining {
            steps,
            batch: 8,
            micro_batch,
            warmup: 2,
            ..TokenizerTraining::default()
        }
    }

    fn trainer(settings: &TokenizerTraining) -> Trainer<VqReconstruction> {
        trainer_of(1, settings)
    }

    fn trainer_of(depth: usize, settings: &TokenizerTraining) -> Trainer<VqReconstruction> {
        let compute = Compute::cpu();
        let sizes = VqSettings {
            codebook: 32,
            code_width: 4,
            width: 16,
            depth,
            heads: 2,
            ..VqSettings::default()
        };
        let model = VqVae::new(&Initialise::new(&compute, 4), &sizes, &SHAPE).unwrap();
        Trainer::vq(model, settings, 4).unwrap()
    }

    fn data() -> Vec<Prepared> {
        (0..20)
            .map(|signal| Prepared {
                values: (0..16)
                    .map(|i| (signal as f32 * 0.8 + i as f32 * 0.4).sin())
                    .collect(),
                valid: (signal % 5 == 0).then(|| (0..8).map(|t| t != 3).collect()),
            })
            .collect()
    }

    fn step(trainer: &mut Trainer<VqReconstruction>, data: &[Prepared]) -> f64 {
        let mut epochs = Epochs::of(trainer, 4);
        let step = trainer.progress().step;
        let report = trainer.step(|micro| -> Result<_, TrainingError> {
            let chosen = epochs.choose(step, micro, data.len())?;
            Ok(chosen.into_iter().map(|i| data[i].clone()).collect())
        });
        report.unwrap().parts[0].1
    }

    /// The bytes of a checkpoint.
    fn bytes<O: Objective>(trainer: &Trainer<O>) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        trainer.save(folder.path()).unwrap();
        let mut files: Vec<_> = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        files.sort();
        files
            .iter()
            .flat_map(|file| std::fs::read(file).unwrap())
            .collect()
    }

    #[test]
    fn training_lowers_the_error_and_a_killed_run_resumes_to_the_same_bytes() {
        let data = data();
        for micro_batch in [0, 3] {
            let settings = settings(60, micro_batch);
            let mut whole = trainer(&settings);
            let stored = tempfile::tempdir().unwrap();
            let mut losses = Vec::new();
            for at in 0..60 {
                if at == 23 {
                    whole.save(stored.path()).unwrap();
                }
                losses.push(step(&mut whole, &data));
            }
            let (first, last) = (losses[0], losses[59]);
            assert!(last < 0.5 * first, "{first} to {last}");

            let mut resumed = trainer(&settings);
            resumed.resume(stored.path()).unwrap();
            assert_eq!(resumed.progress().step, 23);
            for _ in 23..60 {
                step(&mut resumed, &data);
            }
            assert!(bytes(&resumed) == bytes(&whole));
        }
    }

    /// What `work` gives on rank 0 of `size`, once all are found to have it.
    fn on_ranks(size: usize, work: impl Fn(Ranks) -> Vec<u8> + Sync) -> Vec<u8> {
        let mut all = std::thread::scope(|scope| {
            let work = &work;
            let ranks = Communicator::threads(size).into_iter();
            let ranks = ranks.map(|rank| Ranks::new(rank, Reduction::Ordered));
            let threads: Vec<_> = ranks
                .map(|ranks| scope.spawn(move || work(ranks)))
                .collect();
            let ended = threads.into_iter().map(|thread| thread.join().unwrap());
            ended.collect::<Vec<_>>()
        });
        let first = all.swap_remove(0);
        assert!(all.iter().all(|other| *other == first), "{size} ranks");
        first
    }

    /// Backward in parts gives the bits of the whole graph, and is done with gradients about in the order in which they are sent.
    fn assert_in_parts<O: Objective>(objective: &O, batch: &O::Batch) {
        let whole = objective.micro_step(batch, 0.5, None).unwrap();
        let bits = |gradient: &Tensor<1>| -> Vec<u32> {
            let values = to_host(gradient.clone()).into_iter();
            values.map(f32::to_bits).collect()
        };
        let mut told: Vec<(String, Vec<u32>)> = Vec::new();
        let mut hear = |name: &str, gradient: &Tensor<1>| {
            if told.iter().all(|(other, _)| other != name) {
                told.push((name.to_owned(), bits(gradient)));
            }
        };
        let parts = objective.micro_step(batch, 0.5, Some(&mut hear)).unwrap();
        let (expected, found) = (whole.gradients.unwrap(), parts.gradients.unwrap());
        assert_eq!(parts.numbers.read(), whole.numbers.read());
        assert_eq!(parts.parts, whole.parts);
        assert_eq!(found.iter().count(), expected.iter().count());
        assert_eq!(told.len(), expected.iter().count());
        let mut order = objective.backward_order();
        order.retain(|name| expected.get(name).is_some());
        assert_eq!(told.len(), order.len());
        for (at, (name, early)) in told.iter().enumerate() {
            assert_eq!(bits(found.get(name).unwrap()), *early, "{name}");
            assert_eq!(bits(expected.get(name).unwrap()), *early, "{name}");
            // A part has at most 14 parameters, in an order of its own.
            let place = order.iter().position(|other| other == name).unwrap();
            assert!(place.abs_diff(at) < 14, "{name}: {at}, sent as {place}");
        }
    }

    #[test]
    fn gradients_of_tokenizers_in_parts_are_those_of_the_whole_graph_to_the_bit() {
        let vq = trainer_of(3, &settings(5, 0));
        assert_in_parts(vq.objective(), &data());
        let model = small([4, 16, 16], [4, 4], &[4, 3], 2);
        let video = Trainer::video(model, &settings(5, 0)).unwrap();
        assert_in_parts(video.objective(), &vec![video_clip(0), video_clip(1)]);
    }

    /// Codes follow the latents of all ranks, and dead ones are replaced from them.
    #[test]
    fn in_the_order_of_samples_any_number_of_ranks_trains_a_tokenizer_to_the_same_bytes() {
        let data = data();
        let settings = TokenizerTraining {
            batch: 12,
            ..settings(6, 1)
        };
        let train = |mut trainer: Trainer<VqReconstruction>| {
            for _ in 0..6 {
                step(&mut trainer, &data);
            }
            let ranks = trainer.ranks().communicator().clone();
            let held_out = trainer.objective().held_out(&data, &ranks).unwrap();
            let mut bytes = bytes(&trainer);
            bytes.extend(held_out["reconstruction"].loss.to_bits().to_le_bytes());
            bytes
        };
        let expected = train(trainer(&settings));
        for size in 1..=4 {
            let found = on_ranks(size, |ranks| {
                train(trainer(&settings).shared(ranks, 1).unwrap())
            });
            assert!(found == expected, "{size} ranks");
        }
    }

    #[test]
    fn micro_batches_of_a_step_add_up_to_it() {
        let data = data();
        let (mut whole, mut parts) = (trainer(&settings(3, 0)), trainer(&settings(3, 2)));
        // Signals that are valid throughout: a mean over valid values is no mean over signals.
        let data: Vec<Prepared> = data.into_iter().filter(|d| d.valid.is_none()).collect();
        for at in 0..3 {
            let (a, b) = (step(&mut whole, &data), step(&mut parts, &data));
            assert!((a - b).abs() < 1e-4, "{a} {b}");
            let (a, b) = (whole.model().quantizer(), parts.model().quantizer());
            assert!(at > 0 || a.counts() == b.counts());
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
        let data = data();
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| {
                let mut trainer = trainer(&settings(6, 0));
                for _ in 0..6 {
                    step(&mut trainer, &data);
                }
                bytes(&trainer)
            })
        };
        let one = on(1);
        assert!(on(2) == one && on(3) == one);
    }

    #[test]
    fn a_loss_that_is_not_finite_stops_with_the_step_and_changes_nothing() {
        let mut trainer = trainer(&settings(5, 0));
        step(&mut trainer, &data());
        let before = bytes(&trainer);
        let huge = Prepared {
            values: vec![1e30; 16],
            valid: None,
        };
        let next = |_| Ok::<_, TrainingError>(vec![huge.clone(); 8]);
        let error = trainer.step(next).unwrap_err().to_string();
        assert!(error.contains("loss of step 2 is"), "{error}");
        assert!(bytes(&trainer) == before);
    }

    /// Fits with held-out losses that fall until step 4 and rise again; stopped and resumed at `cut`.
    fn fitted(keep: Keep, cut: Option<u64>) -> (u64, crate::engine::Weights) {
        let (data, kept) = (data(), tempfile::tempdir().unwrap());
        let settings = TokenizerTraining {
            keep,
            ..settings(9, 0)
        };
        let run = |trainer: &mut Trainer<VqReconstruction>, cut: Option<u64>| {
            let mut epochs = Epochs::of(trainer, 4);
            let mut step = trainer.progress().step;
            fit(
                trainer,
                Intervals {
                    validate_every: 2,
                    ..Intervals::default()
                },
                |step, micro| -> Result<_, TrainingError> {
                    let chosen = epochs.choose(step, micro, data.len())?;
                    Ok(chosen.into_iter().map(|i| data[i].clone()).collect())
                },
                |_| {
                    step = (step / 2 + 1) * 2;
                    let loss = (step as f64 - 4.0).abs();
                    let score = Score { loss, tokens: 1 };
                    Ok(BTreeMap::from([("x".to_owned(), score)]))
                },
                &mut |event| match event {
                    Event::Step { report, .. } if Some(report.step) == cut => Ok(Flow::Stop),
                    Event::Checkpoint(state) => state.save(kept.path()).map(|()| Flow::Continue),
                    _ => Ok(Flow::Continue),
                },
            )
        };
        let mut trainer = trainer(&settings);
        let mut done = run(&mut trainer, cut);
        if let Some(cut) = cut {
            assert!(matches!(done, Err(TrainingError::Stopped)));
            trainer = self::trainer(&settings);
            trainer.resume(kept.path()).unwrap();
            assert_eq!(trainer.progress().step, cut);
            done = run(&mut trainer, None);
        }
        (done.unwrap().step, trainer.model().weights())
    }

    #[test]
    fn the_best_weights_are_kept_where_asked_for_and_survive_a_stop() {
        let (step, best) = fitted(Keep::Best, None);
        let (last_step, last) = fitted(Keep::Last, None);
        assert_eq!((step, last_step), (4, 9));
        assert!(best != last);
        for cut in [3, 4, 6] {
            assert!(fitted(Keep::Best, Some(cut)) == (4, best.clone()), "{cut}");
            assert!(fitted(Keep::Last, Some(cut)) == (9, last.clone()), "{cut}");
        }
    }

    fn video_clip(clip: usize) -> Signal {
        Signal {
            values: ArrayD::from_shape_fn(IxDyn(&[4, 16, 16, 3]), |at| {
                ((at[0] + 2 * at[1] + at[2] + 5 * clip) as f32 * 0.2).sin()
            }),
            valid: None,
        }
    }

    #[test]
    fn a_video_tokenizer_learns_and_resumes_to_the_same_bytes_on_any_number_of_ranks() {
        let start = || {
            let settings = TokenizerTraining {
                learning_rate: 3e-3,
                batch: 12,
                ..settings(8, 1)
            };
            Trainer::video(small([4, 16, 16], [4, 4], &[4, 3], 2), &settings).unwrap()
        };
        let step = |trainer: &mut Trainer<VideoReconstruction>| {
            let mut epochs = Epochs::of(trainer, 5);
            let step = trainer.progress().step;
            let next = |micro| -> Result<Vec<Signal>, TrainingError> {
                Ok(epochs
                    .choose(step, micro, 5)?
                    .into_iter()
                    .map(video_clip)
                    .collect())
            };
            trainer.step(next).unwrap().loss
        };
        let (mut whole, stored) = (start(), tempfile::tempdir().unwrap());
        let mut losses = Vec::new();
        for at in 0..8 {
            if at == 3 {
                whole.save(stored.path()).unwrap();
            }
            losses.push(step(&mut whole));
        }
        assert!(losses[7] < losses[0], "{losses:?}");
        let mut resumed = start();
        resumed.resume(stored.path()).unwrap();
        for _ in 3..8 {
            step(&mut resumed);
        }
        assert!(bytes(&resumed) == bytes(&whole));
        for size in 1..=4 {
            let found = on_ranks(size, |ranks| {
                let mut trainer = start().shared(ranks, 1).unwrap();
                for _ in 0..8 {
                    step(&mut trainer);
                }
                bytes(&trainer)
            });
            assert!(found == bytes(&whole), "{size} ranks");
        }
    }

    #[test]
    fn the_other_hand_in_a_mirror_is_turned_around_and_back() {
        let joints = ndarray::Array3::from_shape_fn((2, 21, 3), |(t, j, k)| {
            (t + 3 * j + 7 * k) as f32 - 20.0
        });
        let signal = Signal {
            values: joints.into_dyn(),
            valid: None,
        };
        let once = mirrored(&signal).unwrap();
        assert_eq!(once.values[[1, 4, 0]], -signal.values[[1, 4, 0]]);
        assert_eq!(once.values[[1, 4, 2]], signal.values[[1, 4, 2]]);
        assert_eq!(mirrored(&once).unwrap(), signal);
    }
}
