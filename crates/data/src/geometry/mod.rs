//! Rotations, rigid transforms, camera models, alignment, skeletons.
//!
//! Read in this order: [`rotation`] (6D, quaternions), [`rigid`] (SE(3)), [`skeleton`] (the 21 joints of hand and body), [`mano`] (a hand from shape and pose),
//! [`alignment`] (Umeyama's similarity), [`camera`] (pinhole and fisheye lenses), [`undistortion`]. Transforms are named `T_to_from`:
//! `T_world_camera` maps camera coordinates into the world.

pub mod alignment;
pub mod camera;
pub mod mano;
pub mod rigid;
pub mod rotation;
pub mod skeleton;
pub mod undistortion;
