//! Why a recording cannot be reconstructed.

use super::anchor::AnchorError;
use super::folder_error::FolderError;
use super::lens::LensError;
use super::windows::WindowError;
use crate::formats::ReadError;
use crate::labelling::LabelError;
use crate::model::ModelError;
use std::path::PathBuf;

/// Why a recording cannot be reconstructed.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    #[error("`{}` has {frames} frames, {seconds:.2} s; nothing is left from {start:.2} s on", path.display())]
    NothingLeft {
        path: PathBuf,
        frames: usize,
        seconds: f64,
        start: f64,
    },
    #[error("clip `{clip}` has no colour video")]
    NoColour { clip: String },
    #[error("the video ends before its frame {before}")]
    Ends { before: usize },
    #[error(
        "`{modality}` over several windows needs the camera path, which says where each window starts"
    )]
    NoCameraPath { modality: String },
    #[error("stopped by its callback")]
    Stopped,
    #[error(transparent)]
    Read(#[from] ReadError),
    #[error(transparent)]
    Camera(#[from] LensError),
    #[error(transparent)]
    Windows(#[from] WindowError),
    #[error(transparent)]
    Anchor(#[from] AnchorError),
    /// The network that makes the anchor cannot be opened or does not fit the pictures.
    #[error(transparent)]
    AnchorModel(#[from] LabelError),
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error(transparent)]
    Folder(#[from] FolderError),
}
