//! A source into shards: clips are made on all cores, resumable, and with memory that depends on the number of threads only.
//!
//! Clips are grouped by index, so that a shard's content does not depend on how many threads work or on where an earlier attempt
//! stopped. A shard that is there is not made again. How shards lie on disk is the [`ShardSink`]'s affair.

use super::pipeline::in_order;
use super::{ClipSource, DropReason, Outcome, ReadError};
use crate::clip::Clip;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::ControlFlow;

/// How to convert.
#[derive(
    Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(deny_unknown_fields, default)]
pub struct ConvertSettings {
    /// Indices per shard; dropped clips leave their shard smaller.
    pub clips_per_shard: usize,
    /// Leave out clips whose files are damaged instead of stopping at the first one; they are counted and named.
    pub skip_damaged: bool,
}

impl Default for ConvertSettings {
    fn default() -> Self {
        ConvertSettings {
            clips_per_shard: 100,
            skip_damaged: false,
        }
    }
}

/// The part of one of several processes that share a conversion: each makes every `of`-th shard, so that all of them end at about
/// the same time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Share {
    /// From 0.
    index: usize,
    of: usize,
}

impl Share {
    /// Everything.
    pub const WHOLE: Share = Share { index: 0, of: 1 };

    /// Part `index`, from 0, of `of`; everything where there are none.
    #[must_use]
    pub fn new(index: usize, of: usize) -> Self {
        match of {
            0 => Self::WHOLE,
            _ => Share {
                index: index % of,
                of,
            },
        }
    }

    /// Whether a shard belongs to this part.
    #[must_use]
    pub fn has(self, shard: usize) -> bool {
        shard % self.of == self.index
    }
}

impl std::str::FromStr for Share {
    type Err = String;

    /// `2/8` is the second of eight.
    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/');
        let parts = parts.and_then(|(index, of)| Some((index.parse().ok()?, of.parse().ok()?)));
        match parts {
            Some((index, of)) if (1..=of).contains(&index) => Ok(Share {
                index: index - 1,
                of,
            }),
            _ => Err("not a part such as 1/8, 2/8 ... 8/8".to_owned()),
        }
    }
}

/// What became of all clips, once every shard of a conversion is finished, whichever process made it.
#[must_use]
pub fn whole(clips: usize, sink: &dyn ShardSink, settings: &ConvertSettings) -> Option<Tally> {
    let mut tally = Tally::default();
    for shard in 0..clips.div_ceil(settings.clips_per_shard.max(1)) {
        tally.add(&sink.finished(shard)?);
    }
    Some(tally)
}

/// Where shards go.
pub trait ShardSink {
    /// What a finished shard of an earlier attempt holds; `None` when it has to be made.
    fn finished(&self, shard: usize) -> Option<Tally>;
    /// Writes one shard from its clips, so that it is there completely or not at all, together with the tally that
    /// `tally` returns when the clips have been taken.
    ///
    /// # Errors
    /// Those of the clips, and its own.
    fn write(
        &self,
        shard: usize,
        clips: &mut dyn Iterator<Item = Result<Clip, ReadError>>,
        tally: &dyn Fn() -> Tally,
    ) -> Result<(), ReadError>;
}

/// What became of some clips.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tally {
    /// Clips written.
    pub clips: usize,
    /// Clips dropped, by reason.
    pub dropped: BTreeMap<String, usize>,
    /// Damaged clips that were left out: the error of each.
    pub damaged: Vec<String>,
    /// Clips that go without a signal that their recording has, by signal and reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub lost: BTreeMap<String, usize>,
    /// Recordings that could not be opened: the error of each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub excluded: Vec<String>,
}

impl Tally {
    /// Counts a dropped clip.
    pub(super) fn drop(&mut self, reason: DropReason) {
        *self.dropped.entry(reason.text().to_owned()).or_default() += 1;
    }

    /// Counts the signals that a clip goes without.
    pub(super) fn lose(&mut self, signals: Vec<String>) {
        for signal in signals {
            *self.lost.entry(signal).or_default() += 1;
        }
    }

    /// What became of clips beside those that are whole, one sentence each.
    #[must_use]
    pub fn remarks(&self) -> Vec<String> {
        let dropped = self.dropped.iter();
        let dropped = dropped.map(|(reason, count)| format!("{count} clips dropped: {reason}"));
        let lost = self.lost.iter();
        let lost = lost.map(|(reason, count)| format!("{count} clips without {reason}"));
        let damaged = self
            .damaged
            .iter()
            .map(|error| format!("left out: {error}"));
        dropped.chain(lost).chain(damaged).collect()
    }

    /// Adds another one.
    pub fn add(&mut self, other: &Tally) {
        self.clips += other.clips;
        for (reason, count) in &other.dropped {
            *self.dropped.entry(reason.clone()).or_default() += count;
        }
        self.damaged.extend(other.damaged.iter().cloned());
        for (signal, count) in &other.lost {
            *self.lost.entry(signal.clone()).or_default() += count;
        }
        self.excluded.extend(other.excluded.iter().cloned());
    }
}

/// How far a conversion is; handed to the caller after every clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    /// Indices that are done, those of finished shards included.
    pub done: usize,
    /// Indices of this process's share, dropped clips included.
    pub total: usize,
}

/// The result of a conversion.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Converted {
    /// Shards of this process's share; where it was interrupted, those not made yet count too.
    pub shards: usize,
    /// Shards that an earlier attempt had made.
    pub reused: usize,
    /// What became of the clips of the finished shards, reused ones included.
    pub tally: Tally,
    /// It was asked to stop before the end; calling again goes on.
    pub interrupted: bool,
}

/// Converts the clips of `source` that fall into this process's share. `watch` hears of every clip on the calling thread and may stop the work.
///
/// # Errors
/// The first one met; shards that are finished stay, and calling again goes on from there.
pub fn convert(
    source: &dyn ClipSource,
    sink: &dyn ShardSink,
    settings: &ConvertSettings,
    share: Share,
    watch: &mut dyn FnMut(&Progress) -> ControlFlow<()>,
) -> Result<Converted, ReadError> {
    if settings.clips_per_shard == 0 {
        return Err(ReadError::Settings("`clips_per_shard` is 0".to_owned()));
    }
    let clips = source.len();
    let shards: Vec<usize> = (0..clips.div_ceil(settings.clips_per_shard))
        .filter(|shard| share.has(*shard))
        .collect();
    let range = |shard: usize| {
        let first = shard * settings.clips_per_shard;
        first..(first + settings.clips_per_shard).min(clips)
    };
    let total = shards.iter().map(|shard| range(*shard).len()).sum();
    let finished: Vec<Option<Tally>> = shards.iter().map(|shard| sink.finished(*shard)).collect();
    let todo: Vec<usize> = shards
        .iter()
        .zip(&finished)
        .filter(|(_, finished)| finished.is_none())
        .flat_map(|(shard, _)| range(*shard))
        .collect();
    let threads = rayon::current_num_threads();
    in_order(
        todo.len(),
        threads,
        |position| {
            let outcome = source.clip(todo[position]);
            let lost = match &outcome {
                Ok(Outcome::Clip(_)) => source.lost(todo[position]),
                _ => Vec::new(),
            };
            (outcome, lost)
        },
        |outcomes| {
            let mut converted = Converted {
                shards: shards.len(),
                reused: 0,
                tally: Tally::default(),
                interrupted: false,
            };
            let mut done = 0;
            for (&shard, finished) in shards.iter().zip(&finished) {
                let count = range(shard).len();
                if let Some(tally) = finished {
                    done += count;
                    converted.reused += 1;
                    converted.tally.add(tally);
                    converted.interrupted =
                        watch(&Progress { done, total }).is_break() && done < total;
                } else {
                    let mut clips = Shard {
                        outcomes: &mut *outcomes,
                        left: count,
                        skip_damaged: settings.skip_damaged,
                        tally: &RefCell::default(),
                        interrupted: false,
                        watch: &mut *watch,
                        progress: Progress { done, total },
                    };
                    let tally = clips.tally;
                    let written = sink.write(shard, &mut clips, &|| tally.borrow().clone());
                    (done, converted.interrupted) = (clips.progress.done, clips.interrupted);
                    // An interrupted shard is not there, whatever the sink says of it.
                    if !converted.interrupted {
                        written?;
                        converted.tally.add(&tally.borrow());
                    }
                }
                if converted.interrupted {
                    break;
                }
            }
            Ok(converted)
        },
    )
}

/// A clip, and the signals that it goes without.
type Made = (Result<Outcome, ReadError>, Vec<String>);

/// The clips of one shard as they come.
struct Shard<'a, 'b, I: Iterator<Item = Made>> {
    outcomes: &'a mut I,
    left: usize,
    skip_damaged: bool,
    tally: &'b RefCell<Tally>,
    interrupted: bool,
    watch: &'a mut dyn FnMut(&Progress) -> ControlFlow<()>,
    progress: Progress,
}

impl<I: Iterator<Item = Made>> Iterator for Shard<'_, '_, I> {
    type Item = Result<Clip, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.left > 0 && !self.interrupted {
            self.left -= 1;
            let (outcome, lost) = self.outcomes.next()?;
            self.progress.done += 1;
            if (self.watch)(&self.progress).is_break() && self.progress.done < self.progress.total {
                self.interrupted = true;
                return Some(Err(ReadError::Settings("interrupted".to_owned())));
            }
            let mut tally = self.tally.borrow_mut();
            match outcome {
                Ok(Outcome::Clip(clip)) => {
                    tally.clips += 1;
                    tally.lose(lost);
                    return Some(Ok(*clip));
                }
                Ok(Outcome::Dropped { reason, .. }) => tally.drop(reason),
                Err(error) if self.skip_damaged => tally.damaged.push(error.to_string()),
                Err(error) => return Some(Err(error)),
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    struct Numbers;

    impl ClipSource for Numbers {
        fn name(&self) -> &'static str {
            "numbers"
        }
        fn len(&self) -> usize {
            25
        }
        fn modalities(&self) -> Vec<String> {
            Vec::new()
        }
        fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
            if index == 13 {
                return Err(ReadError::Settings("clip 13 is damaged".to_owned()));
            }
            if index % 5 == 4 {
                return Ok(Outcome::Dropped {
                    id: index.to_string(),
                    reason: DropReason::DepthApart,
                });
            }
            Ok(Outcome::Clip(Box::new(Clip::empty(
                index.to_string(),
                "numbers",
            ))))
        }
    }

    #[derive(Default)]
    struct Memory(Mutex<BTreeMap<usize, (Vec<String>, Tally)>>);

    impl ShardSink for Memory {
        fn finished(&self, shard: usize) -> Option<Tally> {
            self.0
                .lock()
                .unwrap()
                .get(&shard)
                .map(|(_, tally)| tally.clone())
        }
        fn write(
            &self,
            shard: usize,
            clips: &mut dyn Iterator<Item = Result<Clip, ReadError>>,
            tally: &dyn Fn() -> Tally,
        ) -> Result<(), ReadError> {
            let ids = clips
                .map(|clip| clip.map(|clip| clip.id))
                .collect::<Result<_, _>>()?;
            self.0.lock().unwrap().insert(shard, (ids, tally()));
            Ok(())
        }
    }

    #[test]
    fn shards_hold_their_indices_and_everything_dropped_is_counted() {
        let sink = Memory::default();
        let settings = ConvertSettings {
            clips_per_shard: 10,
            skip_damaged: true,
        };
        let mut seen = 0;
        let converted = convert(&Numbers, &sink, &settings, Share::WHOLE, &mut |progress| {
            assert_eq!((progress.total, progress.done), (25, seen + 1));
            seen = progress.done;
            ControlFlow::Continue(())
        })
        .unwrap();
        assert_eq!(
            (converted.shards, converted.reused, converted.interrupted),
            (3, 0, false)
        );
        assert_eq!(converted.tally.clips, 19);
        assert_eq!(
            converted.tally.dropped["depth more than 10 ms from colour"],
            5
        );
        assert_eq!(converted.tally.damaged, ["clip 13 is damaged"]);
        assert_eq!(seen, 25);
        assert_eq!(sink.0.lock().unwrap()[&2].0, ["20", "21", "22", "23"]);
        // Again: everything is there already, and the sums are the same.
        sink.0.lock().unwrap().remove(&1);
        let go = &mut |_: &Progress| ControlFlow::Continue(());
        let again = convert(&Numbers, &sink, &settings, Share::WHOLE, go).unwrap();
        assert_eq!((again.reused, &again.tally.clips), (2, &19));
        assert_eq!(again.tally.dropped, converted.tally.dropped);
    }

    #[test]
    fn a_damaged_clip_stops_the_conversion_unless_it_may_be_skipped() {
        let result = convert(
            &Numbers,
            &Memory::default(),
            &ConvertSettings::default(),
            Share::WHOLE,
            &mut |_| ControlFlow::Continue(()),
        );
        assert!(result.unwrap_err().to_string().contains("13"));
    }

    #[test]
    fn an_interrupt_leaves_only_whole_shards() {
        let sink = Memory::default();
        let settings = ConvertSettings {
            clips_per_shard: 5,
            skip_damaged: true,
        };
        let mut stop = |progress: &Progress| {
            if progress.done >= 7 {
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        };
        let converted = convert(&Numbers, &sink, &settings, Share::WHOLE, &mut stop).unwrap();
        assert!(converted.interrupted);
        for (ids, tally) in sink.0.lock().unwrap().values() {
            assert_eq!(ids.len(), tally.clips);
            assert!(ids.len() >= 3);
        }
        assert_eq!(sink.0.lock().unwrap().len(), 1);
        let go = &mut |_: &Progress| ControlFlow::Continue(());
        let rest = convert(&Numbers, &sink, &settings, Share::WHOLE, go).unwrap();
        assert_eq!(
            (rest.interrupted, rest.tally.clips, rest.reused),
            (false, 19, 1)
        );
    }

    #[test]
    fn a_stop_that_comes_when_everything_is_there_interrupts_nothing() {
        let sink = Memory::default();
        let settings = ConvertSettings {
            clips_per_shard: 10,
            skip_damaged: true,
        };
        let go = &mut |_: &Progress| ControlFlow::Continue(());
        convert(&Numbers, &sink, &settings, Share::WHOLE, go).unwrap();
        let stop = &mut |progress: &Progress| match progress.done {
            25 => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        };
        // The last shard is reused, and then made again.
        for reused in [3, 2] {
            let again = convert(&Numbers, &sink, &settings, Share::WHOLE, stop).unwrap();
            assert_eq!(
                (again.interrupted, again.reused, again.tally.clips),
                (false, reused, 19)
            );
            sink.0.lock().unwrap().remove(&2);
        }
    }

    #[test]
    fn shares_make_each_shard_once_and_together_everything() {
        let (sink, alone) = (Memory::default(), Memory::default());
        let settings = ConvertSettings {
            clips_per_shard: 4,
            skip_damaged: true,
        };
        let go = &mut |_: &Progress| ControlFlow::Continue(());
        let all = convert(&Numbers, &alone, &settings, Share::WHOLE, go).unwrap();
        let mut made = 0;
        for part in ["3/3", "1/3", "2/3"] {
            assert_eq!(whole(25, &sink, &settings), None);
            let part = convert(&Numbers, &sink, &settings, part.parse().unwrap(), go).unwrap();
            assert_eq!(part.reused, 0);
            made += part.shards;
        }
        assert_eq!(made, all.shards);
        assert_eq!(whole(25, &sink, &settings), Some(all.tally));
        assert_eq!(*sink.0.lock().unwrap(), *alone.0.lock().unwrap());
        for wrong in ["0/3", "4/3", "1", "a/b", "1/0"] {
            assert!(wrong.parse::<Share>().is_err(), "{wrong}");
        }
    }
}
