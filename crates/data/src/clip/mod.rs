//! A [`Clip`]: two seconds of synchronised egocentric signals (Sec. 3.2).
//!
//! Video runs at 8 Hz (16 frames) or 16 Hz (32 frames), everything else at 30 Hz (60 samples). Every signal is optional and
//! carries its validity; a missing sample is invalid, never zero. Lengths are metres, angles radians, unless a name says else.
//!
//! [`value`] says what a clip can hold, [`tracks`] what it holds of the built-in modalities, [`clock`] which samples make a clip,
//! [`frames`] in which frame of reference they are, [`depth_video`] how depth becomes video, [`source`] where clips come from,
//! [`shard`] and [`store`] how clips and tokens lie on disk.

pub mod clock;
pub mod depth_video;
pub mod frames;
pub mod joined;
pub mod shard;
pub mod source;
pub mod statistics;
pub mod store;
pub mod tracks;
pub mod value;

pub use tracks::{CameraTrack, Depth, GazeTrack, Intrinsics, JointTrack, Rgb, Signal};
pub use value::{Arrays, Form, Held, Key, Value};

use std::collections::BTreeMap;

/// Colour video.
pub const RGB: Key<'static, Rgb> = Key::new("rgb");
/// Depth.
pub const DEPTH: Key<'static, Depth> = Key::new("depth");
/// The head camera.
pub const CAMERA: Key<'static, CameraTrack> = Key::new("camera");
/// Where the wearer looks.
pub const GAZE: Key<'static, GazeTrack> = Key::new("gaze");
/// The left hand.
pub const LEFT_HAND: Key<'static, JointTrack> = Key::new("left_hand");
/// The right hand.
pub const RIGHT_HAND: Key<'static, JointTrack> = Key::new("right_hand");
/// The wearer's body.
pub const BODY: Key<'static, JointTrack> = Key::new("body");

/// Two seconds of one wearer, from any source: by modality what is known of it.
///
/// ```
/// use reviv_data::clip::{Clip, GAZE, GazeTrack, Key, Signal};
/// use ndarray::{Array1, Array2, ArrayD};
///
/// let mut clip = Clip::empty("walk/000000", "walk");
/// let points = Array2::from_elem((60, 2), 0.5);
/// clip.set(GAZE, GazeTrack { rate: 30.0, points, valid: Array1::from_elem(60, true) });
/// clip.set(Key::new("heart_rate"), Signal { values: ArrayD::zeros(vec![60, 1]), valid: None });
/// assert!(clip.gaze().is_some() && clip.camera().is_none());
/// assert_eq!(clip.signal("heart_rate").unwrap().values.shape(), [60, 1]);
/// assert_eq!(clip.modalities().collect::<Vec<_>>(), ["gaze", "heart_rate"]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Clip {
    /// Unique and stable: `source/recording/000012`.
    pub id: String,
    /// The data set it belongs to: `world`, `adt`, `hot3d_aria`, ...
    pub source: String,
    held: BTreeMap<String, Held>,
}

impl Clip {
    /// A clip without any signal.
    pub fn empty(id: impl Into<String>, source: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            source: source.into(),
            held: BTreeMap::new(),
        }
    }

    /// What the clip holds under a key; `None` where it has nothing, or something of another type.
    #[must_use]
    pub fn get<T: Value>(&self, key: Key<'_, T>) -> Option<&T> {
        self.held.get(key.name())?.get()
    }

    /// As [`Clip::get`], to be changed.
    pub fn get_mut<T: Value>(&mut self, key: Key<'_, T>) -> Option<&mut T> {
        self.held.get_mut(key.name())?.get_mut()
    }

    /// Puts a value under a key, or, with `None`, takes away what is there.
    pub fn set<T: Value>(&mut self, key: Key<'_, T>, value: impl Into<Option<T>>) {
        match value.into() {
            Some(value) => self.insert(key.name(), Held::new(value)),
            None => self.remove(key.name()),
        }
    }

    /// Takes a value out of the clip.
    pub fn take<T: Value>(&mut self, key: Key<'_, T>) -> Option<T> {
        self.get(key)?;
        self.held.remove(key.name())?.take()
    }

    /// What the clip holds of a modality, whatever its type.
    #[must_use]
    pub fn held(&self, modality: &str) -> Option<&Held> {
        self.held.get(modality)
    }

    /// Puts a value of any type under the name of a modality.
    pub fn insert(&mut self, modality: &str, value: Held) {
        self.held.insert(modality.to_owned(), value);
    }

    /// Takes away what the clip holds of a modality.
    pub fn remove(&mut self, modality: &str) {
        self.held.remove(modality);
    }

    /// Whether the clip holds anything of a modality.
    #[must_use]
    pub fn has(&self, modality: &str) -> bool {
        self.held.contains_key(modality)
    }

    /// The modalities the clip has, in the order of their names.
    pub fn modalities(&self) -> impl Iterator<Item = &str> {
        self.held.keys().map(String::as_str)
    }

    /// Colour video, upright and square.
    #[must_use]
    pub fn rgb(&self) -> Option<&Rgb> {
        self.get(RGB)
    }

    /// Depth, metres.
    #[must_use]
    pub fn depth(&self) -> Option<&Depth> {
        self.get(DEPTH)
    }

    /// The head camera's path, metres.
    #[must_use]
    pub fn camera(&self) -> Option<&CameraTrack> {
        self.get(CAMERA)
    }

    /// Where the wearer looks, in the image of the same sample.
    #[must_use]
    pub fn gaze(&self) -> Option<&GazeTrack> {
        self.get(GAZE)
    }

    /// The left hand in the camera of the same sample, metres.
    #[must_use]
    pub fn left_hand(&self) -> Option<&JointTrack> {
        self.get(LEFT_HAND)
    }

    /// The right hand in the camera of the same sample, metres.
    #[must_use]
    pub fn right_hand(&self) -> Option<&JointTrack> {
        self.get(RIGHT_HAND)
    }

    /// The body in the gravity frame of the clip's first camera, metres.
    #[must_use]
    pub fn body(&self) -> Option<&JointTrack> {
        self.get(BODY)
    }

    /// A modality that has no type of its own: one declared in YAML.
    #[must_use]
    pub fn signal(&self, modality: &str) -> Option<&Signal> {
        self.get(Key::new(modality))
    }

    /// Every [`Signal`], by modality.
    pub fn signals(&self) -> impl Iterator<Item = (&str, &Signal)> {
        let all = self.held.iter();
        all.filter_map(|(modality, held)| Some((modality.as_str(), held.get()?)))
    }
}
