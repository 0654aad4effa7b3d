//! Recordings of Project Aria glasses: the container ([`vrs`]), and what Machine Perception Services add to it: [`trajectory`],
//! [`gaze`], [`hand_tracking`] and [`calibration`].

pub mod calibration;
pub mod gaze;
pub mod hand_tracking;
pub mod trajectory;
pub mod vrs;
