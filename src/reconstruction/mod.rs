//! From decoded windows to a reconstruction of a whole video: metric where it can be, and never called metric where it cannot
//! (Sec. 4.1, Supp. D).
//!
//! [`reconstruct()`] is the whole: read [`mod@reconstruct`] (the loop), [`recording`] (what it reads), [`result`] (what it gives).
//! Its parts are [`camera`] (the camera, given or assumed), [`windows`] (how a video is cut), [`mod@track`], [`stitch`] and [`depth`] (how windows become one), [`scale`] and [`floor`] (metric depth from the
//! floor or from another model), [`predictions`] (decoded signals of single clips, for evaluation), then [`export`] (files for
//! other programs) and [`overlay`] (the wearer drawn into the video), [`dataset`] (pictures with cameras, for view synthesis).

pub mod anchor;
pub mod camera;
pub mod cloud;
pub mod dataset;
pub mod depth;
mod error;
pub mod export;
pub mod floor;
mod floor_view;
pub mod folder;
mod folder_error;
pub mod frame_buffer;
pub mod overlay;
mod parallax;
mod picture;
pub mod predictions;
pub mod reconstruct;
pub mod recording;
pub mod result;
pub mod samples;
pub mod scale;
pub mod stitch;
pub mod track;
pub mod tracks;
pub mod windows;

pub use error::ReconstructError;
pub use reconstruct::{
    Anchor, Part, ReconstructOptions, WindowProgress, reconstruct, reconstruct_recording,
};
pub use recording::Recording;
pub use result::{Reconstruction, ReconstructionInfo};
