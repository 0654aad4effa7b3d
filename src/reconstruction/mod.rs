//! From decoded windows to a reconstruction of a whole video: metric where it can be, and never called metric where it cannot
//! (Sec. 4.1, Supp. D).
//!
//! Read [`lens`] (the camera, given or assumed), [`windows`] (how a video is cut), [`track`], [`stitch`] and [`depth`] (how windows become one), [`scale`] (metric depth from the
//! floor or from another model), [`predictions`] (decoded signals of single clips, for evaluation), then [`export`] (files for
//! other programs).

pub mod anchor;
pub mod cloud;
pub mod depth;
pub mod export;
pub mod folder;
mod folder_error;
pub mod frame_buffer;
pub mod lens;
pub mod predictions;
pub mod scale;
pub mod stitch;
pub mod track;
pub mod tracks;
pub mod windows;
