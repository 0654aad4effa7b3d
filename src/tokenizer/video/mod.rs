//! The discrete video tokenizer (Cosmos, DV4x8x8 and DV8x16x16, and any smaller one): Haar wavelet, causal factorised
//! convolutions, finite scalar quantisation (Sec. 4.2, Supp. A; frozen in the paper, trainable here).
//!
//! Read in this order: [`settings`] (sizes, and from them every layer), [`haar`] (pixels to wavelet coefficients and back),
//! [`layers`] (convolution, norm, residual block, attention, resampling), [`network`] (encoder and decoder, parameters named as
//! in NVIDIA's files), [`fsq`] (latents to tokens), [`padding`] (clips to the lengths and sizes the network takes) and
//! [`tokenizer`] (signals to tokens and back, and one training step), [`calibrate`] (before the first step), [`cost`] (what it
//! takes), [`stored`] (the file).

pub mod calibrate;
pub mod cost;
pub mod fsq;
pub mod haar;
pub mod layers;
mod maps;
pub mod network;
pub mod padding;
pub mod settings;
pub mod stored;
pub mod tokenizer;

pub use fsq::Fsq;
pub use network::Network;
pub use settings::VideoSettings;
pub use tokenizer::{VideoTokenizer, psnr};

#[cfg(test)]
pub(crate) mod testing {
    use super::{Network, VideoSettings, VideoTokenizer};
    use crate::engine::{Compute, Initialise};

    /// A tokenizer of colour clips of `[frames, height, width]` that trains in moments, with as many channels and latents.
    pub(crate) fn small(
        clip: [usize; 3],
        [channels, latent_channels]: [usize; 2],
        levels: &[usize],
        seed: u64,
    ) -> VideoTokenizer {
        let settings = VideoSettings {
            channels,
            multipliers: vec![1, 2],
            blocks: 1,
            latent_channels,
            levels: levels.to_vec(),
            ..VideoSettings::default()
        };
        let compute = Compute::cpu();
        let network = Network::new(&Initialise::new(&compute, seed), &settings).unwrap();
        VideoTokenizer::new("rgb", clip, network, &compute).unwrap()
    }
}
