//! Rotations: the continuous 6D representation, interpolation, angles.
//!
//! The 6D form is the first two columns of the rotation matrix; any two non-parallel vectors give a rotation back by
//! Gram-Schmidt. The camera modality (Sec. 4.2) stores these six numbers and the translation.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Norms are floored here before a division.
const NORM_FLOOR: f64 = 1e-8;

/// The first two columns of the matrix of `rotation`: `[r00 r10 r20 r01 r11 r21]`.
pub fn to_6d(rotation: &UnitQuaternion<f64>) -> [f64; 6] {
    let m = rotation.to_rotation_matrix();
    let m = m.matrix();
    [
        m[(0, 0)],
        m[(1, 0)],
        m[(2, 0)],
        m[(0, 1)],
        m[(1, 1)],
        m[(2, 1)],
    ]
}

/// The rotation whose first two columns are the Gram-Schmidt orthonormalisation of `six`.
///
/// `None` where no rotation is meant: not finite, or the two vectors are (nearly) parallel or zero.
pub fn from_6d(six: &[f64; 6]) -> Option<UnitQuaternion<f64>> {
    let a1 = Vector3::new(six[0], six[1], six[2]);
    let a2 = Vector3::new(six[3], six[4], six[5]);
    if !six.iter().all(|v| v.is_finite()) || a1.norm() <= NORM_FLOOR || a2.norm() <= NORM_FLOOR {
        return None;
    }
    let b1 = a1.normalize();
    let rest = a2 - b1 * b1.dot(&a2);
    let parallel = rest.norm() <= NORM_FLOOR * a2.norm().max(1.0);
    if parallel || !rest.norm().is_finite() {
        return None;
    }
    let b2 = rest.normalize();
    let b3 = b1.cross(&b2);
    let matrix = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[b1, b2, b3]));
    Some(UnitQuaternion::from_rotation_matrix(&matrix))
}

/// Spherical interpolation along the shorter arc; `t` 0 gives `a`, 1 gives `b`.
pub fn slerp(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>, t: f64) -> UnitQuaternion<f64> {
    // Opposite rotations have no shorter arc; staying at the nearer end keeps the result defined.
    a.try_slerp(b, t, 1e-9)
        .unwrap_or(if t < 0.5 { *a } else { *b })
}

/// The rotation nearest to a 3x3 matrix in the Frobenius norm (by SVD); `None` where the matrix is not finite or singular.
pub fn nearest(matrix: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    if !matrix.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = matrix.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    if svd.singular_values.min() < NORM_FLOOR * svd.singular_values.max().max(1.0) {
        return None;
    }
    let mut fix = Matrix3::identity();
    fix[(2, 2)] = (u * v_t).determinant().signum();
    let rotation = Rotation3::from_matrix_unchecked(u * fix * v_t);
    Some(UnitQuaternion::from_rotation_matrix(&rotation))
}

/// An angle brought into (-pi, pi].
pub fn wrap_angle(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    let wrapped = angle.rem_euclid(turn);
    if wrapped > std::f64::consts::PI {
        wrapped - turn
    } else {
        wrapped
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    fn random_rotation(sample: u64) -> UnitQuaternion<f64> {
        let mut rng = crate::random::stream(1, "test.rotation", 0, sample);
        let axis = Vector3::new(
            rng.random::<f64>() - 0.5,
            rng.random::<f64>() - 0.5,
            rng.random::<f64>() - 0.5,
        );
        UnitQuaternion::from_scaled_axis(axis * 9.0)
    }

    #[test]
    fn six_numbers_hold_a_rotation_and_survive_scaling_and_shear() {
        for sample in 0..100 {
            let r = random_rotation(sample);
            let mut six = to_6d(&r);
            assert!(from_6d(&six).unwrap().angle_to(&r) < 1e-7);
            for k in 0..3 {
                six[k] *= 3.0;
                six[3 + k] = 0.5 * six[3 + k] + 0.7 * six[k];
            }
            assert!(from_6d(&six).unwrap().angle_to(&r) < 1e-7);
        }
    }

    #[test]
    fn degenerate_six_numbers_are_refused() {
        assert!(from_6d(&[0.0; 6]).is_none());
        assert!(from_6d(&[1.0, 2.0, 3.0, 2.0, 4.0, 6.0]).is_none());
        assert!(from_6d(&[f64::NAN, 0.0, 0.0, 0.0, 1.0, 0.0]).is_none());
        assert!(from_6d(&[1.0, 0.0, 0.0, 0.0, f64::INFINITY, 0.0]).is_none());
    }

    #[test]
    fn slerp_moves_at_constant_angular_speed() {
        let (a, b) = (random_rotation(3), random_rotation(4));
        let whole = a.angle_to(&b);
        for step in 0..=10 {
            let t = f64::from(step) / 10.0;
            assert!((a.angle_to(&slerp(&a, &b, t)) - t * whole).abs() < 1e-7);
        }
    }

    #[test]
    fn nearest_rotation_undoes_noise_and_never_reflects() {
        let r = random_rotation(5);
        let noisy = r.to_rotation_matrix().matrix() * 1.7 + Matrix3::from_element(1e-6);
        assert!(nearest(&noisy).unwrap().angle_to(&r) < 1e-5);
        assert!(nearest(&-Matrix3::identity()).is_some());
        assert!(nearest(&Matrix3::zeros()).is_none());
    }

    #[test]
    fn angles_wrap_into_one_turn() {
        assert!((wrap_angle(3.0 * std::f64::consts::PI) - std::f64::consts::PI).abs() < 1e-12);
        assert!((wrap_angle(-0.1) + 0.1).abs() < 1e-12);
    }
}
