//! The pre-norm transformer block of the tokenizers (Supp. A): attention and a GELU MLP, all with biases.

use burn::tensor::Tensor;

use super::{LayerNorm, Mlp, SelfAttention};
use crate::engine::{Initialise, Segments, parameters};

/// `h += Attention(norm1 h)`, then `h += Mlp(norm2 h)`.
#[derive(Debug, Clone)]
pub struct Block {
    norm1: LayerNorm,
    norm2: LayerNorm,
    attn: SelfAttention,
    mlp: Mlp,
}
parameters!(Block {
    norm1,
    attn,
    norm2,
    mlp
});

impl Block {
    /// `hidden` is the width inside the MLP.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, heads: usize, hidden: usize) -> Self {
        Self {
            norm1: LayerNorm::new(&init.at("norm1"), width, true),
            norm2: LayerNorm::new(&init.at("norm2"), width, true),
            attn: SelfAttention::new(&init.at("attn"), width, heads, true),
            mlp: Mlp::new(&init.at("mlp"), width, hidden, true),
        }
    }

    /// `[N, D]` to `[N, D]`.
    #[must_use]
    pub fn forward(&self, h_ND: Tensor<2>, segments: &Segments) -> Tensor<2> {
        let h_ND = h_ND.clone() + self.attn.forward(self.norm1.forward(h_ND), segments);
        h_ND.clone() + self.mlp.forward(self.norm2.forward(h_ND))
    }
}
