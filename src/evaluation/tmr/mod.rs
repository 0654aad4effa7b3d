//! The motion encoder behind the FID and the similarity of motions (Table 2): TMR, whose weights a user brings.
//!
//! Joints of a clip become 22 joints with y up ([`skeleton`]), are resampled ([`resample`]), turned into 263 numbers per frame
//! step ([`mod@features`]) and embedded by a transformer ([`encoder`]); [`stored`] is the folder that `reviv import` makes, and this
//! file the whole chain. Features and their errors are those of the code the weights were trained with, quirks included; each is
//! named where it is. All geometry is f64.

pub mod encoder;
pub mod features;
mod pairs;
pub mod resample;
pub mod skeleton;
pub mod stored;

use ndarray::{ArrayView3, Axis};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::outcome::MetricError;
pub use encoder::{MotionEncoder, MotionEncoderSettings};
use features::{FEATURES, features};
use resample::at_rate;
use skeleton::{Pose, spine_filled, y_up};

/// The rate of the motions that the encoder was trained on, Hz.
pub const TRAINED_RATE: f64 = 20.0;

/// At which rate features are computed. Embeddings of different rates do not compare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FeatureRate {
    /// 20 Hz, as in training: motions are resampled linearly.
    #[default]
    Trained,
    /// The motion's own rate.
    Native,
}

/// An encoder with the statistics its inputs are normalised by.
#[derive(Debug, Clone)]
pub struct Tmr {
    /// The transformer; it takes features that [`Tmr::normalise`] has normalised.
    pub encoder: MotionEncoder,
    /// Of every feature.
    mean: Vec<f32>,
    deviation: Vec<f32>,
    /// SHA-256 of the file it was read from.
    fingerprint: String,
}

impl Tmr {
    /// An encoder with its statistics.
    ///
    /// # Errors
    /// When there are not [`FEATURES`] of each, or one is not finite, or a deviation is negative.
    pub fn new(
        encoder: MotionEncoder,
        mean: Vec<f32>,
        deviation: Vec<f32>,
    ) -> Result<Self, String> {
        for (name, values) in [("mean", &mean), ("std", &deviation)] {
            if values.len() != FEATURES {
                return Err(format!(
                    "{name}: {} values, expected {FEATURES}",
                    values.len()
                ));
            }
            if values.iter().any(|value| !value.is_finite()) {
                return Err(format!("{name}: a value is not finite"));
            }
        }
        if deviation.iter().any(|value| *value < 0.0) {
            return Err("std: a value is negative".to_owned());
        }
        Ok(Self {
            encoder,
            mean,
            deviation,
            fingerprint: String::new(),
        })
    }

    /// SHA-256 of the file it was read from; empty where it was made here.
    #[must_use]
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Mean and standard deviation of every feature, [`FEATURES`] numbers each.
    #[must_use]
    pub fn statistics(&self) -> [&[f32]; 2] {
        [&self.mean, &self.deviation]
    }

    /// `(x - mean) / (std + 1e-12)`, in f32 as in training, of rows of [`FEATURES`].
    #[must_use]
    pub fn normalise(&self, rows: &[f32]) -> Vec<f32> {
        let statistics = self.mean.iter().zip(&self.deviation).cycle();
        rows.iter()
            .zip(statistics)
            .map(|(value, (mean, deviation))| (value - mean) / (deviation + 1e-12))
            .collect()
    }

    /// The embedding of a clip's body: `[T, 21, 3]` metres in the product's order, z up, sampled at `rate` Hz.
    ///
    /// # Errors
    /// When the clip is too short, or its joints have no features.
    pub fn embed(
        &self,
        joints: ArrayView3<'_, f64>,
        rate: f64,
        feature_rate: FeatureRate,
    ) -> Result<Vec<f64>, MetricError> {
        let input = self.input(joints, rate, feature_rate)?;
        let rows: Vec<f32> = features(&input)?
            .rows
            .iter()
            .flatten()
            .map(|value| *value as f32)
            .collect();
        let embedded = self.encoder.forward(&[&self.normalise(&rows)]);
        Ok(embedded[0]
            .mu
            .iter()
            .map(|value| f64::from(*value))
            .collect())
    }

    /// What features are computed from: 22 joints, y up, at the feature rate. With [`FeatureRate::Native`] the samples are taken as
    /// they are: features are per frame step, and no rate enters them.
    ///
    /// # Errors
    /// When the shape is not `[T, 21, 3]`, or the rate is not a positive number.
    pub fn input(
        &self,
        joints: ArrayView3<'_, f64>,
        rate: f64,
        feature_rate: FeatureRate,
    ) -> Result<Vec<Pose>, MetricError> {
        if joints.shape()[1..] != [21, 3] {
            return Err(MetricError::Shape {
                field: "joints",
                found: joints.shape().to_vec(),
                expected: vec![joints.len_of(Axis(0)), 21, 3],
            });
        }
        if !(rate.is_finite() && rate > 0.0) {
            return Err(MetricError::Argument {
                name: "rate",
                found: rate,
                allowed: "a positive number of samples a second".to_owned(),
            });
        }
        let poses: Vec<Pose> = joints
            .outer_iter()
            .map(|pose| {
                let joint = |j: usize| [pose[[j, 0]], pose[[j, 1]], pose[[j, 2]]];
                y_up(&spine_filled(&std::array::from_fn(joint)))
            })
            .collect();
        Ok(match feature_rate {
            FeatureRate::Native => poses,
            FeatureRate::Trained => at_rate(&poses, rate, TRAINED_RATE),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Initialise};
    use ndarray::Array3;

    #[test]
    fn the_rate_decides_what_is_resampled_and_must_be_one() {
        let settings = MotionEncoderSettings {
            width: 8,
            layers: 1,
            heads: 1,
            hidden: 8,
        };
        let encoder = MotionEncoder::new(&Initialise::new(&Compute::cpu(), 5), &settings).unwrap();
        let tmr = Tmr::new(encoder, vec![0.0; FEATURES], vec![1.0; FEATURES]).unwrap();
        let joints = Array3::from_shape_fn((60, 21, 3), |(t, j, k)| (t + 2 * j + 3 * k) as f64);
        let frames = |rate, feature_rate| {
            let input = tmr.input(joints.view(), rate, feature_rate);
            input.map(|poses| poses.len())
        };
        assert_eq!(frames(30.0, FeatureRate::Trained), Ok(40));
        assert_eq!(frames(60.0, FeatureRate::Trained), Ok(20));
        // The motion's own samples, whatever their rate.
        assert_eq!(frames(30.0, FeatureRate::Native), Ok(60));
        for rate in [0.0, -30.0, f64::NAN, f64::INFINITY] {
            for feature_rate in [FeatureRate::Trained, FeatureRate::Native] {
                let message = frames(rate, feature_rate).unwrap_err().to_string();
                assert!(message.contains("`rate`"), "{message}");
            }
        }
    }
}
