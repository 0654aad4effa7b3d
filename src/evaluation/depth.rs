//! Depth: Abs Rel and delta < 1.25 after one least-squares scale and shift per clip (Sec. 5).
//!
//! The space of the alignment is part of the metric's name: `abs_rel@depth` fits depth, `abs_rel@disparity` its inverse. They
//! are different numbers and must never be compared with each other.

use super::outcome::{MetricError, mean};
use ndarray::{ArrayView3, Zip};

/// Where scale and shift are fitted.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Space {
    /// Minimise `Σ (s p + t - g)²`.
    Depth,
    /// Minimise `Σ (s p + t - 1/g)²`; for predictions that are inverse depth.
    Disparity,
    /// Scale by the median of `g / p`: for predictions that are depth up to scale.
    Median,
    /// No alignment: for metric predictions.
    None,
}

/// Ground truth at or below this many metres is not scored where nothing else is said, and aligned depth is clamped to it.
pub const NEAREST: f64 = 1e-3;

/// Which true depths are scored; aligned depth is clamped to the same range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scored {
    /// `dmin`: true depth at or below it is not scored, metres.
    pub min: f64,
    /// `dmax`: true depth at or beyond it is not scored, metres.
    pub max: f64,
}

impl Default for Scored {
    fn default() -> Self {
        Self::between(None, None)
    }
}

impl Scored {
    /// Between `dmin` (otherwise [`NEAREST`]) and `dmax` (otherwise no limit).
    #[must_use]
    pub fn between(min: Option<f64>, max: Option<f64>) -> Self {
        Self {
            min: min.unwrap_or(NEAREST).max(NEAREST),
            max: max.unwrap_or(f64::INFINITY),
        }
    }

    fn has(self, depth: f64) -> bool {
        depth.is_finite() && depth > self.min && depth < self.max
    }
}
/// Farthest aligned depth in disparity space when the data set names no limit.
const FARTHEST_DISPARITY: f64 = 1000.0;

/// Depth errors of one clip.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DepthErrors {
    /// Pixels that were scored, over all frames of the clip.
    pub n_valid: usize,
    /// Mean of `|a - g| / g`.
    pub abs_rel: Option<f64>,
    /// Percent of pixels with `max(a/g, g/a) < 1.25`.
    pub delta_1_25: Option<f64>,
    /// Negative means that the prediction grows where the truth shrinks: a warning.
    pub scale: Option<f64>,
    /// What the fit adds to the scaled prediction: metres, or 1/metres in disparity space; 0 where only a scale is fitted.
    pub shift: Option<f64>,
    /// A constant prediction (or nothing to score): scale and shift are not unique.
    pub degenerate: bool,
}

/// Errors of `pred` against `gt`, both `[T, H, W]`; `gt` in metres. A pixel counts when the mask (if given) says so and the
/// ground truth is finite and in `range`.
///
/// # Errors
/// When the shapes differ, or a prediction on a scored pixel is not finite.
pub fn depth_errors<T: Copy + Into<f64>>(
    pred: ArrayView3<T>,
    gt: ArrayView3<T>,
    mask: Option<ArrayView3<bool>>,
    space: Space,
    range: Scored,
) -> Result<DepthErrors, MetricError> {
    if pred.dim() != gt.dim() || mask.is_some_and(|m| m.dim() != gt.dim()) {
        return Err(MetricError::Shape {
            field: "depth",
            found: pred.shape().to_vec(),
            expected: gt.shape().to_vec(),
        });
    }
    let pixels = scored_pixels(pred, gt, mask, range)?;
    let Some(fit) = fit(&pixels, space) else {
        return Ok(DepthErrors {
            degenerate: true,
            ..DepthErrors::default()
        });
    };
    let least_disparity = 1.0 / range.max.min(FARTHEST_DISPARITY);
    let mut inside = 0_usize;
    let mut relative = 0.0;
    for &(p, g) in &pixels {
        let fitted = fit.scale * p + fit.shift;
        let depth = match space {
            Space::Disparity => 1.0 / fitted.max(least_disparity),
            _ => fitted,
        };
        let a = depth.clamp(range.min, range.max);
        relative += (a - g).abs() / g;
        inside += usize::from((a / g).max(g / a) < 1.25);
    }
    let n = pixels.len() as f64;
    Ok(DepthErrors {
        n_valid: pixels.len(),
        abs_rel: Some(relative / n),
        delta_1_25: Some(100.0 * inside as f64 / n),
        scale: Some(fit.scale),
        shift: Some(fit.shift),
        degenerate: fit.degenerate,
    })
}

fn scored_pixels<T: Copy + Into<f64>>(
    pred: ArrayView3<T>,
    gt: ArrayView3<T>,
    mask: Option<ArrayView3<bool>>,
    range: Scored,
) -> Result<Vec<(f64, f64)>, MetricError> {
    let mut pixels = Vec::with_capacity(gt.len());
    let mut refused = false;
    let mut push = |p: f64, g: f64| {
        if range.has(g) {
            refused |= !p.is_finite();
            pixels.push((p, g));
        }
    };
    match mask {
        Some(mask) => Zip::from(pred).and(gt).and(mask).for_each(|&p, &g, &m| {
            if m {
                push(p.into(), g.into());
            }
        }),
        None => Zip::from(pred)
            .and(gt)
            .for_each(|&p, &g| push(p.into(), g.into())),
    }
    if refused {
        let position = pred
            .indexed_iter()
            .find(|&(i, &p)| {
                let g: f64 = gt[i].into();
                let p: f64 = p.into();
                !p.is_finite() && mask.is_none_or(|m| m[i]) && range.has(g)
            })
            .map_or(vec![], |((t, y, x), _)| vec![t, y, x]);
        return Err(MetricError::NotFinite {
            field: "depth prediction",
            position,
        });
    }
    Ok(pixels)
}

struct Fit {
    scale: f64,
    shift: f64,
    degenerate: bool,
}

fn fit(pixels: &[(f64, f64)], space: Space) -> Option<Fit> {
    match space {
        Space::Depth => least_squares(pixels, |g| g),
        Space::Disparity => least_squares(pixels, |g| 1.0 / g),
        Space::Median => Some(Fit {
            scale: median(pixels.iter().map(|&(p, g)| g / p).collect())?,
            shift: 0.0,
            degenerate: false,
        }),
        Space::None => (!pixels.is_empty()).then_some(Fit {
            scale: 1.0,
            shift: 0.0,
            degenerate: false,
        }),
    }
}

/// Least squares of `scale * p + shift` on `target(g)`, on centred values so that a large offset costs no digits.
fn least_squares(pixels: &[(f64, f64)], target: impl Fn(f64) -> f64) -> Option<Fit> {
    let p_mean = mean(pixels.iter().map(|&(p, _)| p))?;
    let y_mean = mean(pixels.iter().map(|&(_, g)| target(g)))?;
    let (mut covariance, mut variance, mut largest) = (0.0, 0.0, 0.0_f64);
    for &(p, g) in pixels {
        covariance += (p - p_mean) * (target(g) - y_mean);
        variance += (p - p_mean).powi(2);
        largest = largest.max(p.abs());
    }
    let constant = (variance / pixels.len() as f64).sqrt() <= 1e-12 * largest;
    let scale = if constant { 0.0 } else { covariance / variance };
    Some(Fit {
        scale,
        shift: y_mean - scale * p_mean,
        degenerate: constant,
    })
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let half = values.len() / 2;
    match values.len() {
        0 => None,
        n if n % 2 == 1 => Some(values[half]),
        _ => Some(f64::midpoint(values[half - 1], values[half])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;
    use rand::RngExt;

    #[test]
    fn an_affine_change_of_the_prediction_changes_nothing_in_depth_space() {
        let mut rng = crate::random::stream(0, "depth.test", 0, 0);
        let gt = Array3::from_shape_fn((2, 8, 8), |_| 1.0 + 4.0 * rng.random::<f64>());
        let pred = gt.mapv(|g| g + rng.random::<f64>());
        let base = depth_errors(
            pred.view(),
            gt.view(),
            None,
            Space::Depth,
            Scored::default(),
        )
        .unwrap();
        let other = depth_errors(
            pred.mapv(|p| 50.0 - 7.0 * p).view(),
            gt.view(),
            None,
            Space::Depth,
            Scored::default(),
        )
        .unwrap();
        assert!((base.abs_rel.unwrap() - other.abs_rel.unwrap()).abs() < 1e-12);
        assert!(other.scale.unwrap() < 0.0);
        let disparity = depth_errors(
            gt.mapv(|g| 1.0 / g).view(),
            gt.view(),
            None,
            Space::Disparity,
            Scored::default(),
        )
        .unwrap();
        assert!(disparity.abs_rel.unwrap() < 1e-12 && disparity.delta_1_25 == Some(100.0));
    }

    #[test]
    fn only_depth_between_dmin_and_dmax_is_scored() {
        let gt = Array3::from_shape_fn((1, 1, 5), |(_, _, x)| [0.1, 0.5, 1.0, 2.0, 20.0][x]);
        let pred = Array3::from_shape_fn((1, 1, 5), |(_, _, x)| [9.0, 0.5, 1.1, 2.0, 1.0][x]);
        let errors = |min, max| {
            let range = Scored::between(min, max);
            depth_errors(pred.view(), gt.view(), None, Space::None, range).unwrap()
        };
        let inside = errors(Some(0.2), Some(10.0));
        assert_eq!(inside.n_valid, 3);
        assert!((inside.abs_rel.unwrap() - 0.1 / 3.0).abs() < 1e-12);
        assert_eq!(errors(None, Some(10.0)).n_valid, 4);
        assert_eq!(errors(Some(0.2), None).n_valid, 4);
        // A prediction nearer than dmin is taken as dmin.
        let near = Array3::from_elem((1, 1, 5), 0.01);
        let range = Scored::between(Some(0.25), Some(0.6));
        let clamped = depth_errors(near.view(), gt.view(), None, Space::None, range).unwrap();
        assert!((clamped.abs_rel.unwrap() - 0.5).abs() < 1e-12);
    }
}
