//! The loop: encode what is known, decode what is open, decide some of it, repeat (Supp. C).

use super::filter::{Pick, pick};
use super::model::{Asked, DecodingError, Sample, Slot, TokenModel};
use super::plan::{Chain, Group, Target, plan};
use super::settings::{DecodingSettings, Scheme};
use rand::RngExt;
use rand::seq::index;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::rc::Rc;

/// Generated tokens of one sample.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Generated {
    /// By modality.
    pub targets: BTreeMap<String, GeneratedTokens>,
}

/// Tokens of one target.
#[derive(Debug, Clone, PartialEq)]
pub struct GeneratedTokens {
    /// One per position; tokens that were given stand unchanged.
    pub ids: Vec<u32>,
    /// 0 (the model knew nothing) to 1 (it was certain), from the entropy when the token was decided; 1 for given tokens.
    pub confidence: Vec<f32>,
}

/// What a step saw and did, for checks against a reference.
#[derive(Debug, Clone, PartialEq)]
pub struct StepTrace {
    pub modality: usize,
    pub step: usize,
    /// The asked positions of each sample.
    pub positions: Vec<Vec<u32>>,
    /// `[rows, vocabulary]`.
    pub conditional: Vec<f32>,
    /// Empty without guidance.
    pub unconditional: Vec<f32>,
    /// What was sampled from.
    pub combined: Vec<f32>,
    pub picks: Vec<Pick>,
    /// The decided positions of each sample, ascending.
    pub selected: Vec<Vec<u32>>,
}

/// Things that only checks need.
#[derive(Debug, Default)]
pub struct Checks<'a> {
    /// Random positions to take instead of our own, by (modality, step).
    pub positions: BTreeMap<(usize, usize), Vec<u32>>,
    /// Collects every step.
    pub trace: Option<&'a mut Vec<StepTrace>>,
}

/// Generates `targets` of a batch of samples from whatever is known of them: any modalities to any others.
///
/// All samples of a batch know the same number of tokens per target. Random numbers belong to (seed, modality, step, sample id),
/// so neither the batch nor the number of threads changes a token.
///
/// # Errors
/// When a name is unknown, samples do not fit the model or each other, or the model answers with NaN.
pub fn generate<M: TokenModel>(
    model: &M,
    settings: &DecodingSettings,
    samples: &[Sample<'_>],
    targets: &[&str],
    seed: u64,
) -> Result<Vec<Generated>, DecodingError> {
    let mut checks = Checks::default();
    generate_checked(model, settings, samples, targets, seed, &mut checks)
}

/// [`generate`] once per seed. What the encoder makes of the given tokens, and answers that are asked for again, are shared.
///
/// # Errors
/// As [`generate`].
pub fn generate_rounds<M: TokenModel>(
    model: &M,
    settings: &DecodingSettings,
    samples: &[Sample<'_>],
    targets: &[&str],
    seeds: &[u64],
) -> Result<Vec<Vec<Generated>>, DecodingError> {
    let mut checks = Checks::default();
    rounds(model, settings, samples, targets, seeds, &mut checks)
}

/// [`generate`] under observation.
///
/// # Errors
/// As [`generate`].
pub fn generate_checked<M: TokenModel>(
    model: &M,
    settings: &DecodingSettings,
    samples: &[Sample<'_>],
    targets: &[&str],
    seed: u64,
    checks: &mut Checks<'_>,
) -> Result<Vec<Generated>, DecodingError> {
    let mut generated = rounds(model, settings, samples, targets, &[seed], checks)?;
    Ok(generated.pop().unwrap_or_default())
}

fn rounds<M: TokenModel>(
    model: &M,
    settings: &DecodingSettings,
    samples: &[Sample<'_>],
    targets: &[&str],
    seeds: &[u64],
    checks: &mut Checks<'_>,
) -> Result<Vec<Vec<Generated>>, DecodingError> {
    let Some(first) = samples.first() else {
        return Ok(vec![Vec::new(); seeds.len()]);
    };
    check_samples(model, samples, targets)?;
    let given: Vec<bool> = (0..first.slots.len())
        .map(|m| samples.iter().any(|s| s.slots[m].is_given()))
        .collect();
    let open: Vec<usize> = first.slots.iter().map(|slot| slot.open().len()).collect();
    let chains = plan(settings, model.modalities(), &given, &open, targets)?;
    let mut run = Run {
        model,
        seed: 0,
        given: None,
        answered: Vec::new(),
        keep: seeds.len() > 1,
    };
    let mut all = Vec::with_capacity(seeds.len());
    for &seed in seeds {
        run.seed = seed;
        all.push(run.round(&chains, samples, checks)?);
        run.keep = false;
    }
    Ok(all)
}

fn check_samples<M: TokenModel>(
    model: &M,
    samples: &[Sample<'_>],
    targets: &[&str],
) -> Result<(), DecodingError> {
    let modalities = model.modalities();
    for (sample, state) in samples.iter().enumerate() {
        if state.slots.len() != modalities.len() {
            return Err(DecodingError::Slots {
                sample,
                found: state.slots.len(),
                expected: modalities.len(),
            });
        }
        for (m, (slot, modality)) in state.slots.iter().zip(modalities).enumerate() {
            if let Slot::Tokens { ids, known } = slot
                && (ids.len() != modality.tokens || known.len() != modality.tokens)
            {
                return Err(DecodingError::Length {
                    sample,
                    name: modality.name.clone(),
                    found: ids.len(),
                    expected: modality.tokens,
                });
            }
            let (a, b) = (samples[0].slots[m].open().len(), slot.open().len());
            if a != b && targets.contains(&modality.name.as_str()) {
                return Err(DecodingError::Uneven {
                    name: modality.name.clone(),
                    a,
                    b,
                });
            }
        }
    }
    Ok(())
}

/// What is known while a chain runs.
struct State<'a> {
    samples: Vec<Sample<'a>>,
    /// By (sample, modality).
    confidence: BTreeMap<(usize, usize), Vec<f32>>,
    /// Nothing was decided yet: the encoder sees exactly what was given.
    untouched: bool,
}

struct Run<'m, M: TokenModel> {
    model: &'m M,
    seed: u64,
    /// The encoder's view of what was given: the first step of every chain starts from it.
    given: Option<M::Context>,
    /// Answers of the first round to questions about what was given: where all tokens are decided at once, every round has the
    /// same questions.
    answered: Vec<(Asked, Rc<M::Answers>)>,
    keep: bool,
}

/// Logits held at a time, in numbers.
const LOGITS: usize = 1 << 22;

impl<M: TokenModel> Run<'_, M> {
    fn round(
        &mut self,
        chains: &[Chain],
        samples: &[Sample<'_>],
        checks: &mut Checks<'_>,
    ) -> Result<Vec<Generated>, DecodingError> {
        let mut generated = vec![Generated::default(); samples.len()];
        for chain in chains {
            // Every chain starts from what was given; what it decides is known to the rest of the chain only.
            let mut state = State {
                samples: samples.to_vec(),
                confidence: BTreeMap::new(),
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
                    let confidence = state
                        .confidence
                        .remove(&(position, target.modality))
                        .unwrap_or_else(|| vec![1.0; ids.len()]);
                    let tokens = GeneratedTokens {
                        ids: ids.clone(),
                        confidence,
                    };
                    generated.targets.insert(name.clone(), tokens);
                }
            }
        }
        Ok(generated)
    }

    /// Answers from what was given alone.
    fn answers_to_given(
        &mut self,
        samples: &[Sample<'_>],
        asked: &Asked,
        nothing_hidden: &[bool],
    ) -> Result<Rc<M::Answers>, DecodingError> {
        if let Some((_, answers)) = self.answered.iter().find(|(before, _)| before == asked) {
            return Ok(Rc::clone(answers));
        }
        let context = match self.given.take() {
            Some(context) => context,
            None => self.model.encode(samples, nothing_hidden)?,
        };
        let answers = Rc::new(self.model.decode(&context, asked)?);
        self.given = Some(context);
        if self.keep {
            self.answered.push((asked.clone(), Rc::clone(&answers)));
        }
        Ok(answers)
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
        let asked = self.asked(&active, step, state, checks);
        let guided =
            active.iter().any(|t| t.settings.guidance != 1.0) && group.hidden.iter().any(|h| *h);

        let nothing_hidden = vec![false; group.hidden.len()];
        let conditional = if state.untouched {
            self.answers_to_given(&state.samples, &asked, &nothing_hidden)?
        } else {
            let context = self.model.encode(&state.samples, &nothing_hidden)?;
            Rc::new(self.model.decode(&context, &asked)?)
        };
        let unconditional = if guided {
            let context = self.model.encode(&state.samples, &group.hidden)?;
            Some(self.model.decode(&context, &asked)?)
        } else {
            None
        };
        for target in active {
            let guide = unconditional
                .as_ref()
                .filter(|_| target.settings.guidance != 1.0);
            self.decide(target, step, &asked, &conditional, guide, state, checks)?;
        }
        state.untouched = false;
        Ok(())
    }

    fn asked(
        &self,
        active: &[&Target],
        step: usize,
        state: &State<'_>,
        checks: &Checks<'_>,
    ) -> Asked {
        let modalities = self.model.modalities();
        let mut asked = vec![vec![Vec::new(); modalities.len()]; state.samples.len()];
        for target in active {
            let m = target.modality;
            for (sample, asked) in state.samples.iter().zip(&mut asked) {
                let open = sample.slots[m].open();
                asked[m] = match (target.settings.scheme, checks.positions.get(&(m, step))) {
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
        asked
    }

    fn decide(
        &self,
        target: &Target,
        step: usize,
        asked: &Asked,
        conditional: &M::Answers,
        unconditional: Option<&M::Answers>,
        state: &mut State<'_>,
        checks: &mut Checks<'_>,
    ) -> Result<(), DecodingError> {
        let m = target.modality;
        let modality = &self.model.modalities()[m];
        let vocabulary = modality.vocabulary.unwrap_or(1).max(1);
        let rows: usize = asked.iter().map(|sample| sample[m].len()).sum();
        let stream = format!("decoding.draw.{}", modality.name);
        let uniforms: Vec<f64> = state
            .samples
            .iter()
            .zip(asked)
            .flat_map(|(sample, asked)| {
                let mut rng = crate::random::stream(self.seed, &stream, step as u64, sample.id);
                (0..asked[m].len()).map(move |_| rng.random::<f64>())
            })
            .collect();
        let filter = target.settings.filter(target.temperatures[step]);
        let guidance = target.settings.guidance as f32;
        let mut trace = checks.trace.is_some().then(|| StepTrace {
            modality: m,
            step,
            positions: asked.iter().map(|sample| sample[m].clone()).collect(),
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
            if let Some(answers) = unconditional {
                let without = self.model.logits(answers, m, range.clone())?;
                for (with, without) in logits.iter_mut().zip(&without) {
                    *with = without + guidance * (*with - without);
                }
                if let Some(trace) = &mut trace {
                    trace.unconditional.extend_from_slice(&without);
                }
            }
            if logits.iter().any(|l| l.is_nan()) {
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
        for (position, (sample, asked)) in state.samples.iter_mut().zip(asked).enumerate() {
            let own = &picks[first..first + asked[m].len()];
            first += asked[m].len();
            let chosen = match target.settings.scheme {
                Scheme::Roar => (0..own.len()).collect(),
                Scheme::Maskgit => surest(own, &asked[m], target.counts[step]),
            };
            let Slot::Tokens { ids, known } = &mut sample.slots[m] else {
                continue;
            };
            let confidence = state
                .confidence
                .entry((position, m))
                .or_insert_with(|| vec![1.0; ids.len()]);
            let mut selected: Vec<u32> = Vec::with_capacity(chosen.len());
            for row in chosen {
                let place = asked[m][row] as usize;
                ids[place] = own[row].token;
                known[place] = true;
                confidence[place] = own[row].certainty;
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

/// The rows of the `count` surest picks. Saturated confidences tie often: then the probability at temperature 1 decides, then
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

#[cfg(test)]
mod tests {
    use super::super::model::TokenModality;
    use super::super::settings::{Order, TargetSettings};
    use super::*;
    use std::cell::Cell;
    use std::ops::Range;

    /// Answers depend on which tokens are visible and on nothing else; counts its encoder passes.
    struct Toy {
        modalities: Vec<TokenModality>,
        encoded: Cell<usize>,
    }

    fn toy() -> Toy {
        let modality = |name: &str, tokens, vocabulary| TokenModality {
            name: name.to_owned(),
            tokens,
            vocabulary: Some(vocabulary),
        };
        Toy {
            modalities: vec![
                modality("rgb", 8, 16),
                modality("camera", 12, 20),
                modality("body", 21, 33),
            ],
            encoded: Cell::new(0),
        }
    }

    /// Per sample: a number that stands for everything visible.
    type ToyContext = Vec<u64>;

    impl TokenModel for Toy {
        type Context = ToyContext;
        type Answers = (ToyContext, Asked);

        fn modalities(&self) -> &[TokenModality] {
            &self.modalities
        }

        fn encode(
            &self,
            samples: &[Sample<'_>],
            hidden: &[bool],
        ) -> Result<ToyContext, DecodingError> {
            self.encoded.set(self.encoded.get() + 1);
            Ok(samples
                .iter()
                .map(|sample| {
                    let mut sum = 7_u64;
                    for (m, slot) in sample.slots.iter().enumerate().filter(|(m, _)| !hidden[*m]) {
                        if let Slot::Tokens { ids, known } = slot {
                            for p in (0..ids.len()).filter(|&p| known[p]) {
                                sum = sum.wrapping_add(
                                    (m as u64 + 3) * (p as u64 + 5) * (u64::from(ids[p]) + 11),
                                );
                            }
                        }
                    }
                    sum
                })
                .collect())
        }

        fn decode(
            &self,
            context: &ToyContext,
            asked: &Asked,
        ) -> Result<Self::Answers, DecodingError> {
            Ok((context.clone(), asked.clone()))
        }

        fn logits(
            &self,
            answers: &Self::Answers,
            m: usize,
            rows: Range<usize>,
        ) -> Result<Vec<f32>, DecodingError> {
            let vocabulary = self.modalities[m].vocabulary.unwrap();
            let all: Vec<(u64, u32)> = answers
                .0
                .iter()
                .zip(&answers.1)
                .flat_map(|(&context, asked)| asked[m].iter().map(move |&p| (context, p)))
                .collect();
            Ok(all[rows]
                .iter()
                .flat_map(|&(context, p)| {
                    let mut rng = crate::random::stream(context, "toy", m as u64, u64::from(p));
                    (0..vocabulary).map(move |_| 6.0 * rng.random::<f32>())
                })
                .collect())
        }
    }

    fn sample(id: u64) -> Sample<'static> {
        let rgb = (0..8).map(|p| (id as u32 + p) % 16).collect();
        Sample {
            id,
            slots: vec![Slot::given(rgb), Slot::unknown(12), Slot::unknown(21)],
        }
    }

    fn settings(order: Order, scheme: Scheme) -> DecodingSettings {
        DecodingSettings {
            order,
            all: TargetSettings {
                scheme,
                temperature: 1.0,
                ..TargetSettings::default()
            },
            ..DecodingSettings::default()
        }
    }

    fn ids(generated: &[Generated], name: &str) -> Vec<Vec<u32>> {
        generated
            .iter()
            .map(|g| g.targets[name].ids.clone())
            .collect()
    }

    #[test]
    fn neither_the_batch_nor_the_threads_change_a_token() {
        for order in [Order::Independent, Order::Chained, Order::Joint] {
            for scheme in [Scheme::Roar, Scheme::Maskgit] {
                let settings = settings(order, scheme);
                let run = |samples: &[Sample<'_>]| {
                    generate(&toy(), &settings, samples, &["camera", "body"], 5).unwrap()
                };
                let both = run(&[sample(1), sample(2)]);
                assert_eq!(both[1], run(&[sample(2)])[0]);
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads(1)
                    .build()
                    .unwrap();
                assert_eq!(both, pool.install(|| run(&[sample(1), sample(2)])));
                let other = generate(&toy(), &settings, &[sample(1)], &["camera"], 6).unwrap();
                assert_ne!(
                    ids(&other, "camera")[0],
                    ids(&both, "camera")[0],
                    "another seed"
                );
            }
        }
    }

    #[test]
    fn independent_targets_do_not_see_each_other_and_chained_ones_do() {
        let run = |order, targets: &[&str]| {
            let mut settings = settings(order, Scheme::Roar);
            settings.all.temperature = 0.0;
            settings.all.steps = 1;
            settings.all.guidance = 1.0;
            generate(&toy(), &settings, &[sample(3)], targets, 0).unwrap()
        };
        let alone = ids(&run(Order::Independent, &["body"]), "body");
        assert_eq!(
            alone,
            ids(&run(Order::Independent, &["camera", "body"]), "body")
        );
        assert_eq!(
            alone,
            ids(&run(Order::Joint, &["camera", "body"]), "body"),
            "one step decides both at once"
        );
        assert_ne!(
            alone,
            ids(&run(Order::Chained, &["camera", "body"]), "body")
        );
    }

    #[test]
    fn what_was_given_is_read_once_for_all_independent_targets() {
        let model = toy();
        let mut one_step = settings(Order::Independent, Scheme::Roar);
        (one_step.all.steps, one_step.all.guidance) = (1, 1.0);
        generate(&model, &one_step, &[sample(1)], &["camera", "body"], 0).unwrap();
        assert_eq!(model.encoded.get(), 1);
        model.encoded.set(0);
        let guided = settings(Order::Independent, Scheme::Roar);
        generate(&model, &guided, &[sample(1)], &["camera", "body"], 0).unwrap();
        // Two targets of three steps, with and without conditions; what was given is shared.
        assert_eq!(model.encoded.get(), 11);
    }

    #[test]
    fn known_tokens_stay_and_nothing_given_is_enough() {
        let mut partly = sample(1);
        let Slot::Tokens { ids: given, known } = &mut partly.slots[1] else {
            panic!("tokens")
        };
        (given[4], known[4]) = (19, true);
        let settings = settings(Order::Independent, Scheme::Maskgit);
        let generated = generate(&toy(), &settings, &[partly], &["camera"], 0).unwrap();
        let tokens = &generated[0].targets["camera"];
        assert_eq!((tokens.ids[4], tokens.confidence[4]), (19, 1.0));
        assert!(tokens.confidence.iter().all(|c| (0.0..=1.0).contains(c)));
        let empty = Sample {
            id: 0,
            slots: vec![Slot::unknown(8), Slot::unknown(12), Slot::unknown(21)],
        };
        let generated =
            generate(&toy(), &settings, &[empty], &["rgb", "body", "camera"], 0).unwrap();
        assert_eq!(generated[0].targets.len(), 3);
    }

    #[test]
    fn guidance_moves_away_from_what_the_blind_pass_says() {
        let run = |guidance: f64| {
            let mut settings = settings(Order::Independent, Scheme::Roar);
            (settings.all.steps, settings.all.guidance) = (1, guidance);
            let mut trace = Vec::new();
            let mut checks = Checks {
                trace: Some(&mut trace),
                ..Checks::default()
            };
            generate_checked(&toy(), &settings, &[sample(1)], &["camera"], 0, &mut checks).unwrap();
            trace.remove(0)
        };
        let trace = run(3.0);
        for ((all, with), without) in trace
            .combined
            .iter()
            .zip(&trace.conditional)
            .zip(&trace.unconditional)
        {
            assert!((all - (without + 3.0 * (with - without))).abs() < 1e-4);
        }
        assert!(
            run(1.0).unconditional.is_empty(),
            "no second pass at scale 1"
        );
    }

    #[test]
    fn samples_that_do_not_fit_are_refused() {
        let run = |samples: &[Sample<'_>]| {
            generate(
                &toy(),
                &DecodingSettings::default(),
                samples,
                &["camera"],
                0,
            )
        };
        let mut partly = sample(1);
        partly.slots[1] = Slot::given(vec![0; 12]);
        assert!(matches!(
            run(&[sample(0), partly]),
            Err(DecodingError::Uneven { a: 12, b: 0, .. })
        ));
        let mut short = sample(1);
        short.slots[1] = Slot::unknown(11);
        assert!(matches!(
            run(&[short]),
            Err(DecodingError::Length { found: 11, .. })
        ));
        assert!(run(&[]).unwrap().is_empty());
    }

    #[test]
    fn rounds_are_what_single_generations_are_and_share_the_encoder() {
        let settings = DecodingSettings {
            order: Order::Joint,
            all: TargetSettings {
                steps: 1,
                guidance: 1.0,
                temperature: 1.0,
                ..TargetSettings::default()
            },
            ..DecodingSettings::default()
        };
        let (single, several) = (toy(), toy());
        let samples = [sample(3)];
        let targets = ["camera", "body"];
        let rounds = generate_rounds(&several, &settings, &samples, &targets, &[5, 6, 7]).unwrap();
        for (seed, round) in [5, 6, 7].into_iter().zip(&rounds) {
            assert_eq!(
                *round,
                generate(&single, &settings, &samples, &targets, seed).unwrap()
            );
        }
        assert_ne!(rounds[0], rounds[1]);
        assert_eq!((single.encoded.get(), several.encoded.get()), (3, 1));
    }
}
