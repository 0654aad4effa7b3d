//! A source into shards: in parallel, resumable, and with memory that depends on the number of threads only.
//!
//! Clips are grouped by index, so that a shard's content does not depend on how many threads work or on where an earlier attempt
//! stopped. A shard that is there is not made again. How shards lie on disk is the [`ShardSink`]'s affair.

use super::{DropReason, Outcome, Source, SourceError};
use crate::clip::Clip;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

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

/// Where shards go.
pub trait ShardSink: Sync {
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
        clips: &mut dyn Iterator<Item = Result<Clip, SourceError>>,
        tally: &dyn Fn() -> Tally,
    ) -> Result<(), SourceError>;
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
}

impl Tally {
    fn drop(&mut self, reason: DropReason) {
        *self.dropped.entry(reason.text().to_owned()).or_default() += 1;
    }

    /// Adds another one.
    pub fn add(&mut self, other: &Tally) {
        self.clips += other.clips;
        for (reason, count) in &other.dropped {
            *self.dropped.entry(reason.clone()).or_default() += count;
        }
        self.damaged.extend(other.damaged.iter().cloned());
    }
}

/// How far a conversion is; handed to the caller after every clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    /// Indices that are done, those of finished shards included.
    pub done: usize,
    pub total: usize,
}

/// The result of a conversion.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Converted {
    pub shards: usize,
    /// Shards that an earlier attempt had made.
    pub reused: usize,
    pub tally: Tally,
    /// It was asked to stop before the end; calling again goes on.
    pub interrupted: bool,
}

/// Converts all clips of `source`.
///
/// # Errors
/// The first one met; shards that are finished stay, and calling again goes on from there.
pub fn convert(
    source: &dyn Source,
    sink: &dyn ShardSink,
    settings: &ConvertSettings,
    interrupt: &AtomicBool,
    progress: &(dyn Fn(&Progress) + Sync),
) -> Result<Converted, SourceError> {
    if settings.clips_per_shard == 0 {
        return Err(SourceError::Settings("`clips_per_shard` is 0".to_owned()));
    }
    let total = source.len();
    let shards = total.div_ceil(settings.clips_per_shard);
    let done = Mutex::new(0_usize);
    let advance = |count: usize| {
        let mut done = done
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        *done += count;
        progress(&Progress { done: *done, total });
    };
    // `None` for shards that were not begun because of an interrupt.
    let tallies: Vec<Option<(Tally, bool)>> = (0..shards)
        .into_par_iter()
        .map(|shard| {
            let first = shard * settings.clips_per_shard;
            let last = (first + settings.clips_per_shard).min(total);
            if let Some(tally) = sink.finished(shard) {
                advance(last - first);
                return Ok(Some((tally, true)));
            }
            if interrupt.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let tally = Mutex::new(Tally::default());
            let edit = |change: &dyn Fn(&mut Tally)| {
                let mut tally = tally
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner);
                change(&mut tally);
            };
            let stopped = AtomicBool::new(false);
            let mut clips = (first..last).filter_map(|index| {
                if stopped.load(Ordering::Relaxed) {
                    return None;
                }
                if interrupt.load(Ordering::Relaxed) {
                    stopped.store(true, Ordering::Relaxed);
                    return Some(Err(SourceError::Settings("interrupted".to_owned())));
                }
                let outcome = source.clip(index);
                advance(1);
                match outcome {
                    Ok(Outcome::Clip(clip)) => {
                        edit(&|tally| tally.clips += 1);
                        Some(Ok(*clip))
                    }
                    Ok(Outcome::Dropped { reason, .. }) => {
                        edit(&|tally| tally.drop(reason));
                        None
                    }
                    Err(error) if settings.skip_damaged => {
                        edit(&|tally| tally.damaged.push(error.to_string()));
                        None
                    }
                    Err(error) => Some(Err(error)),
                }
            });
            let snapshot = || {
                tally
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner)
                    .clone()
            };
            let written = sink.write(shard, &mut clips, &snapshot);
            if stopped.load(Ordering::Relaxed) {
                return Ok(None);
            }
            written?;
            Ok(Some((snapshot(), false)))
        })
        .collect::<Result<_, SourceError>>()?;
    let mut converted = Converted {
        shards,
        reused: 0,
        tally: Tally::default(),
        interrupted: false,
    };
    for entry in &tallies {
        match entry {
            Some((tally, reused)) => {
                converted.tally.add(tally);
                converted.reused += usize::from(*reused);
            }
            None => converted.interrupted = true,
        }
    }
    Ok(converted)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Numbers;

    impl Source for Numbers {
        fn name(&self) -> &'static str {
            "numbers"
        }
        fn len(&self) -> usize {
            25
        }
        fn modalities(&self) -> Vec<String> {
            Vec::new()
        }
        fn clip(&self, index: usize) -> Result<Outcome, SourceError> {
            if index == 13 {
                return Err(SourceError::Settings("clip 13 is damaged".to_owned()));
            }
            if index % 5 == 4 {
                return Ok(Outcome::Dropped {
                    id: index.to_string(),
                    reason: DropReason::DepthApart,
                });
            }
            Ok(Outcome::Clip(Box::new(Clip {
                id: index.to_string(),
                source: "numbers".to_owned(),
                rgb: None,
                depth: None,
                camera: None,
                gaze: None,
                left_hand: None,
                right_hand: None,
                body: None,
                declared: BTreeMap::new(),
            })))
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
            clips: &mut dyn Iterator<Item = Result<Clip, SourceError>>,
            tally: &dyn Fn() -> Tally,
        ) -> Result<(), SourceError> {
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
        let go = AtomicBool::new(false);
        let seen = Mutex::new(0);
        let watch = |progress: &Progress| {
            assert_eq!(progress.total, 25);
            *seen.lock().unwrap() = progress.done;
        };
        let converted = convert(&Numbers, &sink, &settings, &go, &watch).unwrap();
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
        assert_eq!(*seen.lock().unwrap(), 25);
        assert_eq!(sink.0.lock().unwrap()[&2].0, ["20", "21", "22", "23"]);
        // Again: everything is there already, and the sums are the same.
        sink.0.lock().unwrap().remove(&1);
        let again = convert(&Numbers, &sink, &settings, &go, &watch).unwrap();
        assert_eq!((again.reused, &again.tally.clips), (2, &19));
        assert_eq!(again.tally.dropped, converted.tally.dropped);
    }

    #[test]
    fn a_damaged_clip_stops_the_conversion_unless_it_may_be_skipped() {
        let result = convert(
            &Numbers,
            &Memory::default(),
            &ConvertSettings::default(),
            &AtomicBool::new(false),
            &|_| {},
        );
        assert!(result.unwrap_err().to_string().contains("13"));
    }

    #[test]
    fn an_interrupt_leaves_only_whole_shards() {
        let sink = Memory::default();
        let stop = AtomicBool::new(false);
        let settings = ConvertSettings {
            clips_per_shard: 5,
            skip_damaged: true,
        };
        let converted = convert(&Numbers, &sink, &settings, &stop, &|progress| {
            if progress.done >= 7 {
                stop.store(true, Ordering::Relaxed);
            }
        })
        .unwrap();
        assert!(converted.interrupted);
        for (ids, tally) in sink.0.lock().unwrap().values() {
            assert_eq!(ids.len(), tally.clips);
            assert!(ids.len() >= 3);
        }
        stop.store(false, Ordering::Relaxed);
        let rest = convert(&Numbers, &sink, &settings, &stop, &|_| {}).unwrap();
        assert_eq!((rest.interrupted, rest.tally.clips), (false, 19));
    }
}
