//! The draw for one sample: budgets per modality, then positions (Sec. 4.3, Alg. 1).

use super::budget;
use super::settings::Resolved;
use super::{Mask, MaskingError, MaskingSettings, Policy, Slot, TokenBudget};
use crate::random::StreamRng;
use rand::RngExt;
use std::collections::BTreeMap;

/// A masking policy bound to the modalities of a model.
#[derive(Debug, Clone)]
pub struct Masking {
    settings: MaskingSettings,
    resolved: Resolved,
    slots: Vec<Slot>,
}

/// The token counts of one sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budgets {
    /// The mixture component that was drawn.
    pub component: usize,
    /// `[slots]`.
    pub input: Vec<usize>,
    /// `[slots]`.
    pub target: Vec<usize>,
}

impl Masking {
    /// Binds `settings` to `slots`.
    ///
    /// # Errors
    /// When they do not fit; see [`MaskingError`].
    pub fn new(settings: &MaskingSettings, slots: &[Slot]) -> Result<Self, MaskingError> {
        Ok(Self {
            resolved: settings.resolve(slots)?,
            settings: settings.clone(),
            slots: slots.to_vec(),
        })
    }

    /// The modalities, in the order of [`Mask::input`].
    #[must_use]
    pub fn slots(&self) -> &[Slot] {
        &self.slots
    }

    /// The settings it was built from.
    #[must_use]
    pub fn settings(&self) -> &MaskingSettings {
        &self.settings
    }

    /// How many mixture components there are.
    #[must_use]
    pub fn components(&self) -> usize {
        self.resolved.cumulative.len()
    }

    /// The largest number of tokens a sample can bring, visible and target.
    #[must_use]
    pub fn nominal_tokens(&self) -> (usize, usize) {
        (
            self.settings.input_tokens.bounds().1,
            self.settings.target_tokens.bounds().1,
        )
    }

    /// Masks of one sample; `present[slot]` says which modalities this sample has (valid ones).
    #[must_use]
    pub fn draw(&self, present: &[bool], rng: &mut StreamRng) -> Mask {
        match self.settings.policy {
            Policy::Dirichlet => {
                let budgets = self.budgets(present, rng);
                self.positions(&budgets, rng)
            }
            Policy::Uniform => self.pooled(present, rng),
        }
    }

    /// Token counts of one sample under a Dirichlet policy.
    #[must_use]
    pub fn budgets(&self, present: &[bool], rng: &mut StreamRng) -> Budgets {
        let component = self.component(rng);
        self.budgets_of(component, present, rng)
    }

    /// Token counts of one sample under one mixture component.
    pub(super) fn budgets_of(
        &self,
        component: usize,
        present: &[bool],
        rng: &mut StreamRng,
    ) -> Budgets {
        let only_present = |alphas: &[f64]| -> Vec<f64> {
            alphas
                .iter()
                .zip(present)
                .map(|(alpha, present)| if *present { *alpha } else { 0.0 })
                .collect()
        };
        let settings = &self.settings;
        let input_alphas = only_present(&self.resolved.input[component]);
        let target_alphas = only_present(&self.resolved.target[component]);
        let tokens: Vec<usize> = self.slots.iter().map(|slot| slot.tokens).collect();
        let inputs = draw_total(settings.input_tokens, rng);
        let targets = draw_total(settings.target_tokens, rng);

        let shared = settings
            .shared_proportions
            .then(|| super::dirichlet::proportions(&input_alphas, rng));
        let side = |alphas, total, room| budget::Side {
            alphas,
            total,
            room,
            overflow: settings.overflow,
            whole_budget: settings.whole_budget,
        };
        let input = side(&input_alphas, inputs, &tokens).draw(shared.as_deref(), rng);
        let room: Vec<usize> = tokens.iter().zip(&input).map(|(n, b)| n - b).collect();
        let target = if let Some(mut shares) = shared {
            // What the input gave to a modality that is never a target is not passed on (Alg. 1 to the letter).
            for (share, alpha) in shares.iter_mut().zip(&target_alphas) {
                *share = if *alpha > 0.0 { *share } else { 0.0 };
            }
            let kept: f32 = shares.iter().sum();
            let total = (kept * targets as f32).round() as usize;
            let shares: Vec<f32> = shares.iter().map(|s| s / kept.max(1e-30)).collect();
            side(&target_alphas, total, &room).draw(Some(&shares), rng)
        } else {
            side(&target_alphas, targets, &room).draw(None, rng)
        };
        Budgets {
            component,
            input,
            target,
        }
    }

    fn component(&self, rng: &mut StreamRng) -> usize {
        let value: f64 = rng.random();
        let cumulative = &self.resolved.cumulative;
        cumulative
            .iter()
            .position(|edge| value < *edge)
            .unwrap_or(cumulative.len() - 1)
    }

    fn positions(&self, budgets: &Budgets, rng: &mut StreamRng) -> Mask {
        let mut mask = Mask::default();
        for (index, slot) in self.slots.iter().enumerate() {
            let (input, asked) = (budgets.input[index], budgets.target[index]);
            let mut chosen = choose(slot.tokens, input + asked, rng);
            let mut target = chosen.split_off(input);
            chosen.sort_unstable();
            target.sort_unstable();
            mask.input.push(chosen);
            mask.target.push(target);
        }
        mask
    }

    /// Token counts of one sample under the uniform policy, visible and target: distributed as those of [`Self::draw`], from
    /// other random numbers and without the positions.
    pub(super) fn pooled_counts(
        &self,
        present: &[bool],
        rng: &mut StreamRng,
    ) -> (Vec<usize>, Vec<usize>) {
        let component = self.component(rng);
        let inputs = draw_total(self.settings.input_tokens, rng);
        let targets = draw_total(self.settings.target_tokens, rng);
        let mut left: Vec<usize> = self.slots.iter().map(|slot| slot.tokens).collect();
        let mut side = |table: &[Vec<f64>], total: usize| {
            let takes_part = |slot: usize| present[slot] && table[component][slot] > 0.0;
            let pool: usize = (0..left.len())
                .filter(|s| takes_part(*s))
                .map(|s| left[s])
                .sum();
            let mut counts = vec![0; left.len()];
            for taken in 0..total.min(pool) {
                let mut pick = rng.random_range(0..pool - taken);
                for slot in (0..left.len()).filter(|slot| takes_part(*slot)) {
                    if pick < left[slot] {
                        left[slot] -= 1;
                        counts[slot] += 1;
                        break;
                    }
                    pick -= left[slot];
                }
            }
            counts
        };
        let input = side(&self.resolved.input, inputs);
        let target = side(&self.resolved.target, targets);
        (input, target)
    }

    /// Positions from all tokens pooled: first the visible ones, then targets from what is left.
    fn pooled(&self, present: &[bool], rng: &mut StreamRng) -> Mask {
        let component = self.component(rng);
        let takes_part =
            |table: &[Vec<f64>], slot: usize| present[slot] && table[component][slot] > 0.0;
        let inputs = draw_total(self.settings.input_tokens, rng);
        let targets = draw_total(self.settings.target_tokens, rng);

        let mut pool = Vec::new();
        for (index, slot) in self.slots.iter().enumerate() {
            if takes_part(&self.resolved.input, index) {
                pool.extend((0..slot.tokens as u32).map(|position| (index, position)));
            }
        }
        let mut input = vec![Vec::new(); self.slots.len()];
        for pick in choose(pool.len(), inputs.min(pool.len()), rng) {
            let (slot, position) = pool[pick as usize];
            input[slot].push(position);
        }
        for positions in &mut input {
            positions.sort_unstable();
        }

        let mut pool = Vec::new();
        for (index, slot) in self.slots.iter().enumerate() {
            if takes_part(&self.resolved.target, index) {
                pool.extend(
                    (0..slot.tokens as u32)
                        .filter(|position| input[index].binary_search(position).is_err())
                        .map(|position| (index, position)),
                );
            }
        }
        let mut target = vec![Vec::new(); self.slots.len()];
        for pick in choose(pool.len(), targets.min(pool.len()), rng) {
            let (slot, position) = pool[pick as usize];
            target[slot].push(position);
        }
        for positions in &mut target {
            positions.sort_unstable();
        }
        Mask { input, target }
    }
}

fn draw_total(budget: TokenBudget, rng: &mut StreamRng) -> usize {
    match budget {
        TokenBudget::Fixed(tokens) => tokens,
        TokenBudget::Range { min, max } => rng.random_range(min..=max),
    }
}

/// `count` different numbers below `from` in random order: a Fisher-Yates shuffle that stops early and keeps only the
/// entries that moved.
fn choose(from: usize, count: usize, rng: &mut StreamRng) -> Vec<u32> {
    let mut moved: BTreeMap<usize, usize> = BTreeMap::new();
    (0..count)
        .map(|index| {
            let other = rng.random_range(index..from);
            let here = moved.get(&index).copied().unwrap_or(index);
            let there = moved.get(&other).copied().unwrap_or(other);
            moved.insert(other, here);
            there as u32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::{Alphas, Overflow, PIXELS};
    use super::*;
    use crate::random::stream;
    use std::collections::BTreeSet;

    fn slots() -> Vec<Slot> {
        vec![
            Slot::both("body", 210),
            Slot::both("camera", 30),
            Slot::both("gaze", 30),
            Slot::input_only(PIXELS, 4096),
            Slot::both("rgb", 5120),
        ]
    }

    fn masks(settings: &MaskingSettings, present: &[bool], count: u64) -> Vec<Mask> {
        let masking = Masking::new(settings, &slots()).unwrap();
        (0..count)
            .map(|sample| masking.draw(present, &mut stream(0, "test.masks", 0, sample)))
            .collect()
    }

    fn policies() -> Vec<MaskingSettings> {
        let base = MaskingSettings::default();
        vec![
            base.clone(),
            MaskingSettings {
                alpha: Alphas::One(0.001),
                ..base.clone()
            },
            MaskingSettings {
                policy: Policy::Uniform,
                ..base.clone()
            },
            MaskingSettings {
                shared_proportions: true,
                ..base.clone()
            },
            MaskingSettings {
                overflow: Overflow::Redistribute,
                ..base.clone()
            },
            MaskingSettings {
                input_tokens: TokenBudget::Range { min: 1, max: 300 },
                ..base
            },
        ]
    }

    #[test]
    fn inputs_and_targets_are_disjoint_in_range_and_within_budget() {
        for settings in policies() {
            for mask in masks(&settings, &[true; 5], 60) {
                assert!(mask.input_tokens() <= 2048 && mask.target_tokens() <= 2048);
                assert!(mask.input_tokens() > 0, "{settings:?}");
                for (index, slot) in slots().iter().enumerate() {
                    let inputs: BTreeSet<_> = mask.input[index].iter().collect();
                    let asked: BTreeSet<_> = mask.target[index].iter().collect();
                    assert_eq!(
                        inputs.len() + asked.len(),
                        mask.input[index].len() + mask.target[index].len()
                    );
                    assert!(inputs.is_disjoint(&asked));
                    assert!(
                        inputs
                            .iter()
                            .chain(&asked)
                            .all(|p| (**p as usize) < slot.tokens)
                    );
                    assert!(mask.input[index].is_sorted() && mask.target[index].is_sorted());
                }
                assert!(mask.target[3].is_empty(), "raw video is never asked for");
            }
        }
    }

    #[test]
    fn absent_modalities_get_nothing() {
        for settings in policies() {
            for mask in masks(&settings, &[false, true, true, false, true], 60) {
                assert!(mask.input[0].is_empty() && mask.target[0].is_empty());
                assert!(mask.input[3].is_empty());
            }
        }
    }

    #[test]
    fn a_sample_without_any_modality_is_empty_and_does_not_fail() {
        for settings in policies() {
            for mask in masks(&settings, &[false; 5], 3) {
                assert_eq!(mask.input_tokens() + mask.target_tokens(), 0);
            }
        }
    }

    #[test]
    fn one_to_one_gives_one_modality_and_asks_for_one() {
        let settings = MaskingSettings {
            alpha: Alphas::One(0.001),
            whole_budget: true,
            ..Default::default()
        };
        let used = |side: &[Vec<u32>]| side.iter().filter(|p| !p.is_empty()).count();
        let masks = masks(&settings, &[true; 5], 1000);
        let one = masks.iter().filter(|mask| used(&mask.input) == 1).count();
        assert!(one > 930, "{one} of 1000");
        let sides = |mask: &Mask| (used(&mask.input), used(&mask.target));
        assert!(
            masks
                .iter()
                .all(|mask| sides(mask).0 <= 3 && sides(mask).1 <= 3)
        );
    }

    #[test]
    fn task_specific_gives_video_and_asks_for_body() {
        let settings = MaskingSettings {
            alpha: Alphas::One(1.0),
            inputs: vec!["rgb".into(), PIXELS.into()],
            targets: vec!["body".into()],
            ..Default::default()
        };
        for mask in masks(&settings, &[true; 5], 50) {
            assert_eq!(
                mask.target.iter().map(Vec::len).collect::<Vec<_>>(),
                [210, 0, 0, 0, 0]
            );
            assert_eq!(mask.input[3].len() + mask.input[4].len(), 2048);
        }
    }

    #[test]
    fn uniform_gives_each_modality_its_share_of_the_pool() {
        let settings = MaskingSettings {
            policy: Policy::Uniform,
            ..Default::default()
        };
        let masks = masks(&settings, &[true; 5], 400);
        let body: usize = masks.iter().map(|mask| mask.input[0].len()).sum();
        let pool: usize = slots().iter().map(|slot| slot.tokens).sum();
        let expected = 2048.0 * 210.0 / pool as f64;
        assert!(
            (body as f64 / 400.0 - expected).abs() < 2.0,
            "{body} against {expected} each"
        );
        assert!(
            masks
                .iter()
                .all(|mask| mask.input_tokens() == 2048 && mask.target_tokens() == 2048)
        );
    }

    #[test]
    fn shared_proportions_ask_for_what_they_give() {
        let settings = MaskingSettings {
            alpha: Alphas::One(1.0),
            input_tokens: TokenBudget::Fixed(60),
            target_tokens: TokenBudget::Fixed(60),
            shared_proportions: true,
            ..Default::default()
        };
        for mask in masks(&settings, &[true, false, false, false, true], 50) {
            assert!(mask.input[0].len().abs_diff(mask.target[0].len()) <= 2);
        }
    }

    #[test]
    fn choosing_is_uniform_without_repeats() {
        let mut counts = [0_usize; 10];
        for sample in 0..5000 {
            let picks = choose(10, 4, &mut stream(0, "test.choose", 0, sample));
            assert_eq!(picks.iter().collect::<BTreeSet<_>>().len(), 4);
            for pick in picks {
                counts[pick as usize] += 1;
            }
        }
        assert!(
            counts.iter().all(|count| count.abs_diff(2000) < 180),
            "{counts:?}"
        );
    }
}
