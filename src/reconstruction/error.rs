//! Why a recording cannot be reconstructed.

use super::anchor::AnchorError;
use super::camera::CameraError;
use super::folder_error::FolderError;
use super::windows::WindowError;
use crate::formats::ReadError;
use crate::labelling::LabelError;
use crate::model::ModelError;
use std::path::PathBuf;

/// Why a recording cannot be reconstructed.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    /// The start lies at or beyond the end of the video, or the video has no frames.
    #[error("`{}` has {frames} frames, {seconds:.2} s; nothing is left from {start:.2} s on", path.display())]
    NothingLeft {
        /// The file of the video.
        path: PathBuf,
        /// Frames of the whole video.
        frames: usize,
        /// Length of the whole video, seconds.
        seconds: f64,
        /// Where to start, seconds from the beginning of the video.
        start: f64,
    },
    /// The clip has no colour video, which every reconstruction starts from.
    #[error("clip `{clip}` has no colour video")]
    NoColour {
        /// The id of the clip.
        clip: String,
    },
    /// The video has fewer frames than it announces.
    #[error("the video ends before its frame {before}")]
    Ends {
        /// Index in the video of the frame that was needed and did not come.
        before: usize,
    },
    /// A target stands in the world and the video takes several windows, but `camera` is not a target.
    #[error(
        "`{modality}` over several windows needs the camera path, which says where each window starts"
    )]
    NoCameraPath {
        /// The target that needs the camera path.
        modality: String,
    },
    /// The callback asked to stop.
    #[error("stopped by its callback")]
    Stopped,
    /// The video or the clip cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// What is said of the camera cannot be used.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The video cannot be cut into windows.
    #[error(transparent)]
    Windows(#[from] WindowError),
    /// The metric depth of another model cannot be used.
    #[error(transparent)]
    Anchor(#[from] AnchorError),
    /// The network that makes the anchor cannot be opened or does not fit the pictures.
    #[error(transparent)]
    AnchorModel(#[from] LabelError),
    /// The model refuses a window or what is asked of it.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// Depth or frames cannot be held, or the result cannot be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
}
