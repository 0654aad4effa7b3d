//! Metric scale: depth fitted to the floor under the wearer's feet, or to a metric depth of another model (Supp. D).
//!
//! The camera and the body are metric by their tokenizers; depth is relative. The camera stays fixed and the depth is fitted:
//! `metric = scale * depth + shift`. The literal text of the supplement (fit the points' heights to a constant) has the trivial
//! optimum `scale = 0`; with the camera fixed it has not. What cannot be fitted is refused with a reason, and the depth stays
//! relative and is called so.

use nalgebra::{Isometry3, Matrix2, Vector2, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Height of the floor from the feet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FloorRule {
    /// The mean of the lowest half of the foot joints (Supp. D).
    #[default]
    LowestHalf,
    /// The median of the foot joints less 0.2 m (the authors' release).
    ReleaseMedian,
}

/// Settings of the floor fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FloorFit {
    /// How the feet give the floor.
    pub rule: FloorRule,
    /// Share of the points, lowest first, that are taken for floor.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub lowest: f64,
    /// Times the lowest points are chosen again with the fitted depth.
    #[schemars(range(max = 20))]
    pub repeats: usize,
    /// Root mean square of the residual heights beyond which there is no floor, metres.
    #[schemars(range(min = 0.0))]
    pub max_residual: f64,
    /// A point this far from the fitted floor is an outlier, metres.
    #[schemars(range(min = 0.0))]
    pub outlier: f64,
    /// Share of outliers among the lowest points beyond which the fit is refused.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_outliers: f64,
}

impl Default for FloorFit {
    fn default() -> Self {
        Self {
            rule: FloorRule::LowestHalf,
            lowest: 0.05,
            repeats: 5,
            max_residual: 0.25,
            outlier: 0.3,
            max_outliers: 0.4,
        }
    }
}

/// One depth value and where it comes from. World z is up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRay {
    /// Z-depth in the units of the prediction.
    pub depth: f64,
    /// Height gained per unit of z-depth: the z component of the rotated ray `[(u-cx)/fx, (v-cy)/fy, 1]`.
    pub rise: f64,
    /// Height of the camera, metres.
    pub camera_height: f64,
}

impl DepthRay {
    /// The ray through a point of the image plane at unit depth.
    pub fn new(depth: f64, T_world_camera: &Isometry3<f64>, x: f64, y: f64) -> Self {
        Self {
            depth,
            rise: (T_world_camera.rotation * Vector3::new(x, y, 1.0)).z,
            camera_height: T_world_camera.translation.z,
        }
    }

    fn height(&self, scale: f64, shift: f64) -> f64 {
        self.rise * (scale * self.depth + shift) + self.camera_height
    }
}

/// `metric = scale * depth + shift`, and how good that is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthFit {
    /// Above 0.
    pub scale: f64,
    /// Metres.
    pub shift: f64,
    /// Root mean square residual over the fitted points: heights for the floor, depths for an anchor, metres.
    pub residual: f64,
    /// Points that were fitted.
    pub points: usize,
    /// Share of fitted points beyond [`FloorFit::outlier`]; 0 for an anchor.
    pub outliers: f64,
}

/// Depth is never nearer than this, metres.
pub(super) const NEAREST: f32 = 0.01;

impl DepthFit {
    /// A depth in metres.
    #[must_use]
    pub fn apply(&self, depth: f32) -> f32 {
        (self.scale as f32 * depth + self.shift as f32).max(NEAREST)
    }
}

/// Why no metric scale was found. The depth then stays relative.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case", tag = "reason")]
pub enum ScaleRefusal {
    /// There is no body track, which the floor fit needs.
    #[error("no body in the reconstruction, so no feet to stand on")]
    NoBody,
    /// There is no camera track, which the floor fit needs.
    #[error("no camera path in the reconstruction, so no rays to the floor")]
    NoCamera,
    /// Fewer than two heights of foot joints are finite.
    #[error("only {found} foot samples, at least 2 are needed")]
    NoFeet {
        /// Finite heights of foot joints.
        found: usize,
    },
    /// Fewer than 100 depth values can be used for the fit.
    #[error("only {found} depth points, at least 100 are needed")]
    TooFewPoints {
        /// Depth values that can be used.
        found: usize,
    },
    /// A ray to one of the points that are taken for floor is level or rises.
    #[error("the lowest points do not lie below the camera: no floor in view")]
    NotBelow,
    /// The depths do not determine a scale: all are 0 (floor fit) or equal (anchor).
    #[error("the fit has no unique solution: all depths or all rays are equal")]
    Degenerate,
    /// The fitted scale is 0, negative or not finite.
    #[error("the fitted scale {scale:.4} is not positive")]
    NotPositive {
        /// The fitted scale, metres per unit of depth.
        scale: f64,
    },
    /// The residual is above [`FloorFit::max_residual`].
    #[error("the lowest points are {residual:.2} m (RMS) from any floor: no floor in view")]
    NoFloor {
        /// Root mean square of the residual heights, metres.
        residual: f64,
    },
    /// The share of outliers is above [`FloorFit::max_outliers`].
    #[error("{:.0} % of the lowest points are not on the fitted floor", share * 100.0)]
    Outliers {
        /// Share of the points that are taken for floor, 0 to 1.
        share: f64,
    },
}

/// Height of the floor from foot joints of both feet and all samples, metres.
///
/// # Errors
/// With fewer than two finite heights.
pub fn floor_height(feet: &[f64], rule: FloorRule) -> Result<f64, ScaleRefusal> {
    let mut heights: Vec<f64> = feet.iter().copied().filter(|z| z.is_finite()).collect();
    if heights.len() < 2 {
        return Err(ScaleRefusal::NoFeet {
            found: heights.len(),
        });
    }
    heights.sort_by(f64::total_cmp);
    Ok(match rule {
        FloorRule::LowestHalf => {
            let half = &heights[..heights.len().div_ceil(2)];
            half.iter().sum::<f64>() / half.len() as f64
        }
        FloorRule::ReleaseMedian => {
            let (low, high) = (heights[(heights.len() - 1) / 2], heights[heights.len() / 2]);
            f64::midpoint(low, high) - 0.2
        }
    })
}

/// Fits depth to the floor with the camera held fixed: least squares on the lowest points, chosen again with each fit.
///
/// # Errors
/// A [`ScaleRefusal`] when there is no floor to be seen or no unique positive scale.
pub fn fit_floor(
    rays: &[DepthRay],
    floor: f64,
    settings: &FloorFit,
) -> Result<DepthFit, ScaleRefusal> {
    let rays: Vec<DepthRay> = rays
        .iter()
        .copied()
        .filter(|r| r.depth.is_finite() && r.rise.is_finite() && r.camera_height.is_finite())
        .collect();
    if rays.len() < 100 {
        return Err(ScaleRefusal::TooFewPoints { found: rays.len() });
    }
    let take = ((rays.len() as f64 * settings.lowest).ceil() as usize).clamp(2, rays.len());
    let mut fit = (1.0, 0.0);
    let mut lowest;
    let mut round = 0;
    loop {
        lowest = lowest_points(&rays, fit, take);
        if lowest.iter().any(|r| r.rise >= 0.0) {
            return Err(ScaleRefusal::NotBelow);
        }
        let next = solve(&lowest, floor)?;
        let settled = (next.0 - fit.0).abs() < 1e-3 * next.0.abs();
        fit = next;
        if settled || round >= settings.repeats {
            break;
        }
        round += 1;
    }
    let residuals: Vec<f64> = lowest
        .iter()
        .map(|r| r.height(fit.0, fit.1) - floor)
        .collect();
    let n = residuals.len() as f64;
    let residual = (residuals.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    let outliers = residuals
        .iter()
        .filter(|e| e.abs() > settings.outlier)
        .count() as f64
        / n;
    if residual > settings.max_residual {
        return Err(ScaleRefusal::NoFloor { residual });
    }
    if outliers > settings.max_outliers {
        return Err(ScaleRefusal::Outliers { share: outliers });
    }
    Ok(DepthFit {
        scale: fit.0,
        shift: fit.1,
        residual,
        points: lowest.len(),
        outliers,
    })
}

/// The `take` lowest points under a fit, in a fixed order.
fn lowest_points(rays: &[DepthRay], (scale, shift): (f64, f64), take: usize) -> Vec<DepthRay> {
    let mut order: Vec<usize> = (0..rays.len()).collect();
    let height = |i: &usize| rays[*i].height(scale, shift);
    order.select_nth_unstable_by(take - 1, |a, b| {
        height(a).total_cmp(&height(b)).then(a.cmp(b))
    });
    order.truncate(take);
    order.sort_unstable();
    order.into_iter().map(|i| rays[i]).collect()
}

/// Least squares for `rise * (scale * depth + shift) = floor - camera_height`.
fn solve(points: &[DepthRay], floor: f64) -> Result<(f64, f64), ScaleRefusal> {
    let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
    for point in points {
        let row = Vector2::new(point.depth * point.rise, point.rise);
        normal += row * row.transpose();
        right += row * (floor - point.camera_height);
    }
    let values = normal.symmetric_eigenvalues();
    let (small, large) = (values.min(), values.max());
    if !large.is_finite() || large <= 0.0 || normal[(0, 0)] <= 0.0 {
        return Err(ScaleRefusal::Degenerate);
    }
    // Equal depths or parallel rays leave one unknown: the scale alone.
    let (scale, shift) = if small <= large * 1e-8 {
        (right[0] / normal[(0, 0)], 0.0)
    } else {
        let solution = normal.try_inverse().ok_or(ScaleRefusal::Degenerate)? * right;
        (solution[0], solution[1])
    };
    if scale > 0.0 && scale.is_finite() {
        Ok((scale, shift))
    } else {
        Err(ScaleRefusal::NotPositive { scale })
    }
}

/// Fits depth to a metric depth of another model over pairs `(depth, metric)` with a positive finite metric.
///
/// # Errors
/// With fewer than 100 such pairs, equal depths everywhere, or a scale that is not positive.
pub fn fit_anchor(pairs: &[(f64, f64)]) -> Result<DepthFit, ScaleRefusal> {
    let pairs: Vec<(f64, f64)> = pairs
        .iter()
        .copied()
        .filter(|(d, m)| d.is_finite() && m.is_finite() && *m > 0.0)
        .collect();
    if pairs.len() < 100 {
        return Err(ScaleRefusal::TooFewPoints { found: pairs.len() });
    }
    let n = pairs.len() as f64;
    let mean_d = pairs.iter().map(|p| p.0).sum::<f64>() / n;
    let mean_m = pairs.iter().map(|p| p.1).sum::<f64>() / n;
    let variance = pairs.iter().map(|p| (p.0 - mean_d).powi(2)).sum::<f64>() / n;
    let covariance = pairs
        .iter()
        .map(|p| (p.0 - mean_d) * (p.1 - mean_m))
        .sum::<f64>()
        / n;
    if variance <= 1e-12 * mean_d.abs().max(1e-6).powi(2) {
        return Err(ScaleRefusal::Degenerate);
    }
    let scale = covariance / variance;
    if scale.is_nan() || scale <= 0.0 {
        return Err(ScaleRefusal::NotPositive { scale });
    }
    let shift = mean_m - scale * mean_d;
    let residual = (pairs
        .iter()
        .map(|p| (scale * p.0 + shift - p.1).powi(2))
        .sum::<f64>()
        / n)
        .sqrt();
    Ok(DepthFit {
        scale,
        shift,
        residual,
        points: pairs.len(),
        outliers: 0.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera 1.6 m above the floor that looks 35 degrees down into a room 4 m deep.
    fn room(scale: f64, shift: f64) -> Vec<DepthRay> {
        let pitch =
            nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -35_f64.to_radians());
        let level = nalgebra::UnitQuaternion::from_matrix(&nalgebra::Matrix3::new(
            1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0,
        ));
        let camera = Isometry3::from_parts(Vector3::new(0.0, 0.0, 0.1).into(), level * pitch);
        let mut rays = Vec::new();
        for v in 0..40 {
            for u in 0..40 {
                let (x, y) = ((f64::from(u) - 19.5) / 20.0, (f64::from(v) - 19.5) / 20.0);
                let ray = DepthRay::new(0.0, &camera, x, y);
                let forward = (camera.rotation * Vector3::new(x, y, 1.0)).y;
                let floor = if ray.rise < 0.0 {
                    (-1.5 - 0.1) / ray.rise
                } else {
                    f64::INFINITY
                };
                let metric = floor.min(4.0 / forward.max(1e-3));
                rays.push(DepthRay {
                    depth: (metric - shift) / scale,
                    ..ray
                });
            }
        }
        rays
    }

    #[test]
    fn the_floor_gives_scale_and_shift_back() {
        for (scale, shift) in [(1.0, 0.0), (2.5, 0.0), (0.7, 0.4), (1.6, -0.3)] {
            let fit = fit_floor(&room(scale, shift), -1.5, &FloorFit::default()).unwrap();
            assert!(
                (fit.scale - scale).abs() < 1e-6 && (fit.shift - shift).abs() < 1e-6,
                "{fit:?}"
            );
            assert!(fit.residual < 1e-6);
        }
    }

    #[test]
    fn a_room_without_a_floor_is_refused() {
        let looking_up: Vec<DepthRay> = room(1.0, 0.0)
            .into_iter()
            .map(|r| DepthRay {
                rise: r.rise.abs(),
                ..r
            })
            .collect();
        assert_eq!(
            fit_floor(&looking_up, -1.5, &FloorFit::default()),
            Err(ScaleRefusal::NotBelow)
        );
        assert!(matches!(
            fit_floor(&[], -1.5, &FloorFit::default()),
            Err(ScaleRefusal::TooFewPoints { found: 0 })
        ));
        let flat: Vec<DepthRay> = (0..200)
            .map(|_| DepthRay {
                depth: 0.0,
                rise: -0.5,
                camera_height: 0.0,
            })
            .collect();
        assert_eq!(
            fit_floor(&flat, -1.5, &FloorFit::default()),
            Err(ScaleRefusal::Degenerate)
        );
    }

    #[test]
    fn feet_give_the_floor_by_either_rule() {
        let feet = [-1.4, -1.5, -1.5, -1.0, f64::NAN];
        assert!((floor_height(&feet, FloorRule::LowestHalf).unwrap() + 1.5).abs() < 1e-12);
        assert!((floor_height(&feet, FloorRule::ReleaseMedian).unwrap() + 1.65).abs() < 1e-12);
        assert_eq!(
            floor_height(&[f64::NAN, 1.0], FloorRule::LowestHalf),
            Err(ScaleRefusal::NoFeet { found: 1 })
        );
    }

    #[test]
    fn an_anchor_gives_scale_and_shift_and_refuses_constants() {
        let pairs: Vec<(f64, f64)> = (0..200)
            .map(|i| (f64::from(i), 0.5 * f64::from(i) + 2.0))
            .collect();
        let fit = fit_anchor(&pairs).unwrap();
        assert!((fit.scale - 0.5).abs() < 1e-12 && (fit.shift - 2.0).abs() < 1e-9);
        let constant: Vec<(f64, f64)> = (0..200).map(|i| (3.0, f64::from(i) + 1.0)).collect();
        assert_eq!(fit_anchor(&constant), Err(ScaleRefusal::Degenerate));
        let inverse: Vec<(f64, f64)> = (0..200)
            .map(|i| (f64::from(i), 300.0 - f64::from(i)))
            .collect();
        assert!(matches!(
            fit_anchor(&inverse),
            Err(ScaleRefusal::NotPositive { .. })
        ));
    }
}
