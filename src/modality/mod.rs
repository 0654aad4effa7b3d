//! Modalities: what a signal is, and how it comes out of a [`Clip`] (Sec. 3, 4.2).
//!
//! [`built_in`] gives the seven of the paper at the sizes of a [`ClipFormat`]; [`declared`] makes one from a YAML entry.
//! Read [`camera`] first, it is the most interesting conversion. [`code`] is how a plug-in crate computes a declared one,
//! [`inventory`] counts what clips hold.

pub mod camera;
pub mod code;
pub mod declared;
pub mod format;
pub mod gaze;
pub mod inventory;
pub mod joints;
pub mod video;

pub use declared::{Declared, DeclaredSettings};
pub use format::ClipFormat;

use crate::clip::{Clip, Signal};

/// The names of the built-in modalities.
pub const BUILT_IN: [&str; 7] = [
    "rgb",
    "depth",
    "camera",
    "gaze",
    "left_hand",
    "right_hand",
    "body",
];

/// A built-in modality by name, at the sizes of `format`; `None` for any other name.
pub fn built_in(name: &str, format: &ClipFormat) -> Option<Box<dyn Modality>> {
    Some(match name {
        "rgb" => Box::new(video::Rgb::new(format)),
        "depth" => Box::new(video::Depth::new(format)),
        "camera" => Box::new(camera::Camera::new(format)),
        "gaze" => Box::new(gaze::Gaze::new(format)),
        "left_hand" => Box::new(joints::Joints::left_hand(format)),
        "right_hand" => Box::new(joints::Joints::right_hand(format)),
        "body" => Box::new(joints::Joints::body(format)),
        _ => return None,
    })
}

/// Every modality of `format`: the built-in ones in the order of [`BUILT_IN`], then its declared ones.
pub fn all(format: &ClipFormat) -> Vec<Box<dyn Modality>> {
    let built_in = BUILT_IN.iter().filter_map(|name| built_in(name, format));
    let declared = format
        .declared
        .iter()
        .map(|settings| Box::new(Declared::new(settings.clone(), format)) as Box<dyn Modality>);
    built_in.chain(declared).collect()
}

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
/// Built-in: `rgb depth camera gaze left_hand right_hand body`. Others are declared in YAML, with values
/// from files or from the [`code`] of a plug-in crate.
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

/// Refuses a shape that is not the expected one.
fn expect_shape(
    clip: &str,
    modality: &str,
    found: &[usize],
    expected: &[usize],
) -> Result<(), ModalityError> {
    if found == expected {
        return Ok(());
    }
    Err(ModalityError::Shape {
        clip: clip.to_owned(),
        modality: modality.to_owned(),
        found: found.to_vec(),
        expected: expected.to_vec(),
    })
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
