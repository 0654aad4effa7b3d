//! Statistics that bring a modality's values to mean 0 and deviation 1; fitted on the training split, stored with the weights.

use super::TokenizerError;
use crate::clip::Signal;

/// One mean and deviation per value of a sample (camera 9, gaze 2, joints 21 x 3).
#[derive(Debug, Clone, PartialEq)]
pub struct Normaliser {
    mean: Vec<f32>,
    deviation: Vec<f32>,
    /// Joints are seen from the first one of their sample before they are scaled.
    root_relative: bool,
}

/// Values of a joint.
const AXES: usize = 3;

/// Deviations below this are those of constant values, which are left unscaled.
const CONSTANT_BELOW: f64 = 1e-6;

impl Normaliser {
    /// Given statistics.
    ///
    /// # Errors
    /// When they differ in length, or one is not finite, or a deviation not positive.
    pub fn new(mean: Vec<f32>, deviation: Vec<f32>) -> Result<Self, TokenizerError> {
        let usable = mean.len() == deviation.len()
            && mean.iter().all(|value| value.is_finite())
            && deviation
                .iter()
                .all(|value| value.is_finite() && *value > 0.0);
        if !usable {
            return Err(TokenizerError::Other(format!(
                "normalisation needs as many finite means as positive deviations, found {} and {}",
                mean.len(),
                deviation.len()
            )));
        }
        Ok(Self {
            mean,
            deviation,
            root_relative: false,
        })
    }

    /// The same statistics, but of joints relative to the first one, if `root_relative`; that one stays where it is.
    ///
    /// # Errors
    /// When samples are not of joints.
    pub fn of_joints(self, root_relative: bool) -> Result<Self, TokenizerError> {
        if root_relative && !self.width().is_multiple_of(AXES) {
            return Err(TokenizerError::Other(format!(
                "a sample of {} values is not one of joints, and has no root",
                self.width()
            )));
        }
        Ok(Self {
            root_relative,
            ..self
        })
    }

    /// Whether joints count from the first one of their sample, which then has to be valid.
    #[must_use]
    pub fn is_root_relative(&self) -> bool {
        self.root_relative
    }

    /// The same mean and deviation for all `width` values: gaze in `[0, 1]` becomes `[-1, 1]` with `(0.5, 0.5)`.
    ///
    /// # Errors
    /// As [`Normaliser::new`].
    pub fn constant(width: usize, mean: f32, deviation: f32) -> Result<Self, TokenizerError> {
        Self::new(vec![mean; width], vec![deviation; width])
    }

    /// Statistics over the valid values of `signals`, whose samples have `width` values each, joints as
    /// [`Normaliser::of_joints`] says.
    ///
    /// # Errors
    /// When some value has no valid sample, or a valid one is not finite.
    pub fn fit<'a>(
        signals: impl Iterator<Item = &'a Signal> + Clone,
        width: usize,
        root_relative: bool,
    ) -> Result<Self, TokenizerError> {
        let root = root_relative.then_some(width);
        let mut count = vec![0_u64; width];
        let mut sum = vec![0.0_f64; width];
        for signal in signals.clone() {
            each_valid(signal, root, |i, value| {
                count[i % width] += 1;
                sum[i % width] += value;
            });
        }
        if count.contains(&0) || sum.iter().any(|sum| !sum.is_finite()) {
            return Err(TokenizerError::Other(
                "normalisation cannot be fitted: a value is never valid, or not finite".to_owned(),
            ));
        }
        let mean: Vec<f64> = sum
            .iter()
            .zip(&count)
            .map(|(sum, n)| sum / *n as f64)
            .collect();
        let mut square = vec![0.0_f64; width];
        for signal in signals {
            each_valid(signal, root, |i, value| {
                square[i % width] += (value - mean[i % width]).powi(2);
            });
        }
        let deviation = square.iter().zip(&count).map(|(square, n)| {
            let deviation = (square / *n as f64).sqrt();
            if deviation < CONSTANT_BELOW {
                1.0
            } else {
                deviation as f32
            }
        });
        Self::new(
            mean.iter().map(|value| *value as f32).collect(),
            deviation.collect(),
        )?
        .of_joints(root_relative)
    }

    /// How many values a sample has.
    #[must_use]
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// One mean per value of a sample.
    #[must_use]
    pub fn mean(&self) -> &[f32] {
        &self.mean
    }

    /// One standard deviation per value of a sample.
    #[must_use]
    pub fn deviation(&self) -> &[f32] {
        &self.deviation
    }

    /// `(value - mean) / deviation`, in place; `values` is whole samples.
    pub fn apply(&self, values: &mut [f32]) {
        for sample in values.chunks_mut(self.width()) {
            if self.root_relative {
                shift_joints(sample, -1.0);
            }
            for ((value, mean), deviation) in sample.iter_mut().zip(&self.mean).zip(&self.deviation)
            {
                *value = (*value - mean) / deviation;
            }
        }
    }

    /// The inverse of [`Normaliser::apply`].
    pub fn undo(&self, values: &mut [f32]) {
        for sample in values.chunks_mut(self.width()) {
            for ((value, mean), deviation) in sample.iter_mut().zip(&self.mean).zip(&self.deviation)
            {
                *value = *value * deviation + mean;
            }
            if self.root_relative {
                shift_joints(sample, 1.0);
            }
        }
    }
}

/// Adds `sign` times the first joint of a sample to its other joints.
fn shift_joints(sample: &mut [f32], sign: f32) {
    let (root, others) = sample.split_at_mut(AXES.min(sample.len()));
    for joint in others.chunks_mut(AXES) {
        for (value, root) in joint.iter_mut().zip(&*root) {
            *value += sign * root;
        }
    }
}

/// Calls `visit` with the index and value of every element of `signal` that is valid; with `root`, the values of a sample, as
/// seen from its first joint, where that is valid, too.
fn each_valid(signal: &Signal, root: Option<usize>, mut visit: impl FnMut(usize, f64)) {
    let channels = signal.values.shape().last().copied().unwrap_or(1).max(1);
    let values = signal.values.as_standard_layout();
    let values = values.as_slice().expect("standard layout");
    let valid = signal
        .valid
        .as_ref()
        .map(|valid| valid.as_standard_layout());
    let valid = valid
        .as_ref()
        .map(|valid| valid.as_slice().expect("standard layout"));
    let is_valid = |i: usize| valid.is_none_or(|valid| valid[i / channels]);
    for (i, value) in values.iter().enumerate().filter(|(i, _)| is_valid(*i)) {
        let first = root.map(|width| i / width * width + i % AXES);
        match first.filter(|first| i - first >= AXES) {
            None => visit(i, f64::from(*value)),
            Some(first) if is_valid(first) => visit(i, f64::from(*value - values[first])),
            Some(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{ArrayD, IxDyn};

    #[test]
    fn joints_seen_from_the_root_come_back_and_count_only_where_it_is_valid() {
        // Three samples of a root and one joint, one metre above it; in the last sample the root is not valid.
        let values = [
            0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 4.0, 2.0, 0.0, 4.0, 3.2, 0.0, 9.0, 9.0, 9.0, 5.0, 5.0,
            5.0,
        ];
        let shape = ArrayD::from_shape_vec(IxDyn(&[3, 2, 3]), values.to_vec()).unwrap();
        let valid = vec![true, true, true, true, false, true];
        let valid = ArrayD::from_shape_vec(IxDyn(&[3, 2]), valid).unwrap();
        let signal = Signal {
            values: shape,
            valid: Some(valid),
        };
        let normaliser = Normaliser::fit([&signal].into_iter(), 6, true).unwrap();
        assert_eq!(normaliser.mean()[..4], [2.0, 1.0, 0.0, 0.0]);
        assert!((normaliser.mean()[4] - 1.1).abs() < 1e-6);
        assert!((normaliser.deviation()[4] - 0.1).abs() < 1e-6);
        let mut there = values[..12].to_vec();
        normaliser.apply(&mut there);
        assert!((there[4] + 1.0).abs() < 1e-5 && (there[10] - 1.0).abs() < 1e-5);
        normaliser.undo(&mut there);
        for (found, expected) in there.iter().zip(&values) {
            assert!((found - expected).abs() < 1e-6);
        }
        assert!(
            Normaliser::constant(2, 0.5, 0.5)
                .unwrap()
                .of_joints(true)
                .is_err()
        );
    }

    #[test]
    fn fitting_ignores_invalid_samples_and_undoing_restores() {
        let values = vec![1.0, 10.0, f32::NAN, f32::NAN, 3.0, 10.0];
        let signal = Signal {
            values: ArrayD::from_shape_vec(IxDyn(&[3, 2]), values).unwrap(),
            valid: Some(ArrayD::from_shape_vec(IxDyn(&[3]), vec![true, false, true]).unwrap()),
        };
        let normaliser = Normaliser::fit(std::iter::once(&signal), 2, false).unwrap();
        assert_eq!(normaliser.mean(), [2.0, 10.0]);
        assert_eq!(normaliser.deviation(), [1.0, 1.0]);
        let mut sample = [5.0, 12.0];
        normaliser.apply(&mut sample);
        assert_eq!(sample, [3.0, 2.0]);
        normaliser.undo(&mut sample);
        assert_eq!(sample, [5.0, 12.0]);
    }

    #[test]
    fn statistics_that_cannot_normalise_are_refused() {
        assert!(Normaliser::new(vec![0.0], vec![0.0]).is_err());
        assert!(Normaliser::new(vec![0.0, 1.0], vec![1.0]).is_err());
        assert!(Normaliser::new(vec![f32::NAN], vec![1.0]).is_err());
    }
}
