//! The motion encoder: a post-norm transformer over two learned tokens and the frames of a motion.
//!
//! Shape suffixes: `N` rows of all clips packed without padding (the two tokens of a clip first), `D` width.

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::features::FEATURES;
use crate::engine::parameters::to_host;
use crate::engine::{Compute, Initialise, Parameter, Segments, ops, parameters};
use crate::nn::Linear;
use crate::nn::positions::interleaved;

/// Layer norms add this to the variance.
const EPSILON: f64 = 1e-5;
/// The mean token and the log-variance token.
const TOKENS: usize = 2;
/// The longest motion in frames that positions are made for, as in training.
pub const LONGEST: usize = 4998;

/// Sizes of the encoder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionEncoderSettings {
    /// Width of the tokens and of the embedding: even, and a multiple of `heads`.
    pub width: usize,
    /// Number of transformer layers.
    pub layers: usize,
    /// Attention heads of every layer.
    pub heads: usize,
    /// Width inside the feed-forward layers.
    pub hidden: usize,
}

impl Default for MotionEncoderSettings {
    /// The released encoder.
    fn default() -> Self {
        Self {
            width: 256,
            layers: 6,
            heads: 4,
            hidden: 1024,
        }
    }
}

impl MotionEncoderSettings {
    /// Why no encoder can have these sizes, if so.
    #[must_use]
    pub fn problem(&self) -> Option<String> {
        let sizes = [self.width, self.heads, self.hidden];
        if sizes.iter().any(|size| !(1..=1 << 14).contains(size)) || self.layers > 64 {
            return Some(format!("sizes {sizes:?} and {} layers", self.layers));
        }
        let fits = self.width.is_multiple_of(self.heads) && self.width.is_multiple_of(2);
        (!fits).then(|| format!("width {} in {} heads", self.width, self.heads))
    }
}

/// The encoder, with the names of the released file.
#[derive(Debug, Clone)]
pub struct MotionEncoder {
    /// `[2, D]`.
    tokens: Parameter,
    projection: Linear,
    layers: Vec<Layer>,
    settings: MotionEncoderSettings,
}
parameters!(MotionEncoder {
    tokens,
    projection,
    layers => "seqTransEncoder.layers"
});

#[derive(Debug, Clone)]
struct Layer {
    /// `[3 D, D]`: queries, keys, values.
    in_weight: Parameter,
    in_bias: Parameter,
    out_proj: Linear,
    linear1: Linear,
    linear2: Linear,
    norm1: Norm,
    norm2: Norm,
}
parameters!(Layer {
    in_weight => "self_attn.in_proj_weight",
    in_bias => "self_attn.in_proj_bias",
    out_proj => "self_attn.out_proj",
    linear1,
    linear2,
    norm1,
    norm2
});

#[derive(Debug, Clone)]
struct Norm {
    weight: Parameter,
    bias: Parameter,
}
parameters!(Norm { weight, bias });

impl Norm {
    fn new(init: &Initialise<'_>, width: usize) -> Self {
        Self {
            weight: init.constant(&[width], 1.0),
            bias: init.constant(&[width], 0.0),
        }
    }

    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        ops::layer_norm(x, self.weight.tensor(), Some(self.bias.tensor()), EPSILON)
    }
}

impl Layer {
    fn new(init: &Initialise<'_>, settings: &MotionEncoderSettings) -> Self {
        let (width, hidden) = (settings.width, settings.hidden);
        let attention = init.at("self_attn");
        Self {
            in_weight: attention.xavier("in_proj_weight", &[3 * width, width], width, width),
            in_bias: attention.constant(&[3 * width], 0.0),
            out_proj: Linear::new(&attention.at("out_proj"), width, width, true),
            linear1: Linear::new(&init.at("linear1"), width, hidden, true),
            linear2: Linear::new(&init.at("linear2"), hidden, width, true),
            norm1: Norm::new(&init.at("norm1"), width),
            norm2: Norm::new(&init.at("norm2"), width),
        }
    }

    fn forward(&self, h_ND: Tensor<2>, heads: usize, segments: &Segments) -> Tensor<2> {
        let (weight, bias) = (self.in_weight.tensor(), Some(self.in_bias.tensor()));
        let qkv = ops::linear(h_ND.clone(), weight, bias);
        let mixed = self
            .out_proj
            .forward(ops::self_attention(qkv, heads, segments));
        let h_ND = self.norm1.forward(h_ND + mixed);
        let hidden = ops::gelu(self.linear1.forward(h_ND.clone()));
        self.norm2.forward(h_ND + self.linear2.forward(hidden))
    }
}

/// What the encoder says of one clip.
#[derive(Debug, Clone, PartialEq)]
pub struct Embedded {
    /// The embedding: the mean, nothing sampled.
    pub mu: Vec<f32>,
    /// Logarithm of the variance, one number per number of [`Self::mu`].
    pub logvar: Vec<f32>,
}

/// The rows of every stage, all clips packed. For comparisons with the reference.
#[derive(Debug)]
pub struct Stages {
    /// Without the tokens.
    pub projected: Tensor<2>,
    /// Tokens and frames with their positions added: what the first layer reads.
    pub with_positions: Tensor<2>,
    /// What each layer gives, in order.
    pub layers: Vec<Tensor<2>>,
}

impl MotionEncoder {
    /// An encoder of these sizes.
    ///
    /// # Errors
    /// Why the sizes do not fit each other.
    pub fn new(init: &Initialise<'_>, settings: &MotionEncoderSettings) -> Result<Self, String> {
        if let Some(problem) = settings.problem() {
            return Err(problem);
        }
        Ok(Self {
            tokens: init.normal("tokens", &[TOKENS, settings.width], 1.0),
            projection: Linear::new(&init.at("projection"), FEATURES, settings.width, true),
            layers: (0..settings.layers)
                .map(|i| Layer::new(&init.at("seqTransEncoder.layers").item(i), settings))
                .collect(),
            settings: settings.clone(),
        })
    }

    /// The sizes it was made with.
    #[must_use]
    pub fn settings(&self) -> &MotionEncoderSettings {
        &self.settings
    }

    /// Normalised features of clips, rows of [`FEATURES`] each.
    #[must_use]
    pub fn forward(&self, clips: &[&[f32]]) -> Vec<Embedded> {
        let stages = self.stages(clips);
        let last = stages.layers.last().unwrap_or(&stages.with_positions);
        let values = to_host(last.clone());
        let width = self.settings.width;
        let mut start = 0;
        clips
            .iter()
            .map(|clip| {
                let row = |index: usize| values[start + index * width..][..width].to_vec();
                let embedded = Embedded {
                    mu: row(0),
                    logvar: row(1),
                };
                start += (clip.len() / FEATURES + TOKENS) * width;
                embedded
            })
            .collect()
    }

    /// [`MotionEncoder::forward`], stage by stage.
    ///
    /// # Panics
    /// When a clip is no whole number of rows, or longer than [`LONGEST`].
    #[must_use]
    pub fn stages(&self, clips: &[&[f32]]) -> Stages {
        let width = self.settings.width;
        let lengths: Vec<usize> = clips.iter().map(|clip| clip.len() / FEATURES).collect();
        assert!(
            clips.iter().all(|clip| clip.len() % FEATURES == 0)
                && lengths.iter().all(|length| *length <= LONGEST),
            "rows of features"
        );
        let device = self.tokens.untracked().device();
        let rows: Vec<f32> = clips.concat();
        let rows = TensorData::new(rows, [lengths.iter().sum(), FEATURES]);
        let projected = self.projection.forward(Tensor::from_data(rows, &device));
        let longest = lengths.iter().max().copied().unwrap_or(0) + TOKENS;
        let table = TensorData::new(interleaved(longest, width), [longest, width]);
        let table: Tensor<2> = Tensor::from_data(table, &device);
        let tokens = self.tokens.tensor::<2>();
        let mut parts = Vec::new();
        let mut start = 0;
        for length in &lengths {
            let own = projected.clone().narrow(0, start, *length);
            let own = Tensor::cat(vec![tokens.clone(), own], 0);
            parts.push(own + table.clone().narrow(0, 0, length + TOKENS));
            start += length;
        }
        let with_positions = Tensor::cat(parts, 0);
        let whole: Vec<usize> = lengths.iter().map(|length| length + TOKENS).collect();
        let segments = Segments::within(&whole);
        let mut layers: Vec<Tensor<2>> = Vec::with_capacity(self.layers.len());
        for layer in &self.layers {
            let h_ND = layers.last().unwrap_or(&with_positions).clone();
            layers.push(layer.forward(h_ND, self.settings.heads, &segments));
        }
        Stages {
            projected,
            with_positions,
            layers,
        }
    }

    /// An encoder of the released sizes with random weights: for tests.
    #[must_use]
    pub fn random(compute: &Compute, settings: &MotionEncoderSettings, seed: u64) -> Option<Self> {
        Self::new(&Initialise::new(compute, seed), settings).ok()
    }
}
