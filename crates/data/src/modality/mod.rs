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

use crate::clip::{CameraTrack, Clip, Depth, Form, GazeTrack, JointTrack, Rgb, Signal};

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

/// A modality as code: what it is at the sizes of a format, and what clips hold of it. The built-in ones stand in a list here, those
/// of a plug-in crate come in by `inventory::submit! { LinkedModality { name: "object_pose", make, form: Form::of::<Track>() } }`;
/// a format has them where it declares a modality of that name.
pub struct LinkedModality {
    /// The registry name.
    pub name: &'static str,
    /// At the sizes of a format; its own settings are among [`ClipFormat::declared`].
    pub make: fn(&ClipFormat) -> Box<dyn Modality>,
    /// The type of what clips hold under this name.
    pub form: Form,
}

::inventory::collect!(LinkedModality);

static LINKED: [LinkedModality; 7] = [
    LinkedModality {
        name: "rgb",
        make: |format| Box::new(video::Rgb::new(format)),
        form: Form::of::<Rgb>(),
    },
    LinkedModality {
        name: "depth",
        make: |format| Box::new(video::Depth::new(format)),
        form: Form::of::<Depth>(),
    },
    LinkedModality {
        name: "camera",
        make: |format| Box::new(camera::Camera::new(format)),
        form: Form::of::<CameraTrack>(),
    },
    LinkedModality {
        name: "gaze",
        make: |format| Box::new(gaze::Gaze::new(format)),
        form: Form::of::<GazeTrack>(),
    },
    LinkedModality {
        name: "left_hand",
        make: |format| Box::new(joints::Joints::left_hand(format)),
        form: Form::of::<JointTrack>(),
    },
    LinkedModality {
        name: "right_hand",
        make: |format| Box::new(joints::Joints::right_hand(format)),
        form: Form::of::<JointTrack>(),
    },
    LinkedModality {
        name: "body",
        make: |format| Box::new(joints::Joints::body(format)),
        form: Form::of::<JointTrack>(),
    },
];

/// The code of a modality; `None` for one that is only declared.
pub fn linked(name: &str) -> Option<&'static LinkedModality> {
    let plugins = ::inventory::iter::<LinkedModality>();
    LINKED
        .iter()
        .chain(plugins)
        .find(|linked| linked.name == name)
}

/// How what a clip holds of a modality is read: as a [`Signal`] where no code says else.
pub fn form(name: &str) -> Form {
    linked(name).map_or(Form::of::<Signal>(), |linked| linked.form)
}

/// A built-in modality by name, at the sizes of `format`; `None` for any other name.
pub fn built_in(name: &str, format: &ClipFormat) -> Option<Box<dyn Modality>> {
    let linked = LINKED.iter().find(|linked| linked.name == name)?;
    Some((linked.make)(format))
}

/// A modality that a format declares: the code of that name, or the values as they are.
pub fn from_declaration(settings: &DeclaredSettings, format: &ClipFormat) -> Box<dyn Modality> {
    match linked(&settings.name) {
        Some(linked) => (linked.make)(format),
        None => Box::new(Declared::new(settings.clone(), format)),
    }
}

/// Puts values that a file, a sensor or code gave for a declared modality into a clip.
///
/// # Errors
/// When the modality does not take values of this shape.
pub fn put(
    settings: &DeclaredSettings,
    format: &ClipFormat,
    signal: Signal,
    clip: &mut Clip,
) -> Result<(), ModalityError> {
    from_declaration(settings, format).insert(signal, clip)
}

/// Every modality of `format`: the built-in ones in the order of [`BUILT_IN`], then its declared ones.
pub fn all(format: &ClipFormat) -> Vec<Box<dyn Modality>> {
    let built_in = LINKED.iter().map(|linked| (linked.make)(format));
    let declared = format
        .declared
        .iter()
        .map(|settings| from_declaration(settings, format));
    built_in.chain(declared).collect()
}

/// How a modality becomes tokens: which family of tokenizer takes it, and at which shape.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shape {
    /// Values over time, `[samples, channels]`: camera, gaze and every declared modality.
    Temporal {
        /// Samples of a clip.
        samples: usize,
        /// Values of a sample.
        channels: usize,
    },
    /// Joints over time, `[samples, joints, 3]`: body and hands.
    Kinematic {
        /// Samples of a clip.
        samples: usize,
        /// Joints of a sample.
        joints: usize,
    },
    /// Video, `[frames, height, width, 3]`: rgb and depth.
    Video {
        /// Frames of a clip.
        frames: usize,
        /// Pixels.
        height: usize,
        /// Pixels.
        width: usize,
    },
}

/// Whether lengths among the values may be read as metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lengths {
    /// In metres, as the training data are.
    Metric,
    /// Up to an unknown scale.
    Relative,
    /// There are none.
    None,
}

/// A signal, where there is one, and its units: one per channel, or one for all.
pub type Measured = (Option<Signal>, Vec<String>);

/// A kind of signal that takes part in training and reconstruction.
///
/// Built-in: `rgb depth camera gaze left_hand right_hand body`. Others are declared in YAML, with values
/// from files or from the [`code`] of a plug-in crate, and, where it is more than channels over time, a [`LinkedModality`].
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
    /// The names of the channels; empty where they have none.
    fn channels(&self) -> Vec<String> {
        Vec::new()
    }
    /// The frame of reference of the values, in words: `camera of the same sample`, `gravity frame of the first camera`.
    fn frame(&self) -> &str;
    /// What a predicted length of this modality is.
    fn lengths(&self) -> Lengths {
        Lengths::None
    }
    /// The signal of this modality in `clip`; `None` where the clip does not have it.
    ///
    /// # Errors
    /// When the clip holds the signal in a form that cannot be represented (wrong length, degenerate first camera).
    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError>;

    /// What the clip has in the units a person reads, and these units: what statistics count.
    ///
    /// # Errors
    /// As [`Modality::extract`].
    fn measure(&self, clip: &Clip) -> Result<Measured, ModalityError> {
        Ok((self.extract(clip)?, self.units()))
    }

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
    /// The values or their validity have another shape than the modality at the sizes of its format.
    #[error("clip `{clip}`: {modality} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// The id of the clip.
        clip: String,
        /// The registry name of the modality.
        modality: String,
        /// The shape that was met.
        found: Vec<usize>,
        /// The shape that the format asks for.
        expected: Vec<usize>,
    },
    /// An invalid first pose, a value where none may be missing, or code that is not linked in.
    #[error("clip `{clip}`: {modality}: {reason}")]
    Degenerate {
        /// The id of the clip.
        clip: String,
        /// The registry name of the modality.
        modality: String,
        /// What is wrong with the values.
        reason: String,
    },
}
