//! [`ClipSource`]: a named list of clips, whatever they are made from: recordings, videos, the synthetic world, shards.

use crate::clip::Clip;
use crate::formats::ReadError;
use crate::modality::ClipFormat;
use std::collections::BTreeMap;
use std::ops::Range;

/// A named list of clips, made on request.
///
/// Clips are numbered `0..len()`. The same index gives the same clip, whichever thread asks and whatever was asked before, and
/// memory does not grow with the number of clips that were made.
pub trait ClipSource: Send + Sync {
    /// The data set: `world`, `adt`, `hot3d_aria`, ... It is [`Clip::source`] of every clip.
    fn name(&self) -> &str;

    /// How many clips there are, those that [`ClipSource::clip`] drops included.
    fn len(&self) -> usize;

    /// Whether there is no clip, not even one that [`ClipSource::clip`] would drop.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The modalities a clip of this source can have, by registry name, in the order of
    /// `rgb depth camera gaze left_hand right_hand body`. A single clip may lack some of them.
    fn modalities(&self) -> Vec<String>;

    /// The sizes of its clips, where they are known without looking at one.
    fn format(&self) -> Option<ClipFormat> {
        None
    }

    /// Stretches of time that belong together, by name, in the order of their clips: what is divided into splits.
    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        vec![(self.name().to_owned(), 0..self.len())]
    }

    /// For which split each recording is meant by whoever published it, where they say so: `train`, `validation` or `test`.
    fn splits(&self) -> BTreeMap<String, &'static str> {
        BTreeMap::new()
    }

    /// Recordings that are here and give no clips, each with the reason.
    fn excluded(&self) -> Vec<Excluded> {
        Vec::new()
    }

    /// What is absent and what to supply for it, one sentence each, with the number of recordings it holds for.
    fn notes(&self) -> Vec<(String, usize)> {
        Vec::new()
    }

    /// Which decoders read its videos, each with the number of recordings.
    fn decoders(&self) -> Vec<(String, usize)> {
        Vec::new()
    }

    /// Signals that the recording of clip number `index` has and the clip goes without, each with the reason: `body: ...`.
    fn lost(&self, index: usize) -> Vec<String> {
        let _ = index;
        Vec::new()
    }

    /// Makes clip number `index`.
    ///
    /// # Errors
    /// When a file cannot be read or is malformed, or `index >= len()`.
    fn clip(&self, index: usize) -> Result<Outcome, ReadError>;

    /// Makes clip number `index` with at least these modalities, as far as it has them; others may be left out.
    ///
    /// # Errors
    /// As [`ClipSource::clip`].
    fn clip_with(&self, index: usize, _modalities: &[&str]) -> Result<Outcome, ReadError> {
        self.clip(index)
    }

    /// Whether clip number `index` may have a modality: false only where that is known without making it.
    fn may_have(&self, _index: usize, _modality: &str) -> bool {
        true
    }
}

/// A recording that gives no clips.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Excluded {
    /// Its name within the data set.
    pub recording: String,
    /// One sentence that names the file.
    pub reason: String,
}

/// What became of one clip.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// Here it is.
    Clip(Box<Clip>),
    /// The recording does not allow this clip; whoever iterates counts it.
    Dropped {
        /// The id the clip would have had.
        id: String,
        /// Why the recording does not allow it.
        reason: DropReason,
    },
}

impl Outcome {
    /// The clip, if it was not dropped.
    #[must_use]
    pub fn into_clip(self) -> Option<Clip> {
        match self {
            Outcome::Clip(clip) => Some(*clip),
            Outcome::Dropped { .. } => None,
        }
    }
}

/// Why a clip was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DropReason {
    /// No colour frame within tolerance of a tick has a depth frame within 10 ms.
    DepthApart,
    /// The colour video has a hole at a tick.
    VideoGap,
    /// Not one valid sample of camera, gaze, hands or body in the window.
    NothingValid,
}

impl DropReason {
    /// For reports: `depth more than 10 ms from colour`.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            DropReason::DepthApart => "depth more than 10 ms from colour",
            DropReason::VideoGap => "a gap in the video",
            DropReason::NothingValid => "no valid signal",
        }
    }
}

/// All clips of a source in order, made one at a time.
pub fn clips<S: ClipSource + ?Sized>(source: &S) -> Clips<'_, S> {
    Clips { source, next: 0 }
}

/// Iterator of [`clips`].
#[derive(Debug)]
pub struct Clips<'a, S: ClipSource + ?Sized> {
    source: &'a S,
    next: usize,
}

impl<S: ClipSource + ?Sized> Iterator for Clips<'_, S> {
    type Item = Result<Outcome, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.next >= self.source.len() {
            return None;
        }
        self.next += 1;
        Some(self.source.clip(self.next - 1))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.source.len() - self.next;
        (left, Some(left))
    }
}
