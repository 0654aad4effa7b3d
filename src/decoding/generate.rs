//! Any tokens to any others: what goes in, what comes out, and how often the loop runs (Supp. C).

use super::generated::{Checks, Generated};
use super::model::{DecodingError, Sample, Slot, TokenModel};
use super::plan::plan;
use super::round::Samples;
use super::settings::DecodingSettings;

/// Generates `targets` of a batch of samples from whatever is known of them: any modalities to any others.
///
/// All samples of a batch know the same number of tokens per target. Random numbers belong to (seed, modality, step, sample id),
/// so neither the batch nor the number of threads changes a token.
///
/// # Errors
/// When a name is unknown, samples do not fit the model or each other, or the model answers with a value that is not finite.
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

/// [`generate`] once per seed. The encoder output for the inputs, and the decoder output for target positions that come again, are shared.
///
/// # Errors
/// As [`generate`].
pub fn generate_samples<M: TokenModel>(
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
        .map(|m| samples.iter().any(|s| s.slots[m].is_known()))
        .collect();
    let open: Vec<usize> = first
        .slots
        .iter()
        .map(|slot| slot.masked_positions().len())
        .collect();
    let chains = plan(settings, model.modalities(), &given, &open, targets)?;
    let mut rounds = Samples::new(model, seeds.len());
    seeds
        .iter()
        .map(|&seed| rounds.next(seed, &chains, samples, checks))
        .collect()
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
            let (a, b) = (
                samples[0].slots[m].masked_positions().len(),
                slot.masked_positions().len(),
            );
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

#[cfg(test)]
mod tests {
    use super::super::model::{TargetPositions, TokenModality};
    use super::super::settings::{Order, Scheme, TargetSettings};
    use super::*;
    use rand::RngExt;
    use std::cell::Cell;
    use std::collections::BTreeMap;
    use std::ops::Range;

    /// Its output depends on which tokens are visible and on nothing else; counts its encoder passes.
    struct Toy {
        modalities: Vec<TokenModality>,
        encoded: Cell<usize>,
        /// What stands in the place of every logit of token 2.
        broken: Option<f32>,
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
            broken: None,
        }
    }

    /// Per sample: a number that stands for everything visible.
    type ToyContext = Vec<u64>;

    impl TokenModel for Toy {
        type Context = ToyContext;
        type DecoderOutput = (ToyContext, TargetPositions);

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
            target_positions: &TargetPositions,
        ) -> Result<Self::DecoderOutput, DecodingError> {
            Ok((context.clone(), target_positions.clone()))
        }

        fn logits(
            &self,
            decoder_output: &Self::DecoderOutput,
            m: usize,
            rows: Range<usize>,
        ) -> Result<Vec<f32>, DecodingError> {
            let vocabulary = self.modalities[m].vocabulary.unwrap();
            let all: Vec<(u64, u32)> = decoder_output
                .0
                .iter()
                .zip(&decoder_output.1)
                .flat_map(|(&context, target_positions)| {
                    target_positions[m].iter().map(move |&p| (context, p))
                })
                .collect();
            Ok(all[rows]
                .iter()
                .flat_map(|&(context, p)| {
                    let mut rng = crate::random::stream(context, "toy", m as u64, u64::from(p));
                    (0..vocabulary).map(move |token| {
                        let logit = 6.0 * rng.random::<f32>();
                        self.broken.filter(|_| token == 2).unwrap_or(logit)
                    })
                })
                .collect())
        }
    }

    fn sample(id: u64) -> Sample<'static> {
        let rgb = (0..8).map(|p| (id as u32 + p) % 16).collect();
        Sample {
            id,
            slots: vec![Slot::input(rgb), Slot::masked(12), Slot::masked(21)],
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
        for order in [
            Order::Independent,
            Order::Chained,
            Order::Joint,
            Order::Pooled,
        ] {
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
    fn logits_that_are_not_finite_are_refused_by_the_name_of_their_modality() {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let toy = Toy {
                broken: Some(value),
                ..toy()
            };
            for guidance in [1.0, 2.0] {
                let mut settings = settings(Order::Independent, Scheme::Maskgit);
                settings.all.guidance = guidance;
                let error = generate(&toy, &settings, &[sample(1)], &["body"], 5).unwrap_err();
                let message = error.to_string();
                assert!(
                    message.contains("`body`") && message.contains("not finite"),
                    "{message}"
                );
            }
        }
    }

    #[test]
    fn a_pool_decides_an_equal_share_of_all_targets_together_in_every_step() {
        let mut settings = settings(Order::Pooled, Scheme::Roar);
        settings.all.steps = 3;
        let mut trace = Vec::new();
        let mut checks = Checks {
            positions: BTreeMap::new(),
            trace: Some(&mut trace),
        };
        let names = ["camera", "body"];
        let samples = [sample(1), sample(2)];
        generate_checked(&toy(), &settings, &samples, &names, 5, &mut checks).unwrap();
        let masked: usize = names
            .iter()
            .map(|name| {
                toy()
                    .modalities()
                    .iter()
                    .find(|m| m.name == *name)
                    .unwrap()
                    .tokens
            })
            .sum();
        let counts = super::super::schedule::linear(3, masked);
        for sample in 0..samples.len() {
            for (step, count) in counts.iter().enumerate() {
                let of_step = trace.iter().filter(|t| t.step == step);
                let decided: usize = of_step.map(|t| t.selected[sample].len()).sum();
                assert_eq!(decided, *count);
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
        // Two targets of three steps, with and without conditions; what the inputs give is shared.
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
        assert_eq!((tokens.ids[4], tokens.certainty[4]), (19, 1.0));
        assert!(tokens.certainty.iter().all(|c| (0.0..=1.0).contains(c)));
        let empty = Sample {
            id: 0,
            slots: vec![Slot::masked(8), Slot::masked(12), Slot::masked(21)],
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
        partly.slots[1] = Slot::input(vec![0; 12]);
        assert!(matches!(
            run(&[sample(0), partly]),
            Err(DecodingError::Uneven { a: 12, b: 0, .. })
        ));
        let mut short = sample(1);
        short.slots[1] = Slot::masked(11);
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
        let rounds = generate_samples(&several, &settings, &samples, &targets, &[5, 6, 7]).unwrap();
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
