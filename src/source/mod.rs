//! Where clips come from: videos, recordings, data sets and the built-in synthetic world (Sec. 3, Table 1).
//!
//! Everything is a [`Source`]: a named list of clips that are made when they are asked for, by index, from any thread. Read in
//! this order:
//!
//! * [`error`]: what can be wrong with a file, always with the place in it
//! * [`video`]: mp4, folders of pictures, and anything the user's `ffmpeg` can read; [`image`]: the resize of every clip
//! * [`recording`]: how a recording is cut into clips, once for all data sets; [`track`]: signals with clocks of their own
//! * [`aria`]: recordings of Project Aria glasses; [`umetrack`]: hands from joint angles
//! * one file per data set: [`adt`], [`hot3d`], [`mps`], [`neutral`] (the folder format that any data set can be written
//!   as), [`egom2p`] (the ancestors' layout)
//! * [`world`]: the built-in synthetic world
//! * [`dataset`] (many recordings), [`open`] (whatever a path holds), [`split`] (for training, for the test),
//!   [`convert`] into [`shards`], which are a source again, [`survey`] (a look at what is there)
//!
//! A further data set is one file that fills a [`recording::Recording`], and one line in [`open::Dataset`].

pub mod adt;
pub mod aria;
pub mod coded;
pub mod convert;
pub mod csv;
pub mod cut;
pub mod dataset;
mod declared;
pub mod egom2p;
pub mod error;
pub mod hot3d;
pub mod image;
pub mod mps;
pub mod neutral;
pub mod open;
mod pipeline;
pub mod recording;
mod resize;
pub mod shards;
pub mod split;
pub mod survey;
pub mod track;
pub mod umetrack;
pub mod video;
pub mod world;

pub use error::SourceError;

use crate::clip::Clip;
use crate::modality::ClipFormat;
use std::ops::Range;

/// A named list of clips, made on request.
///
/// Clips are numbered `0..len()`. The same index gives the same clip, whichever thread asks and whatever was asked before, and
/// memory does not grow with the number of clips that were made.
pub trait Source: Send + Sync {
    /// The data set: `world`, `adt`, `hot3d_aria`, ... It is [`Clip::source`] of every clip.
    fn name(&self) -> &str;

    /// How many clips there are, those that [`Source::clip`] drops included.
    fn len(&self) -> usize;

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

    /// Makes clip number `index`.
    ///
    /// # Errors
    /// When a file cannot be read or is malformed, or `index >= len()`.
    fn clip(&self, index: usize) -> Result<Outcome, SourceError>;
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
pub fn clips<S: Source + ?Sized>(source: &S) -> Clips<'_, S> {
    Clips { source, next: 0 }
}

/// Iterator of [`clips`].
#[derive(Debug)]
pub struct Clips<'a, S: Source + ?Sized> {
    source: &'a S,
    next: usize,
}

impl<S: Source + ?Sized> Iterator for Clips<'_, S> {
    type Item = Result<Outcome, SourceError>;

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
