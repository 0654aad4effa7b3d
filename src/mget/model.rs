//! The Masked Generative Egocentric Transformer (Sec. 4.3, Supp. B; model.md 4.1, 4.2).
//!
//! An encoder reads the visible tokens of all modalities; a decoder answers for asked positions, knowing only where they are
//! and what the encoder saw. Samples are packed without padding.
//!
//! Shape suffixes: `N` visible tokens of the batch, `M` asked tokens of the batch, `D` width, `F` hidden width of the SwiGLU,
//! `V` vocabulary, `P` values of a tubelet.

use super::batch::{Batch, Sequence, Visible};
use super::embedding::{Embeddings, Heads};
use super::loss::{self, Loss, Losses};
use super::spec::{MgetSpec, SpecError};
use crate::engine::ops::{cross_attention, layer_norm, linear, self_attention, swiglu};
use crate::engine::{Compute, Initialise, Parameter, Segments, Tensor, parameters};

/// Under the root of the norms.
const EPSILON: f64 = 1e-6;

/// The model.
#[derive(Debug, Clone)]
pub struct Mget {
    spec: MgetSpec,
    mask_token: Parameter,
    encoder_embeddings: Embeddings,
    decoder_embeddings: Heads,
    encoder: Vec<EncoderBlock>,
    encoder_norm: Norm,
    decoder_proj_context: Projection,
    decoder: Vec<DecoderBlock>,
    decoder_norm: Norm,
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
    context_ND: Option<Tensor<2>>,
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
        Some([input, output, self.context_ND.clone()?])
    }
}

impl Mget {
    /// A new model.
    ///
    /// # Errors
    /// When the spec cannot be built.
    pub fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Result<Self, SpecError> {
        spec.check()?;
        let width = spec.size.width;
        let encoder = init.at("encoder");
        let decoder = init.at("decoder");
        Ok(Self {
            mask_token: init.normal("mask_token", &[width], 0.02),
            encoder_embeddings: Embeddings::new(spec, &init.at("encoder_embeddings"))?,
            decoder_embeddings: Heads::new(spec, &init.at("decoder_embeddings")),
            encoder: (0..spec.size.encoder_depth)
                .map(|block| EncoderBlock::new(spec, &encoder.item(block)))
                .collect(),
            encoder_norm: Norm::new(width, init),
            decoder_proj_context: Projection::new(width, &init.at("decoder_proj_context")),
            decoder: (0..spec.size.decoder_depth)
                .map(|block| DecoderBlock::new(spec, &decoder.item(block)))
                .collect(),
            decoder_norm: Norm::new(width, init),
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
                context_ND: None,
                lengths,
                trace: None,
            };
        }
        let samples = Segments::within(&lengths);
        let heads = self.spec.size.heads;

        // What a token says, and where it stands; the second is used twice.
        let x_ND = self.encoder_embeddings.content(visible);
        let place_ND = self.encoder_embeddings.place(&visible.sequence);

        let input_ND = x_ND + place_ND.clone();
        let mut h_ND = input_ND.clone();
        for block in &self.encoder {
            h_ND = block.forward(h_ND, heads, &samples);
        }
        let h_ND = self.encoder_norm.forward(h_ND);

        let context_ND = self.decoder_proj_context.forward(h_ND.clone()) + place_ND;
        Context {
            context_ND: Some(context_ND),
            lengths,
            trace: Some([input_ND, h_ND]),
        }
    }

    /// Answers for the asked positions: `[M, D]`; `None` when nothing is asked.
    #[must_use]
    pub fn decode(&self, context: &Context, asked: &Sequence) -> Option<Tensor<2>> {
        if asked.is_empty() {
            return None;
        }
        // A token attends to the tokens of its own modality in its own sample, and to all of the sample's visible tokens.
        let own_modality = Segments::within(&asked.runs);
        let visible = Segments::across(&asked.lengths, &context.lengths);
        let heads = self.spec.size.heads;

        let mask_token_1D: Tensor<2> = self.mask_token.reshaped([1, self.spec.size.width]);
        let mut y_MD = self.encoder_embeddings.place(asked) + mask_token_1D;
        for block in &self.decoder {
            y_MD = block.forward(
                y_MD,
                context.context_ND.as_ref(),
                heads,
                &own_modality,
                &visible,
            );
        }
        Some(self.decoder_norm.forward(y_MD))
    }

    /// The logits of the asked tokens of `modality`, in order: `[its rows, V]`; `None` when it has none.
    #[must_use]
    pub fn logits(&self, y_MD: &Tensor<2>, asked: &Sequence, modality: usize) -> Option<Tensor<2>> {
        self.decoder_embeddings.logits(y_MD, asked, modality)
    }
}

#[derive(Debug, Clone)]
struct EncoderBlock {
    norm1: Norm,
    attn: Attention,
    norm2: Norm,
    mlp: SwiGlu,
}
parameters!(EncoderBlock {
    norm1,
    attn,
    norm2,
    mlp
});

impl EncoderBlock {
    fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Self {
        let width = spec.size.width;
        Self {
            norm1: Norm::new(width, init),
            attn: Attention::new(width, &init.at("attn")),
            norm2: Norm::new(width, init),
            mlp: SwiGlu::new(spec, &init.at("mlp")),
        }
    }

    fn forward(&self, x_ND: Tensor<2>, heads: usize, samples: &Segments) -> Tensor<2> {
        let x_ND = x_ND.clone() + self.attn.forward(self.norm1.forward(x_ND), heads, samples);
        x_ND.clone() + self.mlp.forward(self.norm2.forward(x_ND))
    }
}

#[derive(Debug, Clone)]
struct DecoderBlock {
    norm1: Norm,
    self_attn: Attention,
    query_norm: Norm,
    context_norm: Norm,
    cross_attn: CrossAttention,
    norm2: Norm,
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
    fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Self {
        let width = spec.size.width;
        Self {
            norm1: Norm::new(width, init),
            self_attn: Attention::new(width, &init.at("self_attn")),
            query_norm: Norm::new(width, init),
            context_norm: Norm::new(width, init),
            cross_attn: CrossAttention::new(width, &init.at("cross_attn")),
            norm2: Norm::new(width, init),
            mlp: SwiGlu::new(spec, &init.at("mlp")),
        }
    }

    fn forward(
        &self,
        y_MD: Tensor<2>,
        context_ND: Option<&Tensor<2>>,
        heads: usize,
        own_modality: &Segments,
        visible: &Segments,
    ) -> Tensor<2> {
        let mut y_MD = y_MD.clone()
            + self
                .self_attn
                .forward(self.norm1.forward(y_MD), heads, own_modality);
        if let Some(context_ND) = context_ND {
            let q_MD = self.query_norm.forward(y_MD.clone());
            let c_ND = self.context_norm.forward(context_ND.clone());
            y_MD = y_MD + self.cross_attn.forward(q_MD, c_ND, heads, visible);
        }
        y_MD.clone() + self.mlp.forward(self.norm2.forward(y_MD))
    }
}

/// A layer norm without bias.
#[derive(Debug, Clone)]
struct Norm {
    weight: Parameter,
}
parameters!(Norm { weight });

impl Norm {
    fn new(width: usize, init: &Initialise<'_>) -> Self {
        Self {
            weight: init.constant(&[width], 1.0),
        }
    }

    fn forward(&self, x_ND: Tensor<2>) -> Tensor<2> {
        layer_norm(x_ND, self.weight.flat(), None, EPSILON)
    }
}

/// A matrix without bias, `[out, in]`.
#[derive(Debug, Clone)]
struct Matrix {
    weight: Parameter,
}
parameters!(Matrix { weight });

impl Matrix {
    fn new(out: usize, input: usize, init: &Initialise<'_>) -> Self {
        Self::stacked(1, out, input, init)
    }

    /// `parts` matrices stored as one, each initialised on its own.
    fn stacked(parts: usize, out: usize, input: usize, init: &Initialise<'_>) -> Self {
        Self {
            weight: init.xavier("weight", &[parts * out, input], input, out),
        }
    }

    fn forward(&self, x_ND: Tensor<2>) -> Tensor<2> {
        linear(x_ND, self.weight.tensor(), None)
    }
}

/// The encoder's output on its way to the decoder: the only matrix with a bias.
#[derive(Debug, Clone)]
struct Projection {
    weight: Parameter,
    bias: Parameter,
}
parameters!(Projection { weight, bias });

impl Projection {
    fn new(width: usize, init: &Initialise<'_>) -> Self {
        Self {
            weight: init.xavier("weight", &[width, width], width, width),
            bias: init.constant(&[width], 0.0),
        }
    }

    fn forward(&self, h_ND: Tensor<2>) -> Tensor<2> {
        linear(h_ND, self.weight.tensor(), Some(self.bias.flat()))
    }
}

#[derive(Debug, Clone)]
struct Attention {
    qkv: Matrix,
    proj: Matrix,
}
parameters!(Attention { qkv, proj });

impl Attention {
    fn new(width: usize, init: &Initialise<'_>) -> Self {
        Self {
            qkv: Matrix::stacked(3, width, width, &init.at("qkv")),
            proj: Matrix::new(width, width, &init.at("proj")),
        }
    }

    fn forward(&self, x_ND: Tensor<2>, heads: usize, segments: &Segments) -> Tensor<2> {
        let qkv_N3D = self.qkv.forward(x_ND);
        self.proj.forward(self_attention(qkv_N3D, heads, segments))
    }
}

#[derive(Debug, Clone)]
struct CrossAttention {
    q: Matrix,
    kv: Matrix,
    proj: Matrix,
}
parameters!(CrossAttention { q, kv, proj });

impl CrossAttention {
    fn new(width: usize, init: &Initialise<'_>) -> Self {
        Self {
            q: Matrix::new(width, width, &init.at("q")),
            kv: Matrix::stacked(2, width, width, &init.at("kv")),
            proj: Matrix::new(width, width, &init.at("proj")),
        }
    }

    fn forward(
        &self,
        y_MD: Tensor<2>,
        c_ND: Tensor<2>,
        heads: usize,
        segments: &Segments,
    ) -> Tensor<2> {
        let q_MD = self.q.forward(y_MD);
        let kv_N2D = self.kv.forward(c_ND);
        self.proj
            .forward(cross_attention(q_MD, kv_N2D, heads, segments))
    }
}

/// `fc2(silu(fc1 x) * fc3 x)`.
#[derive(Debug, Clone)]
struct SwiGlu {
    fc1: Matrix,
    fc2: Matrix,
    fc3: Matrix,
}
parameters!(SwiGlu { fc1, fc2, fc3 });

impl SwiGlu {
    fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Self {
        let (width, hidden) = (spec.size.width, spec.size.hidden());
        Self {
            fc1: Matrix::new(hidden, width, &init.at("fc1")),
            fc2: Matrix::new(width, hidden, &init.at("fc2")),
            fc3: Matrix::new(hidden, width, &init.at("fc3")),
        }
    }

    fn forward(&self, x_ND: Tensor<2>) -> Tensor<2> {
        let gate_NF = self.fc1.forward(x_ND.clone());
        let value_NF = self.fc3.forward(x_ND);
        self.fc2.forward(swiglu(gate_NF, value_NF))
    }
}
