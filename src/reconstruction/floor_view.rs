//! What the floor fit sees of a video.

use crate::geometry::rigid::Rigid;
use ndarray::{ArrayView2, ArrayView3};

/// What is known at one frame of the video.
#[derive(Debug, Clone)]
pub struct View<'a> {
    /// Z-depth as it came, over the square picture.
    pub depth: ArrayView2<'a, f32>,
    /// Metres, world z up.
    pub T_world_camera: Rigid,
    /// Hand joints in this camera, metres.
    pub hands: Vec<[f32; 3]>,
    /// Colours over the square picture.
    pub picture: Option<ArrayView3<'a, u8>>,
    /// From the start of the video.
    pub second: f64,
}
