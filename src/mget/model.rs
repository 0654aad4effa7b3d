//! The Masked Generative Egocentric Transformer (Sec. 4.3, Supp. B).
//!
//! An encoder reads the visible tokens of all modalities; a decoder answers for asked positions, knowing only where they are
//! and what the encoder saw. Samples are packed without padding.
//!
//! Shape suffixes: `N` visible tokens of the batch, `M` asked tokens of the batch, `D` width, `V` vocabulary.

use super::batch::{Batch, Sequence, Visible};
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
    mask_token: Parameter,
    pub(super) encoder_embeddings: Embeddings,
    decoder_embeddings: Heads,
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
    /// Visible tokens of each sample.
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
        })
    }

    /// A model whose values will be loaded.
    ///
    /// # Errors
    /// When the spec cannot be built.
    pub fn to_load(spec: &MgetSpec, compute: &Compute) -> Result<Self, SpecError> {
        Self::new(spec, &Initialise::to_load(compute))
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

    /// The losses of the decoder's answers.
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
    pub fn encode(&self, visible: &Visible) -> Context {
        let lengths = visible.sequence.lengths.clone();
        if visible.sequence.is_empty() {
            return Context {
                tokens_ND: None,
                lengths,
                trace: None,
            };
        }
        let samples = Segments::within(&lengths);
        let place_ND = self.encoder_embeddings.place(&visible.sequence);
        let input_ND = self.seen(visible, place_ND.clone());
        let mut h_ND = input_ND.clone();
        for block in &self.encoder {
            h_ND = block.forward(h_ND, &samples);
        }
        let h_ND = self.encoder_norm.forward(h_ND);
        Context {
            tokens_ND: Some(self.context(h_ND.clone(), place_ND)),
            lengths,
            trace: Some([input_ND, h_ND]),
        }
    }

    /// What the encoder starts from, `[N, D]`: what a token says and where it stands. The place is used again in the context.
    pub(super) fn seen(&self, visible: &Visible, place_ND: Tensor<2>) -> Tensor<2> {
        self.encoder_embeddings.content(visible) + place_ND
    }

    /// What the decoder sees of the encoder's normalised output, `[N, D]`.
    pub(super) fn context(&self, h_ND: Tensor<2>, place_ND: Tensor<2>) -> Tensor<2> {
        self.decoder_proj_context.forward(h_ND) + place_ND
    }

    /// Answers for the asked positions: `[M, D]`; `None` when nothing is asked.
    #[must_use]
    pub fn decode(&self, context: &Context, asked: &Sequence) -> Option<Tensor<2>> {
        if asked.is_empty() {
            return None;
        }
        let (own_modality, visible) = decoder_segments(&context.lengths, asked);
        let mut y_MD = self.questions(asked);
        for block in &self.decoder {
            y_MD = block.forward(y_MD, context.tokens_ND.as_ref(), &own_modality, &visible);
        }
        Some(self.decoder_norm.forward(y_MD))
    }

    /// What the decoder starts from, `[M, D]`: where it is asked, and nothing else.
    pub(super) fn questions(&self, asked: &Sequence) -> Tensor<2> {
        let mask_token_1D: Tensor<2> = self.mask_token.reshaped([1, self.spec.size.width]);
        self.encoder_embeddings.place(asked) + mask_token_1D
    }

    /// The logits of the asked tokens of `modality`, in order: `[its rows, V]`; `None` when it has none.
    #[must_use]
    pub fn logits(&self, y_MD: &Tensor<2>, asked: &Sequence, modality: usize) -> Option<Tensor<2>> {
        self.decoder_embeddings.logits(y_MD, asked, modality)
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
    fn new(size: Size, place: &Initialise<'_>) -> Self {
        Self {
            norm1: norm(size, place, "norm1"),
            attn: SelfAttention::new(&place.at("attn"), size.width, size.heads, false),
            norm2: norm(size, place, "norm2"),
            mlp: SwiGlu::new(&place.at("mlp"), size.width, size.hidden()),
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
    fn new(size: Size, place: &Initialise<'_>) -> Self {
        let Size { width, heads, .. } = size;
        Self {
            norm1: norm(size, place, "norm1"),
            self_attn: SelfAttention::new(&place.at("self_attn"), width, heads, false),
            query_norm: norm(size, place, "query_norm"),
            context_norm: norm(size, place, "context_norm"),
            cross_attn: CrossAttention::new(&place.at("cross_attn"), width, heads, false),
            norm2: norm(size, place, "norm2"),
            mlp: SwiGlu::new(&place.at("mlp"), width, size.hidden()),
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

/// Who attends to whom: an asked token to those of its own modality in its own sample, and to all `visible` (rows per sample) of
/// the sample.
pub(super) fn decoder_segments(visible: &[usize], asked: &Sequence) -> (Segments, Segments) {
    (
        Segments::within(&asked.runs),
        Segments::across(&asked.lengths, visible),
    )
}

/// A layer norm without bias.
fn norm(size: Size, place: &Initialise<'_>, name: &str) -> LayerNorm {
    LayerNorm::new(&place.at(name), size.width, false)
}
