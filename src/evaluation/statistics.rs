//! How sure a number is: bootstrap over clips and seeds together, Student's t over seeds, Holm over arms.
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
    /// Percentile bootstrap over clips: other clips of the same kind; with seeds, both are drawn together.
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

/// One value per clip, once per seed (a training of its own); `None` where a clip has no number. All seeds have the same clips.
pub type Trainings = [Vec<Option<f64>>];

/// Percentile bootstrap of the mean. `None` below two values: one clip has no spread.
#[must_use]
pub fn bootstrap_mean(values: &[f64], level: f64, resamples: usize, seed: u64) -> Option<Interval> {
    let clips = [values.iter().copied().map(Some).collect()];
    hierarchical_interval(&clips, level, resamples, seed)
}

/// Percentile bootstrap of the mean in which trainings and clips are drawn together: every draw takes as many seeds and as many clips
/// as there are, with replacement, the same clips for all seeds. `None` below two clips.
#[must_use]
pub fn hierarchical_interval(
    trainings: &Trainings,
    level: f64,
    resamples: usize,
    seed: u64,
) -> Option<Interval> {
    let clips = with_numbers(trainings.first()?.len(), &[trainings]);
    let means = resampled(clips.len(), resamples, |draw| {
        let mut rng = crate::random::stream(seed, "evaluation.bootstrap", draw, 0);
        let chosen = draws(&mut rng, &clips);
        mean_of_draw(&mut rng, trainings, &chosen)
    })?;
    Some(percentiles(&means, level))
}

/// Positions of the clips for which every side has a number from some seed.
fn with_numbers(clips: usize, sides: &[&Trainings]) -> Vec<usize> {
    let has = |side: &Trainings, clip: usize| side.iter().any(|values| values[clip].is_some());
    (0..clips)
        .filter(|&clip| sides.iter().all(|side| has(side, clip)))
        .collect()
}

/// The finite results of `resamples` draws, ascending.
fn resampled(clips: usize, resamples: usize, of: impl Fn(u64) -> Option<f64>) -> Option<Vec<f64>> {
    if clips < 2 || resamples == 0 {
        return None;
    }
    let mut means: Vec<f64> = (0..resamples as u64).filter_map(of).collect();
    means.sort_by(f64::total_cmp);
    (!means.is_empty()).then_some(means)
}

fn draws(rng: &mut crate::random::StreamRng, from: &[usize]) -> Vec<usize> {
    (0..from.len())
        .map(|_| from[rng.random_range(0..from.len())])
        .collect()
}

/// The mean over `clips` of as many drawn trainings as there are; a single training is not drawn.
fn mean_of_draw(
    rng: &mut crate::random::StreamRng,
    trainings: &Trainings,
    clips: &[usize],
) -> Option<f64> {
    let all: Vec<usize> = (0..trainings.len()).collect();
    let chosen = if all.len() > 1 { draws(rng, &all) } else { all };
    let of = |&training: &usize| {
        let values = &trainings[training];
        mean(clips.iter().filter_map(|&clip| values[clip]))
    };
    mean(chosen.iter().filter_map(of))
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

/// The bootstrap of `a - b`: clips are drawn for both together, since both saw the same; trainings are drawn for each alone, since a
/// seed has nothing in common between two arms but its number. `None` without a clip that both have.
#[must_use]
pub fn paired_difference(
    a: &Trainings,
    b: &Trainings,
    level: f64,
    resamples: usize,
    seed: u64,
) -> Option<Difference> {
    let clips = with_numbers(a.first()?.len().min(b.first()?.len()), &[a, b]);
    let of_all = |side: &Trainings| {
        let one = |values: &Vec<Option<f64>>| mean(clips.iter().filter_map(|&c| values[c]));
        mean(side.iter().filter_map(one))
    };
    let centre = of_all(a)? - of_all(b)?;
    let means = resampled(clips.len(), resamples, |draw| {
        let mut rng = crate::random::stream(seed, "evaluation.bootstrap", draw, 0);
        let chosen = draws(&mut rng, &clips);
        Some(mean_of_draw(&mut rng, a, &chosen)? - mean_of_draw(&mut rng, b, &chosen)?)
    });
    let p = means.as_ref().map(|means| {
        let share = |test: fn(&f64) -> bool| {
            let hits = means.iter().filter(|m| test(m)).count();
            (hits + 1) as f64 / (means.len() + 1) as f64
        };
        (2.0 * share(|m| *m <= 0.0).min(share(|m| *m >= 0.0))).min(1.0)
    });
    Some(Difference {
        n: clips.len(),
        mean: centre,
        interval: means.map(|means| percentiles(&means, level)),
        p,
        p_holm: None,
    })
}

/// The smallest p that [`paired_difference`] can give with so many draws.
#[must_use]
pub fn least_p(resamples: usize) -> f64 {
    2.0 / (resamples + 1) as f64
}

/// The smallest two-sided p that trainings alone can give: the share of the ways to deal the seeds of both arms to two arms that is as
/// far apart as the one that happened, at best this one and its mirror image.
#[must_use]
pub fn least_p_of_trainings(a: usize, b: usize) -> f64 {
    let ways = (1..=a).fold(1.0, |ways, k| ways * (b + k) as f64 / k as f64);
    (2.0 / ways).min(1.0)
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
        let one = paired_difference(&[vec![Some(3.0)]], &[vec![Some(2.0)]], 0.95, 100, 0).unwrap();
        assert_eq!((one.n, one.mean, one.interval, one.p), (1, 1.0, None, None));
        assert_eq!(paired_difference(&[], &[], 0.95, 100, 0), None);
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
        let (a, b) = (0..50)
            .map(|_| {
                let clip = 100.0 * rng.random::<f64>();
                (Some(clip + 1.0 + 0.1 * rng.random::<f64>()), Some(clip))
            })
            .unzip();
        let difference = paired_difference(&[a], &[b], 0.95, 1000, 0).unwrap();
        assert!(difference.interval.unwrap().low > 1.0 && difference.p.unwrap() < 0.01);
    }

    /// Two arms of the same method: what differs is the training alone, and hardly from clip to clip. Clips alone find a difference
    /// in almost every pair of arms; with the trainings drawn too, they do not.
    #[test]
    fn a_difference_that_training_again_would_undo_is_not_found() {
        let trained = |arm: u64, seed: u64| -> Vec<Option<f64>> {
            let mut rng = crate::random::stream(arm, "statistics.training", seed, 0);
            let luck = rng.random::<f64>();
            (0..100)
                .map(|_| Some(10.0 + luck + 0.1 * rng.random::<f64>()))
                .collect()
        };
        let (mut by_clips, mut by_both) = (0, 0);
        for trial in 0..40 {
            let [a, b] = [2 * trial, 2 * trial + 1]
                .map(|arm| (0..5).map(|seed| trained(arm, seed)).collect::<Vec<_>>());
            let mean_of = |arm: &[Vec<Option<f64>>]| {
                vec![
                    (0..100)
                        .map(|c| mean(arm.iter().filter_map(|v| v[c])))
                        .collect::<Vec<_>>(),
                ]
            };
            let p = |a: &Trainings, b: &Trainings| {
                paired_difference(a, b, 0.95, 400, trial)
                    .unwrap()
                    .p
                    .unwrap()
            };
            by_clips += usize::from(p(&mean_of(&a), &mean_of(&b)) < 0.05);
            by_both += usize::from(p(&a, &b) < 0.05);
        }
        assert!(by_clips >= 35, "{by_clips}");
        // Five trainings a side are few, so that the bootstrap finds somewhat more than one in twenty.
        assert!(by_both <= 8, "{by_both}");
    }

    #[test]
    fn the_smallest_p_is_known_before_anything_is_trained() {
        assert!((least_p(2000) - 0.001).abs() < 1e-6);
        assert!((least_p_of_trainings(3, 3) - 0.1).abs() < 1e-12);
        assert!((least_p_of_trainings(1, 1) - 1.0).abs() < 1e-12);
        assert!((least_p_of_trainings(5, 5) - 2.0 / 252.0).abs() < 1e-12);
        let (a, b) = (vec![vec![Some(1.0); 9]], vec![vec![Some(2.0); 9]]);
        let found = paired_difference(&a, &b, 0.95, 2000, 0).unwrap();
        assert!((found.p.unwrap() - least_p(2000)).abs() < 1e-12);
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
