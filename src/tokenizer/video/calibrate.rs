//! What a new video tokenizer takes from its first clips, before the first step: without it, training is spent on scales.
//!
//! * Every wavelet coefficient of the output has its own deviation as its unit. They differ by a factor of a hundred, and an
//!   optimizer moves all of them equally far: the noise of many small ones would hide the few that make the picture.
//! * The decoder starts at the mean of the clips, not at noise larger than they are.
//! * A token starts as a matter of its own block: residual branches start quiet, and the convolutions without a shortcut start
//!   at their centre. Twenty random kernels in a row blur every token over its neighbours, and hide it.
//! * The latents are white and as wide as the levels, so that all tokens are in use from the start.

use burn::tensor::Tensor;

use super::VideoTokenizer;
use crate::clip::Signal;
use crate::engine::parameters::to_host;
use crate::engine::{Cuts, Parameters, Values, Weights, ops};
use crate::tokenizer::TokenizerError;
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::whitening::{Whitening, floats, scale};

/// Deviation of the latents: `tanh` spreads them evenly over the levels.
const SPREAD: f64 = 0.9;

/// What the ends of residual branches, and taps beside the centre, are multiplied by.
const QUIET: f32 = 0.1;

/// Units of coefficients are at least this share of the largest.
const LEAST: f64 = 1e-2;

impl VideoTokenizer {
    /// Fits the scales of a new network to some clips of those it will train on: `read(i)` is clip `i` of `count`, and is asked for
    /// twice; clips that it does not give are left out. One clip is held at a time.
    ///
    /// # Errors
    /// When there are no clips, or one has another size or a value that is not finite; and those of `read`. The network is of no use then.
    pub fn calibrate<E: From<TokenizerError>>(
        &mut self,
        count: usize,
        mut read: impl FnMut(usize) -> Result<Option<Signal>, E>,
    ) -> Result<(), E> {
        let mut coefficients = Moments::new(self.settings().coefficients());
        let found = self.each_clip(count, &mut read, |clip| {
            coefficients.add(&to_host(self.coefficients(&[clip])));
        })?;
        if found == 0 {
            return Err(TokenizerError::Other("no clips to calibrate on".to_owned()).into());
        }
        self.standardise(coefficients.statistics()?)?;
        let mut weights = self.network().weights();
        scale(&mut weights, QUIET, |name| {
            let branches = [".conv2.1.", ".proj_out.", "sample.conv1.", "sample.conv2."];
            branches.iter().any(|branch| name.contains(branch))
        });
        centre(&mut weights);
        self.load(&weights)?;
        let mut latents = Whitening::new(self.settings().levels.len());
        self.each_clip(count, &mut read, |clip| {
            latents.add(&to_host(self.latents(
                self.blocks(&[clip]),
                1,
                &mut Cuts::none(),
            )));
        })?;
        latents.apply(&mut weights, "quant_conv.conv3d", SPREAD)?;
        for name in ["weight", "bias"] {
            let name = format!("decoder.conv_out.1.conv3d.{name}");
            let rows = self.settings().coefficients();
            floats(&mut weights, &name, rows)?.fill(0.0);
        }
        Ok(self.load(&weights)?)
    }

    /// Calls `visit` with the values of every clip that `read` gives, one after the other; how many there were.
    fn each_clip<E: From<TokenizerError>>(
        &self,
        count: usize,
        mut read: impl FnMut(usize) -> Result<Option<Signal>, E>,
        mut visit: impl FnMut(&[f32]),
    ) -> Result<usize, E> {
        let mut found = 0;
        for index in 0..count {
            if let Some(signal) = read(index)? {
                visit(&self.checked_one(index, &signal)?);
                found += 1;
            }
        }
        Ok(found)
    }

    fn load(&mut self, weights: &Weights) -> Result<(), TokenizerError> {
        self.network_mut()
            .load(weights)
            .map_err(|error| TokenizerError::Other(error.to_string()))
    }
}

/// The squared distance of the mean and covariance of latents `[rows, width]` from those they start with, `[1]`. Left alone,
/// they drift to where `tanh` is flat, and a few codes take all tokens.
pub(super) fn unevenness(z: Tensor<2>) -> Tensor<1> {
    let [rows, width] = z.dims();
    let mean = z.clone().mean_dim(0);
    let centred = z - mean.clone();
    let covariance = centred.clone().transpose().matmul(centred) / rows as f64;
    let white = Tensor::<2>::eye(width, &mean.device()) * (SPREAD * SPREAD);
    ops::sum((covariance - white).square()) + ops::sum(mean.square())
}

/// Makes the first and last convolutions of encoder and decoder look mostly at the pixel itself, with the variance they had.
fn centre(weights: &mut Weights) {
    for (name, tensor) in &mut weights.tensors {
        let place = name.contains(".conv_in.") || name.contains(".conv_out.");
        let (&[_, _, time, height, width], Values::F32(values)) =
            (tensor.shape.as_slice(), &mut tensor.values)
        else {
            continue;
        };
        if !place {
            continue;
        }
        let taps = time * height * width;
        // In time the last tap is the present.
        let own = if time > 1 { taps - 1 } else { taps / 2 };
        let loud = (taps as f32).sqrt();
        for kernel in values.chunks_exact_mut(taps) {
            for (tap, value) in kernel.iter_mut().enumerate() {
                *value *= if tap == own { loud } else { QUIET };
            }
        }
    }
}

/// Running mean and deviation of each column.
struct Moments {
    count: f64,
    mean: Vec<f64>,
    square: Vec<f64>,
}

impl Moments {
    fn new(width: usize) -> Self {
        Self {
            count: 0.0,
            mean: vec![0.0; width],
            square: vec![0.0; width],
        }
    }

    fn add(&mut self, rows: &[f32]) {
        for row in rows.chunks_exact(self.mean.len()) {
            self.count += 1.0;
            for ((value, mean), square) in row.iter().zip(&mut self.mean).zip(&mut self.square) {
                let before = f64::from(*value) - *mean;
                *mean += before / self.count;
                *square += before * (f64::from(*value) - *mean);
            }
        }
    }

    fn statistics(&self) -> Result<Normaliser, TokenizerError> {
        let deviation: Vec<f64> = self
            .square
            .iter()
            .map(|square| (square / self.count.max(1.0)).sqrt())
            .collect();
        let most = deviation.iter().copied().fold(1e-6, f64::max);
        Normaliser::new(
            self.mean.iter().map(|mean| *mean as f32).collect(),
            deviation
                .iter()
                .map(|deviation| deviation.max(LEAST * most) as f32)
                .collect(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Compute;
    use crate::tokenizer::video::testing::small;
    use burn::tensor::TensorData;
    use ndarray::{ArrayD, IxDyn};

    fn noise(seed: usize) -> Signal {
        let values = ArrayD::from_shape_fn(IxDyn(&[5, 32, 32, 3]), |at| {
            let cell = at[1] / 8 + 5 * (at[2] / 8) + 25 * (at[0].div_ceil(4)) + 100 * seed;
            ((cell * 7919 + at[3] * 104_729) % 1000) as f32 / 500.0 - 1.0
        });
        Signal {
            values,
            valid: None,
        }
    }

    #[test]
    fn a_token_starts_as_a_matter_of_its_own_block() {
        let mut tokenizer = small([5, 32, 32], [16, 8], &[8, 5, 5], 4);
        let clips: Vec<Signal> = (0..4).map(noise).collect();
        let read = |index: usize| Ok::<_, TokenizerError>(Some(clips[index].clone()));
        tokenizer.calibrate(clips.len(), read).unwrap();

        let latents = |clip: &Signal| {
            let values: Vec<f32> = clip.values.iter().copied().collect();
            to_host(tokenizer.latents(tokenizer.blocks(&[&values]), 1, &mut Cuts::none()))
        };
        let mut changed = clips[0].clone();
        changed
            .values
            .slice_mut(ndarray::s![1.., 8..16, 8..16, ..])
            .mapv_inplace(|value| -value);
        let (before, after) = (latents(&clips[0]), latents(&changed));
        let change: Vec<f32> = before
            .chunks(3)
            .zip(after.chunks(3))
            .map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>())
            .map(f32::sqrt)
            .collect();
        // [3, 4, 4] tokens; the block is the second in both directions, and the third group repeats the last frame.
        let own = [16 + 4 + 1, 32 + 4 + 1];
        for (token, other) in change.iter().enumerate() {
            assert!(
                own.contains(&token) || 2.0 * other < change[own[0]],
                "{change:?}"
            );
        }
    }

    #[test]
    fn only_white_latents_of_the_right_width_are_even() {
        let compute = Compute::cpu();
        let of = |rows: [[f64; 2]; 4]| {
            let values: Vec<f32> = rows.iter().flatten().map(|v| *v as f32).collect();
            let z = Tensor::<2>::from_data(TensorData::new(values, [4, 2]), compute.device());
            unevenness(z).into_scalar::<f32>()
        };
        let s = SPREAD;
        assert!(of([[s, s], [s, -s], [-s, s], [-s, -s]]) < 1e-9);
        let moved = of([[s + 1.0, s], [s + 1.0, -s], [1.0 - s, s], [1.0 - s, -s]]);
        assert!((moved - 1.0).abs() < 1e-5, "{moved}");
        let alike = of([[s, s], [s, s], [-s, -s], [-s, -s]]);
        assert!((f64::from(alike) - 2.0 * s.powi(4)).abs() < 1e-5, "{alike}");
    }
}
