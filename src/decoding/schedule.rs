//! How many tokens each step decides, and at which temperature (Supp. C).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How tokens are spread over steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TokenSchedule {
    /// The same number every step.
    Linear,
    /// Few tokens first, when little is known.
    Cosine,
}

impl TokenSchedule {
    /// Tokens decided by each of at most `steps` steps: positive counts that sum to `tokens`.
    ///
    /// More steps than tokens are no error: steps that would decide nothing are left out.
    #[must_use]
    pub fn counts(self, steps: usize, tokens: usize) -> Vec<usize> {
        match self {
            Self::Linear => linear(steps, tokens),
            Self::Cosine => settle(&cosine(steps, tokens)),
        }
    }
}

/// Differences of `floor(k * tokens / steps)`, largest first, without zeros.
#[must_use]
pub fn linear(steps: usize, tokens: usize) -> Vec<usize> {
    let steps = steps.max(1);
    let at = |k: usize| k * tokens / steps;
    let mut counts: Vec<usize> = (0..steps)
        .map(|k| at(k + 1) - at(k))
        .filter(|&n| n > 0)
        .collect();
    counts.sort_unstable_by(|a, b| b.cmp(a));
    counts
}

/// The cosine schedule as the reference computes it: entries may be 0, and the last, which takes the rest, may be negative when
/// there are many steps for few tokens.
#[must_use]
pub fn cosine(steps: usize, tokens: usize) -> Vec<i64> {
    let steps = steps.max(1);
    let share = |i: usize| 0.5 * (1.0 + (std::f64::consts::PI * i as f64 / steps as f64).cos());
    let mut counts: Vec<i64> = (0..steps - 1)
        .map(|i| (tokens as f64 * (share(i) - share(i + 1))).round_ties_even() as i64)
        .collect();
    counts.push(tokens as i64 - counts.iter().sum::<i64>());
    counts
}

/// Drops empty steps and takes what a negative one is short of from the last positive ones.
fn settle(counts: &[i64]) -> Vec<usize> {
    let mut debt: i64 = counts.iter().filter(|&&n| n < 0).map(|n| -n).sum();
    let mut settled: Vec<usize> = counts
        .iter()
        .filter(|&&n| n > 0)
        .map(|&n| n as usize)
        .collect();
    for count in settled.iter_mut().rev() {
        let taken = (*count).min(debt as usize);
        *count -= taken;
        debt -= taken as i64;
    }
    settled.retain(|&n| n > 0);
    settled
}

/// How temperature moves over the steps of one target.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TemperatureSchedule {
    /// The same every step.
    #[default]
    Constant,
    /// The first step at the full temperature, then in proportion to the share of tokens that is still open.
    Linear,
    /// From the temperature towards `min`, as a power of one over the step and with the share that is still open.
    Onex {
        /// The last step's temperature.
        #[schemars(range(min = 0.0))]
        min: f64,
        /// The power of one over x.
        #[schemars(extend("exclusiveMinimum" = 0.0))]
        power: f64,
    },
}

impl TemperatureSchedule {
    /// One temperature per step of `counts`.
    #[must_use]
    pub fn values(self, temperature: f64, counts: &[usize]) -> Vec<f64> {
        let total: usize = counts.iter().sum();
        let mut decided = 0;
        counts
            .iter()
            .enumerate()
            .map(|(step, &count)| {
                let open_before = (total - decided) as f64 / total as f64;
                decided += count;
                let open_after = (total - decided) as f64 / total as f64;
                match self {
                    Self::Constant => temperature,
                    Self::Linear => temperature * open_before,
                    Self::Onex { min, power } => {
                        let x = 1.0 + 99.0 * step as f64 / (total.max(2) - 1) as f64;
                        let least = 100_f64.powf(-power);
                        let y = (x.powf(-power) - least) / (1.0 - least);
                        min + (temperature - min) * open_after * y
                    }
                }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedules_have_the_reference_counts() {
        assert_eq!(linear(3, 30), [10, 10, 10]);
        assert_eq!(linear(3, 5120), [1707, 1707, 1706]);
        assert_eq!(linear(50, 30), [1; 30]);
        assert_eq!(cosine(3, 30), [8, 15, 7]);
        assert_eq!(cosine(3, 210), [52, 105, 53]);
        assert_eq!(cosine(8, 5), [0, 1, 1, 1, 1, 1, 1, -1]);
    }

    #[test]
    fn every_schedule_decides_every_token_in_positive_steps() {
        for steps in 0..60 {
            for tokens in [1, 2, 3, 5, 13, 30, 31, 210] {
                for schedule in [TokenSchedule::Linear, TokenSchedule::Cosine] {
                    let counts = schedule.counts(steps, tokens);
                    assert_eq!(
                        counts.iter().sum::<usize>(),
                        tokens,
                        "{schedule:?} {steps} {tokens}"
                    );
                    assert!(counts.iter().all(|&n| n > 0));
                }
            }
        }
        assert!(TokenSchedule::Cosine.counts(4, 0).is_empty() && linear(4, 0).is_empty());
    }
}
