//! Rigid transforms (SE(3)): nalgebra's type and what it lacks.

use super::rotation;
use nalgebra::{Isometry3, Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion};

/// A rigid transform, `T_to_from`.
pub type Rigid = Isometry3<f64>;

/// How far a matrix may be from a rotation (largest entry of `RᵀR - 1`) to be read as one.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Why sixteen numbers are not a pose.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// A value is NaN or infinite.
    #[error("the pose has a value that is not finite")]
    NotFinite,
    /// A rigid transform, written column by column.
    #[error(
        "the fourth row of the pose is not 0 0 0 1, its fourth column is: the matrix is transposed (column-major, as ARKit, ARCore and Unity hold it)"
    )]
    Transposed,
    /// The fourth row is not `0 0 0 1`, and the matrix is no transposed pose either.
    #[error("the fourth row of the pose is not 0 0 0 1")]
    NotAffine,
    /// A rotation times this positive factor, which is farther from 1 than rounding explains.
    #[error("the pose's rotation part is scaled by {0:.3}: its columns must be of length one")]
    Scaled(f64),
    /// Orthogonal, but of determinant -1: the axes are left-handed.
    #[error("the pose's rotation part is mirrored: one of its axes points the other way")]
    Mirrored,
    /// The columns are not orthogonal, differ in length, or are mirrored and scaled at once.
    #[error("the pose's rotation part is not a rotation")]
    NotARotation,
}

/// A pose from a 4x4 matrix in row-major order.
///
/// # Errors
/// When a value is not finite, the last row is not `0 0 0 1`, or the rotation part is mirrored, scaled or sheared by more
/// than 1e-3.
pub fn from_row_major(m: &[f64; 16]) -> Result<Rigid, PoseError> {
    if !m.iter().all(|v| v.is_finite()) {
        return Err(PoseError::NotFinite);
    }
    let m = Matrix4::from_row_slice(m);
    let is_last = |v: [f64; 4]| {
        let last = [0.0, 0.0, 0.0, 1.0];
        v.iter().zip(last).all(|(a, b)| (a - b).abs() <= 1e-6)
    };
    let row = std::array::from_fn(|k| m[(3, k)]);
    let column = std::array::from_fn(|k| m[(k, 3)]);
    let r: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into_owned();
    let off = |r: &Matrix3<f64>| (r.transpose() * r - Matrix3::identity()).amax();
    if !is_last(row) {
        return Err(if is_last(column) && off(&r) <= ROTATION_TOLERANCE {
            PoseError::Transposed
        } else {
            PoseError::NotAffine
        });
    }
    if off(&r) > ROTATION_TOLERANCE {
        let scale = r.determinant().cbrt();
        return Err(if scale > 0.0 && off(&(r / scale)) <= ROTATION_TOLERANCE {
            PoseError::Scaled(scale)
        } else {
            PoseError::NotARotation
        });
    }
    if r.determinant() < 0.0 {
        return Err(PoseError::Mirrored);
    }
    let rotation = rotation::nearest(&r).ok_or(PoseError::NotARotation)?;
    Ok(Rigid::from_parts(
        Translation3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]),
        rotation,
    ))
}

/// The 4x4 matrix of a pose in row-major order.
pub fn to_row_major(pose: &Rigid) -> [f64; 16] {
    let m = pose.to_homogeneous().transpose();
    let mut out = [0.0; 16];
    out.copy_from_slice(m.as_slice());
    out
}

/// `T_a_b` from `T_world_a` and `T_world_b`.
pub fn relative(T_world_a: &Rigid, T_world_b: &Rigid) -> Rigid {
    T_world_a.inv_mul(T_world_b)
}

/// The pose of a camera that looks straight ahead: x right, y forward, z up, at the origin. What is assumed where gravity is
/// not known.
pub fn level_camera() -> Rigid {
    let axes = Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0);
    let rotation = Rotation3::from_matrix_unchecked(axes);
    Rigid::from_parts(
        Translation3::identity(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Between two poses: linear in position, spherical in rotation.
pub fn interpolate(a: &Rigid, b: &Rigid, t: f64) -> Rigid {
    let position = a.translation.vector.lerp(&b.translation.vector, t);
    Rigid::from_parts(
        position.into(),
        rotation::slerp(&a.rotation, &b.rotation, t),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn pose() -> Rigid {
        Rigid::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.3, -1.1, 0.7))
    }

    #[test]
    fn matrices_round_trip() {
        let back = from_row_major(&to_row_major(&pose())).unwrap();
        assert!((back.to_homogeneous() - pose().to_homogeneous()).amax() < 1e-12);
        assert_eq!(to_row_major(&pose())[3], 1.0);
    }

    #[test]
    fn what_is_no_pose_is_refused() {
        let good = to_row_major(&pose());
        let mut bad = good;
        bad[5] = f64::NAN;
        assert_eq!(from_row_major(&bad), Err(PoseError::NotFinite));
        bad = good;
        bad[12] = 0.1;
        assert_eq!(from_row_major(&bad), Err(PoseError::NotAffine));
        bad = good;
        bad[0] += 0.1;
        assert_eq!(from_row_major(&bad), Err(PoseError::NotARotation));
        bad = good;
        for v in &mut bad[0..3] {
            *v = -*v;
        }
        assert_eq!(from_row_major(&bad), Err(PoseError::Mirrored));
        let transposed = std::array::from_fn(|k| good[4 * (k % 4) + k / 4]);
        assert_eq!(from_row_major(&transposed), Err(PoseError::Transposed));
        bad = good;
        for v in bad
            .iter_mut()
            .take(12)
            .enumerate()
            .filter(|(k, _)| k % 4 < 3)
            .map(|(_, v)| v)
        {
            *v *= 0.5;
        }
        assert!(
            matches!(from_row_major(&bad), Err(PoseError::Scaled(s)) if (s - 0.5).abs() < 1e-9)
        );
        bad = good;
        bad[15] = 2.0;
        assert_eq!(from_row_major(&bad), Err(PoseError::NotAffine));
    }

    #[test]
    fn relative_poses_compose_back() {
        let (a, b) = (pose(), Rigid::translation(1.0, 2.0, 3.0) * pose().inverse());
        let back = a * relative(&a, &b);
        assert!((back.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12);
        let half = interpolate(&a, &b, 0.5);
        let mid = (a.translation.vector + b.translation.vector) / 2.0;
        assert!((half.translation.vector - mid).norm() < 1e-12);
    }
}
