//! Modalities: what a signal is, and how it comes out of a [`Clip`] (Sec. 3, 4.2).

use crate::clip::{Clip, Signal};

/// How a modality becomes tokens: which family of tokenizer takes it, and at which shape.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shape {
    /// Values over time, `[samples, channels]`: camera, gaze and every declared modality.
    Temporal { samples: usize, channels: usize },
    /// Joints over time, `[samples, joints, 3]`: body and hands.
    Kinematic { samples: usize, joints: usize },
    /// Video, `[frames, height, width, 3]`: rgb and depth.
    Video {
        frames: usize,
        height: usize,
        width: usize,
    },
}

/// A kind of signal that takes part in training and reconstruction.
///
/// Built-in: `rgb depth camera gaze left_hand right_hand body`. Others are declared in YAML or submitted by plug-in crates.
pub trait Modality: Send + Sync {
    /// The registry name.
    fn name(&self) -> &str;
    /// One line for `reviv list`.
    fn about(&self) -> &str;
    /// Samples per second.
    fn rate(&self) -> f64;
    /// The shape of [`Signal::values`].
    fn shape(&self) -> Shape;
    /// One per channel (or one for all).
    fn units(&self) -> Vec<String>;
    /// The frame of reference of the values, in words: `camera of the same sample`, `gravity frame of the first camera`.
    fn frame(&self) -> &str;
    /// The signal of this modality in `clip`; `None` where the clip does not have it.
    ///
    /// # Errors
    /// When the clip holds the signal in a form that cannot be represented (wrong length, degenerate first camera).
    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError>;
    /// Puts a (decoded) signal into `clip`; the inverse of [`Modality::extract`] up to the frame the clip is in.
    ///
    /// # Errors
    /// When the signal's shape is not [`Modality::shape`].
    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError>;
}

/// Why a clip and a modality do not fit.
#[derive(Debug, thiserror::Error)]
pub enum ModalityError {
    #[error("clip `{clip}`: {modality} has shape {found:?}, expected {expected:?}")]
    Shape {
        clip: String,
        modality: String,
        found: Vec<usize>,
        expected: Vec<usize>,
    },
    #[error("clip `{clip}`: {modality}: {reason}")]
    Degenerate {
        clip: String,
        modality: String,
        reason: String,
    },
}
