//! Metric scale: what a fit of depth is, why there is none, and the fit to a metric depth of another model (Supp. D).
//!
//! The fit to the floor is in [`super::floor`]. What cannot be fitted is refused with a reason, and the depth stays relative and is
//! called so.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The quantity that is known up to scale and shift.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthSpace {
    /// `metres = scale * depth + shift`.
    #[default]
    Depth,
    /// `1 / metres = scale / depth + shift`: depth that was coded as inverse depth between a clip's own extremes.
    Disparity,
}

impl DepthSpace {
    /// A depth in this space, and back.
    pub(super) fn of(self, depth: f64) -> f64 {
        match self {
            Self::Depth => depth,
            Self::Disparity => 1.0 / depth,
        }
    }
}

/// How relative depth becomes metric, and how good that is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthFit {
    /// What scale and shift apply to.
    #[serde(default)]
    pub space: DepthSpace,
    /// Above 0.
    pub scale: f64,
    /// Metres, or 1/m.
    pub shift: f64,
    /// Root mean square residual: heights of the lowest points over the floor, or depths for an anchor, metres.
    pub residual: f64,
    /// Points that were fitted.
    pub points: usize,
    /// Share of the lowest points beyond [`super::floor::FloorFit::outlier`]; 0 for an anchor.
    pub outliers: f64,
}

/// Depth is never nearer than this, metres.
pub(super) const NEAREST: f32 = 0.01;
/// Nor farther, where inverse depth comes to nothing, metres.
const FARTHEST: f32 = 100.0;

impl DepthFit {
    /// A depth in metres.
    #[must_use]
    pub fn apply(&self, depth: f32) -> f32 {
        let (scale, shift) = (self.scale as f32, self.shift as f32);
        match self.space {
            DepthSpace::Depth => (scale * depth + shift).max(NEAREST),
            DepthSpace::Disparity => {
                let inverse = scale / depth + shift;
                (1.0 / inverse.max(1.0 / FARTHEST)).max(NEAREST)
            }
        }
    }

    /// The fit as a formula.
    #[must_use]
    pub fn words(&self) -> String {
        match self.space {
            DepthSpace::Depth => format!("depth x {:.3} + {:.3} m", self.scale, self.shift),
            DepthSpace::Disparity => {
                format!("1 / ({:.3} / depth + {:.3} / m)", self.scale, self.shift)
            }
        }
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
    /// The pictures have no contrast to measure by.
    #[error("the frames are blank: depth there is the model's guess, not a measurement")]
    Blank,
    /// Neighbouring pictures do not resemble each other.
    #[error("neighbouring frames have nothing in common: this is noise, not a video of a place")]
    Noise,
    /// No ray to a point that could be floor goes down.
    #[error("the camera looks nowhere down: no floor in view")]
    NotBelow,
    /// Too few of all points lie on the best plane.
    #[error("only {:.1} % of the points lie on one floor: no floor in view", support * 100.0)]
    NoFloor {
        /// Share of the whole cloud that lies on the fitted floor, 0 to 1.
        support: f64,
    },
    /// Too many of the lowest points are off the fitted floor.
    #[error("{:.0} % of the lowest points are not on the fitted floor", share * 100.0)]
    Outliers {
        /// Share of the points that are taken for floor, 0 to 1.
        share: f64,
    },
    /// Depth varies too little over the floor to tell scale from shift.
    #[error("depth does not say its scale: it spreads by {:.0} % where it was fitted, with a residual of {:.0} %", spread * 100.0, residual * 100.0)]
    Degenerate {
        /// Spread of the depths that were fitted, relative to their mean.
        spread: f64,
        /// Residual of the fit, relative to depth.
        residual: f64,
    },
    /// The fitted scale is 0, negative or not finite.
    #[error("the fitted scale {scale:.4} is not positive")]
    NotPositive {
        /// Metres per unit of depth.
        scale: f64,
    },
    /// Scale or shift is further from the identity than any plausible depth model is.
    #[error(
        "the fit would make depth {factor:.2} times what it was with a shift of {shift:.2}: that is no floor"
    )]
    Bounds {
        /// What depth would be multiplied by.
        factor: f64,
        /// What would be added.
        shift: f64,
    },
    /// Parts of the video, fitted alone, disagree with the whole.
    #[error("seconds of the video fitted alone are {:.0} % from the whole", apart * 100.0)]
    Windows {
        /// How far they are apart, relative to the scale.
        apart: f64,
    },
    /// The wearer's hands, whose distance is known, disagree with the fit.
    #[error(
        "at the hands the fitted depth is {factor:.2} times that of the hands: what was fitted is not the floor"
    )]
    Hands {
        /// Fitted depth over the hands' own.
        factor: f64,
    },
    /// The parallax of the camera's own path disagrees with the fit.
    #[error(
        "the camera's path fits depth {factor:.2} times as large as the floor does: what was fitted is not the floor"
    )]
    Parallax {
        /// Depth by parallax over depth by the floor.
        factor: f64,
    },
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
        return Err(ScaleRefusal::Degenerate {
            spread: 0.0,
            residual: 0.0,
        });
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
        space: DepthSpace::Depth,
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

    #[test]
    fn an_anchor_gives_scale_and_shift_and_refuses_constants() {
        let pairs: Vec<(f64, f64)> = (0..200)
            .map(|i| (f64::from(i), 0.5 * f64::from(i) + 2.0))
            .collect();
        let fit = fit_anchor(&pairs).unwrap();
        assert!((fit.scale - 0.5).abs() < 1e-12 && (fit.shift - 2.0).abs() < 1e-9);
        let constant: Vec<(f64, f64)> = (0..200).map(|i| (3.0, f64::from(i) + 1.0)).collect();
        assert!(matches!(
            fit_anchor(&constant),
            Err(ScaleRefusal::Degenerate { .. })
        ));
        let inverse: Vec<(f64, f64)> = (0..200)
            .map(|i| (f64::from(i), 300.0 - f64::from(i)))
            .collect();
        assert!(matches!(
            fit_anchor(&inverse),
            Err(ScaleRefusal::NotPositive { .. })
        ));
    }
}
