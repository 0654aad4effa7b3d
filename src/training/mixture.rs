//! The data sets that a tokenizer learns from, and how often each is drawn.

use super::epochs::Epochs;
use super::trainer::TrainingError;
use std::ops::Range;

/// The data sets that follow each other in what a tokenizer learns from.
#[derive(Debug, Clone, Copy, Default)]
pub struct Mixture<'a> {
    /// Name and clips of each; none: a single one.
    pub sets: &'a [(&'a str, usize)],
    /// How often each is drawn; `None`: in proportion to its signals.
    pub weights: Option<&'a [f64]>,
}

impl Mixture<'_> {
    /// The clips that are read of each data set, of `clips` in all.
    pub(super) fn ranges(&self, clips: usize) -> Vec<Range<usize>> {
        if self.sets.is_empty() {
            return std::iter::once(0..clips).collect();
        }
        let mut start = 0;
        let range = |(set, (_, clips)): (usize, &(&str, usize))| {
            start += clips;
            // A data set of weight 0 is not read, and its statistics do not count.
            let left_out = self
                .weights
                .and_then(|w| w.get(set))
                .is_some_and(|w| *w == 0.0);
            if left_out {
                start..start
            } else {
                start - clips..start
            }
        };
        self.sets.iter().enumerate().map(range).collect()
    }

    /// The order of a run, of data sets with so many signals.
    pub(super) fn epochs(
        &self,
        epochs: Epochs,
        signals: &[usize],
    ) -> Result<Epochs, TrainingError> {
        let Some(weights) = self.weights else {
            return Ok(epochs);
        };
        let names: Vec<&str> = self.sets.iter().map(|(name, _)| *name).collect();
        epochs.weighted(&names, signals, weights)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_never_drawn_is_not_read() {
        assert_eq!(
            Mixture::default().ranges(7),
            std::iter::once(0..7).collect::<Vec<_>>()
        );
        let sets = [("a", 3), ("b", 2), ("c", 2)];
        let weighted = |weights| Mixture {
            sets: &sets,
            weights,
        };
        assert_eq!(weighted(None).ranges(7), [0..3, 3..5, 5..7]);
        let weights = weighted(Some(&[1.0, 0.0, 2.0])).ranges(7);
        assert_eq!(weights, [0..3, 5..5, 5..7]);
    }
}
