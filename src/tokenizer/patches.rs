//! Cutting a signal into patches of neighbouring samples (and joints), one per token, and putting them back.
//!
//! A patch is a row of `channels x patch samples x patch joints` values, in that order: the order of a convolution's weight
//! `[out, channels, samples(, joints)]` and of the released decoders' outputs. Temporal signals are the case of one joint.

use serde::{Deserialize, Serialize};

use super::TokenizerError;
use crate::modality::Shape;

/// The largest size of a signal along any axis.
const MOST: usize = 1 << 20;

/// How signals of one shape are cut.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Patches {
    samples: usize,
    joints: usize,
    channels: usize,
    /// Samples and joints per token.
    patch: [usize; 2],
    /// Whether signals have a joint axis.
    kinematic: bool,
}

impl Patches {
    /// Signals of `shape`, `compression` samples (and joints, for kinematic signals) to a token.
    ///
    /// # Errors
    /// When the compression has the wrong number of entries or does not divide the shape, or the shape is that of video.
    pub fn new(shape: &Shape, compression: &[usize]) -> Result<Self, TokenizerError> {
        let (samples, joints, channels, kinematic) = match shape {
            Shape::Temporal { samples, channels } => (*samples, 1, *channels, false),
            Shape::Kinematic { samples, joints } => (*samples, *joints, 3, true),
            Shape::Video { .. } => {
                return Err(TokenizerError::Other(
                    "video has its own tokenizer; a VQ-VAE takes samples of channels or joints"
                        .to_owned(),
                ));
            }
        };
        let patch = match (compression, kinematic) {
            ([time], false) => [*time, 1],
            ([time, joints], true) => [*time, *joints],
            _ => {
                return Err(TokenizerError::Other(format!(
                    "compression {compression:?} does not fit {shape:?}: one number for signals over time, two for joints"
                )));
            }
        };
        let divides = |size: usize, by: usize| by > 0 && size > 0 && size.is_multiple_of(by);
        if [samples, joints, channels].iter().any(|size| *size > MOST) {
            return Err(TokenizerError::Other(format!(
                "{shape:?} is too large: each size is at most {MOST}"
            )));
        }
        if channels == 0 || !divides(samples, patch[0]) || !divides(joints, patch[1]) {
            return Err(TokenizerError::Other(format!(
                "compression {compression:?} does not divide {shape:?}"
            )));
        }
        Ok(Self {
            samples,
            joints,
            channels,
            patch,
            kinematic,
        })
    }

    /// Tokens along time, and along joints for kinematic signals.
    #[must_use]
    pub fn grid(&self) -> Vec<usize> {
        let [rows, columns] = self.rows_columns();
        if self.kinematic {
            vec![rows, columns]
        } else {
            vec![rows]
        }
    }

    /// Tokens along time and along joints (1 without joints).
    #[must_use]
    pub fn rows_columns(&self) -> [usize; 2] {
        [self.samples / self.patch[0], self.joints / self.patch[1]]
    }

    /// Tokens per signal.
    #[must_use]
    pub fn tokens(&self) -> usize {
        self.rows_columns().iter().product()
    }

    /// Values per patch.
    #[must_use]
    pub fn width(&self) -> usize {
        self.channels * self.patch[0] * self.patch[1]
    }

    /// Values of a sample or joint.
    #[must_use]
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Whether the signal is joints over time.
    #[must_use]
    pub fn is_kinematic(&self) -> bool {
        self.kinematic
    }

    /// Values per sample: channels, or joints times three.
    #[must_use]
    pub fn values_per_sample(&self) -> usize {
        self.joints * self.channels
    }

    /// The shape of a signal's values.
    #[must_use]
    pub fn signal_shape(&self) -> Vec<usize> {
        let mut shape = self.valid_shape();
        shape.push(self.channels);
        shape
    }

    /// The shape of a signal's validity.
    #[must_use]
    pub fn valid_shape(&self) -> Vec<usize> {
        if self.kinematic {
            vec![self.samples, self.joints]
        } else {
            vec![self.samples]
        }
    }

    /// The shape of a 1x1 convolution's weight, or of any that covers a patch: `[out, in]` and the patch or ones.
    #[must_use]
    pub fn convolution(&self, outputs: usize, inputs: usize, covers_patch: bool) -> Vec<usize> {
        let [time, joints] = if covers_patch { self.patch } else { [1, 1] };
        if self.kinematic {
            vec![outputs, inputs, time, joints]
        } else {
            vec![outputs, inputs, time]
        }
    }

    /// Where each value of a signal goes: the position in its patches of element `i` of the signal.
    pub(super) fn positions(&self) -> impl Iterator<Item = usize> + '_ {
        let [time, joints] = self.patch;
        let columns = self.joints / joints;
        (0..self.samples).flat_map(move |t| {
            (0..self.joints).flat_map(move |j| {
                (0..self.channels).map(move |c| {
                    let token = (t / time) * columns + j / joints;
                    let within = (c * time + t % time) * joints + j % joints;
                    token * self.width() + within
                })
            })
        })
    }

    /// Appends the patches of one signal, `[tokens, width]`, to `out`. `values` is row-major `[samples, joints, channels]`.
    ///
    /// # Panics
    /// When the number of values is not that of the shape.
    pub fn cut(&self, values: &[f32], out: &mut Vec<f32>) {
        assert_eq!(values.len(), self.samples * self.values_per_sample());
        let start = out.len();
        out.resize(start + values.len(), 0.0);
        for (value, position) in values.iter().zip(self.positions()) {
            out[start + position] = *value;
        }
    }

    /// The signal of `[tokens, width]` patches: the inverse of [`Patches::cut`].
    ///
    /// # Panics
    /// When the number of values is not that of the shape.
    #[must_use]
    pub fn join(&self, patches: &[f32]) -> Vec<f32> {
        assert_eq!(patches.len(), self.samples * self.values_per_sample());
        self.positions().map(|position| patches[position]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joining_undoes_cutting_for_any_compression_that_divides() {
        for (shape, compression) in [
            (
                Shape::Temporal {
                    samples: 60,
                    channels: 9,
                },
                vec![2],
            ),
            (
                Shape::Kinematic {
                    samples: 60,
                    joints: 21,
                },
                vec![2, 3],
            ),
            (
                Shape::Kinematic {
                    samples: 60,
                    joints: 21,
                },
                vec![4, 7],
            ),
        ] {
            let patches = Patches::new(&shape, &compression).unwrap();
            let signal: Vec<f32> = (0..60 * patches.values_per_sample())
                .map(|i| i as f32)
                .collect();
            let mut cut = Vec::new();
            patches.cut(&signal, &mut cut);
            assert_eq!(cut.len(), patches.tokens() * patches.width());
            assert_eq!(patches.join(&cut), signal);
        }
    }

    #[test]
    fn a_patch_holds_channel_then_sample_then_joint() {
        let patches = Patches::new(
            &Shape::Kinematic {
                samples: 4,
                joints: 6,
            },
            &[2, 3],
        )
        .unwrap();
        let value = |t: usize, j: usize, c: usize| (100 * t + 10 * j + c) as f32;
        let signal: Vec<f32> = (0..4 * 6 * 3)
            .map(|i| value(i / 18, i / 3 % 6, i % 3))
            .collect();
        let mut cut = Vec::new();
        patches.cut(&signal, &mut cut);
        // Token (1, 1), channel 2, second sample, third joint.
        assert_eq!(cut[3 * 18 + 2 * 6 + 3 + 2], value(3, 5, 2));
        assert_eq!(patches.grid(), [2, 2]);
    }

    #[test]
    fn a_compression_that_does_not_divide_is_refused_with_both() {
        let shape = Shape::Kinematic {
            samples: 60,
            joints: 21,
        };
        let message = Patches::new(&shape, &[2, 4]).unwrap_err().to_string();
        assert!(
            message.contains("[2, 4]") && message.contains("21"),
            "{message}"
        );
        assert!(Patches::new(&shape, &[2]).is_err());
    }
}
