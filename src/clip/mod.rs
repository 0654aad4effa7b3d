//! A [`Clip`]: two seconds of synchronised egocentric signals (Sec. 3.2).
//!
//! Video runs at 8 Hz (16 frames) or 16 Hz (32 frames), everything else at 30 Hz (60 samples). Every signal is optional and
//! carries its validity; a missing sample is invalid, never zero. Lengths are metres, angles radians, unless a name says else.
//!
//! [`clock`] says which samples make a clip, [`frames`] in which frame of reference they are, [`depth_video`] how depth becomes
//! video, [`source`] where clips come from, [`shard`] and [`store`] how clips and tokens lie on disk.

pub mod clock;
pub mod depth_video;
pub mod frames;
pub mod shard;
pub mod source;
pub mod statistics;
pub mod store;

use nalgebra::Isometry3;
use ndarray::{Array1, Array2, Array3, Array4, ArrayD};
use std::collections::BTreeMap;

/// Two seconds of one wearer, from any source.
#[derive(Debug, Clone, PartialEq)]
pub struct Clip {
    /// Unique and stable: `source/recording/000012`.
    pub id: String,
    /// The data set it belongs to: `world`, `adt`, `hot3d_aria`, ...
    pub source: String,
    pub rgb: Option<Rgb>,
    pub depth: Option<Depth>,
    pub camera: Option<CameraTrack>,
    pub gaze: Option<GazeTrack>,
    pub left_hand: Option<JointTrack>,
    pub right_hand: Option<JointTrack>,
    pub body: Option<JointTrack>,
    /// Signals of modalities declared in YAML, by modality name.
    pub declared: BTreeMap<String, Signal>,
}

impl Clip {
    /// A clip without any signal.
    pub fn empty(id: impl Into<String>, source: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            source: source.into(),
            rgb: None,
            depth: None,
            camera: None,
            gaze: None,
            left_hand: None,
            right_hand: None,
            body: None,
            declared: BTreeMap::new(),
        }
    }
}

/// Colour video, upright, square.
#[derive(Debug, Clone, PartialEq)]
pub struct Rgb {
    /// Hz.
    pub rate: f64,
    /// `[T, H, W, 3]`, sRGB.
    pub frames: Array4<u8>,
}

/// Depth along the optical axis, aligned with the colour video.
#[derive(Debug, Clone, PartialEq)]
pub struct Depth {
    /// Hz.
    pub rate: f64,
    /// `[T, H, W]`, metres of z-depth; NaN where nothing was measured.
    pub metres: Array3<f32>,
}

/// The head camera: where it is, and how it projects.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraTrack {
    /// Hz.
    pub rate: f64,
    /// `T_world_camera` per sample; `OpenCV` axes (x right, y down, z forward) of the upright image.
    pub T_world_camera: Vec<Isometry3<f64>>,
    /// `[T]`.
    pub valid: Vec<bool>,
    /// Up (against gravity) in the world of the poses, unit length; `None` where the source does not know it.
    pub up_world: Option<nalgebra::Unit<nalgebra::Vector3<f64>>>,
    /// Pinhole intrinsics of the clip's square frames, in pixels of their resolution.
    pub intrinsics: Option<Intrinsics>,
}

/// Pinhole intrinsics in pixels; the centre of the top-left pixel is (0, 0).
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Intrinsics {
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub width: u32,
    pub height: u32,
}

/// Where the wearer looks, in the upright square image.
#[derive(Debug, Clone, PartialEq)]
pub struct GazeTrack {
    /// Hz.
    pub rate: f64,
    /// `[T, 2]`: x right, y down, the image is `[0, 1]^2`.
    pub points: Array2<f32>,
    /// `[T]`.
    pub valid: Array1<bool>,
}

/// Joints over time. Hands: camera frame of the same sample. Body: gravity frame of the clip's first camera.
#[derive(Debug, Clone, PartialEq)]
pub struct JointTrack {
    /// Hz.
    pub rate: f64,
    /// `[T, 21, 3]`, metres, in the order of [`crate::geometry::skeleton`].
    pub joints: Array3<f32>,
    /// `[T, 21]`.
    pub valid: Array2<bool>,
}

/// A modality's values as its tokenizer sees them, before normalisation: the common currency of tokenizers, decoding,
/// reconstruction and evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Camera `[T, 9]`, gaze `[T, 2]`, joints `[T, 21, 3]`, video `[T, H, W, 3]` in [-1, 1], declared `[T, C]`.
    pub values: ArrayD<f32>,
    /// The shape of `values` without its last axis (gaze `[T]`, joints `[T, 21]`); `None` means all valid.
    pub valid: Option<ArrayD<bool>>,
}
