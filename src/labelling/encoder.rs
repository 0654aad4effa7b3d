//! The image encoder: `DINOv2`, a plain vision transformer that sees every frame alone.
//!
//! Shape suffixes: `N` tokens of all frames (class token first in each), `D` width. Patches and features have no class token.

use burn::tensor::{Tensor, TensorData};

use super::NetworkSettings;
use crate::engine::{Initialise, Parameter, Segments, ops, parameters};
use crate::nn::{LayerNorm, Linear, Mlp, SelfAttention};

/// Added to the number of cells before the position table is resampled. It belongs to the weights: leaving it out changes a
/// resampled table by a tenth.
const POSITION_OFFSET: f64 = 0.1;

/// Patches of frames to the features of four blocks.
#[derive(Debug, Clone)]
pub struct Encoder {
    /// `[1, 1, D]`.
    cls_token: Parameter,
    /// `[1, 1 + grid^2, D]`, the class token's first.
    pos_embed: Parameter,
    /// A convolution whose stride is its size: a linear layer on the pixels of a patch, `[D, 3, patch, patch]`.
    patch_embed: PatchEmbedding,
    blocks: Vec<Block>,
    norm: LayerNorm,
    settings: NetworkSettings,
}
parameters!(Encoder {
    cls_token,
    pos_embed,
    patch_embed => "patch_embed.proj",
    blocks,
    norm
});

#[derive(Debug, Clone)]
struct PatchEmbedding {
    weight: Parameter,
    bias: Parameter,
}
parameters!(PatchEmbedding { weight, bias });

/// `x += gamma1 Attention(norm1 x)`, then `x += gamma2 Mlp(norm2 x)`.
#[derive(Debug, Clone)]
struct Block {
    norm1: LayerNorm,
    attn: SelfAttention,
    ls1: Parameter,
    norm2: LayerNorm,
    mlp: Mlp,
    ls2: Parameter,
}
parameters!(Block {
    norm1,
    attn,
    ls1 => "ls1.gamma",
    norm2,
    mlp,
    ls2 => "ls2.gamma"
});

impl Block {
    fn new(init: &Initialise<'_>, settings: &NetworkSettings) -> Self {
        let width = settings.width;
        Self {
            norm1: LayerNorm::new(&init.at("norm1"), width, true),
            attn: SelfAttention::new(&init.at("attn"), width, settings.heads, true),
            ls1: init.constant(&[width], 1.0),
            norm2: LayerNorm::new(&init.at("norm2"), width, true),
            mlp: Mlp::new(&init.at("mlp"), width, settings.hidden, true),
            ls2: init.constant(&[width], 1.0),
        }
    }

    fn forward(&self, x_ND: Tensor<2>, heads: usize, segments: &Segments) -> Tensor<2> {
        let qkv = self.attn.qkv.forward(self.norm1.forward(x_ND.clone()));
        let mixed_ND = ops::self_attention(qkv, heads, segments);
        let x_ND = x_ND + scaled(&self.attn.proj, &self.ls1, mixed_ND);
        let hidden = ops::gelu(self.mlp.fc1.forward(self.norm2.forward(x_ND.clone())));
        x_ND + scaled(&self.mlp.fc2, &self.ls2, hidden)
    }
}

/// `gamma (x W^T + b)`, with the factor in the weights: they are smaller than the activations.
fn scaled(linear: &Linear, gamma: &Parameter, x: Tensor<2>) -> Tensor<2> {
    let gamma: Tensor<1> = gamma.tensor();
    let weight: Tensor<2> = linear.weight.tensor::<2>() * gamma.clone().unsqueeze_dim(1);
    let bias = linear.bias.as_ref().map(|bias| bias.tensor::<1>() * gamma);
    ops::linear(x, weight, bias)
}

impl Encoder {
    /// An encoder of these sizes, which were checked.
    #[must_use]
    pub fn new(init: &Initialise<'_>, settings: &NetworkSettings) -> Self {
        let width = settings.width;
        let pixels = 3 * settings.patch * settings.patch;
        let cells = settings.grid * settings.grid;
        let patches = init.at("patch_embed.proj");
        Self {
            cls_token: init.normal("cls_token", &[1, 1, width], 0.02),
            pos_embed: init.normal("pos_embed", &[1, 1 + cells, width], 0.02),
            patch_embed: PatchEmbedding {
                weight: patches.uniform(
                    "weight",
                    &[width, 3, settings.patch, settings.patch],
                    (3.0 / pixels as f64).sqrt(),
                ),
                bias: patches.constant(&[width], 0.0),
            },
            blocks: (0..settings.blocks)
                .map(|index| Block::new(&init.at("blocks").item(index), settings))
                .collect(),
            norm: LayerNorm::new(&init.at("norm"), width, true),
            settings: settings.clone(),
        }
    }

    /// The position table of a picture of `cells` (rows, columns): `[1 + rows * columns, D]`.
    #[must_use]
    pub fn positions(&self, cells: [usize; 2]) -> Tensor<2> {
        let (grid, width) = (self.settings.grid, self.settings.width);
        let table = self.pos_embed.reshaped([1 + grid * grid, width]);
        if cells == [grid, grid] {
            return table;
        }
        let device = table.device();
        let resampled = resample_positions(&self.pos_embed.to_vec(), grid, width, cells);
        let rows = resampled.len() / width;
        Tensor::from_data(TensorData::new(resampled, [rows, width]), &device)
    }

    /// Pixels of patches `[frames * cells, 3 * patch^2]` to `[frames * cells, D]`.
    #[must_use]
    pub fn embed(&self, patches: Tensor<2>) -> Tensor<2> {
        let weight = &self.patch_embed.weight;
        let outputs = weight.shape()[0];
        let matrix = weight.reshaped([outputs, weight.len() / outputs]);
        ops::linear(patches, matrix, Some(self.patch_embed.bias.tensor()))
    }

    /// Puts the class token in front of the embedded patches of each frame and adds the positions: `[N, D]`.
    #[must_use]
    pub fn tokens(&self, patches: Tensor<2>, frames: usize, positions: &Tensor<2>) -> Tensor<2> {
        let [rows, width] = patches.dims();
        let cells = rows / frames;
        let class = self.cls_token.tensor::<3>().expand([frames, 1, width]);
        let all = Tensor::cat(vec![class, patches.reshape([frames, cells, width])], 1);
        (all + positions.clone().unsqueeze()).reshape([frames * (1 + cells), width])
    }

    /// The block `index` on tokens `[N, D]` of `frames` frames.
    #[must_use]
    pub fn block(&self, index: usize, x_ND: Tensor<2>, frames: usize) -> Tensor<2> {
        let segments = Segments::batch(frames, x_ND.dims()[0] / frames);
        self.blocks[index].forward(x_ND, self.settings.heads, &segments)
    }

    /// The output of a tap block as the head sees it: the final norm, without the class tokens, `[frames * cells, D]`.
    #[must_use]
    pub fn feature(&self, x_ND: Tensor<2>, frames: usize) -> Tensor<2> {
        let [rows, width] = x_ND.dims();
        let tokens = rows / frames;
        self.norm
            .forward(x_ND)
            .reshape([frames, tokens, width])
            .narrow(1, 1, tokens - 1)
            .reshape([frames * (tokens - 1), width])
    }

    /// Patches `[frames * cells, 3 * patch^2]` to the features of the four taps, each `[frames * cells, D]`.
    #[must_use]
    pub fn forward(
        &self,
        patches: Tensor<2>,
        frames: usize,
        positions: &Tensor<2>,
    ) -> Vec<Tensor<2>> {
        let mut x_ND = self.tokens(self.embed(patches), frames, positions);
        let mut features = Vec::with_capacity(self.settings.taps.len());
        for index in 0..=self.settings.taps[3] {
            x_ND = self.block(index, x_ND, frames);
            if self.settings.taps.contains(&index) {
                features.push(self.feature(x_ND.clone(), frames));
            }
        }
        features
    }
}

/// The row-major table `[1 + grid^2, width]` for `cells` rows and columns: bicubic (a = -0.75, half-pixel centres, edges
/// repeated, nothing smoothed), the class token's row unchanged. The step is `grid / (cells + 0.1)`, as in training.
///
/// # Panics
/// When the table does not have these sizes.
#[must_use]
pub fn resample_positions(table: &[f32], grid: usize, width: usize, cells: [usize; 2]) -> Vec<f32> {
    assert_eq!(table.len(), (1 + grid * grid) * width);
    let (class, map) = table.split_at(width);
    let axis = |count: usize| {
        let step = grid as f64 / (count as f64 + POSITION_OFFSET);
        (0..count)
            .map(|i| cubic_taps((i as f64 + 0.5) * step - 0.5, grid))
            .collect::<Vec<_>>()
    };
    let (rows, columns) = (axis(cells[0]), axis(cells[1]));
    let mut resampled = class.to_vec();
    resampled.reserve(cells[0] * cells[1] * width);
    let mut sums = vec![0.0_f64; width];
    for row in &rows {
        for column in &columns {
            sums.fill(0.0);
            for (y, weight_y) in row {
                for (x, weight_x) in column {
                    let values = &map[(y * grid + x) * width..][..width];
                    for (sum, value) in sums.iter_mut().zip(values) {
                        *sum += f64::from(*value) * weight_y * weight_x;
                    }
                }
            }
            resampled.extend(sums.iter().map(|sum| *sum as f32));
        }
    }
    resampled
}

/// The four neighbours of `place` on an axis of `length` elements with their cubic weights (a = -0.75); edges are repeated.
#[must_use]
pub fn cubic_taps(place: f64, length: usize) -> [(usize, f64); 4] {
    const A: f64 = -0.75;
    let whole = place.floor();
    let t = place - whole;
    let near = |x: f64| ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0;
    let far = |x: f64| ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A;
    let weights = [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)];
    std::array::from_fn(|i| {
        let at = (whole + i as f64 - 1.0).clamp(0.0, (length - 1) as f64);
        (at as usize, weights[i])
    })
}
