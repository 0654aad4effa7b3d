//! Where the head segment of the suit sits on the glasses: the hand-eye problem `A X = X B`.
//!
//! Over the same short time the glasses turn by A and the head segment, seen by the suit, by B; X = `T_device_head` is what makes them
//! the same movement. Its rotation aligns the rotation vectors (by SVD), its translation is the least-squares solution of
//! `(R_A - 1) t_X = R_X t_B - t_A`. Suit and glasses drift against each other, which short steps do not see.

use crate::geometry::rotation;
use nalgebra::{Isometry3, Matrix3, Translation3, Vector3};

/// Directions of turning whose share of all turning is less than this are not known (of the translation's normal equations).
const WEAKEST: f64 = 1e-4;
/// Fewer steps decide nothing.
const FEWEST: usize = 100;

/// Relative movements of both, one pair after another.
#[derive(Debug, Default)]
pub(super) struct HandEye {
    /// Sum of `a b^T` over rotation vectors.
    rotation: Matrix3<f64>,
    /// `(R_A, t_A, t_B)` of each step.
    steps: Vec<(Matrix3<f64>, Vector3<f64>, Vector3<f64>)>,
}

impl HandEye {
    /// Adds a step: `T_device1_device2` and `T_head1_head2`.
    pub fn add(&mut self, device: &Isometry3<f64>, head: &Isometry3<f64>) {
        let (a, b) = (device.rotation.scaled_axis(), head.rotation.scaled_axis());
        self.rotation += a * b.transpose();
        self.steps.push((
            device.rotation.to_rotation_matrix().into_inner(),
            device.translation.vector,
            head.translation.vector,
        ));
    }

    /// `T_device_head`; `None` where the head hardly turned, or around one axis only.
    pub fn solve(&self) -> Option<Isometry3<f64>> {
        if self.steps.len() < FEWEST {
            return None;
        }
        let scale = self.rotation.amax();
        if !(scale > 0.0 && scale.is_finite()) {
            return None;
        }
        let R_device_head = rotation::nearest(&(self.rotation / scale))?;
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (R_a, t_a, t_b) in &self.steps {
            let m = R_a - Matrix3::identity();
            normal += m.transpose() * m;
            right += m.transpose() * (R_device_head * t_b - t_a);
        }
        let shares = normal.symmetric_eigenvalues();
        if shares.min() < WEAKEST * shares.max() {
            return None;
        }
        let translation = normal.try_inverse()? * right;
        Some(Isometry3::from_parts(
            Translation3::from(translation),
            R_device_head,
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A head that nods and shakes at 1 rad/s, seen every 8 ms.
    fn head(k: usize) -> Isometry3<f64> {
        let t = k as f64 * 0.008;
        Isometry3::new(
            Vector3::new(0.3 * t, (2.0 * t).sin() * 0.1, 1.6),
            Vector3::new((3.0 * t).sin() * 0.4, (2.0 * t).cos() * 0.3, 0.5 * t),
        )
    }

    #[test]
    fn the_place_of_the_head_on_the_glasses_is_found() {
        let T_device_head = Isometry3::new(
            Vector3::new(0.09, 0.03, -0.07),
            Vector3::new(0.2, -2.0, 0.7),
        );
        let mut problem = HandEye::default();
        for k in 0..400 {
            let step = head(k).inverse() * head(k + 1);
            problem.add(&(T_device_head * step * T_device_head.inverse()), &step);
        }
        let found = problem.solve().unwrap();
        assert!((found.to_homogeneous() - T_device_head.to_homogeneous()).amax() < 1e-9);
    }

    #[test]
    fn a_head_that_turns_around_one_axis_is_not_placed() {
        let mut problem = HandEye::default();
        for _ in 0..400 {
            let step = Isometry3::new(Vector3::zeros(), Vector3::z() * 0.01);
            problem.add(&step, &step);
        }
        assert!(problem.solve().is_none());
        assert!(HandEye::default().solve().is_none());
    }
}
