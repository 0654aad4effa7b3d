//! Pseudo labels of depth for videos that have none (Sec. 3.1): Video Depth Anything.
//!
//! A network sees 32 frames at once: an image encoder (DINOv2) each frame alone, and a head whose temporal modules mix the
//! frames pixel by pixel. Longer videos run in overlapping windows that are brought to one scale and blended. Two kinds of weights
//! with the same names and shapes: relative ones give inverse depth up to scale and shift (near is large), metric ones metres.
//!
//! In reading order: [`settings`] (sizes), [`preprocess`] (a frame to the network's input), [`encoder`], [`motion`], [`head`],
//! [`network`] (both together), [`plan`] (which frames a window sees), [`stitch`] (windows to one video), [`labeller`] (frames in,
//! depth out, memory flat in the length of the video), [`stored`] (the folder that a user keeps), [`levels`] (labels as video),
//! [`files`] (labels for other programs), [`clips`] (labels of clips).

pub mod clips;
pub mod encoder;
pub mod files;
pub mod head;
pub mod labeller;
pub mod levels;
pub mod motion;
pub mod network;
pub mod plan;
pub mod preprocess;
pub mod settings;
pub mod stitch;
pub mod stored;

pub use labeller::{DepthLabeller, LabelOptions, Labelled};
pub use network::{DepthNetwork, FrameFeatures};
pub use settings::{DepthLabelKind, NetworkSettings};
pub use stitch::{Map, Stitcher};

/// Why depth cannot be labelled.
#[derive(Debug, thiserror::Error)]
pub enum LabelError {
    /// The network's folder, sizes or kind of weights cannot be used.
    #[error("depth network: {0}")]
    Settings(String),
    /// The video has no frames, or they are empty, too narrow or of different sizes.
    #[error("{0}")]
    Frames(String),
    /// Something cannot be read or written.
    #[error("{0}")]
    Files(String),
    /// The weights cannot be read, written or put into the network.
    #[error(transparent)]
    Engine(#[from] crate::engine::EngineError),
}
