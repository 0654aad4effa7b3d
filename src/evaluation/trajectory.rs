//! Camera trajectories (Sec. 5): ATE, RTE and RRE after one similarity over the clip.
//!
//! With `P_i` the aligned estimate and `Q_i` the reference, `ATE_i = |pos P_i - pos Q_i|`, and for pairs `delta` samples apart
//! `E = (Q_i⁻¹ Q_{i+Δ})⁻¹ (P_i⁻¹ P_{i+Δ})`, `RTE = |trans E|`, `RRE = angle(rot E)`. RRE does not depend on the alignment.

use super::outcome::{MetricError, Outcome, mean, rms};
use crate::geometry::alignment::{Freedom, Similarity, align};
use nalgebra::{Isometry3, Matrix3, Vector3};
use ndarray::ArrayView3;

/// A pose as metrics take it: a rotation matrix that was checked, and a position in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// From the camera's axes to the world's.
    pub rotation: Matrix3<f64>,
    /// The camera's origin in the world, metres.
    pub position: Vector3<f64>,
}

impl From<&Isometry3<f64>> for Pose {
    fn from(pose: &Isometry3<f64>) -> Self {
        Self {
            rotation: *pose.rotation.to_rotation_matrix().matrix(),
            position: pose.translation.vector,
        }
    }
}

/// How far `det R` may be from 1, and any entry of `RᵀR` from the identity.
const ROTATION_TOLERANCE: f64 = 1e-4;

impl Pose {
    fn is_finite(&self) -> bool {
        self.rotation
            .iter()
            .chain(&self.position)
            .all(|c| c.is_finite())
    }

    /// The motion from `self` to `next`, seen from `self`.
    fn step(&self, next: &Self) -> Self {
        let back = self.rotation.transpose();
        Self {
            rotation: back * next.rotation,
            position: back * (next.position - self.position),
        }
    }
}

/// Poses out of `[T, 4, 4]` matrices.
///
/// # Errors
/// When the shape is another, an entry is not finite, a rotation block is not a rotation (1e-4), or a fourth row not `0 0 0 1`.
pub fn poses_from_matrices(
    matrices: ArrayView3<f64>,
    field: &'static str,
) -> Result<Vec<Pose>, MetricError> {
    let (count, rows, columns) = matrices.dim();
    if (rows, columns) != (4, 4) {
        return Err(MetricError::Shape {
            field,
            found: vec![count, rows, columns],
            expected: vec![count, 4, 4],
        });
    }
    (0..count)
        .map(|i| {
            let pose = Pose {
                rotation: Matrix3::from_fn(|r, c| matrices[(i, r, c)]),
                position: Vector3::from_fn(|r, _| matrices[(i, r, 3)]),
            };
            check(&pose, i, field)?;
            let last = [0.0, 0.0, 0.0, 1.0];
            if (0..4).any(|c| (matrices[(i, 3, c)] - last[c]).abs() > 1e-6) {
                return Err(MetricError::NotAffine { field, index: i });
            }
            Ok(pose)
        })
        .collect()
}

fn check(pose: &Pose, index: usize, field: &'static str) -> Result<(), MetricError> {
    if !pose.is_finite() {
        return Err(MetricError::NotFinite {
            field,
            position: vec![index],
        });
    }
    let gram = pose.rotation.transpose() * pose.rotation - Matrix3::identity();
    let error = gram.amax().max((pose.rotation.determinant() - 1.0).abs());
    if error > ROTATION_TOLERANCE {
        return Err(MetricError::NotARotation {
            field,
            index,
            error,
        });
    }
    Ok(())
}

/// Trajectory errors of one clip; metres and degrees.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrajectoryErrors {
    /// Poses that were scored.
    pub n_poses: usize,
    /// Pairs `delta` samples apart, both of them scored poses.
    pub n_pairs: usize,
    /// Root mean square of ATE over poses, metres.
    pub ate_rmse: Option<f64>,
    /// Mean of ATE over poses, metres.
    pub ate_mean: Option<f64>,
    /// Root mean square of RTE over pairs, metres; `None` without a pair.
    pub rte_rmse: Option<f64>,
    /// Mean of RTE over pairs, metres; `None` without a pair.
    pub rte_mean: Option<f64>,
    /// The translation of `(P_i⁻¹ P_{i+Δ}) (Q_i⁻¹ Q_{i+Δ})⁻¹`, the order of the TUM benchmark's script.
    pub rte_tum_rmse: Option<f64>,
    /// Root mean square of RRE over pairs, degrees; `None` without a pair.
    pub rre_rmse: Option<f64>,
    /// Mean of RRE over pairs, degrees; `None` without a pair.
    pub rre_mean: Option<f64>,
    /// RTE and RRE of a camera that never moves.
    pub still_rte_rmse: Option<f64>,
    /// Mean RTE of a camera that never moves, metres.
    pub still_rte_mean: Option<f64>,
    /// Root mean square of the RRE of a camera that never moves, degrees.
    pub still_rre_rmse: Option<f64>,
    /// Mean RRE of a camera that never moves, degrees.
    pub still_rre_mean: Option<f64>,
    /// The alignment that was applied to the estimate.
    pub alignment: Option<Similarity>,
    /// ATE and RTE are not comparable: the alignment is not unique, or there are fewer than three poses.
    pub degenerate: bool,
}

impl TrajectoryErrors {
    /// The root mean square of ATE as the clip's score, metres.
    #[must_use]
    pub fn ate(&self) -> Outcome {
        Outcome::unless(self.degenerate, self.ate_rmse)
    }

    /// The root mean square of RTE as the clip's score, metres.
    #[must_use]
    pub fn rte(&self) -> Outcome {
        Outcome::unless(self.degenerate, self.rte_rmse)
    }

    /// Excluded with the others on degenerate clips, so that the three columns stand for the same clips.
    #[must_use]
    pub fn rre(&self) -> Outcome {
        Outcome::unless(self.degenerate, self.rre_rmse)
    }
}

/// [`masked_trajectory_errors`] with every sample valid.
///
/// # Errors
/// As there.
pub fn trajectory_errors(
    estimate: &[Pose],
    reference: &[Pose],
    delta: usize,
    freedom: Freedom,
) -> Result<TrajectoryErrors, MetricError> {
    masked_trajectory_errors(estimate, reference, None, delta, freedom)
}

/// Errors of `estimate` against `reference`, poses at the same times; `delta` samples between the two poses of a pair. Samples
/// that `valid` (if given) excludes take no part, and neither do pairs with one of them.
///
/// # Errors
/// When the lengths differ, `delta` is 0, or a valid pose is not finite or not a rotation.
pub fn masked_trajectory_errors(
    estimate: &[Pose],
    reference: &[Pose],
    valid: Option<&[bool]>,
    delta: usize,
    freedom: Freedom,
) -> Result<TrajectoryErrors, MetricError> {
    let lengths = [
        ("trajectory", estimate.len()),
        (
            "validity of a trajectory",
            valid.map_or(reference.len(), <[bool]>::len),
        ),
    ];
    for (field, found) in lengths {
        if found != reference.len() {
            return Err(MetricError::Shape {
                field,
                found: vec![found],
                expected: vec![reference.len()],
            });
        }
    }
    if delta == 0 {
        return Err(MetricError::Argument {
            name: "delta",
            found: 0.0,
            allowed: "at least 1 sample".to_owned(),
        });
    }
    let scored: Vec<usize> = (0..reference.len())
        .filter(|&i| valid.is_none_or(|v| v[i]))
        .collect();
    if scored.is_empty() {
        return Ok(TrajectoryErrors::default());
    }
    for &i in &scored {
        check(&estimate[i], i, "estimated camera")?;
        check(&reference[i], i, "reference camera")?;
    }
    let positions = |poses: &[Pose]| {
        scored
            .iter()
            .map(|&i| poses[i].position)
            .collect::<Vec<_>>()
    };
    let alignment = align(&positions(estimate), &positions(reference), freedom);
    let similarity = alignment.transform;
    let aligned: Vec<Pose> = estimate
        .iter()
        .map(|p| Pose {
            rotation: similarity.rotation * p.rotation,
            position: similarity.apply(&p.position),
        })
        .collect();
    let absolute: Vec<f64> = scored
        .iter()
        .map(|&i| (aligned[i].position - reference[i].position).norm())
        .collect();

    let (mut rte, mut rte_tum, mut rre) = (Vec::new(), Vec::new(), Vec::new());
    let (mut still_rte, mut still_rre) = (Vec::new(), Vec::new());
    for &i in &scored {
        let next = i + delta;
        if next >= reference.len() || valid.is_some_and(|v| !v[next]) {
            continue;
        }
        let truth = reference[i].step(&reference[next]);
        let guess = aligned[i].step(&aligned[next]);
        let error = truth.rotation.transpose() * guess.rotation;
        let undone = guess.rotation * (truth.rotation.transpose() * truth.position);
        rte.push((guess.position - truth.position).norm());
        rte_tum.push((guess.position - undone).norm());
        rre.push(angle_degrees(&error));
        still_rte.push(truth.position.norm());
        still_rre.push(angle_degrees(&truth.rotation));
    }
    let stats = |values: &[f64]| (rms(values.iter().copied()), mean(values.iter().copied()));
    let (ate_rmse, ate_mean) = stats(&absolute);
    let (rte_rmse, rte_mean) = stats(&rte);
    let (rre_rmse, rre_mean) = stats(&rre);
    let (still_rte_rmse, still_rte_mean) = stats(&still_rte);
    let (still_rre_rmse, still_rre_mean) = stats(&still_rre);
    Ok(TrajectoryErrors {
        n_poses: scored.len(),
        n_pairs: rte.len(),
        ate_rmse,
        ate_mean,
        rte_rmse,
        rte_mean,
        rte_tum_rmse: stats(&rte_tum).0,
        rre_rmse,
        rre_mean,
        still_rte_rmse,
        still_rte_mean,
        still_rre_rmse,
        still_rre_mean,
        alignment: Some(similarity),
        degenerate: alignment.degenerate.is_some() || scored.len() < 3,
    })
}

/// The angle of a rotation by `atan2`: the arc cosine of the trace loses everything below 1e-6 degrees.
fn angle_degrees(rotation: &Matrix3<f64>) -> f64 {
    let skew = rotation - rotation.transpose();
    let axis = Vector3::new(skew[(2, 1)], skew[(0, 2)], skew[(1, 0)]);
    axis.norm().atan2(rotation.trace() - 1.0).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use rand::RngExt;

    fn walk(name: &str) -> Vec<Pose> {
        let mut rng = crate::random::stream(5, name, 0, 0);
        (0..60)
            .map(|i| {
                let mut noise = || 0.1 * rng.random::<f64>();
                Pose {
                    rotation: *Rotation3::from_euler_angles(noise(), noise(), noise()).matrix(),
                    position: Vector3::new(0.05 * i as f64, noise(), noise()),
                }
            })
            .collect()
    }

    #[test]
    fn a_similarity_of_the_estimate_changes_no_error() {
        let (estimate, reference) = (walk("a"), walk("b"));
        let base = trajectory_errors(&estimate, &reference, 1, Freedom::Similarity).unwrap();
        let turn = *Rotation3::from_euler_angles(1.0, 2.0, 3.0).matrix();
        let moved: Vec<_> = estimate
            .iter()
            .map(|p| Pose {
                rotation: turn * p.rotation,
                position: 7.0 * (turn * p.position) + Vector3::new(1.0, 2.0, 3.0),
            })
            .collect();
        let other = trajectory_errors(&moved, &reference, 1, Freedom::Similarity).unwrap();
        for (x, y) in [
            (base.ate_rmse, other.ate_rmse),
            (base.rte_rmse, other.rte_rmse),
            (base.rre_rmse, other.rre_rmse),
        ] {
            assert!((x.unwrap() - y.unwrap()).abs() < 1e-10);
        }
        assert_eq!(base.degenerate, other.degenerate);
    }

    #[test]
    fn an_immobile_reference_is_degenerate_for_any_prediction() {
        let still = vec![walk("a")[0]; 60];
        let errors = trajectory_errors(&walk("b"), &still, 1, Freedom::Similarity).unwrap();
        assert_eq!(errors.ate(), Outcome::Degenerate);
        assert_eq!(errors.still_rre_mean, Some(0.0));
    }

    #[test]
    fn an_invalid_sample_changes_nothing() {
        let (mut estimate, reference) = (walk("a"), walk("b"));
        let mut valid = vec![true; 60];
        valid[20] = false;
        let errors = |estimate: &[Pose]| {
            masked_trajectory_errors(estimate, &reference, Some(&valid), 1, Freedom::Similarity)
                .unwrap()
        };
        let before = errors(&estimate);
        estimate[20].position.x = f64::NAN;
        assert_eq!(before, errors(&estimate));
        assert_eq!((before.n_poses, before.n_pairs), (59, 57));
    }

    #[test]
    fn a_step_of_no_samples_is_named_and_not_called_a_shape() {
        let (a, b) = (walk("a"), walk("b"));
        let refusal = trajectory_errors(&a, &b, 0, Freedom::Similarity).unwrap_err();
        assert_eq!(
            refusal.to_string(),
            "`delta` is 0; it must be at least 1 sample"
        );
        let valid = [true; 59];
        let refusal = masked_trajectory_errors(&a, &b, Some(&valid), 1, Freedom::Similarity);
        assert_eq!(
            refusal.unwrap_err().to_string(),
            "validity of a trajectory: shape [59] does not fit [60]"
        );
    }

    #[test]
    fn a_matrix_that_is_no_rotation_is_refused() {
        let mut estimate = walk("a");
        estimate[7].rotation[(0, 0)] += 2e-3;
        let refusal = trajectory_errors(&estimate, &walk("b"), 1, Freedom::Similarity).unwrap_err();
        assert!(matches!(
            refusal,
            MetricError::NotARotation { index: 7, .. }
        ));
    }
}
