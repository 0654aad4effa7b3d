//! Which clip stands where in the stream of training samples: a function of the position alone.
//!
//! Sample `n` of the stream first draws its data set by the weights, then takes the clip that a permutation of that data set
//! puts at place `n mod length` in epoch `n / length`. With one data set every epoch shows every clip once; with several, no
//! clip returns within an epoch's worth of samples.

use super::source::DataError;
use crate::random::stream;
use rand::RngExt;

/// The order of clips of one or more data sets.
#[derive(Debug, Clone)]
pub struct Sampler {
    seed: u64,
    lengths: Vec<u64>,
    /// Cumulative shares; the last is 1.
    cumulative: Vec<f64>,
}

/// A clip of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleIndex {
    /// The data set.
    pub set: usize,
    /// The clip in it.
    pub clip: usize,
}

impl Sampler {
    /// An order over data sets of `lengths` clips, drawn in proportion to `weights`; without weights, in proportion to their
    /// lengths.
    ///
    /// # Errors
    /// When a data set is empty or the weights cannot be used.
    pub fn new(
        seed: u64,
        names: &[&str],
        lengths: &[usize],
        weights: Option<&[f64]>,
    ) -> Result<Self, DataError> {
        if let Some(empty) = lengths.iter().position(|length| *length == 0) {
            return Err(DataError::Empty(names[empty].to_owned()));
        }
        let by_length: Vec<f64> = lengths.iter().map(|length| *length as f64).collect();
        let weights = weights.unwrap_or(&by_length);
        let total: f64 = weights.iter().sum();
        let usable = weights
            .iter()
            .all(|weight| weight.is_finite() && *weight >= 0.0);
        if weights.len() != lengths.len() || !usable || total <= 0.0 {
            return Err(DataError::Weights);
        }
        let mut sum = 0.0;
        Ok(Self {
            seed,
            lengths: lengths.iter().map(|length| *length as u64).collect(),
            cumulative: weights
                .iter()
                .map(|weight| {
                    sum += weight;
                    sum / total
                })
                .collect(),
        })
    }

    /// The clip at position `n` of the stream.
    #[must_use]
    pub fn place(&self, n: u64) -> SampleIndex {
        let set = if self.lengths.len() == 1 {
            0
        } else {
            let value: f64 = stream(self.seed, "training.data_set", n, 0).random();
            let last = self.cumulative.len() - 1;
            self.cumulative
                .iter()
                .position(|edge| value < *edge)
                .unwrap_or(last)
        };
        let length = self.lengths[set];
        let epoch = Permutation::new(self.seed, set as u64, n / length, length);
        SampleIndex {
            set,
            clip: epoch.at(n % length) as usize,
        }
    }
}

/// A keyed permutation of `0..length`: four rounds of a Feistel network on the next even number of bits, walked until the
/// result is in range.
struct Permutation {
    keys: [u64; 4],
    half_bits: u32,
    length: u64,
}

impl Permutation {
    fn new(seed: u64, set: u64, epoch: u64, length: u64) -> Self {
        let mut rng = stream(seed, "training.order", epoch, set);
        let bits = 64 - length.saturating_sub(1).leading_zeros();
        Self {
            keys: std::array::from_fn(|_| rng.random()),
            half_bits: bits.div_ceil(2).max(1),
            length,
        }
    }

    fn at(&self, index: u64) -> u64 {
        let mut value = index;
        loop {
            value = self.rounds(value);
            if value < self.length {
                return value;
            }
        }
    }

    fn rounds(&self, value: u64) -> u64 {
        let mask = (1 << self.half_bits) - 1;
        let (mut left, mut right) = (value >> self.half_bits, value & mask);
        for key in self.keys {
            let mixed = mix(right ^ key) & mask;
            (left, right) = (right, left ^ mixed);
        }
        left << self.half_bits | right
    }
}

/// The finaliser of SplitMix64: every input bit reaches every output bit.
fn mix(value: u64) -> u64 {
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_epoch_shows_every_clip_once_in_another_order() {
        for length in [1, 2, 3, 7, 64, 200, 1000] {
            let order = Sampler::new(5, &["a"], &[length], None).unwrap();
            let epoch = |e: usize| -> Vec<usize> {
                (0..length)
                    .map(|i| order.place((e * length + i) as u64).clip)
                    .collect()
            };
            let (first, second) = (epoch(0), epoch(1));
            assert_eq!(first.iter().collect::<BTreeSet<_>>().len(), length);
            assert_eq!(second.iter().collect::<BTreeSet<_>>().len(), length);
            assert!(length < 7 || first != second);
        }
    }

    #[test]
    fn data_sets_come_in_proportion_to_their_weights() {
        let order =
            Sampler::new(1, &["a", "b", "c"], &[10, 500, 90], Some(&[1.0, 2.0, 1.0])).unwrap();
        let mut counts = [0_usize; 3];
        for n in 0..8000 {
            let place = order.place(n);
            assert!(place.clip < [10, 500, 90][place.set]);
            counts[place.set] += 1;
        }
        assert!(
            counts[0].abs_diff(2000) < 200 && counts[1].abs_diff(4000) < 200,
            "{counts:?}"
        );
    }

    #[test]
    fn empty_data_sets_and_unusable_weights_are_refused() {
        assert_eq!(
            Sampler::new(0, &["a", "b"], &[3, 0], None).unwrap_err(),
            DataError::Empty("b".into())
        );
        for weights in [&[1.0][..], &[0.0, 0.0], &[-1.0, 2.0], &[f64::NAN, 1.0]] {
            assert!(Sampler::new(0, &["a", "b"], &[3, 3], Some(weights)).is_err());
        }
    }
}
