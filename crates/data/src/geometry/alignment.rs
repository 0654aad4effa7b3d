//! Rigid and similarity alignment of corresponding points (Umeyama 1991), with the cases where the optimum is not unique.
//!
//! Every metric that "aligns first" goes through [`align`]: GA- and PA-MPJPE, ATE, and the seams of long reconstructions.

use nalgebra::{Matrix3, Vector3};

/// A similarity transform: `y = scale * rotation * x + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// 1 for a rigid transform; never negative.
    pub scale: f64,
    /// Proper: its determinant is 1.
    pub rotation: Matrix3<f64>,
    /// Metres, in the frame of the target.
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// The transform that changes nothing.
    #[must_use]
    pub fn identity() -> Self {
        Self {
            scale: 1.0,
            rotation: Matrix3::identity(),
            translation: Vector3::zeros(),
        }
    }

    /// Where the transform takes a point.
    #[must_use]
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * point) + self.translation
    }
}

/// What an alignment may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Freedom {
    /// Rotation and translation.
    Rigid,
    /// Rotation, translation and one positive scale.
    Similarity,
}

/// Why an alignment has no unique optimum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Degeneracy {
    /// All source or all target points coincide (sum of squares below 1e-12 m^2). Scale 1 and no rotation are used.
    Point,
    /// The points lie on a line: any rotation about it is as good.
    Line,
    /// The best orthogonal map is a reflection and two rotations come equally close to it.
    MirrorTie,
}

/// The result of [`align`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// From source to target.
    pub transform: Similarity,
    /// `None` when the transform is the unique optimum.
    pub degenerate: Option<Degeneracy>,
}

/// Below this sum of squared deviations (m^2) a set of points is a single point.
const POINT_LIMIT: f64 = 1e-12;
/// Singular values this much smaller than the largest count as zero.
const RANK_LIMIT: f64 = 1e-9;

/// The transform that takes `source` to `target` with the least squared error; proper rotations only.
///
/// Pairs are `source[i]`, `target[i]`; the lengths must agree and no coordinate may be non-finite (callers check).
/// No point at all gives the identity, marked [`Degeneracy::Point`].
#[must_use]
pub fn align(source: &[Vector3<f64>], target: &[Vector3<f64>], freedom: Freedom) -> Alignment {
    debug_assert_eq!(source.len(), target.len());
    let count = source.len() as f64;
    if source.is_empty() {
        return Alignment {
            transform: Similarity::identity(),
            degenerate: Some(Degeneracy::Point),
        };
    }
    let source_mean = source.iter().sum::<Vector3<f64>>() / count;
    let target_mean = target.iter().sum::<Vector3<f64>>() / count;
    let mut covariance = Matrix3::zeros();
    let (mut source_spread, mut target_spread) = (0.0, 0.0);
    for (x, y) in source.iter().zip(target) {
        let (x, y) = (x - source_mean, y - target_mean);
        covariance += y * x.transpose();
        source_spread += x.norm_squared();
        target_spread += y.norm_squared();
    }
    if source_spread < POINT_LIMIT || target_spread < POINT_LIMIT {
        return Alignment {
            transform: Similarity {
                translation: target_mean - source_mean,
                ..Similarity::identity()
            },
            degenerate: Some(Degeneracy::Point),
        };
    }
    let fit = closest_rotation(&covariance);
    let [first, second, third] = fit.singular_values;
    let degenerate = if second <= RANK_LIMIT * first {
        Some(Degeneracy::Line)
    } else if third < 0.0 && second + third <= RANK_LIMIT * first {
        Some(Degeneracy::MirrorTie)
    } else {
        None
    };
    let scale = match freedom {
        Freedom::Rigid => 1.0,
        Freedom::Similarity => (first + second + third) / source_spread,
    };
    Alignment {
        transform: Similarity {
            scale,
            rotation: fit.rotation,
            translation: target_mean - scale * (fit.rotation * source_mean),
        },
        degenerate,
    }
}

/// The rotation that maximises `trace(Rᵀ M)`, with the singular values of `M`; the last carries the sign of `det M`.
struct ClosestRotation {
    rotation: Matrix3<f64>,
    singular_values: [f64; 3],
}

/// One-sided Jacobi: accurate to the last digits even where singular values differ by 1e9, which an eigendecomposition of
/// `MᵀM` is not, and the degeneracy tests need it.
fn closest_rotation(matrix: &Matrix3<f64>) -> ClosestRotation {
    let mut b = *matrix;
    let mut v = Matrix3::<f64>::identity();
    for _sweep in 0..30 {
        let mut rotated = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let alpha = b.column(p).norm_squared();
            let beta = b.column(q).norm_squared();
            let gamma = b.column(p).dot(&b.column(q));
            if gamma == 0.0 || gamma.abs() <= 1e-17 * (alpha * beta).sqrt() {
                continue;
            }
            rotated = true;
            let zeta = (beta - alpha) / (2.0 * gamma);
            let tangent = zeta.signum() / (zeta.abs() + zeta.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = cosine * tangent;
            for m in [&mut b, &mut v] {
                for row in 0..3 {
                    let (x, y) = (m[(row, p)], m[(row, q)]);
                    m[(row, p)] = cosine * x - sine * y;
                    m[(row, q)] = sine * x + cosine * y;
                }
            }
        }
        if !rotated {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| b.column(j).norm().total_cmp(&b.column(i).norm()));
    let column = |m: &Matrix3<f64>, k: usize| m.column(order[k]).into_owned();
    let v1: Vector3<f64> = column(&v, 0);
    let v2: Vector3<f64> = column(&v, 1);
    let v3 = v1.cross(&v2);
    let first = column(&b, 0).norm();
    let u1 = column(&b, 0).try_normalize(0.0).unwrap_or_else(Vector3::x);
    let rest = column(&b, 1) - u1 * u1.dot(&column(&b, 1));
    let second = column(&b, 1).norm();
    let u2 = rest
        .try_normalize(0.0)
        .unwrap_or_else(|| perpendicular(&u1));
    let u3 = u1.cross(&u2);
    ClosestRotation {
        rotation: u1 * v1.transpose() + u2 * v2.transpose() + u3 * v3.transpose(),
        singular_values: [first, second, u3.dot(&(matrix * v3))],
    }
}

fn perpendicular(direction: &Vector3<f64>) -> Vector3<f64> {
    let axis = if direction.x.abs() < 0.6 {
        Vector3::x()
    } else {
        Vector3::y()
    };
    direction.cross(&axis).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use rand::RngExt;

    fn cloud(n: usize, name: &str) -> Vec<Vector3<f64>> {
        let mut rng = crate::random::stream(1, name, 0, 0);
        (0..n)
            .map(|_| Vector3::from_fn(|_, _| rng.random::<f64>() - 0.5))
            .collect()
    }

    #[test]
    fn a_similarity_is_recovered_exactly() {
        let source = cloud(20, "alignment.test");
        let rotation = *Rotation3::from_euler_angles(2.9, -0.4, 1.3).matrix();
        let truth = Similarity {
            scale: 0.37,
            rotation,
            translation: Vector3::new(4.0, -2.0, 0.5),
        };
        let target: Vec<_> = source.iter().map(|p| truth.apply(p)).collect();
        let found = align(&source, &target, Freedom::Similarity);
        assert_eq!(found.degenerate, None);
        assert!((found.transform.rotation - rotation).norm() < 1e-13);
        assert!((found.transform.scale - 0.37).abs() < 1e-13);
        assert!((found.transform.translation - truth.translation).norm() < 1e-13);
    }

    #[test]
    fn a_reflection_is_not_undone() {
        let source = cloud(20, "alignment.mirror");
        let target: Vec<_> = source
            .iter()
            .map(|p| Vector3::new(-p.x, p.y, p.z))
            .collect();
        let found = align(&source, &target, Freedom::Similarity).transform;
        assert!((found.rotation.determinant() - 1.0).abs() < 1e-12);
        assert!(found.scale > 0.0 && found.scale < 1.0);
    }

    #[test]
    fn points_lines_and_mirror_ties_have_no_unique_optimum_and_planes_have() {
        let source = cloud(20, "alignment.rank");
        let still = vec![source[0]; 20];
        let line: Vec<_> = (0..20)
            .map(|i| Vector3::new(1.0, 2.0, 3.0) * i as f64 * 0.1)
            .collect();
        let plane: Vec<_> = source.iter().map(|p| Vector3::new(p.x, p.y, 0.3)).collect();
        let check = |a: &[_], b: &[_]| align(a, b, Freedom::Similarity).degenerate;
        assert_eq!(check(&still, &source), Some(Degeneracy::Point));
        assert_eq!(check(&source, &still), Some(Degeneracy::Point));
        assert_eq!(check(&[], &[]), Some(Degeneracy::Point));
        assert_eq!(check(&line, &source), Some(Degeneracy::Line));
        assert_eq!(check(&plane, &plane), None);
        // A regular octahedron seen in a mirror: every axis flip is equally good.
        let octahedron: Vec<_> = (0..6)
            .map(|i| {
                Vector3::from_fn(|row, _| {
                    if row == i / 2 {
                        1.0 - 2.0 * (i % 2) as f64
                    } else {
                        0.0
                    }
                })
            })
            .collect();
        let mirrored: Vec<_> = octahedron.iter().map(|p: &Vector3<f64>| -p).collect();
        assert_eq!(check(&octahedron, &mirrored), Some(Degeneracy::MirrorTie));
    }

    #[test]
    fn a_rigid_alignment_keeps_the_scale() {
        let source = cloud(9, "alignment.rigid");
        let target: Vec<_> = source.iter().map(|p| p * 3.0).collect();
        assert_eq!(align(&source, &target, Freedom::Rigid).transform.scale, 1.0);
    }
}
