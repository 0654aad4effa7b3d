//! What a forward pass of a video tokenizer costs per clip, walked as [`super::Network`] computes it; nothing is allocated.

use super::padding::Padding;
use super::settings::{Resampling, VideoSettings};

/// Of one forward pass of the encoder and the decoder.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Cost {
    /// Those of convolutions and projections; scores of attention are left out.
    pub multiply_accumulates: f64,
    /// Numbers that are left for the backward pass.
    pub floats: f64,
}

impl Cost {
    /// For clips of `[frames, height, width]`.
    #[must_use]
    pub fn of(settings: &VideoSettings, clip: [usize; 3]) -> Self {
        let [frames, height, width] = Padding::of(clip, settings.temporal, settings.spatial).padded;
        let patch = settings.patch;
        // The first frame stands for a whole block.
        let frames = (frames - 1).div_ceil(patch) + 1;
        Self::on(settings, [frames, height / patch, width / patch])
    }

    /// For blocks of pixels.
    fn on(settings: &VideoSettings, mut extent: [usize; 3]) -> Self {
        let mut cost = Self::default();
        let levels = settings.multipliers.len();
        let latent = settings.latent_channels;
        let mut channels = settings.channels;
        cost.end(extent, settings.coefficients(), channels);
        for level in 0..levels {
            for _ in 0..settings.blocks {
                cost.residual(extent, channels, settings.width(level));
                channels = settings.width(level);
            }
            let way = settings.down(level);
            let [space, time] = [way.space, way.time].map(|halves| 1 + usize::from(halves));
            extent = [
                extent[0].div_ceil(time),
                extent[1].div_ceil(space),
                extent[2].div_ceil(space),
            ];
            cost.resampling(extent, channels, way);
        }
        cost.middle(extent, channels);
        cost.end(extent, channels, latent);
        let code = settings.levels.len();
        cost.convolution(extent, latent, code, 1);
        cost.convolution(extent, code, latent, 1);
        cost.end(extent, latent, channels);
        cost.middle(extent, channels);
        for level in (0..levels).rev() {
            for _ in 0..=settings.blocks {
                cost.residual(extent, channels, settings.width(level));
                channels = settings.width(level);
            }
            let way = settings.up(level);
            let [space, time] = [way.space, way.time].map(|doubles| 1 + usize::from(doubles));
            extent = [
                (extent[0] - 1) * time + 1,
                extent[1] * space,
                extent[2] * space,
            ];
            cost.resampling(extent, channels, way);
        }
        cost.end(extent, channels, settings.coefficients());
        cost
    }

    fn convolution(&mut self, extent: [usize; 3], inputs: usize, outputs: usize, taps: usize) {
        self.multiply_accumulates += cells(extent) * (inputs * outputs * taps) as f64;
    }

    /// Over the picture, then over time.
    fn factorised(&mut self, extent: [usize; 3], inputs: usize, outputs: usize) {
        self.convolution(extent, inputs, outputs, 9);
        self.convolution(extent, outputs, outputs, 3);
    }

    /// The first or the last convolution of a half.
    fn end(&mut self, extent: [usize; 3], inputs: usize, outputs: usize) {
        self.factorised(extent, inputs, outputs);
        self.floats += cells(extent) * (inputs + 2 * outputs) as f64;
    }

    fn residual(&mut self, extent: [usize; 3], inputs: usize, outputs: usize) {
        self.factorised(extent, inputs, outputs);
        self.factorised(extent, outputs, outputs);
        if inputs != outputs {
            self.convolution(extent, inputs, outputs, 1);
        }
        self.floats += cells(extent) * (2 * inputs + 7 * outputs) as f64;
    }

    /// Where the extent is the one after it, or, doubled, before its last convolution.
    fn resampling(&mut self, extent: [usize; 3], channels: usize, way: Resampling) {
        if way == Resampling::default() {
            return;
        }
        self.convolution(extent, channels, channels, 1);
        if way.space {
            self.convolution(extent, channels, channels, 9);
        }
        if way.time {
            self.convolution(extent, channels, channels, 3);
        }
        self.floats += cells(extent) * 3.0 * channels as f64;
    }

    /// Two residual blocks and two attentions.
    fn middle(&mut self, extent: [usize; 3], channels: usize) {
        for _ in 0..2 {
            self.residual(extent, channels, channels);
            self.convolution(extent, channels, channels, 4);
            self.floats += cells(extent) * 8.0 * channels as f64;
        }
    }
}

fn cells(extent: [usize; 3]) -> f64 {
    extent.iter().product::<usize>() as f64
}

#[cfg(test)]
mod tests {
    use super::super::Network;
    use super::*;
    use crate::engine::{Compute, Initialise, Parameters};

    #[test]
    fn a_single_block_is_multiplied_by_every_weight_once() {
        let settings = VideoSettings {
            channels: 4,
            latent_channels: 6,
            ..VideoSettings::default()
        };
        let settings = VideoSettings {
            spatial: settings.patch,
            temporal: settings.patch,
            ..settings
        };
        let compute = Compute::cpu();
        let network = Network::new(&Initialise::meta(&compute), &settings).unwrap();
        let mut weights = 0;
        network.visit("", &mut |name, parameter| {
            if name.ends_with("weight") && parameter.shape().len() > 1 {
                weights += parameter.shape().iter().product::<usize>();
            }
        });
        let cost = Cost::on(&settings, [1, 1, 1]);
        assert_eq!(cost.multiply_accumulates, weights as f64);
    }

    #[test]
    fn twice_the_picture_costs_twice_as_much() {
        let settings = VideoSettings::default();
        let [small, large] = [[17, 64, 64], [17, 64, 128]].map(|clip| Cost::of(&settings, clip));
        assert_eq!(large.floats, 2.0 * small.floats);
        assert_eq!(large.multiply_accumulates, 2.0 * small.multiply_accumulates);
    }
}
