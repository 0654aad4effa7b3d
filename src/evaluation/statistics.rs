//! How sure a number is: bootstrap over clips, Student's t over seeds, Holm over arms.
//!
//! One sample has no interval, and nothing here pretends that it has.

use super::outcome::{Outcome, mean};
use rand::RngExt;
use serde::{Deserialize, Serialize};

/// A column of outcomes in one line. Only numbers enter the mean.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Summary {
    /// `None` without a number.
    pub mean: Option<f64>,
    /// Standard error of the mean, `std(ddof=1) / sqrt(n)`; `None` below two numbers.
    pub standard_error: Option<f64>,
    /// How many outcomes are numbers.
    pub n: usize,
    /// How many outcomes are null: nothing valid to score.
    pub n_null: usize,
    /// How many outcomes are degenerate.
    pub n_degenerate: usize,
}

/// Plain mean over clips (each clip weight 1), with the counts of everything that is not a number.
#[must_use]
pub fn summarise(values: &[Outcome]) -> Summary {
    let numbers: Vec<f64> = values.iter().filter_map(|v| v.number()).collect();
    Summary {
        mean: mean(numbers.iter().copied()),
        standard_error: deviation(&numbers).map(|s| s / (numbers.len() as f64).sqrt()),
        n: numbers.len(),
        n_null: values.iter().filter(|v| **v == Outcome::Null).count(),
        n_degenerate: values.iter().filter(|v| **v == Outcome::Degenerate).count(),
    }
}

/// Standard deviation with `n - 1`; `None` below two values.
fn deviation(values: &[f64]) -> Option<f64> {
    let centre = mean(values.iter().copied())?;
    let squares: f64 = values.iter().map(|v| (v - centre).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// A confidence interval and where it comes from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end, in the unit of the values.
    pub low: f64,
    /// Upper end, in the unit of the values.
    pub high: f64,
    /// What was varied to get it.
    pub over: Over,
}

/// What varies in an interval.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Over {
    /// Percentile bootstrap over clips: other clips of the same kind.
    Clips,
    /// Student's t over seeds: training again.
    Seeds,
}

impl Interval {
    /// Whether `value` lies in it; both ends do.
    #[must_use]
    pub fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// Distance of its ends, in the unit of the values.
    #[must_use]
    pub fn width(&self) -> f64 {
        self.high - self.low
    }
}

/// Bootstrap draws when nothing else is said.
pub const RESAMPLES: usize = 2000;

/// Percentile bootstrap of the mean. `None` below two values: one clip has no spread.
#[must_use]
pub fn bootstrap_mean(values: &[f64], level: f64, resamples: usize, seed: u64) -> Option<Interval> {
    let means = resampled_means(values, resamples, seed)?;
    Some(percentiles(&means, level))
}

/// The means of `resamples` draws with replacement, ascending.
fn resampled_means(values: &[f64], resamples: usize, seed: u64) -> Option<Vec<f64>> {
    if values.len() < 2 || resamples == 0 {
        return None;
    }
    let n = values.len();
    let mut means: Vec<f64> = (0..resamples)
        .map(|draw| {
            let mut rng = crate::random::stream(seed, "evaluation.bootstrap", draw as u64, 0);
            (0..n).map(|_| values[rng.random_range(0..n)]).sum::<f64>() / n as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    Some(means)
}

fn percentiles(ascending: &[f64], level: f64) -> Interval {
    let tail = (1.0 - level) / 2.0;
    let at = |share: f64| {
        let position = share * (ascending.len() - 1) as f64;
        let (below, part) = (position.floor() as usize, position.fract());
        let above = (below + 1).min(ascending.len() - 1);
        ascending[below] + part * (ascending[above] - ascending[below])
    };
    Interval {
        low: at(tail),
        high: at(1.0 - tail),
        over: Over::Clips,
    }
}

/// How two systems differ on the clips that both have.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// Clips on which both have a number.
    pub n: usize,
    /// Mean of `a - b`.
    pub mean: f64,
    /// `None` below two clips.
    pub interval: Option<Interval>,
    /// Two-sided bootstrap p-value; `None` below two clips.
    pub p: Option<f64>,
    /// `p` after Holm's correction over the arms of the table.
    pub p_holm: Option<f64>,
}

/// The paired bootstrap of `a - b` over pairs `(a, b)` of the same clip. `None` without a pair.
#[must_use]
pub fn paired_difference(
    pairs: &[(f64, f64)],
    level: f64,
    resamples: usize,
    seed: u64,
) -> Option<Difference> {
    let differences: Vec<f64> = pairs.iter().map(|(a, b)| a - b).collect();
    let centre = mean(differences.iter().copied())?;
    let means = resampled_means(&differences, resamples, seed);
    let p = means.as_ref().map(|means| {
        let share = |test: fn(&f64) -> bool| {
            let hits = means.iter().filter(|m| test(m)).count();
            (hits + 1) as f64 / (means.len() + 1) as f64
        };
        (2.0 * share(|m| *m <= 0.0).min(share(|m| *m >= 0.0))).min(1.0)
    });
    Some(Difference {
        n: differences.len(),
        mean: centre,
        interval: means.map(|means| percentiles(&means, level)),
        p,
        p_holm: None,
    })
}

/// Student's t interval of the mean of `values`, one per seed. `None` below two seeds.
#[must_use]
pub fn student_interval(values: &[f64], level: f64) -> Option<Interval> {
    let centre = mean(values.iter().copied())?;
    let error = deviation(values)? / (values.len() as f64).sqrt();
    let half = student_quantile(level, values.len() - 1) * error;
    Some(Interval {
        low: centre - half,
        high: centre + half,
        over: Over::Seeds,
    })
}

/// The `t` with `P(|T| <= t) = level` for an integer number of degrees of freedom, by bisection of the closed form.
#[must_use]
pub fn student_quantile(level: f64, freedom: usize) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    while central_probability(high, freedom) < level && high < 1e12 {
        high *= 2.0;
    }
    for _ in 0..200 {
        let middle = f64::midpoint(low, high);
        if central_probability(middle, freedom) < level {
            low = middle;
        } else {
            high = middle;
        }
    }
    f64::midpoint(low, high)
}

/// `P(|T| <= t)` (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn central_probability(t: f64, freedom: usize) -> f64 {
    let angle = (t / (freedom as f64).sqrt()).atan();
    let (sin, cos) = angle.sin_cos();
    let odd = freedom % 2 == 1;
    let (mut term, mut sum) = if odd { (cos, cos) } else { (1.0, 1.0) };
    if freedom == 1 {
        sum = 0.0;
    }
    let mut k = if odd { 3 } else { 2 };
    while k < freedom {
        term *= cos * cos * (k - 1) as f64 / k as f64;
        sum += term;
        k += 2;
    }
    if odd {
        2.0 / std::f64::consts::PI * (angle + sin * sum)
    } else {
        sin * sum
    }
}

/// Holm's step-down correction: p-values that hold for all comparisons together, in the order given.
#[must_use]
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|&i, &j| p[i].total_cmp(&p[j]));
    let mut corrected = vec![0.0; p.len()];
    let mut largest = 0.0_f64;
    for (rank, &index) in order.iter().enumerate() {
        largest = largest.max(((p.len() - rank) as f64 * p[index]).min(1.0));
        corrected[index] = largest;
    }
    corrected
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn student_quantiles_match_the_printed_tables() {
        for (freedom, t) in [
            (1, 12.706),
            (2, 4.303),
            (3, 3.182),
            (4, 2.776),
            (9, 2.262),
            (10, 2.228),
            (30, 2.042),
        ] {
            assert!(
                (student_quantile(0.95, freedom) - t).abs() < 6e-4,
                "{freedom}"
            );
        }
    }

    #[test]
    fn holm_corrects_step_down() {
        let corrected = holm(&[0.01, 0.04, 0.03, 0.005]);
        for (got, want) in corrected.iter().zip([0.03, 0.06, 0.06, 0.02]) {
            assert!((got - want).abs() < 1e-12);
        }
        assert!(holm(&[]).is_empty());
    }

    #[test]
    fn one_value_has_no_interval() {
        assert_eq!(bootstrap_mean(&[3.0], 0.95, 100, 0), None);
        assert_eq!(student_interval(&[3.0], 0.95), None);
        let one = paired_difference(&[(3.0, 2.0)], 0.95, 100, 0).unwrap();
        assert_eq!((one.n, one.mean, one.interval, one.p), (1, 1.0, None, None));
        assert_eq!(paired_difference(&[], 0.95, 100, 0), None);
    }

    #[test]
    fn the_bootstrap_covers_the_mean_about_as_often_as_it_says() {
        let covered = (0..200)
            .filter(|&trial| {
                let mut rng = crate::random::stream(9, "statistics.coverage", trial, 0);
                let values: Vec<f64> = (0..60).map(|_| rng.random::<f64>()).collect();
                bootstrap_mean(&values, 0.9, 400, trial)
                    .unwrap()
                    .contains(0.5)
            })
            .count();
        assert!((165..=193).contains(&covered), "{covered} of 200");
    }

    #[test]
    fn a_shift_that_every_clip_shares_is_found_by_pairing() {
        let mut rng = crate::random::stream(1, "statistics.pairs", 0, 0);
        let pairs: Vec<(f64, f64)> = (0..50)
            .map(|_| {
                let clip = 100.0 * rng.random::<f64>();
                (clip + 1.0 + 0.1 * rng.random::<f64>(), clip)
            })
            .collect();
        let difference = paired_difference(&pairs, 0.95, 1000, 0).unwrap();
        assert!(difference.interval.unwrap().low > 1.0 && difference.p.unwrap() < 0.01);
    }

    #[test]
    fn null_and_degenerate_are_counted_not_averaged() {
        let values = [
            Outcome::Number(1.0),
            Outcome::Null,
            Outcome::Number(3.0),
            Outcome::Degenerate,
        ];
        let summary = summarise(&values);
        assert_eq!(
            (
                summary.mean,
                summary.n,
                summary.n_null,
                summary.n_degenerate
            ),
            (Some(2.0), 2, 1, 1)
        );
        assert_eq!(summary.standard_error, Some(1.0));
    }
}
