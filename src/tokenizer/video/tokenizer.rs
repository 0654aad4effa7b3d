//! Video signals to tokens and back, and the loss of one training step.

use burn::tensor::{Device, Tensor, TensorData};
use ndarray::{ArrayD, IxDyn};

use super::calibrate::unevenness;
use super::layers::Extent;
use super::maps::{Map, maps};
use super::padding::Padding;
use super::settings::COLOURS;
use super::{Fsq, Network, VideoSettings, haar};
use crate::clip::Signal;
use crate::engine::parameters::to_host;
use crate::engine::{Cuts, ops};
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::trained::FILE;
use crate::tokenizer::{TokenGrid, Tokenizer, TokenizerError, check_tokens};

/// A network with the modality and clip size it works on. Signals are `[frames, height, width, 3]` in [-1, 1].
#[derive(Debug, Clone)]
pub struct VideoTokenizer {
    network: Network,
    fsq: Fsq,
    modality: String,
    padding: Padding,
    grid: Vec<usize>,
    /// Pixels of a block to the network's input, and its output to pixels.
    maps: [Map; 2],
    statistics: Option<Normaliser>,
}

/// What one training forward pass gives.
#[derive(Debug)]
pub struct Trained {
    /// Mean squared error of all pixels of the padded clip, `[1]`: what to minimise.
    pub loss: Tensor<1>,
    /// How far the latents are from those that use all codes evenly, `[1]`.
    pub unevenness: Tensor<1>,
}

impl VideoTokenizer {
    /// A tokenizer of `modality` for clips of `[frames, height, width]`.
    ///
    /// # Errors
    /// When the clip is empty.
    pub fn new(
        modality: &str,
        clip: [usize; 3],
        network: Network,
        compute: &crate::engine::Compute,
    ) -> Result<Self, TokenizerError> {
        if clip.contains(&0) || clip.iter().any(|n| *n > 1 << 14) {
            return Err(TokenizerError::Other(format!(
                "{modality}: a clip of {clip:?} frames, height, width"
            )));
        }
        let settings = network.settings();
        let padding = Padding::of(clip, settings.temporal, settings.spatial);
        let maps = maps(settings, None, compute.device());
        Ok(Self {
            fsq: Fsq::new(&settings.levels),
            modality: modality.to_owned(),
            grid: settings.grid(padding.padded).to_vec(),
            padding,
            maps,
            statistics: None,
            network,
        })
    }

    /// Encoder and decoder.
    #[must_use]
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// For training and loading.
    pub fn network_mut(&mut self) -> &mut Network {
        &mut self.network
    }

    fn device(&self) -> Device {
        self.maps[0].device()
    }

    /// Mean and deviation of each wavelet coefficient, where the network works on standardised ones.
    #[must_use]
    pub fn statistics(&self) -> Option<&Normaliser> {
        self.statistics.as_ref()
    }

    /// Makes the network work on coefficients that are standardised by `statistics`.
    ///
    /// # Errors
    /// When they are not those of as many coefficients as there are.
    pub fn standardise(&mut self, statistics: Normaliser) -> Result<(), TokenizerError> {
        let expected = self.settings().coefficients();
        if statistics.width() != expected {
            return Err(TokenizerError::Other(format!(
                "{}: statistics of {} wavelet coefficients, the tokenizer has {expected}",
                self.modality,
                statistics.width()
            )));
        }
        self.maps = maps(self.settings(), Some(&statistics), &self.device());
        self.statistics = Some(statistics);
        Ok(())
    }

    /// What it was made with.
    #[must_use]
    pub fn settings(&self) -> &VideoSettings {
        self.network.settings()
    }

    /// Frames, height and width of the clips.
    #[must_use]
    pub fn clip(&self) -> [usize; 3] {
        self.padding.clip
    }

    fn size(&self) -> [usize; 4] {
        let [frames, height, width] = self.padding.padded;
        [frames, height, width, COLOURS]
    }

    /// Where the rows of `samples` clips lie after the wavelet.
    fn extent(&self, samples: usize) -> Extent {
        let (patch, [frames, height, width]) = (self.settings().patch, self.padding.padded);
        Extent {
            samples,
            frames: frames.div_ceil(patch),
            height: height / patch,
            width: width / patch,
        }
    }

    /// Where the rows of `samples` token grids lie.
    fn token_extent(&self, samples: usize) -> Extent {
        Extent {
            samples,
            frames: self.grid[0],
            height: self.grid[1],
            width: self.grid[2],
        }
    }

    /// Blocks of pixels of clips `[frames, height, width, 3]`: `[N, patch^3 * 3]`.
    pub(super) fn blocks(&self, clips: &[&[f32]]) -> Tensor<2> {
        let mut values = Vec::new();
        for clip in clips {
            let padded = self.padding.pad(clip, COLOURS);
            values.extend(haar::cut(&padded, self.size(), [self.settings().patch; 2]));
        }
        let side = self.settings().coefficients();
        let rows = values.len() / side;
        let device = self.device();
        Tensor::from_data(TensorData::new(values, [rows, side]), &device)
    }

    /// The network's input of clips.
    pub(super) fn coefficients(&self, clips: &[&[f32]]) -> Tensor<2> {
        self.maps[0].apply(self.blocks(clips))
    }

    /// Latents `[N', code width]` before quantisation.
    pub(super) fn latents(&self, blocks: Tensor<2>, samples: usize, cuts: &mut Cuts) -> Tensor<2> {
        let coefficients = self.maps[0].apply(blocks);
        let extent = self.extent(samples);
        self.network.encode(coefficients, extent, cuts).0
    }

    /// Blocks of pixels `[N, patch^3 * 3]` of codes `[N', code width]`.
    fn pixels(&self, codes: Tensor<2>, samples: usize, cuts: &mut Cuts) -> Tensor<2> {
        let extent = self.token_extent(samples);
        let (coefficients, _) = self.network.decode(codes, extent, cuts);
        self.maps[1].apply(coefficients)
    }

    /// The forward pass of one training step over clips `[frames, height, width, 3]`, gradients passing straight through the
    /// rounding. Backward can go block by block.
    ///
    /// # Errors
    /// When a clip has another size or holds a value that is not finite.
    pub fn train(&self, clips: &[Signal], cuts: &mut Cuts) -> Result<Trained, TokenizerError> {
        let values = self.checked(clips)?;
        let samples = clips.len();
        let slices: Vec<&[f32]> = values.iter().map(Vec::as_slice).collect();
        let blocks = self.blocks(&slices);
        let latents = self.latents(blocks.clone(), samples, cuts);
        let latents = cuts.at(latents);
        let unevenness = unevenness(latents.clone());
        let bounded = self.bound(latents);
        let codes = self.rounded(bounded.clone().without_autodiff());
        let soft = bounded / self.half_levels();
        let offset: Tensor<2> = codes - soft.clone().without_autodiff();
        let found = self.pixels(soft + offset, samples, cuts);
        let (kept, count) = self.kept(samples);
        let loss = ops::sum((found - blocks).square() * kept) / count;
        Ok(Trained { loss, unevenness })
    }

    /// The codes of squashed latents; on a device nobody waits for them.
    fn rounded(&self, bounded: Tensor<2>) -> Tensor<2> {
        if !ops::on_processor(&bounded) {
            return bounded.round() / self.half_levels();
        }
        let shape = bounded.dims();
        let tokens = self.fsq.index(&to_host(bounded));
        let codes = TensorData::new(self.fsq.decode(&tokens), shape);
        Tensor::from_data(codes, &self.device())
    }

    /// Half of each dimension's levels, rounded down, `[1, width]`: what makes a code of a level.
    fn half_levels(&self) -> Tensor<2> {
        let levels = self.settings().levels.iter();
        let values: Vec<f32> = levels.map(|levels| (levels / 2) as f32).collect();
        let width = values.len();
        Tensor::from_data(TensorData::new(values, [1, width]), &self.device())
    }

    /// The squashed latents, differentiable.
    fn bound(&self, z: Tensor<2>) -> Tensor<2> {
        let squash: Vec<[f64; 3]> = (0..self.fsq.width()).map(|i| self.fsq.squash(i)).collect();
        let part = |k: usize| {
            let values: Vec<f32> = squash.iter().map(|s| s[k] as f32).collect();
            Tensor::<2>::from_data(TensorData::new(values, [1, squash.len()]), &self.device())
        };
        (z + part(2)).tanh() * part(0) - part(1)
    }

    /// 1 where a value of a block stands for a pixel of the padded clip, 0 where it repeats the padded clip's first frame.
    /// Padding counts: edge frames in front and at the end, zeros at the sides. And how many there are, as f32 has it.
    fn kept(&self, samples: usize) -> (Tensor<2>, f64) {
        let extent = self.extent(samples);
        let (patch, side) = (self.settings().patch, self.settings().coefficients());
        let repeated = (patch - 1) * side / patch;
        let mut values = Vec::with_capacity(extent.rows() * side);
        for row in 0..extent.rows() {
            let first = (row / extent.pixels()).is_multiple_of(extent.frames);
            values.extend((0..side).map(|i| f32::from(u8::from(!first || i >= repeated))));
        }
        let count = values.iter().filter(|value| **value != 0.0).count() as f32;
        let values = TensorData::new(values, [extent.rows(), side]);
        (Tensor::from_data(values, &self.device()), f64::from(count))
    }

    /// The values of signals, row-major, checked for shape and finiteness.
    pub(super) fn checked(&self, signals: &[Signal]) -> Result<Vec<Vec<f32>>, TokenizerError> {
        let signals = signals.iter().enumerate();
        signals
            .map(|(index, signal)| self.checked_one(index, signal))
            .collect()
    }

    /// The same of one that is called `index` in errors.
    pub(super) fn checked_one(
        &self,
        index: usize,
        signal: &Signal,
    ) -> Result<Vec<f32>, TokenizerError> {
        let [frames, height, width] = self.padding.clip;
        let expected = [frames, height, width, COLOURS];
        let fits = |found: &[usize], expected: &[usize]| {
            if found == expected {
                return Ok(());
            }
            Err(TokenizerError::Shape {
                modality: self.modality.clone(),
                index,
                found: found.to_vec(),
                expected: expected.to_vec(),
            })
        };
        fits(signal.values.shape(), &expected)?;
        let mut values: Vec<f32> = signal.values.iter().copied().collect();
        if let Some(valid) = &signal.valid {
            fits(valid.shape(), &expected[..3])?;
            for (pixel, valid) in values.chunks_exact_mut(COLOURS).zip(valid) {
                if !valid {
                    pixel.fill(0.0);
                }
            }
        }
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let pixel = at / COLOURS;
            return Err(TokenizerError::NotFinite {
                modality: self.modality.clone(),
                index,
                position: vec![
                    pixel / (height * width),
                    pixel / width % height,
                    pixel % width,
                    at % COLOURS,
                ],
            });
        }
        Ok(values)
    }
}

impl Tokenizer for VideoTokenizer {
    fn write(&self, directory: &std::path::Path) -> Result<(), TokenizerError> {
        self.weights()
            .write(&directory.join(FILE))
            .map_err(|error| TokenizerError::Other(error.to_string()))
    }

    fn modality(&self) -> &str {
        &self.modality
    }

    fn grid(&self) -> &[usize] {
        &self.grid
    }

    fn vocabulary(&self) -> usize {
        self.settings().vocabulary()
    }

    /// One clip at a time: memory does not grow with the batch.
    fn encode(&self, signals: &[Signal]) -> Result<Vec<TokenGrid>, TokenizerError> {
        let clips = self.checked(signals)?;
        Ok(clips
            .iter()
            .map(|clip| TokenGrid {
                ids: self.fsq.encode(&to_host(self.latents(
                    self.blocks(&[clip]),
                    1,
                    &mut Cuts::none(),
                ))),
                grid: self.grid.clone(),
            })
            .collect())
    }

    fn decode(&self, tokens: &[TokenGrid]) -> Result<Vec<Signal>, TokenizerError> {
        check_tokens(self, tokens)?;
        let device = self.device();
        tokens
            .iter()
            .map(|grid| {
                let codes = self.fsq.decode(&grid.ids);
                let shape = [grid.ids.len(), self.fsq.width()];
                let codes = Tensor::from_data(TensorData::new(codes, shape), &device);
                let blocks = to_host(self.pixels(codes, 1, &mut Cuts::none()));
                let padded = haar::paste(&blocks, self.size(), [self.settings().patch; 2]);
                let mut values = self.padding.crop(&padded, COLOURS);
                for value in &mut values {
                    *value = value.clamp(-1.0, 1.0);
                }
                let [frames, height, width] = self.padding.clip;
                let shape = IxDyn(&[frames, height, width, COLOURS]);
                let values = ArrayD::from_shape_vec(shape, values)
                    .map_err(|e| TokenizerError::Other(e.to_string()))?;
                Ok(Signal {
                    values,
                    valid: None,
                })
            })
            .collect()
    }
}

/// Peak signal-to-noise ratio in dB of values in [-1, 1]; infinite for equal videos.
///
/// # Panics
/// When the videos have different sizes.
#[must_use]
pub fn psnr(found: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let square: f64 = found
        .iter()
        .zip(expected)
        .map(|(a, b)| f64::from(a - b).powi(2))
        .sum();
    10.0 * (4.0 * found.len() as f64 / square).log10()
}

#[cfg(test)]
mod tests {
    use super::super::testing::small;
    use super::*;
    use crate::engine::{Gradients, Parameters};
    use crate::training::{AdamW, AdamWSettings};

    fn tiny(seed: u64) -> VideoTokenizer {
        small([8, 16, 24], [8, 6], &[8, 5, 5], seed)
    }

    /// A bright square that moves over a gradient.
    fn clip(phase: usize) -> Signal {
        let values = ArrayD::from_shape_fn(IxDyn(&[8, 16, 24, 3]), |at| {
            let inside =
                (at[1] + 4).abs_diff(8 + phase) < 4 && at[2].abs_diff(4 + at[0] + phase) < 4;
            if inside {
                0.9 - 0.4 * at[3] as f32
            } else {
                at[2] as f32 / 24.0 - 0.5
            }
        });
        Signal {
            values,
            valid: None,
        }
    }

    #[test]
    fn shapes_and_bad_signals_are_handled() {
        let tokenizer = tiny(0);
        assert_eq!(tokenizer.grid(), [3, 2, 4]);
        assert_eq!(tokenizer.vocabulary(), 200);
        let tokens = tokenizer.encode(&[clip(0), clip(1)]).unwrap();
        assert_eq!(tokens.len(), 2);
        assert!(tokens[0].ids.iter().all(|id| *id < 200));
        let back = tokenizer.decode(&tokens).unwrap();
        assert_eq!(back[1].values.shape(), [8, 16, 24, 3]);

        let mut bad = clip(0);
        bad.values[[2, 3, 4, 1]] = f32::NAN;
        let error = tokenizer.encode(&[clip(0), bad]).unwrap_err();
        assert!(error.to_string().contains("[2, 3, 4, 1]"), "{error}");
        let mut wrong = tokens[0].clone();
        wrong.ids[5] = 200;
        assert!(matches!(
            tokenizer.decode(&[wrong]),
            Err(TokenizerError::Vocabulary { token: 200, .. })
        ));
    }

    #[test]
    fn a_few_steps_of_training_bring_the_loss_down_and_are_reproducible() {
        let run = || {
            let mut tokenizer = tiny(1);
            tokenizer.network_mut().start_training();
            let mut optimizer = AdamW::new(AdamWSettings::default(), tokenizer.network());
            let mut losses = Vec::new();
            for _ in 0..12 {
                let trained = tokenizer
                    .train(&[clip(0), clip(2)], &mut Cuts::none())
                    .unwrap();
                losses.push(trained.loss.clone().into_scalar::<f32>());
                let gradients = Gradients::of(&trained.loss, tokenizer.network());
                optimizer
                    .step(tokenizer.network_mut(), gradients, 3e-3)
                    .unwrap();
            }
            losses
        };
        let losses = run();
        assert!(losses[11] < 0.7 * losses[0], "{losses:?}");
        assert_eq!(losses, run());
    }
}
