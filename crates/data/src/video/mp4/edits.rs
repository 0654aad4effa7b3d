//! Edit lists: which samples are shown, and when.
//!
//! Frames are chosen as `ffmpeg` chooses them: a sample belongs to a segment when its presentation time lies in
//! `[media_time, media_time + duration)`; empty segments move what follows.

use super::Track;

/// One segment of an edit list.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Edit {
    /// In ticks of the movie; 0 in the last segment means to the end.
    pub duration: u64,
    /// First tick of the media; -1 where nothing is shown.
    pub media_time: i64,
    /// 16.16 fixed point.
    pub rate: i32,
}

/// A sample that is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// Decoding position.
    pub sample: u32,
    /// Ticks of the media's time scale from the start of the presentation.
    pub time: i64,
}

/// A presentation may repeat its media, but not without end.
const MOST_REPEATS: usize = 64;

impl Track {
    /// Every frame that is shown, in order.
    ///
    /// # Errors
    /// Why the edit list is not understood, or shows nothing.
    pub fn presentation(&self) -> Result<Vec<Shown>, String> {
        let mut order: Vec<Shown> = (0..self.samples.len() as u32)
            .filter(|&sample| self.samples[sample as usize].size > 0)
            .map(|sample| Shown {
                sample,
                time: self.samples[sample as usize].time,
            })
            .collect();
        order.sort_by_key(|shown| (shown.time, shown.sample));
        let most = order.len().saturating_mul(MOST_REPEATS);
        let mut shown = Vec::with_capacity(order.len());
        let mut clock = 0_i64;
        for edit in &self.edits {
            let length = self.media_ticks(edit.duration);
            if edit.media_time == -1 {
                clock = clock.saturating_add(length);
                continue;
            }
            if edit.media_time < 0 {
                return Err("an edit list that starts before its media".to_owned());
            }
            if edit.rate != 0x0001_0000 {
                return Err("an edit list that changes the speed".to_owned());
            }
            // Fragments follow later than the edit list was written: its length says nothing about them.
            let open = self.fragmented || edit.duration == 0;
            let end = if open {
                i64::MAX
            } else {
                edit.media_time.saturating_add(length)
            };
            let first = order.partition_point(|shown| shown.time < edit.media_time);
            let last = order.partition_point(|shown| shown.time < end);
            if shown.len() + last.saturating_sub(first) > most {
                return Err("an edit list that repeats its media without end".to_owned());
            }
            shown.extend(order[first..last.max(first)].iter().map(|one| Shown {
                time: clock.saturating_add(one.time - edit.media_time),
                ..*one
            }));
            clock = clock.saturating_add(length);
        }
        if !self.edits.iter().any(|edit| edit.media_time != -1) {
            shown = order;
        }
        if shown.is_empty() {
            return Err("an edit list that hides every frame".to_owned());
        }
        Ok(shown)
    }

    /// Ticks of the movie as ticks of the media, rounded to the nearest.
    fn media_ticks(&self, ticks: u64) -> i64 {
        let scale = u128::from(self.movie_timescale.max(1));
        let scaled = (u128::from(ticks) * u128::from(self.timescale) + scale / 2) / scale;
        i64::try_from(scaled).unwrap_or(i64::MAX).min(i64::MAX / 4)
    }
}
