//! **The loop**: encode what is known, decode what is open, decide some of it, repeat (Supp. C).

use super::filter::{Pick, pick};
use super::generated::{Checks, Generated, GeneratedTokens, StepTrace};
use super::model::{DecodingError, Sample, Slot, TargetPositions, TokenModel};
use super::plan::{Chain, Group, Target};
use super::settings::Scheme;
use rand::RngExt;
use rand::seq::index;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::rc::Rc;

/// What is known while a chain runs.
struct State<'a> {
    samples: Vec<Sample<'a>>,
    /// By (sample, modality).
    certainty: BTreeMap<(usize, usize), Vec<f32>>,
    /// Nothing was decided yet: the encoder reads the inputs alone.
    untouched: bool,
}

/// Generations of the same targets with different seeds.
pub(super) struct Samples<'m, M: TokenModel> {
    model: &'m M,
    seed: u64,
    /// The encoder's output for the inputs: the first step of every chain starts from it.
    given: Option<M::Context>,
    /// Decoder output of the first sample for the inputs alone: where all tokens are decided at once, every sample has the same
    /// target positions.
    answered: Vec<(TargetPositions, Rc<M::DecoderOutput>)>,
    keep: bool,
}

/// Logits held at a time, in numbers.
const LOGITS: usize = 1 << 22;

impl<'m, M: TokenModel> Samples<'m, M> {
    pub(super) fn new(model: &'m M, rounds: usize) -> Self {
        Self {
            model,
            seed: 0,
            given: None,
            answered: Vec::new(),
            keep: rounds > 1,
        }
    }

    /// The round of `seed`: all chains, one after the other.
    pub(super) fn next(
        &mut self,
        seed: u64,
        chains: &[Chain],
        samples: &[Sample<'_>],
        checks: &mut Checks<'_>,
    ) -> Result<Vec<Generated>, DecodingError> {
        self.seed = seed;
        let mut generated = vec![Generated::default(); samples.len()];
        for chain in chains {
            // Every chain starts from the inputs; what it decides is known to the rest of the chain only.
            let mut state = State {
                samples: samples.to_vec(),
                certainty: BTreeMap::new(),
                untouched: true,
            };
            for group in &chain.groups {
                for step in 0..group.steps() {
                    self.step(group, step, &mut state, checks)?;
                }
            }
            for target in chain.groups.iter().flat_map(|group| &group.targets) {
                let name = &self.model.modalities()[target.modality].name;
                for (position, (sample, generated)) in
                    state.samples.iter().zip(&mut generated).enumerate()
                {
                    let Slot::Tokens { ids, .. } = &sample.slots[target.modality] else {
                        continue;
                    };
                    let certainty = state
                        .certainty
                        .remove(&(position, target.modality))
                        .unwrap_or_else(|| vec![1.0; ids.len()]);
                    let tokens = GeneratedTokens {
                        ids: ids.clone(),
                        certainty,
                    };
                    generated.targets.insert(name.clone(), tokens);
                }
            }
        }
        self.keep = false;
        Ok(generated)
    }

    /// Decoder output for the inputs alone.
    fn output_for_inputs(
        &mut self,
        samples: &[Sample<'_>],
        target_positions: &TargetPositions,
        nothing_hidden: &[bool],
    ) -> Result<Rc<M::DecoderOutput>, DecodingError> {
        if let Some((_, decoder_output)) = self
            .answered
            .iter()
            .find(|(before, _)| before == target_positions)
        {
            return Ok(Rc::clone(decoder_output));
        }
        let context = match self.given.take() {
            Some(context) => context,
            None => self.model.encode(samples, nothing_hidden)?,
        };
        let decoder_output = Rc::new(self.model.decode(&context, target_positions)?);
        self.given = Some(context);
        if self.keep {
            self.answered
                .push((target_positions.clone(), Rc::clone(&decoder_output)));
        }
        Ok(decoder_output)
    }

    fn step(
        &mut self,
        group: &Group,
        step: usize,
        state: &mut State<'_>,
        checks: &mut Checks<'_>,
    ) -> Result<(), DecodingError> {
        let active: Vec<&Target> = group
            .targets
            .iter()
            .filter(|t| step < t.counts.len())
            .collect();
        let target_positions = match &group.pooled {
            Some(counts) => self.pooled_positions(&active, step, counts[step], state),
            None => self.target_positions(&active, step, state, checks),
        };
        let guided =
            active.iter().any(|t| t.settings.guidance != 1.0) && group.hidden.iter().any(|h| *h);

        let nothing_hidden = vec![false; group.hidden.len()];
        let conditional = if state.untouched {
            self.output_for_inputs(&state.samples, &target_positions, &nothing_hidden)?
        } else {
            let context = self.model.encode(&state.samples, &nothing_hidden)?;
            Rc::new(self.model.decode(&context, &target_positions)?)
        };
        let unconditional = if guided {
            let context = self.model.encode(&state.samples, &group.hidden)?;
            Some(self.model.decode(&context, &target_positions)?)
        } else {
            None
        };
        for target in active {
            let guide = unconditional
                .as_ref()
                .filter(|_| target.settings.guidance != 1.0);
            self.decide(
                target,
                step,
                &target_positions,
                &conditional,
                guide,
                state,
                checks,
            )?;
        }
        state.untouched = false;
        Ok(())
    }

    /// `count` random positions of each sample, of all masked ones of the targets together.
    fn pooled_positions(
        &self,
        active: &[&Target],
        step: usize,
        count: usize,
        state: &State<'_>,
    ) -> TargetPositions {
        let choose = |sample: &Sample<'_>| {
            let pool: Vec<(usize, u32)> = active
                .iter()
                .flat_map(|target| {
                    let masked = sample.slots[target.modality].masked_positions();
                    masked.into_iter().map(|p| (target.modality, p))
                })
                .collect();
            let mut rng = crate::random::stream(
                self.seed,
                "decoding.positions.pooled",
                step as u64,
                sample.id,
            );
            let mut positions = vec![Vec::new(); self.model.modalities().len()];
            for i in index::sample(&mut rng, pool.len(), count.min(pool.len())) {
                let (modality, position) = pool[i];
                positions[modality].push(position);
            }
            for own in &mut positions {
                own.sort_unstable();
            }
            positions
        };
        state.samples.iter().map(choose).collect()
    }

    fn target_positions(
        &self,
        active: &[&Target],
        step: usize,
        state: &State<'_>,
        checks: &Checks<'_>,
    ) -> TargetPositions {
        let modalities = self.model.modalities();
        let mut target_positions = vec![vec![Vec::new(); modalities.len()]; state.samples.len()];
        for target in active {
            let m = target.modality;
            for (sample, target_positions) in state.samples.iter().zip(&mut target_positions) {
                let open = sample.slots[m].masked_positions();
                target_positions[m] =
                    match (target.settings.scheme, checks.positions.get(&(m, step))) {
                        (Scheme::Maskgit, _) => open,
                        (Scheme::Roar, Some(positions)) => positions.clone(),
                        (Scheme::Roar, None) => {
                            let stream = format!("decoding.positions.{}", modalities[m].name);
                            let mut rng =
                                crate::random::stream(self.seed, &stream, step as u64, sample.id);
                            let count = target.counts[step].min(open.len());
                            let mut chosen: Vec<u32> = index::sample(&mut rng, open.len(), count)
                                .iter()
                                .map(|i| open[i])
                                .collect();
                            chosen.sort_unstable();
                            chosen
                        }
                    };
            }
        }
        target_positions
    }

    fn decide(
        &self,
        target: &Target,
        step: usize,
        target_positions: &TargetPositions,
        conditional: &M::DecoderOutput,
        unconditional: Option<&M::DecoderOutput>,
        state: &mut State<'_>,
        checks: &mut Checks<'_>,
    ) -> Result<(), DecodingError> {
        let m = target.modality;
        let modality = &self.model.modalities()[m];
        let vocabulary = modality.vocabulary.unwrap_or(1).max(1);
        let rows: usize = target_positions.iter().map(|sample| sample[m].len()).sum();
        let stream = format!("decoding.draw.{}", modality.name);
        let uniforms: Vec<f64> = state
            .samples
            .iter()
            .zip(target_positions)
            .flat_map(|(sample, target_positions)| {
                let mut rng = crate::random::stream(self.seed, &stream, step as u64, sample.id);
                (0..target_positions[m].len()).map(move |_| rng.random::<f64>())
            })
            .collect();
        let filter = target.settings.filter(target.temperatures[step]);
        let guidance = target.settings.guidance as f32;
        let mut trace = checks.trace.is_some().then(|| StepTrace {
            modality: m,
            step,
            positions: target_positions
                .iter()
                .map(|sample| sample[m].clone())
                .collect(),
            conditional: Vec::new(),
            unconditional: Vec::new(),
            combined: Vec::new(),
            picks: Vec::new(),
            selected: Vec::new(),
        });

        let mut picks: Vec<Pick> = Vec::with_capacity(rows);
        let chunk = (LOGITS / vocabulary).max(1);
        for start in (0..rows).step_by(chunk) {
            let range = start..(start + chunk).min(rows);
            let mut logits = self.model.logits(conditional, m, range.clone())?;
            if let Some(trace) = &mut trace {
                trace.conditional.extend_from_slice(&logits);
            }
            if let Some(decoder_output) = unconditional {
                let without = self.model.logits(decoder_output, m, range.clone())?;
                for (with, without) in logits.iter_mut().zip(&without) {
                    *with = without + guidance * (*with - without);
                }
                if let Some(trace) = &mut trace {
                    trace.unconditional.extend_from_slice(&without);
                }
            }
            // Infinite ones too: the largest logit is subtracted before `exp`, and what is left of the others is nothing or NaN.
            if logits.iter().any(|l| !l.is_finite()) {
                return Err(DecodingError::NotFinite {
                    name: modality.name.clone(),
                });
            }
            let chosen: Vec<Pick> = logits
                .par_chunks(vocabulary)
                .zip(&uniforms[range])
                .map(|(logits, uniform)| pick(logits, &filter, *uniform))
                .collect();
            picks.extend(chosen);
            if let Some(trace) = &mut trace {
                trace.combined.extend_from_slice(&logits);
            }
        }

        let mut first = 0;
        for (position, (sample, target_positions)) in
            state.samples.iter_mut().zip(target_positions).enumerate()
        {
            let own = &picks[first..first + target_positions[m].len()];
            first += target_positions[m].len();
            let chosen = match target.settings.scheme {
                Scheme::Roar => (0..own.len()).collect(),
                Scheme::Maskgit => surest(own, &target_positions[m], target.counts[step]),
            };
            let Slot::Tokens { ids, known } = &mut sample.slots[m] else {
                continue;
            };
            let certainty = state
                .certainty
                .entry((position, m))
                .or_insert_with(|| vec![1.0; ids.len()]);
            let mut selected: Vec<u32> = Vec::with_capacity(chosen.len());
            for row in chosen {
                let place = target_positions[m][row] as usize;
                ids[place] = own[row].token;
                known[place] = true;
                certainty[place] = own[row].certainty;
                selected.push(place as u32);
            }
            selected.sort_unstable();
            if let Some(trace) = &mut trace {
                trace.selected.push(selected);
            }
        }
        if let (Some(all), Some(mut trace)) = (&mut checks.trace, trace) {
            trace.picks = picks;
            all.push(trace);
        }
        Ok(())
    }
}

/// The rows of the `count` surest picks. Saturated probabilities tie often: then the probability at temperature 1 decides, then
/// the position.
fn surest(picks: &[Pick], positions: &[u32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..picks.len()).collect();
    order.sort_by(|&a, &b| {
        let (x, y) = (&picks[a], &picks[b]);
        y.probability
            .total_cmp(&x.probability)
            .then(y.plain_probability.total_cmp(&x.plain_probability))
            .then(positions[a].cmp(&positions[b]))
    });
    order.truncate(count);
    order
}
