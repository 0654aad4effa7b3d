//! AdamW with the reference's parameter groups, and clipping by the global norm (Supp. B).
//!
//! Weight decay applies to everything but norms and biases. A parameter that took no part in a step has a zero gradient, not a
//! missing one: its moments fade and its values decay.
//!
//! Of several ranks each may keep the moments of its stretch of the parameters alone ([`AdamW::shard`]). It moves that stretch, and the
//! ranks tell each other what became of theirs; every number comes out as if one rank had moved all of them.

use std::collections::{BTreeMap, BTreeSet};

use burn::tensor::{Tensor, TensorData};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::muon;
use crate::engine::communicator::shard::Shard;
use crate::engine::ops::{self, AdamWStep, MuonParameter, Norm};
use crate::engine::parameters::{Kind, to_host};
use crate::engine::{
    Communicator, Device, EngineError, Gradients, HostTensor, Parameters, RankError, Values,
    Weights,
};

/// How the optimizer steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AdamWSettings {
    /// Decay of the mean and of the mean square of gradients; each at least 0 and below 1.
    pub betas: [f64; 2],
    /// Added to the root of the mean square; above 0.
    pub epsilon: f64,
    /// Share of the values lost per step and unit of learning rate, at least 0; not for norms and biases.
    pub weight_decay: f64,
    /// Largest norm of all gradients together, above 0; larger ones are scaled down. `null`: no limit.
    pub clip_norm: Option<f64>,
    /// Of several ranks each keeps its share of the optimizer's two moments and no more (ZeRO stage 1): less memory, one more
    /// exchange of all weights a step, and the same bytes. One rank keeps everything.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub shard: bool,
    /// Muon for the matrices inside blocks: their momentum is made orthogonal first, and their gradients are not clipped. Everything else
    /// steps as before. Not with `shard`: the step of a matrix needs all of it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub muon: bool,
}

impl Default for AdamWSettings {
    fn default() -> Self {
        Self {
            betas: [0.9, 0.95],
            epsilon: 1e-8,
            weight_decay: 0.05,
            clip_norm: Some(1.0),
            shard: false,
            muon: false,
        }
    }
}

impl AdamWSettings {
    /// The first setting that is out of its range, if any: a step would be NaN, or go uphill.
    #[must_use]
    pub fn wrong(&self) -> Option<&'static str> {
        // Steps are taken in f32, where a tiny number may be 0.
        let positive = |value: f64| value.is_finite() && value as f32 > 0.0;
        let good = [
            ("betas", self.betas.iter().all(|b| (0.0..1.0).contains(b))),
            ("epsilon", positive(self.epsilon)),
            (
                "weight_decay",
                self.weight_decay.is_finite() && self.weight_decay >= 0.0,
            ),
            ("clip_norm", self.clip_norm.is_none_or(positive)),
            ("muon", !(self.muon && self.shard)),
        ];
        good.into_iter()
            .find(|(_, good)| !good)
            .map(|(name, _)| name)
    }
}

/// Whether weight decay applies to the parameter `name`.
#[must_use]
pub fn decays(name: &str) -> bool {
    let is_bias = name.strip_suffix(".bias").is_some();
    !(name.contains("norm.") || name.contains(".norm") || is_bias)
}

/// Means of gradients and of their squares, flat; where the state is shared, of this rank's part of the parameter.
#[derive(Debug, Clone)]
struct Moments {
    mean: Tensor<1>,
    /// Nothing where Muon steps, which has no use for it.
    square: Option<Tensor<1>>,
}

/// The optimizer and its state, or this rank's share of it.
#[derive(Debug, Clone)]
pub struct AdamW {
    settings: AdamWSettings,
    step: u64,
    moments: BTreeMap<String, Moments>,
    shard: Option<Shard>,
    /// The values of this rank's stretch after a step, until the others have them too.
    moved: Vec<f32>,
}

/// A step that was refused; nothing has changed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the gradient of step {step} is not finite (norm {norm})")]
pub struct NotFinite {
    /// Counted from 1.
    pub step: u64,
    /// Global norm of the gradient.
    pub norm: f64,
}

/// Refuses step `step`, counted from 1, where the norm of its gradient is known and not finite.
fn refuse(step: u64, norm: Option<f64>) -> Result<(), NotFinite> {
    match norm {
        Some(norm) if !norm.is_finite() => Err(NotFinite { step, norm }),
        _ => Ok(()),
    }
}

impl AdamW {
    /// A fresh optimizer for the trainable parameters of `model`.
    #[must_use]
    pub fn new<M: Parameters + ?Sized>(settings: AdamWSettings, model: &M) -> Self {
        let mut moments = BTreeMap::new();
        model.visit("", &mut |name, parameter| {
            if parameter.kind() == Kind::Trainable {
                let zeros = parameter.untracked().zeros_like();
                let with_muon = settings.muon && muon::matrices(name, parameter.shape()).is_some();
                let pair = Moments {
                    mean: zeros.clone(),
                    square: (!with_muon).then_some(zeros),
                };
                moments.insert(name.to_owned(), pair);
            }
        });
        Self {
            settings,
            step: 0,
            moments,
            shard: None,
            moved: Vec::new(),
        }
    }

    /// Where the settings ask for it and there are several ranks, keeps this rank's share of the state alone. Before the first step.
    #[must_use]
    pub fn shard<M: Parameters + ?Sized>(mut self, ranks: &Communicator, model: &M) -> Self {
        self.shard = Shard::of(ranks, model).filter(|_| self.settings.shard);
        if let Some(shard) = &self.shard {
            let all = std::mem::take(&mut self.moments).into_iter();
            let own = all.filter_map(|(name, moments)| {
                let (own, _) = shard.own(&name)?;
                let zeros = Tensor::zeros([own.len()], &moments.mean.device());
                let pair = Moments {
                    mean: zeros.clone(),
                    square: Some(zeros),
                };
                Some((name, pair))
            });
            self.moments = own.collect();
        }
        self
    }

    /// Whether this rank has a share of the state, and not all of it.
    #[must_use]
    pub fn is_sharded(&self) -> bool {
        self.shard.is_some()
    }

    /// How many steps were taken.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Clips `gradients` by their global norm, and moves the parameters of `model`. Gives the norm before clipping. Where the state is
    /// sharded, nothing has moved before [`AdamW::gather`].
    ///
    /// # Errors
    /// When the norm is not finite. No weight has changed then.
    ///
    /// # Panics
    /// When `gradients` or `model` are not of the model the optimizer was made for.
    pub fn step<M: Parameters + ?Sized>(
        &mut self,
        model: &mut M,
        gradients: Gradients,
        rate: f64,
    ) -> Result<f64, NotFinite> {
        let norm = self.step_unread(model, gradients, rate)?.read();
        refuse(self.step, Some(norm))?;
        Ok(norm)
    }

    /// As [`AdamW::step`], without waiting for a device: where the norm is there, the step refuses itself, and only who reads the norm
    /// sees whether it did.
    ///
    /// # Errors
    /// When the norm is known and not finite. Nothing has changed then.
    ///
    /// # Panics
    /// As [`AdamW::step`].
    pub fn step_unread<M: Parameters + ?Sized>(
        &mut self,
        model: &mut M,
        mut gradients: Gradients,
        rate: f64,
    ) -> Result<Norm, NotFinite> {
        let norm = gradients.norm();
        // What a share has moved is told to the other ranks at once.
        let known = if self.shard.is_some() {
            Some(norm.read())
        } else {
            norm.known()
        };
        let next = self.step + 1;
        refuse(next, known)?;
        let settings = &self.settings;
        let exponent = i32::try_from(next).unwrap_or(i32::MAX);
        let mut step = AdamWStep {
            clip: settings.clip_norm,
            betas: settings.betas,
            epsilon: settings.epsilon,
            decay: 0.0,
            rate: rate / (1.0 - settings.betas[0].powi(exponent)),
            square_correction: 1.0 / (1.0 - settings.betas[1].powi(exponent)).sqrt(),
        };
        let decay = |name: &str| {
            if decays(name) {
                rate * settings.weight_decay
            } else {
                0.0
            }
        };
        let moments = &mut self.moments;
        if let Some(shard) = &self.shard {
            self.moved = vec![0.0; shard.stretch()];
            let moved = &mut self.moved;
            model.visit("", &mut |name, parameter| {
                let (Some(state), Some((own, at))) = (moments.remove(name), shard.own(name)) else {
                    return;
                };
                let square = state.square.expect("Muon is not for shares");
                let gradient = gradients
                    .remove(name)
                    .expect("one gradient per trainable parameter");
                step.decay = decay(name);
                let length = own.len();
                let (values, mean, square) = ops::adamw(
                    parameter.untracked().slice([own.clone()]),
                    gradient.slice([own]),
                    state.mean,
                    square,
                    &norm,
                    step,
                );
                moved[at..at + length].copy_from_slice(&to_host(values));
                let square = Some(square);
                moments.insert(name.to_owned(), Moments { mean, square });
            });
            self.step = next;
            return Ok(norm);
        }
        let (mut with_muon, mut names) = (Vec::new(), Vec::new());
        model.visit_mut("", &mut |name, parameter| {
            let Some(state) = moments.remove(name) else {
                return;
            };
            let gradient = gradients
                .remove(name)
                .expect("one gradient per trainable parameter");
            step.decay = decay(name);
            let tracked = parameter.is_tracked();
            if let Some(square) = state.square {
                let (values, mean, square) =
                    ops::adamw(parameter.take(), gradient, state.mean, square, &norm, step);
                parameter.put(values, tracked);
                let square = Some(square);
                moments.insert(name.to_owned(), Moments { mean, square });
                return;
            }
            let &[rows, columns] = parameter.shape() else {
                unreachable!("Muon is for matrices");
            };
            names.push((name.to_owned(), tracked));
            with_muon.push(MuonParameter {
                shape: [rows, columns],
                matrices: muon::matrices(name, &[rows, columns])
                    .expect("moments without squares are Muon's"),
                values: parameter.take(),
                gradient,
                momentum: state.mean,
                decay: step.decay,
            });
        });
        // All at once, since a matrix alone is too small for several threads.
        let moved = names.into_iter().zip(ops::muon(with_muon, rate, &norm));
        let mut moved: BTreeMap<_, _> = moved
            .map(|((name, tracked), after)| (name, (tracked, after)))
            .collect();
        model.visit_mut("", &mut |name, parameter| {
            if let Some((tracked, (values, mean))) = moved.remove(name) {
                parameter.put(values, tracked);
                moments.insert(name.to_owned(), Moments { mean, square: None });
            }
        });
        self.step = next;
        Ok(norm)
    }

    /// Ends a step where the state is sharded: every rank gets from all what they have moved. Does nothing where it is not.
    ///
    /// # Errors
    /// When a rank is lost.
    ///
    /// # Panics
    /// When `model` is not of the optimizer.
    pub fn gather<M: Parameters + ?Sized>(&mut self, model: &mut M) -> Result<(), RankError> {
        let Some(shard) = &self.shard else {
            return Ok(());
        };
        let all = shard.collect(&std::mem::take(&mut self.moved), true)?;
        model.visit_mut("", &mut |name, parameter| {
            if let Some(place) = shard.place(name) {
                parameter.set(all[place].to_vec());
            }
        });
        Ok(())
    }

    /// The state as arrays: `step`, `exp_avg.<name>` and, where Muon does not step, `exp_avg_sq.<name>`, the same however many ranks
    /// share it. Where it is sharded, all ranks must ask at once, and rank 0 alone gets it; the others get `None`.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn state(&self) -> Result<Option<Weights>, RankError> {
        let mut weights = Weights::default();
        let step = HostTensor {
            shape: vec![1],
            values: Values::I64(vec![self.step as i64]),
        };
        weights.tensors.insert("step".to_owned(), step);
        for kind in ["exp_avg", "exp_avg_sq"] {
            let of = |moments: &Moments| match kind {
                "exp_avg" => Some(to_host(moments.mean.clone())),
                _ => moments.square.clone().map(to_host),
            };
            let mut insert = |name: &str, values: Vec<f32>| {
                let length = values.len();
                weights.insert_f32(&format!("{kind}.{name}"), values, &[length]);
            };
            let Some(shard) = &self.shard else {
                for (name, moments) in &self.moments {
                    if let Some(values) = of(moments) {
                        insert(name, values);
                    }
                }
                continue;
            };
            let mut mine = vec![0.0; shard.stretch()];
            for (name, moments) in &self.moments {
                if let (Some((own, at)), Some(values)) = (shard.own(name), of(moments)) {
                    mine[at..at + own.len()].copy_from_slice(&values);
                }
            }
            let all = shard.collect(&mine, shard.is_root())?;
            for (name, _) in shard.names().filter(|_| shard.is_root()) {
                let place = shard.place(name).unwrap_or_default();
                insert(name, all[place].to_vec());
            }
        }
        let whole = self.shard.as_ref().is_none_or(Shard::is_root);
        Ok(whole.then_some(weights))
    }

    /// Continues from a state of [`AdamW::state`], of any number of ranks; the next steps are those the stored optimizer would have
    /// taken, to the bit.
    ///
    /// # Errors
    /// When the state is of another model.
    pub fn restore(&mut self, state: &Weights) -> Result<(), EngineError> {
        let step = state.get("step", &[1])?.i64("step")?[0];
        let names: Vec<(String, usize)> = if let Some(shard) = &self.shard {
            let names = shard.names();
            names
                .map(|(name, length)| (name.to_owned(), length))
                .collect()
        } else {
            let all = self.moments.iter();
            all.map(|(name, moments)| (name.clone(), moments.mean.dims()[0]))
                .collect()
        };
        let mut restored = BTreeMap::new();
        let mut known = BTreeSet::from(["step".to_owned()]);
        for (name, length) in &names {
            // What other ranks keep must be there too.
            let mut read = |kind: &str| {
                let name = format!("{kind}.{name}");
                let values = state.get(&name, &[*length])?.f32(&name)?;
                known.insert(name);
                Ok::<_, EngineError>(values)
            };
            let with_muon = self.moments.get(name).is_some_and(|m| m.square.is_none());
            let mean = read("exp_avg")?;
            let square = if with_muon {
                None
            } else {
                Some(read("exp_avg_sq")?)
            };
            let Some(moments) = self.moments.get(name) else {
                continue;
            };
            let own = self.shard.as_ref().and_then(|shard| shard.own(name));
            let own = own.map_or(0..*length, |(own, _)| own);
            let device = moments.mean.device();
            let pair = Moments {
                mean: flat(&mean[own.clone()], &device),
                square: square.map(|square| flat(&square[own], &device)),
            };
            restored.insert(name.clone(), pair);
        }
        let unknown: Vec<_> = (state.tensors.keys())
            .filter(|key| !known.contains(*key))
            .collect();
        if let Some(first) = unknown.first() {
            return Err(EngineError::Unknown {
                count: unknown.len(),
                first: (*first).clone(),
            });
        }
        self.step = u64::try_from(step).unwrap_or(0);
        self.moments = restored;
        Ok(())
    }
}

fn flat(values: &[f32], device: &Device) -> Tensor<1> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::nn::Linear;

    fn train(model: &mut Linear, optimizer: &mut AdamW, steps: std::ops::Range<u64>) {
        for step in steps {
            let x = Tensor::<1>::from_floats(
                [0.5, -1.0, 0.25 * step as f32],
                &model.weight.flat().device(),
            );
            let y = model.forward(x.without_autodiff().reshape([1, 3]));
            let gradients = Gradients::of(&y.square().sum(), model);
            optimizer.step(model, gradients, 0.01).unwrap();
            optimizer.gather(model).unwrap();
        }
    }

    #[test]
    fn a_restored_optimizer_continues_to_the_same_bytes() {
        let compute = Compute::cpu();
        let mut model = Linear::new(&Initialise::new(&compute, 1), 3, 2, true);
        model.start_training();
        let mut optimizer = AdamW::new(AdamWSettings::default(), &model);
        train(&mut model, &mut optimizer, 0..3);
        let (weights, state) = (
            model.weights(),
            optimizer.state().unwrap().unwrap().to_bytes(),
        );
        train(&mut model, &mut optimizer, 3..6);

        let mut again = Linear::new(&Initialise::empty(&compute), 3, 2, true);
        again.load(&weights).unwrap();
        again.start_training();
        let mut resumed = AdamW::new(AdamWSettings::default(), &again);
        resumed
            .restore(&Weights::from_bytes(&state).unwrap())
            .unwrap();
        assert_eq!(resumed.steps(), 3);
        train(&mut again, &mut resumed, 3..6);
        assert_eq!(again.weights().to_bytes(), model.weights().to_bytes());
        assert_eq!(
            resumed.state().unwrap().unwrap().to_bytes(),
            optimizer.state().unwrap().unwrap().to_bytes()
        );
    }

    /// A state that was sharded over some ranks goes on over others, and comes out as one that never was.
    #[test]
    fn ranks_that_share_the_state_move_every_number_as_one_does() {
        let settings = |shard| AdamWSettings {
            shard,
            ..AdamWSettings::default()
        };
        let model = || {
            let mut model = Linear::new(&Initialise::new(&Compute::cpu(), 1), 3, 2, true);
            model.start_training();
            model
        };
        let (mut expected, mut whole) = (model(), AdamW::new(settings(false), &model()));
        train(&mut expected, &mut whole, 0..3);
        let half = (
            expected.weights(),
            whole.state().unwrap().unwrap().to_bytes(),
        );
        train(&mut expected, &mut whole, 3..6);
        let on = |size: usize, from: Option<&(Weights, Vec<u8>)>, steps: std::ops::Range<u64>| {
            let work = |ranks: &Communicator| {
                let mut model = model();
                let mut optimizer = AdamW::new(settings(true), &model).shard(ranks, &model);
                assert_eq!(optimizer.is_sharded(), size > 1);
                if let Some((weights, state)) = from {
                    model.load(weights).unwrap();
                    let state = Weights::from_bytes(state).unwrap();
                    optimizer.restore(&state).unwrap();
                }
                let kept = optimizer.moments.values();
                let kept: usize = kept.map(|moments| moments.mean.dims()[0]).sum();
                assert!(
                    kept <= 8_usize.div_ceil(size),
                    "{kept} of 8 on {size} ranks"
                );
                train(&mut model, &mut optimizer, steps.clone());
                let state = optimizer.state().unwrap();
                (model.weights(), state.map(|state| state.to_bytes()))
            };
            let mut all = std::thread::scope(|scope| {
                let work = &work;
                let threads = Communicator::threads(size).into_iter();
                let threads: Vec<_> = threads
                    .map(|ranks| scope.spawn(move || work(&ranks)))
                    .collect();
                let ended = threads.into_iter().map(|thread| thread.join().unwrap());
                ended.collect::<Vec<_>>()
            });
            let (weights, state) = all.swap_remove(0);
            assert!(all.iter().all(|other| *other == (weights.clone(), None)));
            (weights, state.unwrap())
        };
        let last = (
            expected.weights(),
            whole.state().unwrap().unwrap().to_bytes(),
        );
        for size in 1..5 {
            let found = on(size, None, 0..3);
            assert!(found == half, "{size} ranks");
            let found = on(5 - size, Some(&found), 3..6);
            assert!(found == last, "{size} ranks, then others");
        }
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        let compute = Compute::cpu();
        let mut model = Linear::new(&Initialise::new(&compute, 1), 1, 1, false);
        model.start_training();
        let before = model.weights();
        let mut optimizer = AdamW::new(AdamWSettings::default(), &model);
        let nan = Tensor::<1>::from_floats([f32::NAN], compute.device());
        let gradients = Gradients::from_map([("weight".to_owned(), nan)].into());
        let error = optimizer.step(&mut model, gradients, 0.1).unwrap_err();
        assert!(error.to_string().contains("step 1 "), "{error}");
        assert_eq!((model.weights(), optimizer.steps()), (before, 0));
    }

    #[test]
    fn settings_out_of_their_range_are_named() {
        let wrong = |change: fn(&mut AdamWSettings)| {
            let mut settings = AdamWSettings::default();
            change(&mut settings);
            settings.wrong()
        };
        assert_eq!(wrong(|_| ()), None);
        assert_eq!(wrong(|s| s.betas[0] = 0.0), None);
        assert_eq!(wrong(|s| s.weight_decay = 0.0), None);
        assert_eq!(wrong(|s| s.clip_norm = None), None);
        for beta in [1.0, -0.1, f64::NAN] {
            let settings = AdamWSettings {
                betas: [0.9, beta],
                ..AdamWSettings::default()
            };
            assert_eq!(settings.wrong(), Some("betas"), "{beta}");
        }
        assert_eq!(wrong(|s| s.epsilon = 0.0), Some("epsilon"));
        assert_eq!(wrong(|s| s.epsilon = 1e-60), Some("epsilon"));
        assert_eq!(wrong(|s| s.weight_decay = -0.1), Some("weight_decay"));
        assert_eq!(wrong(|s| s.clip_norm = Some(-1.0)), Some("clip_norm"));
        assert_eq!(wrong(|s| s.clip_norm = Some(0.0)), Some("clip_norm"));
        assert_eq!(
            wrong(|s| s.clip_norm = Some(f64::INFINITY)),
            Some("clip_norm")
        );
    }

    #[test]
    fn norms_and_biases_do_not_decay() {
        for name in [
            "encoder.0.norm1.weight",
            "encoder_norm.weight",
            "a.norm_mlp.bias",
            "x.bias",
            "q.query_norm.weight",
        ] {
            assert!(!decays(name), "{name}");
        }
        for name in [
            "mask_token",
            "a.qkv.weight",
            "encoder_embeddings.tok_rgb.mod_emb",
        ] {
            assert!(decays(name), "{name}");
        }
    }
}
