//! Gaze error in normalised image coordinates (Sec. 5): MSE, mean distance, and the image centre as the baseline.

use super::outcome::{MetricError, mean};
use ndarray::{ArrayView1, ArrayView2};

/// Ground truth outside these limits on either axis is not scored; the limits themselves are.
pub const VALID_RANGE: (f64, f64) = (-0.2, 1.2);

/// Gaze errors of one clip; unit-free, the image is `[0, 1]^2`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GazeErrors {
    /// Frames that were scored.
    pub n_valid: usize,
    /// Mean squared difference over valid frames and both coordinates (half the mean squared distance).
    pub mse: Option<f64>,
    /// Mean distance.
    pub l2: Option<f64>,
    /// The `mse` of always predicting the image centre: what is not below it has learnt nothing.
    pub center_mse: Option<f64>,
}

/// Errors of `pred` against `gt`, both `[T, 2]`. A frame counts when `valid` (if given) says so and the ground truth is finite
/// and within [`VALID_RANGE`]. Predictions are not clamped.
///
/// # Errors
/// When the shapes differ, or a prediction on a scored frame is not finite.
pub fn gaze_errors<T: Copy + Into<f64>>(
    pred: ArrayView2<T>,
    gt: ArrayView2<T>,
    valid: Option<ArrayView1<bool>>,
) -> Result<GazeErrors, MetricError> {
    if pred.dim() != gt.dim() || gt.ncols() != 2 || valid.is_some_and(|v| v.len() != gt.nrows()) {
        return Err(MetricError::Shape {
            field: "gaze",
            found: pred.shape().to_vec(),
            expected: gt.shape().to_vec(),
        });
    }
    let (low, high) = VALID_RANGE;
    let mut frames = Vec::with_capacity(gt.nrows());
    for t in 0..gt.nrows() {
        let truth: [f64; 2] = [gt[(t, 0)].into(), gt[(t, 1)].into()];
        let scored = valid.is_none_or(|v| v[t]) && truth.iter().all(|c| (low..=high).contains(c));
        if !scored {
            continue;
        }
        let guess: [f64; 2] = [pred[(t, 0)].into(), pred[(t, 1)].into()];
        if !guess.iter().all(|c| c.is_finite()) {
            return Err(MetricError::NotFinite {
                field: "gaze prediction",
                position: vec![t],
            });
        }
        frames.push((guess, truth));
    }
    let squared = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
    Ok(GazeErrors {
        n_valid: frames.len(),
        mse: mean(frames.iter().map(|&(p, g)| squared(p, g) / 2.0)),
        l2: mean(frames.iter().map(|&(p, g)| squared(p, g).sqrt())),
        center_mse: mean(frames.iter().map(|&(_, g)| squared([0.5; 2], g) / 2.0)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn invalid_frames_change_nothing() {
        let gt = array![[0.5, 0.5], [0.2, f64::NAN], [1.3, 0.5], [0.25, 0.75]];
        let pred = array![[0.6, 0.5], [f64::NAN, 0.0], [9.0, 9.0], [0.25, 0.75]];
        let errors = gaze_errors(pred.view(), gt.view(), None).unwrap();
        assert_eq!(errors.n_valid, 2);
        assert!((errors.mse.unwrap() - 0.01 / 4.0).abs() < 1e-15);
        let mask = array![false, true, true, true];
        let errors = gaze_errors(pred.view(), gt.view(), Some(mask.view())).unwrap();
        assert_eq!((errors.n_valid, errors.mse), (1, Some(0.0)));
        assert_eq!(errors.center_mse, Some(0.0625));
    }
}
