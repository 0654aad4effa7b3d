//! Decoders that go on where another reader of the same file has stopped.

use super::Wanted;
use crate::video::h264::Pictures;
use std::sync::Arc;

/// A decoder in the middle of a file.
pub(super) struct Standing {
    pub pictures: Pictures,
    /// The sample it decodes next, and the rank from which on it has all pictures.
    pub next: usize,
    pub first_rank: u32,
}

impl Wanted {
    /// A decoder that stands behind `start` and before all wanted pictures, with what they may refer to.
    pub(super) fn standing(&self, start: usize) -> Option<Standing> {
        let samples = self.ranks.iter();
        let samples = samples.map(|(rank, _)| self.index.order[*rank as usize] as usize);
        let (first, lowest) = (samples.min()?, self.ranks.first()?.0);
        self.index.parked.take(|standing| {
            let fits = start < standing.next && standing.next <= first;
            (fits && standing.first_rank <= lowest).then_some(standing.next)
        })
    }
}

impl Drop for Wanted {
    fn drop(&mut self) {
        let begun = self.next > 0 && self.next < self.index.samples.len();
        if !begun || self.failed {
            return;
        }
        let none = Pictures::new(Arc::clone(&self.index.configurations));
        self.index.parked.park(Standing {
            pictures: std::mem::replace(&mut self.pictures, none),
            next: self.next,
            first_rank: self.first_rank,
        });
    }
}
