//! Several rounds of one generation: their seeds, and the mean of what they give.

use crate::clip::Signal;
use rand::RngExt;

/// The first round has the seed itself.
pub(super) fn seed_of_round(seed: u64, round: usize) -> u64 {
    match round {
        0 => seed,
        _ => crate::random::stream(seed, "decoding.round", round as u64, 0).random(),
    }
}

/// The mean over rounds of every clip's signal and certainty.
#[derive(Default)]
pub(super) struct Mean {
    rounds: usize,
    signals: Vec<Signal>,
    certainty: Vec<Vec<f32>>,
}

impl Mean {
    pub fn add(&mut self, signals: Vec<Signal>, certainty: Vec<Vec<f32>>) {
        self.rounds += 1;
        if self.rounds == 1 {
            (self.signals, self.certainty) = (signals, certainty);
            return;
        }
        for (sum, signal) in self.signals.iter_mut().zip(signals) {
            sum.values += &signal.values;
        }
        for (sum, values) in self.certainty.iter_mut().zip(certainty) {
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += value;
            }
        }
    }

    pub fn finish(mut self) -> (Vec<Signal>, Vec<Vec<f32>>) {
        let rounds = self.rounds.max(1) as f32;
        for signal in &mut self.signals {
            signal.values /= rounds;
        }
        for value in self.certainty.iter_mut().flatten() {
            *value /= rounds;
        }
        (self.signals, self.certainty)
    }
}

/// The mean certainty of the tokens of each of `steps` time steps, spread over `samples`.
pub(super) fn per_sample(tokens: &[f32], steps: usize, samples: usize) -> Vec<f32> {
    let each = (tokens.len() / steps.max(1)).max(1);
    let means: Vec<f32> = tokens
        .chunks(each)
        .map(|chunk| chunk.iter().sum::<f32>() / chunk.len() as f32)
        .collect();
    let of = |sample: usize| means.get(sample * steps / samples.max(1)).copied();
    (0..samples)
        .map(|sample| of(sample).unwrap_or(f32::NAN))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certainty_of_tokens_is_spread_over_samples() {
        let tokens = [1.0, 0.0, 0.5, 0.5];
        assert_eq!(per_sample(&tokens, 2, 6), [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]);
        assert_eq!(per_sample(&[0.25, 0.75], 2, 4), [0.25, 0.25, 0.75, 0.75]);
    }

    #[test]
    fn rounds_are_averaged_and_the_first_has_the_seed_itself() {
        assert_eq!(seed_of_round(7, 0), 7);
        assert_ne!(seed_of_round(7, 1), seed_of_round(7, 2));
        let signal = |value: f32| Signal {
            values: ndarray::ArrayD::from_elem(vec![2, 1], value),
            valid: None,
        };
        let mut mean = Mean::default();
        mean.add(vec![signal(1.0)], vec![vec![0.5]]);
        mean.add(vec![signal(2.0)], vec![vec![1.0]]);
        let (signals, certainty) = mean.finish();
        assert_eq!(signals[0].values, signal(1.5).values);
        assert_eq!(certainty, [[0.75]]);
    }
}
