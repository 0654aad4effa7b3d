//! Which rank is lost: it has been silent, or all others have waited for it in a step.
//!
//! A function of what was heard and when; it looks at no clock and sends nothing.

use super::RankError;

/// What a rank says of itself, about once a second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Beat {
    /// How many times it has come to where all ranks meet.
    pub met: u64,
    /// Whether it is in a step.
    pub stepping: bool,
}

/// When each rank was heard last, and what it said. Times are seconds of one clock.
#[derive(Debug)]
pub struct Watch {
    patience: f64,
    heard: Vec<(f64, Beat)>,
    /// When each rank came to where it is now.
    since: Vec<f64>,
    looked: f64,
    /// The longest that ranks were apart in a step that came to its end.
    longest: f64,
}

impl Watch {
    /// A watch over `size` ranks that are silent or behind for at most `patience` seconds.
    #[must_use]
    pub fn new(size: usize, patience: f64, now: f64) -> Self {
        Self {
            patience,
            heard: vec![(now, Beat::default()); size],
            since: vec![now; size],
            looked: now,
            longest: 0.0,
        }
    }

    /// A rank was heard.
    pub fn hear(&mut self, rank: usize, beat: Beat, now: f64) {
        let (_, before) = self.heard[rank];
        if beat.met != before.met {
            let others = self.heard.iter().zip(&self.since);
            let there = others.filter(|((_, other), _)| other.met == beat.met);
            let first = there.map(|(_, since)| *since).reduce(f64::min);
            if let Some(first) = first.filter(|_| before.stepping) {
                self.longest = self.longest.max(now - first);
            }
            self.since[rank] = now;
        }
        self.heard[rank] = (now, beat);
    }

    /// Since when the first of the ranks is where it is.
    fn ahead(&self) -> Option<f64> {
        let most = self.heard.iter().map(|(_, beat)| beat.met).max()?;
        let first = self.heard.iter().zip(&self.since);
        let first = first.filter(|((_, beat), _)| beat.met == most);
        first.map(|(_, since)| *since).reduce(f64::min)
    }

    /// The rank that is lost, of those of `watched`, and why.
    pub fn lost(&mut self, watched: impl Iterator<Item = usize>, now: f64) -> Option<RankError> {
        let size = self.heard.len();
        if now - self.looked > self.patience / 2.0 {
            // This process itself was stopped for a while: it cannot have heard anyone.
            for (heard, _) in &mut self.heard {
                *heard = now;
            }
            self.since.fill(now);
        }
        self.looked = now;
        let most = self.heard.iter().map(|(_, beat)| beat.met).max()?;
        let ahead = self.ahead()?;
        // Steps of ranks take about as long as each other, whatever they take.
        let apart = self.patience.max(4.0 * self.longest);
        for rank in watched {
            let (heard, beat) = self.heard[rank];
            let reason = if now - heard > self.patience {
                format!("it has been silent for {:.0} s", now - heard)
            } else if beat.stepping && beat.met < most && now - ahead > apart {
                format!(
                    "the others have waited for it in a step for {:.0} s",
                    now - ahead
                )
            } else {
                continue;
            };
            return Some(RankError {
                rank,
                size,
                host: String::new(),
                reason,
            });
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn beat(met: u64, stepping: bool) -> Beat {
        Beat { met, stepping }
    }

    /// Looks every second from `from` to `to`, everyone in `heard` saying the same each time.
    fn look(watch: &mut Watch, from: u32, to: u32, heard: &[(usize, Beat)]) -> Option<String> {
        (from..to).find_map(|now| {
            let now = f64::from(now);
            for (rank, beat) in heard {
                watch.hear(*rank, *beat, now);
            }
            watch.lost(0..3, now).map(|error| error.to_string())
        })
    }

    #[test]
    fn a_silent_rank_is_named() {
        let mut watch = Watch::new(3, 20.0, 0.0);
        let heard = [(0, beat(1, false)), (2, beat(1, false))];
        let found = look(&mut watch, 0, 40, &heard).unwrap();
        assert_eq!(found, "rank 1 of 3: it has been silent for 21 s");
    }

    #[test]
    fn a_rank_that_does_not_come_to_the_end_of_its_step_is_named() {
        let mut watch = Watch::new(3, 20.0, 0.0);
        let heard = [(0, beat(5, true)), (1, beat(5, true)), (2, beat(4, true))];
        let found = look(&mut watch, 0, 40, &heard).unwrap();
        assert!(
            found.starts_with("rank 2 of 3: the others have waited"),
            "{found}"
        );
    }

    #[test]
    fn ranks_that_wait_for_work_may_wait_and_long_steps_may_be_long() {
        let mut watch = Watch::new(3, 20.0, 0.0);
        // Rank 0 does a stage that is its alone.
        let alone = [
            (0, beat(4, false)),
            (1, beat(5, false)),
            (2, beat(5, false)),
        ];
        assert_eq!(look(&mut watch, 0, 500, &alone), None);
        // All are in one step.
        let step = [(0, beat(5, true)), (1, beat(5, true)), (2, beat(5, true))];
        assert_eq!(look(&mut watch, 500, 900, &step), None);
    }

    #[test]
    fn a_process_that_slept_blames_nobody() {
        let mut watch = Watch::new(3, 20.0, 0.0);
        let heard = [0, 1, 2].map(|rank| (rank, beat(1, true)));
        assert_eq!(look(&mut watch, 0, 5, &heard), None);
        assert_eq!(watch.lost(0..3, 500.0), None);
        assert!(watch.lost(0..3, 505.0).is_none());
    }
}
