//! What a modality brings to a reconstruction: a [`Track`] takes the decoded windows of a video and says what of the whole is
//! written and shown.
//!
//! A plug-in crate submits `inventory::submit! { TrackEntry { modality: "object_pose", make } }`. A modality without a track of its
//! own is stitched as channels over time ([`super::tracks::SignalTrack`]).

use super::export::files::Files;
use super::folder_error::FolderError;
use super::predictions::ScaleStatus;
use super::windows::Window;
use crate::clip::Clip;
use crate::clip::clock::SIGNAL_RATE;
use crate::geometry::rigid::Rigid;
use crate::modality::Modality;
use crate::view::Part;
use std::any::Any;
use std::fmt::Debug;

/// One modality over the whole video.
pub trait Track: Any + Debug + Send + Sync {
    /// Adds the decoded clip of a window; windows come in order. Returns how far it was from what was there, where they overlap.
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap>;

    /// Writes the arrays and files that other programs read.
    ///
    /// # Errors
    /// When the disk refuses.
    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError>;

    /// Whether it stands in the world, so that several windows need the camera's path to lie beside each other.
    fn follows_camera(&self) -> bool {
        false
    }

    /// What the page draws; rows beyond the timeline are cut, missing ones unknown.
    fn parts(&self, timeline: &Timeline<'_>) -> Vec<Part>;
}

/// Where a window lies.
#[derive(Debug)]
pub struct Placement<'a> {
    /// The window, in motion samples at 30 Hz from the start of the video.
    pub window: &'a Window,
    /// World pose of the window's first camera, as far as the camera's own track says it; that comes first.
    pub T_world_first: Rigid,
}

/// Distances between a window and what was there before it, over the samples they share.
#[derive(Debug)]
pub struct Gap {
    /// The quantity and its unit: `body_m`. Distances of several tracks under one name are averaged together.
    pub name: String,
    /// In the unit of the name, one per shared sample, of body and hands one per joint.
    pub distances: Vec<f64>,
}

impl Gap {
    /// Of this name.
    pub fn new(name: impl Into<String>, distances: Vec<f64>) -> Self {
        Self {
            name: name.into(),
            distances,
        }
    }
}

/// The time that is shown, and where the camera was.
#[derive(Debug)]
pub struct Timeline<'a> {
    /// Samples at 30 Hz.
    pub samples: usize,
    /// `T_world_camera` per sample; empty where the camera is not known.
    pub cameras: &'a [Rigid],
}

/// What a modality is, for a track that writes and draws it.
#[derive(Debug, Clone, Default)]
pub struct Description {
    /// The modality's name.
    pub modality: String,
    /// One name per channel; empty where they have none.
    pub channels: Vec<String>,
    /// One per channel, or one for all.
    pub units: Vec<String>,
    /// The frame of reference, in words.
    pub frame: String,
    /// Samples per second.
    pub rate: Option<f64>,
    /// Whether its lengths are metric, and by what; `None` is written as not a length.
    pub scale: Option<ScaleStatus>,
}

impl Description {
    /// What a modality says of itself.
    pub fn of(modality: &dyn Modality) -> Self {
        Self {
            modality: modality.name().to_owned(),
            channels: modality.channels(),
            units: modality.units(),
            frame: modality.frame().to_owned(),
            rate: Some(modality.rate()),
            scale: Some(ScaleStatus::of(modality)),
        }
    }
}

/// A track that is linked in.
pub struct TrackEntry {
    /// The name of the modality that it is the track of.
    pub modality: &'static str,
    /// Makes an empty track of the modality that is described.
    pub make: fn(&Description) -> Box<dyn Track>,
}
inventory::collect!(TrackEntry);

impl Window {
    /// The same window in samples of another rate than 30 Hz.
    #[must_use]
    pub fn at_rate(&self, rate: f64) -> Self {
        let scaled = |samples: usize| (samples as f64 / SIGNAL_RATE * rate).round() as usize;
        Self {
            index: self.index,
            start: scaled(self.start),
            inside: scaled(self.inside),
            overlap: scaled(self.overlap),
        }
    }

    /// The samples of `held` that `new` covers too, beside those of `new`.
    pub fn shared<'a, T>(
        &self,
        held: &'a [T],
        new: &'a [T],
    ) -> impl Iterator<Item = (&'a T, &'a T)> {
        let from = self.start.min(held.len());
        held[from..].iter().zip(new).take(self.overlap)
    }

    /// Adds the samples of the window to a track; where both have one, `mix(old, new, share of the new)` is taken.
    pub fn append<T: Clone>(&self, held: &mut Vec<T>, new: &[T], mix: impl Fn(&T, &T, f64) -> T) {
        for (i, value) in new.iter().take(self.inside).enumerate() {
            let at = self.start + i;
            if at < held.len() {
                held[at] = mix(&held[at], value, ramp(i, self.overlap));
            } else {
                held.push(value.clone());
            }
        }
    }
}

/// Share of the new window at sample `i` of an overlap: rises from just above 0 to just below 1.
pub fn ramp(i: usize, overlap: usize) -> f64 {
    (i + 1) as f64 / (overlap + 1) as f64
}

/// Between two values; where one of them is not finite, the other.
pub fn blend<const N: usize>(a: [f32; N], b: [f32; N], t: f64) -> [f32; N] {
    let known = |v: &[f32; N]| v.iter().all(|v| v.is_finite());
    match (known(&a), known(&b)) {
        (true, true) => {
            std::array::from_fn(|k| (f64::from(a[k]) * (1.0 - t) + f64::from(b[k]) * t) as f32)
        }
        (true, false) => a,
        _ => b,
    }
}
