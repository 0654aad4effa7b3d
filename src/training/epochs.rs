//! Which signals each step of a tokenizer's training sees.

use rand::seq::SliceRandom;

use super::sampler::Sampler;
use super::source::DataError;
use super::trainer::{Objective, Trainer, TrainingError};
use crate::random::stream;

/// Which signals each step sees: epochs are permutations of the signals of all data sets, drawn for (seed, epoch), read one after
/// the other; or data sets are drawn by weights, as MGET's are.
#[derive(Debug, Clone)]
pub struct Epochs {
    seed: u64,
    micro_batches: Vec<usize>,
    /// The order of the epoch it was last asked for.
    order: (u64, Vec<usize>),
    /// Where data sets are drawn by weights, in place of epochs.
    weighted: Option<Weighted>,
}

/// Data sets drawn by weights, each with its clips in an order of its own.
#[derive(Debug, Clone)]
struct Weighted {
    sampler: Sampler,
    /// Where the signals of each drawn data set begin.
    starts: Vec<usize>,
}

impl Epochs {
    /// The order of a run of `trainer`, under a seed.
    #[must_use]
    pub fn of<O: Objective>(trainer: &Trainer<O>, seed: u64) -> Self {
        Self::new(seed, trainer.micro_batches().to_vec())
    }

    fn new(seed: u64, micro_batches: Vec<usize>) -> Self {
        Self {
            seed,
            micro_batches,
            order: (u64::MAX, Vec::new()),
            weighted: None,
        }
    }

    /// Draws data sets of `lengths` signals, which follow each other, by `weights` instead of in proportion to their signals.
    ///
    /// # Errors
    /// When a data set that is to be drawn has no signal, or the weights cannot be used.
    pub fn weighted(
        mut self,
        names: &[&str],
        lengths: &[usize],
        weights: &[f64],
    ) -> Result<Self, TrainingError> {
        if names.len() != lengths.len() || weights.len() != lengths.len() {
            return Err(DataError::Weights.into());
        }
        let (mut starts, mut drawn, mut start) = (Vec::new(), Vec::new(), 0);
        for (set, length) in lengths.iter().enumerate() {
            // A data set of weight 0 may as well be empty.
            if weights[set] != 0.0 {
                starts.push(start);
                drawn.push(set);
            }
            start += length;
        }
        let names: Vec<&str> = drawn.iter().map(|set| names[*set]).collect();
        let lengths: Vec<usize> = drawn.iter().map(|set| lengths[*set]).collect();
        let weights: Vec<f64> = drawn.iter().map(|set| weights[*set]).collect();
        let sampler = Sampler::new(self.seed, &names, &lengths, Some(&weights))?;
        self.weighted = Some(Weighted { sampler, starts });
        Ok(self)
    }

    /// The signals of micro-batch `micro` of `step`, of `count` that there are.
    ///
    /// # Errors
    /// When there are none.
    pub fn choose(
        &mut self,
        step: u64,
        micro: usize,
        count: usize,
    ) -> Result<Vec<usize>, TrainingError> {
        if count == 0 {
            return Err(TrainingError::NoData);
        }
        let per_step: usize = self.micro_batches.iter().sum();
        let before: usize = self.micro_batches[..micro].iter().sum();
        let first = step * per_step as u64 + before as u64;
        let mut at = |n: u64| {
            if let Some(Weighted { sampler, starts }) = &self.weighted {
                let place = sampler.place(n);
                return starts[place.set] + place.clip;
            }
            let epoch = n / count as u64;
            if self.order.0 != epoch || self.order.1.len() != count {
                let mut order: Vec<usize> = (0..count).collect();
                order.shuffle(&mut stream(self.seed, "train_tokenizer.order", epoch, 0));
                self.order = (epoch, order);
            }
            self.order.1[(n % count as u64) as usize]
        };
        let size = self.micro_batches[micro] as u64;
        Ok((first..first + size).map(&mut at).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_signal_is_seen_once_per_epoch() {
        let mut epochs = Epochs::new(4, vec![5, 3]);
        let mut seen = Vec::new();
        for step in 0..5 {
            for micro in 0..2 {
                seen.extend(epochs.choose(step, micro, 20).unwrap());
            }
        }
        for epoch in seen.chunks(20) {
            let mut epoch = epoch.to_vec();
            epoch.sort_unstable();
            assert_eq!(epoch, (0..20).collect::<Vec<_>>());
        }
        assert_ne!(seen[..20], seen[20..]);
        assert!(epochs.choose(0, 0, 0).is_err());
    }

    #[test]
    fn weights_say_how_often_each_data_set_is_drawn() {
        let names = ["a", "b", "c"];
        let draw = |lengths: &[usize], weights: &[f64]| {
            Epochs::new(4, vec![50]).weighted(&names, lengths, weights)
        };
        let mut epochs = draw(&[10, 0, 90], &[3.0, 0.0, 1.0]).unwrap();
        let seen: Vec<usize> = (0..80)
            .flat_map(|step| epochs.choose(step, 0, 100).unwrap())
            .collect();
        let small = seen.iter().filter(|index| **index < 10).count();
        assert!(small.abs_diff(3000) < 150, "{small} of {}", seen.len());
        // Each signal of a data set as often as the others of it: once an epoch of 10, where its set is drawn, so 400 times in 3 of 4,
        // with a standard deviation of 8.7.
        let of = |signal: usize| seen.iter().filter(|index| **index == signal).count();
        assert!((0..10).all(|signal| of(signal).abs_diff(small / 10) < 45));
        assert!((10..100).all(|signal| of(signal) > 0));
        for (lengths, weights) in [
            ([10, 0, 90], vec![1.0, 1.0, 1.0]),
            ([10, 5, 90], vec![1.0, 1.0]),
            ([10, 5, 90], vec![0.0, 0.0, 0.0]),
            ([10, 5, 90], vec![1.0, f64::NAN, 1.0]),
        ] {
            assert!(draw(&lengths, &weights).is_err(), "{weights:?}");
        }
    }
}
