//! The built-in synthetic egocentric world: endless clips with exact ground truth and no licence.
//!
//! A wearer of random stature lives in a furnished room: walks, turns, stops, crouches, looks around, reaches for things,
//! takes, turns and puts them back. The head camera sees the room and the wearer's own arms and hands. Body, both hands, gaze,
//! camera and depth are exact, and a clip is a function of (seed, index) alone.
//!
//! What is to be reconstructed can be seen: camera motion carries the head's path and the gait, hands are in view when they
//! act, gaze goes to what stands out and to what the hands do, the height over the floor tells a crouch.
//!
//! Read in this order: [`script`] (what happens), [`wearer`], [`hand`], [`steps`], [`motion`] (how it moves), [`room`],
//! [`furniture`], [`object`], [`texture`] (what is there), [`primitive`], [`bins`], [`render`] (how it is seen), and
//! [`episode`], which brings them together. [`clips`] is the world as a source like any other.

mod bins;
pub mod clips;
pub mod episode;
mod figure;
mod furniture;
pub mod hand;
pub mod motion;
mod object;
mod primitive;
pub mod render;
mod room;
pub mod scene;
pub mod script;
pub mod steps;
pub mod texture;
pub mod track;
pub mod vector;
mod wall;
pub mod wearer;

pub use clips::WorldClips;
pub use episode::Episode;

use crate::clip::{Clip, Intrinsics, clock};
use crate::modality::ClipFormat;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When a hand counts as measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum HandValidity {
    /// While at least five of its joints are in the image, as with a real tracker.
    Visible,
    /// Always.
    Always,
}

/// Settings of the built-in world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WorldSettings {
    /// Height and width of the images, pixels.
    pub size: u32,
    /// Video frames per clip.
    pub frames: usize,
    /// Video frames per second.
    pub video_rate: f64,
    /// Horizontal and vertical field of view, degrees.
    pub field_of_view: f64,
    /// Smooth outlines with four more rays.
    pub antialias: bool,
    /// When a hand counts as measured.
    pub hands: HandValidity,
    /// How many different rooms there are; none means a new one for every clip.
    pub rooms: Option<u64>,
}

impl Default for WorldSettings {
    fn default() -> Self {
        Self {
            size: 256,
            frames: 16,
            video_rate: clock::VIDEO_RATE,
            field_of_view: 90.0,
            antialias: true,
            hands: HandValidity::Visible,
            rooms: None,
        }
    }
}

impl WorldSettings {
    /// What is wrong with the settings, if anything, as (key, reason).
    pub fn problem(&self) -> Option<(&'static str, String)> {
        if !(8..=2048).contains(&self.size) {
            return Some(("size", format!("{} is not in 8..=2048 pixels", self.size)));
        }
        if !(self.field_of_view.is_finite() && (20.0..=140.0).contains(&self.field_of_view)) {
            return Some((
                "field_of_view",
                format!("{} is not in 20..=140 degrees", self.field_of_view),
            ));
        }
        if !(self.video_rate.is_finite()
            && self.video_rate > 0.0
            && self.video_rate <= clock::SIGNAL_RATE)
        {
            return Some((
                "video_rate",
                format!("{} is not in (0, 30] Hz", self.video_rate),
            ));
        }
        let seconds = self.frames as f64 / self.video_rate;
        if self.frames == 0 || seconds > clock::CLIP_SECONDS + 1e-9 {
            return Some((
                "frames",
                format!(
                    "{} frames at {} Hz are not a clip of two seconds",
                    self.frames, self.video_rate
                ),
            ));
        }
        (self.rooms == Some(0)).then(|| ("rooms", "needs at least one room".to_owned()))
    }

    /// Pinhole intrinsics of the head camera.
    pub fn intrinsics(&self) -> Intrinsics {
        let half = f64::from(self.size) / 2.0;
        let f = half / (self.field_of_view.to_radians() / 2.0).tan();
        Intrinsics {
            fx: f,
            fy: f,
            cx: half - 0.5,
            cy: half - 0.5,
            width: self.size,
            height: self.size,
        }
    }

    /// The sizes of the clips.
    pub fn format(&self) -> ClipFormat {
        ClipFormat {
            frames: self.frames,
            video_rate: self.video_rate,
            size: self.size as usize,
            ..ClipFormat::default()
        }
    }
}

/// The world with one seed: a collection of clips by index.
#[derive(Debug, Clone)]
pub struct World {
    settings: WorldSettings,
    seed: u64,
}

impl World {
    /// A world; `settings` must have no [`WorldSettings::problem`].
    pub fn new(settings: WorldSettings, seed: u64) -> Self {
        Self { settings, seed }
    }

    /// The world of 64 x 64 pixels and 48 rooms, under seed 0: for CPU training in minutes.
    #[must_use]
    pub fn small() -> Self {
        let settings = WorldSettings {
            size: 64,
            rooms: Some(48),
            ..WorldSettings::default()
        };
        Self::new(settings, 0)
    }

    /// A stretch of its clips, as a source like any other.
    #[must_use]
    pub fn clips(&self, range: std::ops::Range<u64>) -> WorldClips {
        WorldClips::new(self.clone(), range)
    }

    /// The settings.
    pub fn settings(&self) -> &WorldSettings {
        &self.settings
    }

    /// Clip `index`: two seconds from the middle of an episode of its own.
    pub fn clip(&self, index: u64) -> Clip {
        let start =
            crate::random::stream(self.seed, "world.window", 0, index).random_range(0.4..6.5);
        let episode = self.episode(index, start + clock::CLIP_SECONDS + 0.3);
        episode.clip(&format!("world/{index:06}"), start)
    }

    /// The episode that clip `index` is cut from, at least `seconds` long: for recordings longer than a clip.
    pub fn episode(&self, index: u64, seconds: f64) -> Episode {
        Episode::new(&self.settings, self.seed, index, seconds)
    }
}
