//! Dirichlet proportions in log space (Alg. 1, line 2).
//!
//! A Dirichlet draw is a vector of Gamma(alpha) draws divided by its sum. For the 1-to-1 ablation alpha is 0.001, where a
//! Gamma draw underflows `f64` about half of the time; a sampler on the linear scale then returns uniform proportions or NaN.
//! `ln Gamma(alpha) = ln Gamma(alpha + 1) + ln(u) / alpha` with u uniform in (0, 1] has no such defect.

use crate::random::StreamRng;
use rand::RngExt;
use rand_distr::{Distribution, Gamma};

/// The logarithms of unnormalised Gamma(alpha) draws; negative infinity where alpha is 0.
pub fn log_gamma_draws(alphas: &[f64], rng: &mut StreamRng) -> Vec<f64> {
    alphas
        .iter()
        .map(|alpha| {
            if *alpha <= 0.0 {
                return f64::NEG_INFINITY;
            }
            let boosted: f64 = Gamma::new(alpha + 1.0, 1.0)
                .expect("alpha is finite and positive")
                .sample(rng);
            let uniform = 1.0 - rng.random::<f64>();
            boosted.ln() + uniform.ln() / alpha
        })
        .collect()
}

/// The largest `f32` below one: where the reference's sampler clamps a share.
pub const JUST_BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// One draw of Dirichlet(`alphas`): non-negative, sum 1; all zero when every alpha is 0.
pub fn proportions(alphas: &[f64], rng: &mut StreamRng) -> Vec<f32> {
    let logs = log_gamma_draws(alphas, rng);
    let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest == f64::NEG_INFINITY {
        return vec![0.0; alphas.len()];
    }
    let weights: Vec<f64> = logs.iter().map(|log| (log - largest).exp()).collect();
    let total: f64 = weights.iter().sum();
    weights
        .iter()
        .map(|weight| (weight / total) as f32)
        .collect()
}

/// The index of the largest share of one draw of Dirichlet(`alphas`); `None` when every alpha is 0.
pub fn largest_share(alphas: &[f64], rng: &mut StreamRng) -> Option<usize> {
    let logs = log_gamma_draws(alphas, rng);
    (0..logs.len())
        .filter(|index| alphas[*index] > 0.0)
        .max_by(|a, b| logs[*a].total_cmp(&logs[*b]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::stream;

    #[test]
    fn mean_and_variance_are_those_of_the_distribution() {
        for alphas in [[0.01, 0.01, 0.01], [1.0, 2.0, 5.0], [10.0, 10.0, 10.0]] {
            let total: f64 = alphas.iter().sum();
            let draws = 20_000;
            let mut sums = [0.0; 3];
            let mut squares = [0.0; 3];
            for sample in 0..draws {
                let mut rng = stream(3, "test.dirichlet", 0, sample);
                for (i, p) in proportions(&alphas, &mut rng).iter().enumerate() {
                    sums[i] += f64::from(*p);
                    squares[i] += f64::from(*p).powi(2);
                }
            }
            for i in 0..3 {
                let mean = sums[i] / draws as f64;
                let variance = squares[i] / draws as f64 - mean * mean;
                let expected_mean = alphas[i] / total;
                let expected = expected_mean * (1.0 - expected_mean) / (total + 1.0);
                let error = 5.0 * (expected / draws as f64).sqrt();
                assert!((mean - expected_mean).abs() < error, "{alphas:?}");
                assert!((variance / expected - 1.0).abs() < 0.06, "{alphas:?}");
            }
        }
    }

    #[test]
    fn alpha_one_thousandth_is_one_to_one_and_never_uniform() {
        let mut whole = 0;
        for sample in 0..2000 {
            let mut rng = stream(0, "test.one_to_one", 0, sample);
            let pi = proportions(&[0.001; 4], &mut rng);
            let largest = pi.iter().copied().fold(0.0, f32::max);
            assert!(largest > 0.4, "not even near uniform: {pi:?}");
            whole += usize::from(largest == 1.0);
        }
        // P(the second largest is below 2^-25 of the largest) is about 0.95 at this alpha.
        assert!(
            whole > 1850,
            "{whole} of 2000 gave everything to one modality"
        );
    }

    #[test]
    fn alpha_zero_means_never() {
        let mut rng = stream(0, "test.zero", 0, 0);
        assert_eq!(proportions(&[0.0, 0.0], &mut rng), [0.0, 0.0]);
        assert_eq!(largest_share(&[0.0, 0.0], &mut rng), None);
        for _ in 0..100 {
            assert_eq!(proportions(&[0.0, 1e-9], &mut rng), [0.0, 1.0]);
            assert_eq!(largest_share(&[0.0, 1e-9], &mut rng), Some(1));
        }
    }
}
