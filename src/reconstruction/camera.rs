//! What is known of the camera before anything is decoded: its projection and where up is, given or assumed, and always said.

use crate::clip::Intrinsics;
use crate::geometry::rigid::{Rigid, level_camera};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The head camera, as far as its owner knows it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CameraSettings {
    /// Horizontal field of view of the centre square in degrees, where there is no `calibration`.
    #[schemars(range(min = 1.0, max = 170.0))]
    pub field_of_view: f64,
    /// Pinhole calibration of the whole upright picture; crop and resize are followed, and a picture of another size but the same
    /// shape is scaled.
    pub calibration: Option<Intrinsics>,
    /// Direction against gravity in the axes of the first camera: x right, y down, z forward; absent: that camera is level.
    pub up: Option<[f64; 3]>,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            field_of_view: 90.0,
            calibration: None,
            up: None,
        }
    }
}

/// Why a camera cannot be used.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum CameraError {
    /// The field of view, in degrees, is out of its range.
    #[error("a field of view of {0} degrees is not between 1 and 170")]
    FieldOfView(f64),
    /// The calibration is not that of a pinhole camera.
    #[error(
        "the calibration has a focal length that is not positive, or a value that is not finite"
    )]
    Calibration,
    /// The calibration is for pictures of another aspect ratio, or of width 0.
    #[error(
        "the calibration is for {expected:?} pixels, the video has {found:?}: not the same shape"
    )]
    Shape {
        /// Width and height that the calibration is for, pixels.
        expected: [u32; 2],
        /// Width and height of the video, pixels.
        found: [u32; 2],
    },
    /// `up` gives no direction, or one that leaves the heading of the camera open.
    #[error("`up` is zero, not finite, or along the camera's right axis")]
    Up,
}

impl CameraSettings {
    /// Intrinsics of the square frames of `side` pixels, cut from the centre of pictures of `width` x `height`.
    ///
    /// # Errors
    /// When a number cannot be that of a camera, or the calibration is for pictures of another shape.
    pub fn intrinsics(
        &self,
        [width, height]: [u32; 2],
        side: u32,
    ) -> Result<Intrinsics, CameraError> {
        let side_f = f64::from(side);
        let Some(own) = self.calibration else {
            if !(1.0..=170.0).contains(&self.field_of_view) {
                return Err(CameraError::FieldOfView(self.field_of_view));
            }
            let focal = side_f / 2.0 / (self.field_of_view.to_radians() / 2.0).tan();
            let centre = (side_f - 1.0) / 2.0;
            return Ok(Intrinsics {
                fx: focal,
                fy: focal,
                cx: centre,
                cy: centre,
                width: side,
                height: side,
            });
        };
        let numbers = [own.fx, own.fy, own.cx, own.cy];
        if numbers.iter().any(|v| !v.is_finite()) || own.fx <= 0.0 || own.fy <= 0.0 {
            return Err(CameraError::Calibration);
        }
        let same =
            u64::from(own.width) * u64::from(height) == u64::from(own.height) * u64::from(width);
        if !same || own.width == 0 {
            return Err(CameraError::Shape {
                expected: [own.width, own.height],
                found: [width, height],
            });
        }
        // Pixel centres are at integers: half a pixel is added before a scale and taken off after it.
        let short = f64::from(own.width.min(own.height));
        let scale = side_f / short;
        let cut =
            |centre: f64, size: u32| (centre + 0.5 - (f64::from(size) - short) / 2.0) * scale - 0.5;
        Ok(Intrinsics {
            fx: own.fx * scale,
            fy: own.fy * scale,
            cx: cut(own.cx, own.width),
            cy: cut(own.cy, own.height),
            width: side,
            height: side,
        })
    }

    /// Pose of the first camera in a world with z up and x along the camera's right axis.
    ///
    /// # Errors
    /// When `up` is no direction, or lies along the camera's right axis.
    pub fn first_pose(&self) -> Result<Rigid, CameraError> {
        match self.up {
            None => Ok(level_camera()),
            Some(up) => pose_with_up(Vector3::from(up)).ok_or(CameraError::Up),
        }
    }
}

/// Pose at the origin of a camera in whose axes `up` is against gravity.
fn pose_with_up(up: Vector3<f64>) -> Option<Rigid> {
    let z = up.try_normalize(1e-9)?;
    let x = (Vector3::x() - z * z.x).try_normalize(1e-6)?;
    let y = z.cross(&x);
    let axes = Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    let rotation = Rotation3::from_matrix_unchecked(axes);
    Some(Rigid::from_parts(
        Vector3::zeros().into(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ninety_degrees_reach_half_a_side_at_half_a_side() {
        let intrinsics = CameraSettings::default()
            .intrinsics([1920, 1080], 256)
            .unwrap();
        assert!((intrinsics.fx - 128.0).abs() < 1e-9);
        assert_eq!(intrinsics.cx, 127.5);
    }

    #[test]
    fn a_calibration_follows_crop_and_resize() {
        let settings = CameraSettings {
            calibration: Some(Intrinsics {
                fx: 600.0,
                fy: 610.0,
                cx: 959.5,
                cy: 539.5,
                width: 1920,
                height: 1080,
            }),
            ..CameraSettings::default()
        };
        let intrinsics = settings.intrinsics([1920, 1080], 270).unwrap();
        assert!((intrinsics.fx - 150.0).abs() < 1e-9);
        assert!((intrinsics.fy - 152.5).abs() < 1e-9);
        assert!((intrinsics.cx - 134.5).abs() < 1e-9 && (intrinsics.cy - 134.5).abs() < 1e-9);
        // The same picture at half the size has the same camera.
        assert_eq!(settings.intrinsics([960, 540], 270).unwrap(), intrinsics);
        assert!(matches!(
            settings.intrinsics([1080, 1920], 270),
            Err(CameraError::Shape { .. })
        ));
    }

    #[test]
    fn up_is_up_and_no_up_is_level() {
        let looking_down = 0.4_f64;
        let up = [0.0, -looking_down.cos(), -looking_down.sin()];
        let settings = CameraSettings {
            up: Some(up),
            ..CameraSettings::default()
        };
        let pose = settings.first_pose().unwrap();
        assert!((pose * Vector3::from(up) - Vector3::z()).norm() < 1e-12);
        let forward = pose * Vector3::z();
        assert!((forward.z + looking_down.sin()).abs() < 1e-12);
        let level = CameraSettings {
            up: Some([0.0, -1.0, 0.0]),
            ..CameraSettings::default()
        };
        let difference = level.first_pose().unwrap().inv_mul(&level_camera());
        assert!(difference.rotation.angle() < 1e-9);
        let sideways = CameraSettings {
            up: Some([1.0, 0.0, 0.0]),
            ..CameraSettings::default()
        };
        assert_eq!(sideways.first_pose(), Err(CameraError::Up));
    }
}
