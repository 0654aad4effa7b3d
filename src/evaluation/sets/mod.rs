//! The metrics and baselines of the built-in modalities, and of every modality that brings none of its own.
//!
//! The arithmetic is in the rooms beside this one ([`super::joints`], [`super::trajectory`], ...), on plain arrays; here it meets
//! clips and gets the names of columns.

mod camera;
mod gaze;
mod joints;
mod motion;
mod pictures;
mod signal;

pub use signal::{MeanValue, rmse};
