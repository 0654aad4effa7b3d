//! Who of the ranks keeps which trainable numbers of a model: its share of the optimizer's state (ZeRO stage 1).
//!
//! All trainable numbers, parameter after parameter in the order of names, are cut into as many equal stretches as there are ranks.
//! A stretch begins and ends anywhere in a parameter, so that shares are even however large a table is.

use super::reduce::BUCKET;
use super::{Communicator, RankError};
use crate::engine::Parameters;
use std::collections::BTreeMap;
use std::ops::Range;

/// This rank's stretch, and where every parameter lies.
#[derive(Debug, Clone)]
pub struct Shard {
    ranks: Communicator,
    /// By name: from where to where, counted over all.
    places: BTreeMap<String, Range<usize>>,
    /// Numbers of one rank's stretch, rounded up.
    stretch: usize,
}

impl Shard {
    /// The stretches of `model`; `None` where there is one rank, which keeps everything.
    #[must_use]
    pub fn of<M: Parameters + ?Sized>(ranks: &Communicator, model: &M) -> Option<Self> {
        if ranks.size() < 2 {
            return None;
        }
        let mut lengths = BTreeMap::new();
        model.visit("", &mut |name, parameter| {
            if parameter.kind() == crate::engine::parameters::Kind::Trainable {
                lengths.insert(name.to_owned(), parameter.len());
            }
        });
        let mut end = 0;
        let places = lengths.into_iter().map(|(name, length)| {
            end += length;
            (name, end - length..end)
        });
        let places = places.collect();
        Some(Self {
            ranks: ranks.clone(),
            places,
            stretch: end.div_ceil(ranks.size()),
        })
    }

    /// Whether this is rank 0, which has what is put together.
    #[must_use]
    pub fn is_root(&self) -> bool {
        self.ranks.is_root()
    }

    /// How many numbers a stretch has, on every rank; the last one's may go beyond the end.
    #[must_use]
    pub fn stretch(&self) -> usize {
        self.stretch
    }

    /// The names, in order, each with how many numbers it has.
    pub fn names(&self) -> impl Iterator<Item = (&str, usize)> {
        let places = self.places.iter();
        places.map(|(name, place)| (name.as_str(), place.len()))
    }

    /// What of a parameter is this rank's, and where in its stretch that begins; `None` where nothing is.
    #[must_use]
    pub fn own(&self, name: &str) -> Option<(Range<usize>, usize)> {
        let place = self.places.get(name)?;
        let first = self.ranks.rank() * self.stretch;
        let start = place.start.max(first);
        let end = place.end.min(first + self.stretch);
        (start < end).then(|| (start - place.start..end - place.start, start - first))
    }

    /// Where the numbers of a parameter are among those of all.
    #[must_use]
    pub fn place(&self, name: &str) -> Option<Range<usize>> {
        self.places.get(name).cloned()
    }

    /// The stretches of all ranks, one after the other; empty on ranks that do not `keep` them. All ranks must be here.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn collect(&self, mine: &[f32], keep: bool) -> Result<Vec<f32>, RankError> {
        self.collect_in_pieces(mine, keep, BUCKET)
    }

    fn collect_in_pieces(
        &self,
        mine: &[f32],
        keep: bool,
        most: usize,
    ) -> Result<Vec<f32>, RankError> {
        let size = self.ranks.size();
        let mut all = vec![0.0; if keep { self.stretch * size } else { 0 }];
        let piece = (most / size).max(1);
        for (index, part) in mine.chunks(piece).enumerate() {
            // A bucket at a time: what a rank does not keep takes no memory.
            let Some(link) = &self.ranks.link else {
                break;
            };
            let received = link.collect(part.to_vec()).wait()?;
            if !keep {
                continue;
            }
            for (rank, part) in received.chunks_exact(part.len()).enumerate() {
                let start = rank * self.stretch + index * piece;
                all[start..start + part.len()].copy_from_slice(part);
            }
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::on_ranks;
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::nn::Linear;

    #[test]
    fn stretches_are_even_cover_every_number_once_and_come_together_in_order() {
        for size in 2..6 {
            let found = on_ranks(size, |ranks| {
                let model = Linear::new(&Initialise::new(&Compute::cpu(), 1), 5, 3, true);
                let shard = Shard::of(&ranks, &model).unwrap();
                assert_eq!(
                    shard.names().collect::<Vec<_>>(),
                    [("bias", 3), ("weight", 15)]
                );
                let mut mine = vec![-1.0; shard.stretch()];
                for (name, _) in shard.names() {
                    let Some((own, at)) = shard.own(name) else {
                        continue;
                    };
                    for i in 0..own.len() {
                        mine[at + i] = (shard.place(name).unwrap().start + own.start + i) as f32;
                    }
                }
                let own = mine.iter().filter(|value| **value >= 0.0).count();
                assert!(own <= 18_usize.div_ceil(size));
                let keep = ranks.is_root();
                let kept = shard.collect_in_pieces(&mine, keep, 7).unwrap();
                let all = shard.collect(&mine, true).unwrap();
                assert!(if keep { kept == all } else { kept.is_empty() });
                all
            });
            for all in found {
                let expected: Vec<f32> = (0..18_u8).map(f32::from).collect();
                assert_eq!(all[..18], expected, "{size} ranks");
                assert!(all[18..].iter().all(|padding| *padding == -1.0));
            }
        }
    }

    #[test]
    fn one_rank_keeps_everything() {
        let model = Linear::new(&Initialise::new(&Compute::cpu(), 1), 5, 3, true);
        assert!(Shard::of(&Communicator::alone(), &model).is_none());
    }
}
