//! Layers shared by the tokenizers and MGET, on packed tokens `[tokens, width]`.
//!
//! * [`layers`]: linear, layer norm, MLP, SwiGLU;
//! * [`attention`]: self- and cross-attention with packed projections;
//! * [`block`]: the pre-norm transformer block of the tokenizers;
//! * [`positions`]: fixed sine-cosine tables.

pub mod attention;
pub mod block;
pub mod layers;
pub mod positions;

pub use attention::{CrossAttention, SelfAttention};
pub use block::Block;
pub use layers::{LayerNorm, Linear, Mlp, SwiGlu};
