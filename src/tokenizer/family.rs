//! A tokenizer before it is trained, by family.

use super::video::VideoSettings;
use super::vq::VqSettings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Family and sizes of a tokenizer: what `registry/tokenizer/*.yaml` hold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "family", rename_all = "snake_case")]
pub enum TokenizerSettings {
    /// VQ-VAE of signals or joints over time.
    Vq(VqSettings),
    /// Wavelet, causal convolutions and finite scalar quantisation of video (Cosmos).
    Video(VideoSettings),
}

impl Default for TokenizerSettings {
    fn default() -> Self {
        Self::Vq(VqSettings::default())
    }
}
