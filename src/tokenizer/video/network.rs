//! Encoder and decoder, with the names of NVIDIA's files: the forward passes read top to bottom.

use burn::tensor::Tensor;

use super::layers::{
    Attends, Attention, Conv, Downsample, Extent, Factorised, Kernel, Norm, ResBlock, Upsample,
    chain, factorised,
};
use super::settings::VideoSettings;
use crate::engine::cuts::backward_order;
use crate::engine::{Cuts, Initialise, parameters};
use crate::tokenizer::TokenizerError;

/// Wavelet coefficients to latents and back.
#[derive(Debug, Clone)]
pub struct Network {
    encoder: Encoder,
    quant_conv: Conv,
    post_quant_conv: Conv,
    decoder: Decoder,
    settings: VideoSettings,
}
parameters!(Network {
    encoder,
    quant_conv,
    post_quant_conv,
    decoder
});

/// Two residual blocks with attention in space and in time between them.
#[derive(Debug, Clone)]
struct Middle {
    block_1: ResBlock,
    attn_1: Vec<Attention>,
    block_2: ResBlock,
}
parameters!(Middle {
    block_1,
    attn_1,
    block_2
});

impl Middle {
    fn new(init: &Initialise<'_>, channels: usize) -> Self {
        let attention = init.at("attn_1");
        Self {
            block_1: ResBlock::new(&init.at("block_1"), channels, channels),
            attn_1: vec![
                Attention::new(&attention.item(0), channels, Attends::Space),
                Attention::new(&attention.item(1), channels, Attends::Time),
            ],
            block_2: ResBlock::new(&init.at("block_2"), channels, channels),
        }
    }

    fn forward(&self, x_NC: Tensor<2>, extent: Extent, cuts: &mut Cuts) -> Tensor<2> {
        let x_NC = self.block_1.forward(cuts.at(x_NC), extent);
        let x_NC = self.attn_1.iter().fold(x_NC, |x_NC, attention| {
            attention.forward(cuts.at(x_NC), extent)
        });
        self.block_2.forward(cuts.at(x_NC), extent)
    }
}

#[derive(Debug, Clone)]
struct Down {
    block: Vec<ResBlock>,
    downsample: Option<Downsample>,
}
parameters!(Down { block, downsample });

#[derive(Debug, Clone)]
struct Up {
    block: Vec<ResBlock>,
    upsample: Option<Upsample>,
}
parameters!(Up { block, upsample });

#[derive(Debug, Clone)]
struct Encoder {
    conv_in: Factorised,
    down: Vec<Down>,
    mid: Middle,
    norm_out: Norm,
    conv_out: Factorised,
}
parameters!(Encoder {
    conv_in,
    down,
    mid,
    norm_out,
    conv_out
});

impl Encoder {
    fn new(init: &Initialise<'_>, settings: &VideoSettings) -> Self {
        let mut width = settings.channels;
        let down = (0..settings.multipliers.len())
            .map(|level| {
                let init = init.at("down").item(level);
                let block = (0..settings.blocks)
                    .map(|i| {
                        let inputs = std::mem::replace(&mut width, settings.width(level));
                        ResBlock::new(&init.at("block").item(i), inputs, width)
                    })
                    .collect();
                let way = settings.down(level);
                Down {
                    block,
                    downsample: Downsample::new(&init.at("downsample"), width, way),
                }
            })
            .collect();
        Self {
            conv_in: factorised(
                &init.at("conv_in"),
                settings.coefficients(),
                settings.channels,
            ),
            down,
            mid: Middle::new(&init.at("mid"), width),
            norm_out: Norm::new(&init.at("norm_out"), width),
            conv_out: factorised(&init.at("conv_out"), width, settings.latent_channels),
        }
    }

    fn forward(&self, x_NC: Tensor<2>, mut extent: Extent, cuts: &mut Cuts) -> (Tensor<2>, Extent) {
        let mut x_NC = chain(&self.conv_in, x_NC, extent);
        for level in &self.down {
            for block in &level.block {
                x_NC = block.forward(cuts.at(x_NC), extent);
            }
            if let Some(downsample) = &level.downsample {
                (x_NC, extent) = downsample.forward(cuts.at(x_NC), extent);
            }
        }
        let x_NC = self.mid.forward(x_NC, extent, cuts);
        let x_NC = self.norm_out.forward(cuts.at(x_NC), extent, true);
        (chain(&self.conv_out, x_NC, extent), extent)
    }
}

#[derive(Debug, Clone)]
struct Decoder {
    conv_in: Factorised,
    mid: Middle,
    /// In the order of levels; the last is applied first.
    up: Vec<Up>,
    norm_out: Norm,
    conv_out: Factorised,
}
parameters!(Decoder {
    conv_in,
    mid,
    up,
    norm_out,
    conv_out
});

impl Decoder {
    fn new(init: &Initialise<'_>, settings: &VideoSettings) -> Self {
        let levels = settings.multipliers.len();
        let widest = settings.width(levels - 1);
        let mut width = widest;
        let mut up: Vec<Up> = (0..levels)
            .rev()
            .map(|level| {
                let init = init.at("up").item(level);
                let block = (0..=settings.blocks)
                    .map(|i| {
                        let inputs = std::mem::replace(&mut width, settings.width(level));
                        ResBlock::new(&init.at("block").item(i), inputs, width)
                    })
                    .collect();
                Up {
                    block,
                    upsample: Upsample::new(&init.at("upsample"), width, settings.up(level)),
                }
            })
            .collect();
        up.reverse();
        Self {
            conv_in: factorised(&init.at("conv_in"), settings.latent_channels, widest),
            mid: Middle::new(&init.at("mid"), widest),
            up,
            norm_out: Norm::new(&init.at("norm_out"), width),
            conv_out: factorised(&init.at("conv_out"), width, settings.coefficients()),
        }
    }

    fn forward(&self, x_NC: Tensor<2>, mut extent: Extent, cuts: &mut Cuts) -> (Tensor<2>, Extent) {
        let x_NC = chain(&self.conv_in, x_NC, extent);
        let mut x_NC = self.mid.forward(x_NC, extent, cuts);
        for level in self.up.iter().rev() {
            for block in &level.block {
                x_NC = block.forward(cuts.at(x_NC), extent);
            }
            if let Some(upsample) = &level.upsample {
                (x_NC, extent) = upsample.forward(cuts.at(x_NC), extent);
            }
        }
        let x_NC = self.norm_out.forward(cuts.at(x_NC), extent, true);
        (chain(&self.conv_out, x_NC, extent), extent)
    }
}

impl Network {
    /// A network of these sizes.
    ///
    /// # Errors
    /// When the sizes do not fit each other.
    pub fn new(init: &Initialise<'_>, settings: &VideoSettings) -> Result<Self, TokenizerError> {
        settings.check()?;
        let (latent, code) = (settings.latent_channels, settings.levels.len());
        let conv =
            |name: &str, inputs, outputs| Conv::new(&init.at(name), inputs, outputs, Kernel::Point);
        Ok(Self {
            encoder: Encoder::new(&init.at("encoder"), settings),
            quant_conv: conv("quant_conv", latent, code),
            post_quant_conv: conv("post_quant_conv", code, latent),
            decoder: Decoder::new(&init.at("decoder"), settings),
            settings: settings.clone(),
        })
    }

    /// What it was made with.
    #[must_use]
    pub fn settings(&self) -> &VideoSettings {
        &self.settings
    }

    /// The encoder's output before the projection to latents: `[N, coefficients]` to `[N', latent channels]`.
    #[must_use]
    pub fn hidden(&self, x_NC: Tensor<2>, extent: Extent, cuts: &mut Cuts) -> (Tensor<2>, Extent) {
        self.encoder.forward(x_NC, extent, cuts)
    }

    /// Wavelet coefficients `[N, coefficients]` to latents `[N', code width]`, before quantisation.
    #[must_use]
    pub fn encode(&self, x_NC: Tensor<2>, extent: Extent, cuts: &mut Cuts) -> (Tensor<2>, Extent) {
        let (h_NC, extent) = self.hidden(x_NC, extent, cuts);
        (self.quant_conv.forward(h_NC, extent), extent)
    }

    /// Codes `[N', code width]` to wavelet coefficients `[N, coefficients]`.
    #[must_use]
    pub fn decode(
        &self,
        code_NC: Tensor<2>,
        extent: Extent,
        cuts: &mut Cuts,
    ) -> (Tensor<2>, Extent) {
        let h_NC = self.post_quant_conv.forward(code_NC, extent);
        self.decoder.forward(h_NC, extent, cuts)
    }

    /// The names of all parameters, about in the order in which backward is done with them.
    #[must_use]
    pub fn backward_order(&self) -> Vec<String> {
        let up = (0..self.decoder.up.len()).rev();
        let up: Vec<String> = up.map(|level| format!("decoder.up.{level}.")).collect();
        let start = ["encoder.", "quant_conv.", "post_quant_conv.", "decoder."];
        let end = ["decoder.norm_out.", "decoder.conv_out."];
        let up = up.iter().map(String::as_str);
        let stages: Vec<&str> = start.into_iter().chain(up).chain(end).collect();
        backward_order(self, &stages)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Parameters};

    /// Counts by names alone would need 400 MB of zeros; the sizes are linear in blocks, so a narrow network shows the
    /// structure and the formula below gives the published totals.
    fn conv(inputs: usize, outputs: usize, taps: usize) -> usize {
        outputs * inputs * taps + outputs
    }

    fn factorised(inputs: usize, outputs: usize) -> usize {
        conv(inputs, outputs, 9) + conv(outputs, outputs, 3)
    }

    fn res(i: usize, o: usize) -> usize {
        let shortcut = if i == o { 0 } else { conv(i, o, 1) };
        2 * i + factorised(i, o) + 2 * o + factorised(o, o) + shortcut
    }

    fn middle(c: usize) -> usize {
        2 * res(c, c) + 2 * (2 * c + 4 * conv(c, c, 1))
    }

    fn expected(s: &VideoSettings) -> usize {
        let mut total = factorised(s.coefficients(), s.channels);
        let mut width = s.channels;
        for level in 0..s.multipliers.len() {
            for _ in 0..s.blocks {
                total += res(width, s.width(level));
                width = s.width(level);
            }
            let way = s.down(level);
            if way.space || way.time {
                total += conv(width, width, 1);
            }
            total += usize::from(way.space) * conv(width, width, 9);
            total += usize::from(way.time) * conv(width, width, 3);
        }
        total += middle(width) + 2 * width + factorised(width, s.latent_channels);
        total += conv(s.latent_channels, s.levels.len(), 1);
        total += conv(s.levels.len(), s.latent_channels, 1);
        total += factorised(s.latent_channels, width) + middle(width);
        for level in (0..s.multipliers.len()).rev() {
            for _ in 0..=s.blocks {
                total += res(width, s.width(level));
                width = s.width(level);
            }
            let way = s.up(level);
            if way.space || way.time {
                total += conv(width, width, 1);
            }
            total += usize::from(way.time) * conv(width, width, 3);
            total += usize::from(way.space) * conv(width, width, 9);
        }
        total + 2 * width + factorised(width, s.coefficients())
    }

    #[test]
    fn the_networks_have_the_published_number_of_parameters() {
        for (settings, published) in [
            (VideoSettings::default(), 104_669_558),
            (VideoSettings::dv8x16x16(), 110_898_294),
        ] {
            assert_eq!(expected(&settings), published);
            let narrow = VideoSettings {
                channels: 3,
                latent_channels: 6,
                ..settings
            };
            let compute = Compute::cpu();
            let network = Network::new(&Initialise::empty(&compute), &narrow).unwrap();
            assert_eq!(network.count(), expected(&narrow));
        }
    }
}
