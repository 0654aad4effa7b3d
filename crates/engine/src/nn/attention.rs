//! Self- and cross-attention with packed projections, over segments of packed tokens.

use burn::tensor::Tensor;

use super::layers::Linear;
use crate::engine::{Initialise, Segments, ops, parameters};

/// Tokens attend to the tokens of their own segment.
#[derive(Debug, Clone)]
pub struct SelfAttention {
    /// `[3 D, D]`, rows `[3][heads][D / heads]`.
    pub qkv: Linear,
    /// `[D, D]`, on the heads' outputs side by side.
    pub proj: Linear,
    heads: usize,
}
parameters!(SelfAttention { qkv, proj });

impl SelfAttention {
    /// Tokens of `width` values; `heads` must divide it. `bias` is for both layers.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, heads: usize, bias: bool) -> Self {
        Self {
            qkv: Linear::packed(&init.at("qkv"), width, 3 * width, 3, bias),
            proj: Linear::new(&init.at("proj"), width, width, bias),
            heads,
        }
    }

    /// `[N, D]` to `[N, D]`.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>, segments: &Segments) -> Tensor<2> {
        let mixed = ops::self_attention(self.qkv.forward(x), self.heads, segments);
        self.proj.forward(mixed)
    }
}

/// Query tokens attend to the context tokens of their own segment.
#[derive(Debug, Clone)]
pub struct CrossAttention {
    /// `[D, D]`, rows `[heads][D / heads]`.
    pub q: Linear,
    /// `[2 D, D]`, rows `[2][heads][D / heads]`.
    pub kv: Linear,
    /// `[D, D]`, on the heads' outputs side by side.
    pub proj: Linear,
    heads: usize,
}
parameters!(CrossAttention { q, kv, proj });

impl CrossAttention {
    /// Query and context tokens of `width` values; `heads` must divide it. `bias` is for all three layers.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, heads: usize, bias: bool) -> Self {
        Self {
            q: Linear::new(&init.at("q"), width, width, bias),
            kv: Linear::packed(&init.at("kv"), width, 2 * width, 2, bias),
            proj: Linear::new(&init.at("proj"), width, width, bias),
            heads,
        }
    }

    /// Queries `[N, D]`, context `[M, D]`, to `[N, D]`.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>, context: Tensor<2>, segments: &Segments) -> Tensor<2> {
        let (q, kv) = (self.q.forward(x), self.kv.forward(context));
        self.proj
            .forward(ops::cross_attention(q, kv, self.heads, segments))
    }
}
