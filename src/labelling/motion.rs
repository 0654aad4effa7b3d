//! The temporal module: one transformer block over the frames of a window, pixel by pixel.
//!
//! Shape suffixes: `N` rows of all frames (frame by frame, row-major within a frame), `P` the same rows pixel by pixel (all
//! frames of the first pixel, then those of the second), `C` channels.

use burn::tensor::Tensor;

use super::settings::{MOTION_GROUPS, MOTION_HEADS, WINDOW};
use crate::engine::{Initialise, Parameter, Segments, ops, parameters};
use crate::nn::Linear;
use crate::nn::positions::interleaved;

/// Layer norms of the block add this to the variance; the group norm adds [`GROUP_EPSILON`].
const EPSILON: f64 = 1e-5;
const GROUP_EPSILON: f64 = 1e-6;

/// Group norm, a linear layer, the block, a linear layer; plus the input.
#[derive(Debug, Clone)]
pub struct Motion {
    norm: Affine,
    proj_in: Linear,
    block: Block,
    proj_out: Linear,
}
parameters!(Motion {
    norm,
    proj_in,
    block => "transformer_blocks.0",
    proj_out
});

/// Scale and shift per channel.
#[derive(Debug, Clone)]
struct Affine {
    weight: Parameter,
    bias: Parameter,
}
parameters!(Affine { weight, bias });

impl Affine {
    fn new(init: &Initialise<'_>, channels: usize) -> Self {
        Self {
            weight: init.constant(&[channels], 1.0),
            bias: init.constant(&[channels], 0.0),
        }
    }

    fn layer_norm(&self, x: Tensor<2>) -> Tensor<2> {
        ops::layer_norm(x, self.weight.tensor(), Some(self.bias.tensor()), EPSILON)
    }
}

/// Two attention layers over time, then a gated feed-forward layer.
#[derive(Debug, Clone)]
struct Block {
    attention_blocks: Vec<Attention>,
    norms: Vec<Affine>,
    /// `C` to `8 C`: values, then gates.
    ff_in: Linear,
    /// `4 C` to `C`.
    ff_out: Linear,
    ff_norm: Affine,
}
parameters!(Block {
    attention_blocks,
    norms,
    ff_in => "ff.net.0.proj",
    ff_out => "ff.net.2",
    ff_norm
});

#[derive(Debug, Clone)]
struct Attention {
    to_q: Linear,
    to_k: Linear,
    to_v: Linear,
    to_out: Linear,
    /// `[1, WINDOW, C]`, fixed.
    positions: Parameter,
}
parameters!(Attention {
    to_q,
    to_k,
    to_v,
    to_out => "to_out.0",
    positions => "pos_encoder.pe"
});

impl Attention {
    fn new(init: &Initialise<'_>, channels: usize) -> Self {
        let linear = |name: &str, bias| Linear::new(&init.at(name), channels, channels, bias);
        Self {
            to_q: linear("to_q", false),
            to_k: linear("to_k", false),
            to_v: linear("to_v", false),
            to_out: linear("to_out.0", true),
            positions: init.fixed(&[1, WINDOW, channels], || interleaved(WINDOW, channels)),
        }
    }

    /// `[P, C]` to `[P, C]`, `frames` rows per pixel. Positions are added before queries, keys and values alike.
    fn forward(&self, x_PC: Tensor<2>, frames: usize) -> Tensor<2> {
        let [rows, channels] = x_PC.dims();
        let pixels = rows / frames;
        let positions = self.positions.tensor::<3>().narrow(1, 0, frames);
        let x_PC = (x_PC.reshape([pixels, frames, channels]) + positions).reshape([rows, channels]);
        let weights = [&self.to_q, &self.to_k, &self.to_v].map(|part| part.weight.tensor::<2>());
        let qkv = ops::linear(x_PC, Tensor::cat(weights.to_vec(), 0), None);
        let segments = Segments::batch(pixels, frames);
        let mixed = ops::self_attention(qkv, MOTION_HEADS, &segments);
        self.to_out.forward(mixed)
    }
}

/// What every step of a module gives, on rows frame by frame. For comparisons with the reference.
#[derive(Debug)]
pub struct Steps {
    /// The input after the group norm, `[N, C]`.
    pub group_norm: Tensor<2>,
    /// After the first linear layer, `[N, C]`.
    pub proj_in: Tensor<2>,
    /// Per attention layer: its norm, and its output before it is added.
    pub attention: Vec<[Tensor<2>; 2]>,
    /// The layer norm before the feed-forward part, `[N, C]`.
    pub ff_norm: Tensor<2>,
    /// The gated hidden layer of the feed-forward part, `[N, 4 * C]`.
    pub geglu: Tensor<2>,
    /// The output of the feed-forward part before it is added, `[N, C]`.
    pub ff: Tensor<2>,
    /// The output of the transformer block, `[N, C]`.
    pub block: Tensor<2>,
    /// After the last linear layer, before the module's input is added, `[N, C]`.
    pub proj_out: Tensor<2>,
    /// The output of the module, `[N, C]`.
    pub y: Tensor<2>,
}

impl Motion {
    /// A module for `channels`, a multiple of the heads and of the groups.
    #[must_use]
    pub fn new(init: &Initialise<'_>, channels: usize) -> Self {
        let block = init.at("transformer_blocks.0");
        Self {
            norm: Affine::new(&init.at("norm"), channels),
            proj_in: Linear::new(&init.at("proj_in"), channels, channels, true),
            block: Block {
                attention_blocks: (0..2)
                    .map(|i| Attention::new(&block.at("attention_blocks").item(i), channels))
                    .collect(),
                norms: (0..2)
                    .map(|i| Affine::new(&block.at("norms").item(i), channels))
                    .collect(),
                ff_in: Linear::new(&block.at("ff.net.0.proj"), channels, 8 * channels, true),
                ff_out: Linear::new(&block.at("ff.net.2"), 4 * channels, channels, true),
                ff_norm: Affine::new(&block.at("ff_norm"), channels),
            },
            proj_out: Linear::new(&init.at("proj_out"), channels, channels, true),
        }
    }

    /// `[N, C]` of `frames` frames to `[N, C]`.
    #[must_use]
    pub fn forward(&self, x_NC: Tensor<2>, frames: usize) -> Tensor<2> {
        let normal = self.group_norm(x_NC.clone(), frames);
        // Linear layers act on rows: the order of rows changes once before the block and once behind it.
        let mut y_PC = by_pixel(self.proj_in.forward(normal), frames);
        for (attention, norm) in self.layers() {
            y_PC = y_PC.clone() + attention.forward(norm.layer_norm(y_PC), frames);
        }
        let hidden = self.geglu(self.block.ff_norm.layer_norm(y_PC.clone()));
        let y_PC = y_PC + self.block.ff_out.forward(hidden);
        x_NC + by_frame(self.proj_out.forward(y_PC), frames)
    }

    /// [`Motion::forward`], step by step.
    #[must_use]
    pub fn steps(&self, x_NC: Tensor<2>, frames: usize) -> Steps {
        let group_norm = self.group_norm(x_NC.clone(), frames);
        let proj_in = self.proj_in.forward(group_norm.clone());
        let mut y_PC = by_pixel(proj_in.clone(), frames);
        let mut attention = Vec::new();
        for (layer, norm) in self.layers() {
            let normal = norm.layer_norm(y_PC.clone());
            let mixed = layer.forward(normal.clone(), frames);
            y_PC = y_PC + mixed.clone();
            attention.push([normal, mixed].map(|x| by_frame(x, frames)));
        }
        let ff_norm = self.block.ff_norm.layer_norm(y_PC.clone());
        let geglu = self.geglu(ff_norm.clone());
        let ff = self.block.ff_out.forward(geglu.clone());
        let block = by_frame(y_PC + ff.clone(), frames);
        let proj_out = self.proj_out.forward(block.clone());
        Steps {
            group_norm,
            proj_in,
            attention,
            ff_norm: by_frame(ff_norm, frames),
            geglu: by_frame(geglu, frames),
            ff: by_frame(ff, frames),
            block,
            y: x_NC + proj_out.clone(),
            proj_out,
        }
    }

    fn layers(&self) -> impl Iterator<Item = (&Attention, &Affine)> {
        self.block.attention_blocks.iter().zip(&self.block.norms)
    }

    /// `a gelu(g)`, where `a` is the first half of the outputs and `g` the second.
    fn geglu(&self, x: Tensor<2>) -> Tensor<2> {
        let half = |index: usize| {
            let outputs = self.block.ff_in.weight.shape()[0] / 2;
            let weight = self.block.ff_in.weight.tensor::<2>();
            let weight = weight.narrow(0, index * outputs, outputs);
            let bias = self.block.ff_in.bias.as_ref();
            let bias = bias.map(|b| b.tensor::<1>().narrow(0, index * outputs, outputs));
            ops::linear(x.clone(), weight, bias)
        };
        half(0) * ops::gelu(half(1))
    }

    /// Groups of channels of each frame to mean 0 and variance 1, then scale and shift.
    fn group_norm(&self, x_NC: Tensor<2>, frames: usize) -> Tensor<2> {
        let [rows, channels] = x_NC.dims();
        let pixels = rows / frames;
        let each = channels / MOTION_GROUPS;
        let grouped = x_NC
            .reshape([frames, pixels, MOTION_GROUPS, each])
            .swap_dims(1, 2)
            .reshape([frames * MOTION_GROUPS, pixels * each]);
        let centred = grouped.clone() - grouped.mean_dim(1);
        let variance = centred.clone().square().mean_dim(1);
        let normal = (centred / (variance + GROUP_EPSILON).sqrt())
            .reshape([frames, MOTION_GROUPS, pixels, each])
            .swap_dims(1, 2)
            .reshape([rows, channels]);
        normal * self.norm.weight.reshaped([1, channels]) + self.norm.bias.reshaped([1, channels])
    }
}

/// `[N, C]` to `[P, C]`.
fn by_pixel(x_NC: Tensor<2>, frames: usize) -> Tensor<2> {
    let [rows, channels] = x_NC.dims();
    x_NC.reshape([frames, rows / frames, channels])
        .swap_dims(0, 1)
        .reshape([rows, channels])
}

/// `[P, C]` to `[N, C]`.
fn by_frame(x_PC: Tensor<2>, frames: usize) -> Tensor<2> {
    let [rows, channels] = x_PC.dims();
    x_PC.reshape([rows / frames, frames, channels])
        .swap_dims(0, 1)
        .reshape([rows, channels])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{Compute, Parameters};
    use burn::tensor::TensorData;

    fn module(compute: &Compute) -> (Motion, Tensor<2>) {
        let values = (0..3 * 4 * 64)
            .map(|i| (i as f32 * 0.37).sin())
            .collect::<Vec<_>>();
        let x = Tensor::from_data(TensorData::new(values, [12, 64]), compute.device());
        (Motion::new(&Initialise::new(compute, 1), 64), x)
    }

    #[test]
    fn a_module_whose_last_layer_is_zero_changes_nothing() {
        let compute = Compute::cpu();
        let (mut motion, x) = module(&compute);
        let changed = to_host(motion.forward(x.clone(), 3));
        assert_ne!(changed, to_host(x.clone()));
        let mut weights = motion.weights();
        weights.insert_f32("proj_out.weight", vec![0.0; 64 * 64], &[64, 64]);
        motion.load(&weights).unwrap();
        assert_eq!(to_host(motion.forward(x.clone(), 3)), to_host(x));
    }

    #[test]
    fn the_steps_end_where_the_forward_pass_does() {
        let compute = Compute::cpu();
        let (motion, x) = module(&compute);
        let one = to_host(motion.forward(x.clone(), 3));
        let other = to_host(motion.steps(x, 3).y);
        let off = one.iter().zip(&other).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 1e-5);
    }
}
