//! What a new video tokenizer takes from its first clips, before the first step: without it, training is spent on scales.
//!
//! * Every wavelet coefficient of the output has its own deviation as its unit. They differ by a factor of a hundred, and an
//!   optimizer moves all of them equally far: the noise of many small ones would hide the few that make the picture.
//! * The decoder starts at the mean of the clips, not at noise larger than they are.
//! * Residual branches start quiet: twenty random ones in a row blur every token over its neighbours, and hide it.
//! * The latents are white and as wide as the levels, so that all tokens are in use from the start.

use super::VideoTokenizer;
use crate::clip::Signal;
use crate::engine::parameters::to_host;
use crate::engine::{Parameters, Weights};
use crate::tokenizer::TokenizerError;
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::whitening::{Whitening, floats, scale};

/// Deviation of the latents: `tanh` spreads them evenly over the levels.
const SPREAD: f64 = 0.9;

/// What the ends of residual branches are multiplied by.
const QUIET: f32 = 0.1;

/// Units of coefficients are at least this share of the largest.
const LEAST: f64 = 1e-2;

impl VideoTokenizer {
    /// Fits the scales of a new network to `clips`, some of those it will train on.
    ///
    /// # Errors
    /// When there are no clips, or one has another size or a value that is not finite.
    pub fn calibrate(&mut self, clips: &[Signal]) -> Result<(), TokenizerError> {
        let values = self.checked(clips)?;
        if values.is_empty() {
            return Err(TokenizerError::Other("no clips to calibrate on".to_owned()));
        }
        let mut coefficients = Moments::new(self.settings().coefficients());
        for clip in &values {
            coefficients.add(&to_host(self.coefficients(&[clip])));
        }
        self.standardise(coefficients.statistics()?)?;
        let mut weights = self.network().weights();
        scale(&mut weights, QUIET, |name| {
            name.contains(".conv2.1.") || name.contains(".proj_out.")
        });
        self.load(&weights)?;
        let mut latents = Whitening::new(self.settings().levels.len());
        for clip in &values {
            latents.add(&to_host(self.latents(self.blocks(&[clip]), 1)));
        }
        latents.apply(&mut weights, "quant_conv.conv3d", SPREAD)?;
        for name in ["weight", "bias"] {
            let name = format!("decoder.conv_out.1.conv3d.{name}");
            let rows = self.settings().coefficients();
            floats(&mut weights, &name, rows)?.fill(0.0);
        }
        self.load(&weights)
    }

    fn load(&mut self, weights: &Weights) -> Result<(), TokenizerError> {
        self.network_mut()
            .load(weights)
            .map_err(|error| TokenizerError::Other(error.to_string()))
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
