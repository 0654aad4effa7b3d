//! Frames of reference: hands in the camera of the same sample, the body in the gravity frame of the first camera
//! (Sec. 3.2).

use super::{CameraTrack, JointTrack};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};
use ndarray::{Array2, Array3};

/// Below this horizontal part of the camera's right axis (a head tilted sideways by more than 84 degrees) the gravity frame
/// has no heading.
pub const MIN_HORIZONTAL: f64 = 0.1;

/// Why a clip has no gravity frame, or joints do not fit a camera track.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// The track has no `up_world`, so that nothing says where gravity points.
    #[error("the camera track does not know which way is up")]
    NoUp,
    /// The track has no pose, or its first one is not valid: there is nothing to put the gravity frame at.
    #[error("the first camera pose is missing or invalid")]
    NoFirstPose,
    /// The head is tilted sideways so far that the frame has no heading.
    #[error(
        "the first camera's right axis is nearly vertical (horizontal part {horizontal:.3}): the gravity frame is undefined"
    )]
    Degenerate {
        /// Length of the right axis's projection onto the ground, below [`MIN_HORIZONTAL`]; NaN for a pose that is not finite.
        horizontal: f64,
    },
    /// Joints and camera track differ in length: they do not have the samples of one clock.
    #[error("{joints} samples of joints but {poses} camera poses")]
    Length {
        /// Samples of the joints.
        joints: usize,
        /// Poses of the camera track.
        poses: usize,
    },
}

/// `T_gravity_world` of a first camera: origin at the camera's centre, z up, x the horizontal part of the camera's right
/// axis, y = z × x (forward).
///
/// # Errors
/// When the camera's right axis is (nearly) vertical.
pub fn gravity_frame(
    T_world_camera: &Isometry3<f64>,
    up_world: &Unit<Vector3<f64>>,
) -> Result<Isometry3<f64>, FrameError> {
    let right = T_world_camera.rotation * Vector3::x();
    let level = right - up_world.into_inner() * right.dot(up_world);
    let horizontal = level.norm();
    if !horizontal.is_finite() || horizontal < MIN_HORIZONTAL {
        return Err(FrameError::Degenerate { horizontal });
    }
    let x = level / horizontal;
    let z = up_world.into_inner();
    let R_world_gravity =
        Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, z.cross(&x), z]));
    let T_world_gravity = Isometry3::from_parts(
        T_world_camera.translation,
        UnitQuaternion::from_rotation_matrix(&R_world_gravity),
    );
    Ok(T_world_gravity.inverse())
}

/// [`gravity_frame`] of a track's first pose.
///
/// # Errors
/// When the track has no up, no valid first pose, or a degenerate one.
pub fn gravity_frame_of(camera: &CameraTrack) -> Result<Isometry3<f64>, FrameError> {
    let up = camera.up_world.as_ref().ok_or(FrameError::NoUp)?;
    match (camera.T_world_camera.first(), camera.valid.first()) {
        (Some(pose), Some(true)) => gravity_frame(pose, up),
        _ => Err(FrameError::NoFirstPose),
    }
}

/// Joints over time in the world, invalid where NaN: the common input of both conversions. `[T][J]`.
pub type WorldJoints = Vec<Vec<Option<Point3<f64>>>>;

/// World joints in the camera of the same sample. A joint is valid where it and the pose are.
///
/// # Errors
/// When the lengths differ.
pub fn joints_in_camera(
    joints: &WorldJoints,
    camera: &CameraTrack,
) -> Result<JointTrack, FrameError> {
    if joints.len() != camera.T_world_camera.len() {
        return Err(FrameError::Length {
            joints: joints.len(),
            poses: camera.T_world_camera.len(),
        });
    }
    Ok(track(joints, camera.rate, |t, point| {
        camera.valid[t].then(|| camera.T_world_camera[t].inverse_transform_point(point))
    }))
}

/// World joints in one fixed frame, usually `T_gravity_world`.
pub fn joints_in_frame(
    joints: &WorldJoints,
    rate: f64,
    T_frame_world: &Isometry3<f64>,
) -> JointTrack {
    track(joints, rate, |_, point| Some(T_frame_world * point))
}

fn track(
    joints: &WorldJoints,
    rate: f64,
    map: impl Fn(usize, &Point3<f64>) -> Option<Point3<f64>>,
) -> JointTrack {
    let count = joints.iter().map(Vec::len).max().unwrap_or(0);
    let mut out = Array3::zeros((joints.len(), count, 3));
    let mut valid = Array2::from_elem((joints.len(), count), false);
    for (t, row) in joints.iter().enumerate() {
        for (j, point) in row.iter().enumerate() {
            let Some(p) = point.as_ref().and_then(|p| map(t, p)) else {
                continue;
            };
            if p.coords.iter().all(|v| v.is_finite()) {
                valid[[t, j]] = true;
                for k in 0..3 {
                    out[[t, j, k]] = p[k] as f32;
                }
            }
        }
    }
    JointTrack {
        rate,
        joints: out,
        valid,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At (1, 2, 1.6), looking along world +y, pitched 30 degrees down, then turned by yaw 40 degrees.
    fn golden_camera() -> Isometry3<f64> {
        let level = Rotation3::from_matrix_unchecked(Matrix3::new(
            1.0, 0.0, 0.0, //
            0.0, 0.0, 1.0, //
            0.0, -1.0, 0.0,
        ));
        let down = Rotation3::from_axis_angle(&Vector3::x_axis(), -30f64.to_radians());
        let yaw = Rotation3::from_axis_angle(&Vector3::z_axis(), 40f64.to_radians());
        Isometry3::from_parts(
            Vector3::new(1.0, 2.0, 1.6).into(),
            UnitQuaternion::from_rotation_matrix(&(yaw * down * level)),
        )
    }

    #[test]
    fn the_gravity_frame_has_the_golden_coordinates() {
        let frame = gravity_frame(&golden_camera(), &Vector3::z_axis()).unwrap();
        let point = frame * Point3::new(1.5, 3.0, 0.1);
        assert!(
            (point - Point3::new(1.025_809_8, 0.444_650_6, -1.5)).norm() < 1e-6,
            "{point}"
        );
    }

    #[test]
    fn the_gravity_frame_does_not_depend_on_the_world() {
        let camera = golden_camera();
        let point = Point3::new(1.5, 3.0, 0.1);
        let expected = gravity_frame(&camera, &Vector3::z_axis()).unwrap() * point;
        let turn = Isometry3::new(Vector3::new(4.0, -1.0, 2.0), Vector3::new(0.5, 1.0, -2.0));
        let up = Unit::new_normalize(turn.rotation * Vector3::z());
        let found = gravity_frame(&(turn * camera), &up).unwrap() * (turn * point);
        assert!((found - expected).norm() < 1e-12);
    }

    #[test]
    fn a_head_tilted_sideways_is_refused() {
        let level = Isometry3::from_parts(
            nalgebra::Translation3::identity(),
            UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::FRAC_PI_2),
        );
        assert!(matches!(
            gravity_frame(&level, &Vector3::z_axis()),
            Err(FrameError::Degenerate { .. })
        ));
        assert!(gravity_frame(&level, &Vector3::x_axis()).is_ok());
    }

    #[test]
    fn missing_joints_and_poses_become_invalid() {
        let camera = CameraTrack {
            rate: 30.0,
            T_world_camera: vec![golden_camera(); 2],
            valid: vec![true, false],
            up_world: Some(Vector3::z_axis()),
            intrinsics: None,
        };
        let p = Point3::new(1.0, 3.0, 1.6);
        let joints = vec![
            vec![Some(p), None, Some(Point3::new(f64::NAN, 0.0, 0.0))],
            vec![Some(p); 3],
        ];
        let track = joints_in_camera(&joints, &camera).unwrap();
        assert_eq!(track.valid.iter().filter(|v| **v).count(), 1);
        assert!(track.joints[[0, 0, 2]] > 0.0);
        assert_eq!(track.joints[[1, 0, 2]], 0.0);
        assert!(joints_in_camera(&joints[..1].to_vec(), &camera).is_err());
    }
}
