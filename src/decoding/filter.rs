//! From logits to a token: top-k, then nucleus (top-p), then temperature, then the draw.
//!
//! The order matters: the filters see the untempered logits. A temperature of 0 takes the largest logit without any filter.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How a token is taken from its logits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Filter {
    /// How many of the most likely tokens stay.
    pub top_k: TopK,
    /// Tokens after the one that crosses this mass are dropped; 0 (or 1) is off.
    pub top_p: f64,
    /// 0 takes the most likely token.
    pub temperature: f64,
    /// How one of the tokens that stay is taken.
    pub sampling: Sampling,
}

/// How many of the largest logits stay.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TopK {
    /// All tokens stay.
    #[default]
    Off,
    /// This many.
    Count(usize),
    /// This share of the vocabulary.
    Share(f64),
}

impl TopK {
    /// How many of `vocabulary` stay; ties with the last of them stay too.
    #[must_use]
    pub fn kept(self, vocabulary: usize) -> usize {
        match self {
            Self::Off | Self::Count(0) => vocabulary,
            Self::Count(count) => count.min(vocabulary),
            Self::Share(share) if share > 0.0 => {
                ((share * vocabulary as f64) as usize).clamp(1, vocabulary.max(1))
            }
            Self::Share(_) => vocabulary,
        }
    }
}

/// How one of the remaining tokens is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// By its probability.
    #[default]
    Random,
    /// The most likely one.
    MostLikely,
}

/// Temperatures this near to 0 mean the largest logit.
pub const ZERO_TEMPERATURE: f64 = 1e-10;

/// A token and what is known about how sure it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pick {
    /// The token.
    pub token: u32,
    /// Its probability after filter and temperature.
    pub probability: f32,
    /// Its probability at temperature 1 without filters; breaks ties between equal `probability`.
    pub plain_probability: f32,
    /// `1 - entropy / ln(vocabulary)` of the unfiltered logits at temperature 1: 0 knows nothing, 1 is certain.
    pub certainty: f32,
}

/// Takes a token from `logits`; `uniform` in [0, 1) decides a random draw.
///
/// Equal logits stand in the order of their tokens. NaN counts as the smallest logit.
#[must_use]
pub fn pick(logits: &[f32], filter: &Filter, uniform: f64) -> Pick {
    let (largest, best) = largest(logits);
    let plain = Softmax::of(logits, largest);
    let certainty = plain.certainty(logits.len());
    let finish = |token: usize, probability: f64| Pick {
        token: token as u32,
        probability: probability as f32,
        plain_probability: plain.probability(logits[token]) as f32,
        certainty,
    };
    if filter.temperature.abs() <= ZERO_TEMPERATURE {
        return finish(best, 1.0);
    }
    let weight = |logit: f32| ((f64::from(logit) - f64::from(largest)) / filter.temperature).exp();
    match survivors(logits, filter, &plain) {
        None => {
            let total: f64 = logits
                .iter()
                .map(|&l| weight(l))
                .filter(|w| w.is_finite())
                .sum();
            let token = match filter.sampling {
                Sampling::MostLikely => best,
                Sampling::Random => {
                    drawn(logits.iter().map(|&l| weight(l)), uniform * total).unwrap_or(best)
                }
            };
            finish(token, weight(logits[token]) / total)
        }
        Some(kept) => {
            let total: f64 = kept.iter().map(|&i| weight(logits[i as usize])).sum();
            let token = match filter.sampling {
                Sampling::MostLikely => best,
                Sampling::Random => drawn(
                    kept.iter().map(|&i| weight(logits[i as usize])),
                    uniform * total,
                )
                .map_or(best, |position| kept[position] as usize),
            };
            finish(token, weight(logits[token]) / total)
        }
    }
}

/// The tokens that survive both filters, largest logit first; `None` when no filter is on.
#[must_use]
pub fn kept_tokens(logits: &[f32], filter: &Filter) -> Option<Vec<u32>> {
    survivors(logits, filter, &Softmax::of(logits, largest(logits).0))
}

fn largest(logits: &[f32]) -> (f32, usize) {
    let mut best = (f32::NEG_INFINITY, 0);
    for (i, &logit) in logits.iter().enumerate() {
        if logit > best.0 {
            best = (logit, i);
        }
    }
    best
}

/// The unfiltered distribution at temperature 1.
struct Softmax {
    largest: f32,
    total: f64,
    entropy: f64,
}

impl Softmax {
    fn of(logits: &[f32], largest: f32) -> Self {
        let (mut total, mut weighted) = (0.0, 0.0);
        for &logit in logits {
            let gap = f64::from(logit - largest);
            if gap > -700.0 {
                let weight = gap.exp();
                total += weight;
                weighted += weight * gap;
            }
        }
        Self {
            largest,
            total,
            entropy: total.ln() - weighted / total,
        }
    }

    fn probability(&self, logit: f32) -> f64 {
        f64::from(logit - self.largest).exp() / self.total
    }

    fn certainty(&self, vocabulary: usize) -> f32 {
        if vocabulary < 2 {
            return 1.0;
        }
        (1.0 - self.entropy / (vocabulary as f64).ln()).clamp(0.0, 1.0) as f32
    }
}

fn survivors(logits: &[f32], filter: &Filter, plain: &Softmax) -> Option<Vec<u32>> {
    let k = filter.top_k.kept(logits.len());
    let nucleus = filter.top_p > 0.0 && filter.top_p < 1.0;
    if k >= logits.len() && !nucleus {
        return None;
    }
    let before = |a: &u32, b: &u32| {
        let (x, y) = (logits[*a as usize], logits[*b as usize]);
        y.total_cmp(&x).then(a.cmp(b))
    };
    let mut tokens: Vec<u32> = (0..logits.len() as u32)
        .filter(|&i| !logits[i as usize].is_nan())
        .collect();
    let mut mass = plain.total;
    if k < tokens.len() {
        tokens.select_nth_unstable_by(k - 1, before);
        let threshold = logits[tokens[k - 1] as usize];
        tokens.retain(|&i| logits[i as usize] >= threshold);
        mass = tokens
            .iter()
            .map(|&i| f64::from(logits[i as usize] - plain.largest).exp())
            .sum();
    }
    if !nucleus {
        tokens.sort_unstable_by(before);
        return Some(tokens);
    }
    // Only the front needs an order: sort a growing part of it until the mass is reached.
    let (mut sorted, mut part, mut cumulative) = (0, 32, 0.0);
    loop {
        let end = part.min(tokens.len());
        if end < tokens.len() {
            tokens[sorted..].select_nth_unstable_by(end - sorted - 1, before);
        }
        tokens[sorted..end].sort_unstable_by(before);
        for position in sorted..end {
            if position > 0 && cumulative > filter.top_p {
                tokens.truncate(position);
                return Some(tokens);
            }
            cumulative += f64::from(logits[tokens[position] as usize] - plain.largest).exp() / mass;
        }
        if end == tokens.len() {
            return Some(tokens);
        }
        (sorted, part) = (end, part * 8);
    }
}

/// The position at which the running sum of `weights` exceeds `target`; the last positive one if rounding leaves it short.
fn drawn(weights: impl Iterator<Item = f64>, target: f64) -> Option<usize> {
    let (mut sum, mut last) = (0.0, None);
    for (position, weight) in weights.enumerate() {
        if weight > 0.0 {
            last = Some(position);
            sum += weight;
            if sum > target {
                break;
            }
        }
    }
    last
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    const OFF: Filter = Filter {
        top_k: TopK::Off,
        top_p: 0.0,
        temperature: 1.0,
        sampling: Sampling::Random,
    };

    #[test]
    fn a_random_draw_follows_the_softmax() {
        let logits = [0.0, 1.0, 2.0, f32::NEG_INFINITY];
        let mut rng = crate::random::stream(0, "filter.test", 0, 0);
        let mut counts = [0_u32; 4];
        for _ in 0..20_000 {
            counts[pick(&logits, &OFF, rng.random()).token as usize] += 1;
        }
        let total: f64 = logits.iter().map(|l| f64::from(*l).exp()).sum();
        for (count, logit) in counts.iter().zip(logits) {
            let expected = 20_000.0 * f64::from(logit).exp() / total;
            assert!(
                (f64::from(*count) - expected).abs() <= 4.0 * expected.sqrt(),
                "{counts:?}"
            );
        }
    }

    #[test]
    fn temperature_zero_takes_the_first_of_the_largest_without_filters() {
        let filter = Filter {
            temperature: 0.0,
            top_k: TopK::Count(1),
            ..OFF
        };
        let chosen = pick(&[1.0, 3.0, 3.0, 2.0], &filter, 0.99);
        assert_eq!((chosen.token, chosen.probability), (1, 1.0));
    }

    #[test]
    fn the_nucleus_keeps_the_token_that_crosses_the_mass_and_equals_a_full_sort() {
        let mut rng = crate::random::stream(0, "filter.nucleus", 0, 0);
        for size in [3, 40, 5000] {
            let logits: Vec<f32> = (0..size).map(|_| 6.0 * rng.random::<f32>()).collect();
            for top_p in [0.05, 0.5, 0.8, 0.999] {
                let kept = kept_tokens(&logits, &Filter { top_p, ..OFF }).unwrap();
                let mut order: Vec<u32> = (0..size as u32).collect();
                order.sort_by(|a, b| logits[*b as usize].total_cmp(&logits[*a as usize]));
                let total: f64 = logits.iter().map(|l| f64::from(*l).exp()).sum();
                let mut mass = 0.0;
                order.retain(|&i| {
                    let keep = mass <= top_p;
                    mass += f64::from(logits[i as usize]).exp() / total;
                    keep
                });
                assert_eq!(kept, order, "{size} {top_p}");
            }
        }
    }

    #[test]
    fn certainty_is_zero_for_equal_logits_and_one_for_a_sure_thing() {
        assert!(pick(&[0.5; 64], &OFF, 0.3).certainty.abs() < 1e-6);
        let mut sure = [0.0; 64];
        sure[9] = 80.0;
        let chosen = pick(&sure, &OFF, 0.3);
        assert!(chosen.token == 9 && chosen.certainty > 0.9999);
    }
}
