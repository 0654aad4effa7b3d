//! The Masked Generative Egocentric Transformer (Sec. 4.3, Supp. B).
//!
//! An encoder reads the visible tokens of all modalities; a decoder predicts the target positions, knowing only where they are
//! and what the encoder read. Samples are packed without padding.
//!
//! Shape suffixes: `N` visible tokens of the batch, `M` target tokens of the batch, `D` width, `V` vocabulary.

use super::batch::{Batch, EncoderInput, Sequence};
use super::embedding::{Embeddings, Heads};
use super::loss::{self, Loss, Losses};
use super::size::Size;
use super::spec::{MgetSpec, SpecError};
use crate::engine::{Compute, Initialise, Parameter, Segments, Tensor, parameters};
use crate::nn::{CrossAttention, LayerNorm, Linear, SelfAttention, SwiGlu};

/// The model.
#[derive(Debug, Clone)]
pub struct Mget {
    spec: MgetSpec,
    compute: Compute,
    mask_token: Parameter,
    pub(super) encoder_embeddings: Embeddings,
    pub(super) decoder_embeddings: Heads,
    pub(super) encoder: Vec<EncoderBlock>,
    pub(super) encoder_norm: LayerNorm,
    /// The only matrix with a bias.
    pub(super) decoder_proj_context: Linear,
    pub(super) decoder: Vec<DecoderBlock>,
    pub(super) decoder_norm: LayerNorm,
}
parameters!(Mget {
    mask_token,
    encoder_embeddings,
    decoder_embeddings,
    encoder,
    encoder_norm,
    decoder_proj_context,
    decoder,
    decoder_norm,
});

/// What the decoder sees of the encoder.
#[derive(Debug, Clone)]
pub struct Context {
    /// `[N, D]`; `None` when nothing is visible in the whole batch.
    tokens_ND: Option<Tensor<2>>,
    /// EncoderInput tokens of each sample.
    lengths: Vec<usize>,
    /// For parity checks: the encoder's input and normed output.
    trace: Option<[Tensor<2>; 2]>,
}

impl Context {
    /// The encoder's input, its normed output, and the context: each `[N, D]`.
    #[must_use]
    pub fn stages(&self) -> Option<[Tensor<2>; 3]> {
        let [input, output] = self.trace.clone()?;
        Some([input, output, self.tokens_ND.clone()?])
    }
}

impl Mget {
    /// A new model.
    ///
    /// # Errors
    /// When the spec cannot be built.
    pub fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Result<Self, SpecError> {
        spec.check()?;
        let size = spec.size;
        let (encoder, decoder) = (init.at("encoder"), init.at("decoder"));
        Ok(Self {
            mask_token: init.normal("mask_token", &[size.width], 0.02),
            encoder_embeddings: Embeddings::new(spec, &init.at("encoder_embeddings"))?,
            decoder_embeddings: Heads::new(spec, &init.at("decoder_embeddings")),
            encoder: (0..size.encoder_depth)
                .map(|block| EncoderBlock::new(size, &encoder.item(block)))
                .collect(),
            encoder_norm: norm(size, init, "encoder_norm"),
            decoder_proj_context: Linear::new(
                &init.at("decoder_proj_context"),
                size.width,
                size.width,
                true,
            ),
            decoder: (0..size.decoder_depth)
                .map(|block| DecoderBlock::new(size, &decoder.item(block)))
                .collect(),
            decoder_norm: norm(size, init, "decoder_norm"),
            spec: spec.clone(),
            compute: init.compute().clone(),
        })
    }

    /// A model whose values will be loaded.
    ///
    /// # Errors
    /// When the spec cannot be built.
    pub fn empty(spec: &MgetSpec, compute: &Compute) -> Result<Self, SpecError> {
        Self::new(spec, &Initialise::empty(compute))
    }

    /// Where the model computes.
    #[must_use]
    pub fn compute(&self) -> &Compute {
        &self.compute
    }

    /// What the model is made of.
    #[must_use]
    pub fn spec(&self) -> &MgetSpec {
        &self.spec
    }

    /// The losses of a batch.
    #[must_use]
    pub fn losses(&self, batch: &Batch, kind: Loss) -> Losses {
        let context = self.encode(&batch.visible);
        let y_MD = self.decode(&context, &batch.targets.sequence);
        self.losses_of(y_MD, batch, kind)
    }

    /// The losses of the decoder's output.
    pub(super) fn losses_of(&self, y_MD: Option<Tensor<2>>, batch: &Batch, kind: Loss) -> Losses {
        loss::losses(
            &self.spec,
            &self.decoder_embeddings,
            y_MD,
            &batch.targets,
            kind,
        )
    }

    /// Reads the visible tokens.
    #[must_use]
    pub fn encode(&self, visible: &EncoderInput) -> Context {
        let lengths = visible.sequence.lengths.clone();
        if visible.sequence.is_empty() {
            return Context {
                tokens_ND: None,
                lengths,
                trace: None,
            };
        }
        let samples = Segments::within(&lengths);
        let positional_ND = self
            .encoder_embeddings
            .positional_embedding(&visible.sequence);
        let input_ND = self.input_embedding(visible, positional_ND.clone());
        let mut h_ND = input_ND.clone();
        for block in &self.encoder {
            h_ND = block.forward(h_ND, &samples);
        }
        let h_ND = self.encoder_norm.forward(h_ND);
        Context {
            tokens_ND: Some(self.context(h_ND.clone(), positional_ND)),
            lengths,
            trace: Some([input_ND, h_ND]),
        }
    }

    /// What the encoder starts from, `[N, D]`: token plus positional embedding. The latter is used again in the context.
    pub(super) fn input_embedding(
        &self,
        visible: &EncoderInput,
        positional_ND: Tensor<2>,
    ) -> Tensor<2> {
        self.encoder_embeddings.token_embedding(visible) + positional_ND
    }

    /// What the decoder sees of the encoder's normalised output, `[N, D]`.
    pub(super) fn context(&self, h_ND: Tensor<2>, positional_ND: Tensor<2>) -> Tensor<2> {
        self.decoder_proj_context.forward(h_ND) + positional_ND
    }

    /// Decodes the target positions: `[M, D]`; `None` when there are none.
    #[must_use]
    pub fn decode(&self, context: &Context, targets: &Sequence) -> Option<Tensor<2>> {
        if targets.is_empty() {
            return None;
        }
        let (own_modality, visible) = decoder_segments(&context.lengths, targets);
        let mut y_MD = self.decoder_queries(targets);
        for block in &self.decoder {
            y_MD = block.forward(y_MD, context.tokens_ND.as_ref(), &own_modality, &visible);
        }
        Some(self.decoder_norm.forward(y_MD))
    }

    /// What the decoder starts from, `[M, D]`: the positions of the targets, and nothing else.
    pub(super) fn decoder_queries(&self, targets: &Sequence) -> Tensor<2> {
        let mask_token_1D: Tensor<2> = self.mask_token.reshaped([1, self.spec.size.width]);
        self.encoder_embeddings.positional_embedding(targets) + mask_token_1D
    }

    /// The logits of the target tokens of `modality`, in order: `[its rows, V]`; `None` when it has none.
    #[must_use]
    pub fn logits(
        &self,
        y_MD: &Tensor<2>,
        targets: &Sequence,
        modality: usize,
    ) -> Option<Tensor<2>> {
        self.decoder_embeddings.logits(y_MD, targets, modality)
    }
}

/// `h += Attention(norm1 h)`, then `h += SwiGlu(norm2 h)`.
#[derive(Debug, Clone)]
pub(super) struct EncoderBlock {
    norm1: LayerNorm,
    attn: SelfAttention,
    norm2: LayerNorm,
    mlp: SwiGlu,
}
parameters!(EncoderBlock {
    norm1,
    attn,
    norm2,
    mlp
});

impl EncoderBlock {
    fn new(size: Size, init: &Initialise<'_>) -> Self {
        Self {
            norm1: norm(size, init, "norm1"),
            attn: SelfAttention::new(&init.at("attn"), size.width, size.heads, false),
            norm2: norm(size, init, "norm2"),
            mlp: SwiGlu::new(&init.at("mlp"), size.width, size.hidden()),
        }
    }

    pub(super) fn forward(&self, h_ND: Tensor<2>, samples: &Segments) -> Tensor<2> {
        let h_ND = h_ND.clone() + self.attn.forward(self.norm1.forward(h_ND), samples);
        h_ND.clone() + self.mlp.forward(self.norm2.forward(h_ND))
    }
}

/// `y += Attention(norm1 y)` within modalities, `y += CrossAttention(query_norm y, context_norm context)`, then
/// `y += SwiGlu(norm2 y)`.
#[derive(Debug, Clone)]
pub(super) struct DecoderBlock {
    norm1: LayerNorm,
    self_attn: SelfAttention,
    query_norm: LayerNorm,
    context_norm: LayerNorm,
    cross_attn: CrossAttention,
    norm2: LayerNorm,
    mlp: SwiGlu,
}
parameters!(DecoderBlock {
    norm1,
    self_attn,
    query_norm,
    context_norm,
    cross_attn,
    norm2,
    mlp
});

impl DecoderBlock {
    fn new(size: Size, init: &Initialise<'_>) -> Self {
        let Size { width, heads, .. } = size;
        Self {
            norm1: norm(size, init, "norm1"),
            self_attn: SelfAttention::new(&init.at("self_attn"), width, heads, false),
            query_norm: norm(size, init, "query_norm"),
            context_norm: norm(size, init, "context_norm"),
            cross_attn: CrossAttention::new(&init.at("cross_attn"), width, heads, false),
            norm2: norm(size, init, "norm2"),
            mlp: SwiGlu::new(&init.at("mlp"), width, size.hidden()),
        }
    }

    pub(super) fn forward(
        &self,
        y_MD: Tensor<2>,
        context_ND: Option<&Tensor<2>>,
        own_modality: &Segments,
        visible: &Segments,
    ) -> Tensor<2> {
        let attended_MD = self
            .self_attn
            .forward(self.norm1.forward(y_MD.clone()), own_modality);
        let mut y_MD = y_MD + attended_MD;
        if let Some(context_ND) = context_ND {
            let q_MD = self.query_norm.forward(y_MD.clone());
            let c_ND = self.context_norm.forward(context_ND.clone());
            y_MD = y_MD + self.cross_attn.forward(q_MD, c_ND, visible);
        }
        y_MD.clone() + self.mlp.forward(self.norm2.forward(y_MD))
    }
}

/// Who attends to whom: a target token to those of its own modality in its own sample, and to all `visible` (rows per sample) of
/// the sample.
pub(super) fn decoder_segments(visible: &[usize], targets: &Sequence) -> (Segments, Segments) {
    (
        Segments::within(&targets.runs),
        Segments::across(&targets.lengths, visible),
    )
}

/// A layer norm without bias.
fn norm(size: Size, init: &Initialise<'_>, name: &str) -> LayerNorm {
    LayerNorm::new(&init.at(name), size.width, false)
}
