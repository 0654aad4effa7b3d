//! Linear, layer norm and the two feed-forward layers.

use burn::tensor::Tensor;

use crate::engine::{Initialise, Parameter, Precision, ops, parameters};

/// Layer norms add this to the variance.
pub const EPSILON: f64 = 1e-6;

/// `x W^T + b`.
#[derive(Debug, Clone)]
pub struct Linear {
    /// `[out, in]`.
    pub weight: Parameter,
    /// `[out]`.
    pub bias: Option<Parameter>,
    precision: Precision,
}
parameters!(Linear { weight, bias });

impl Linear {
    /// Xavier-uniform weight; the bias, if any, is 0.
    #[must_use]
    pub fn new(init: &Initialise<'_>, inputs: usize, outputs: usize, bias: bool) -> Self {
        Self::packed(init, inputs, outputs, 1, bias)
    }

    /// `parts` linear layers of `outputs / parts` outputs each, stored as one (qkv, kv): initialised as if separate.
    #[must_use]
    pub fn packed(
        init: &Initialise<'_>,
        inputs: usize,
        outputs: usize,
        parts: usize,
        bias: bool,
    ) -> Self {
        Self {
            weight: init.xavier("weight", &[outputs, inputs], inputs, outputs / parts),
            bias: bias.then(|| init.constant(&[outputs], 0.0)),
            precision: init.compute().precision(),
        }
    }

    /// `[N, in]` to `[N, out]`.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        ops::linear_in(
            self.precision,
            x,
            self.weight.tensor(),
            self.bias.as_ref().map(Parameter::tensor),
        )
    }
}

/// Layer norm with a weight and, in the tokenizers, a bias.
#[derive(Debug, Clone)]
pub struct LayerNorm {
    /// `[D]`.
    pub weight: Parameter,
    /// `[D]`; `None` in layers without a bias.
    pub bias: Option<Parameter>,
}
parameters!(LayerNorm { weight, bias });

impl LayerNorm {
    /// Weight 1, bias 0.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, bias: bool) -> Self {
        Self {
            weight: init.constant(&[width], 1.0),
            bias: bias.then(|| init.constant(&[width], 0.0)),
        }
    }

    /// `[N, D]` to `[N, D]`.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        ops::layer_norm(
            x,
            self.weight.tensor(),
            self.bias.as_ref().map(Parameter::tensor),
            EPSILON,
        )
    }
}

/// `fc2(gelu(fc1 x))`, or with tanh instead of GELU.
#[derive(Debug, Clone)]
pub struct Mlp {
    /// `[hidden, D]`.
    pub fc1: Linear,
    /// `[D, hidden]`.
    pub fc2: Linear,
}
parameters!(Mlp { fc1, fc2 });

impl Mlp {
    /// From `width` to `hidden` values and back; `bias` is for both layers.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, hidden: usize, bias: bool) -> Self {
        Self {
            fc1: Linear::new(&init.at("fc1"), width, hidden, bias),
            fc2: Linear::new(&init.at("fc2"), hidden, width, bias),
        }
    }

    /// With GELU.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self.fc2.forward(ops::gelu(self.fc1.forward(x)))
    }

    /// With tanh.
    #[must_use]
    pub fn forward_tanh(&self, x: Tensor<2>) -> Tensor<2> {
        self.fc2.forward(ops::tanh(self.fc1.forward(x)))
    }
}

/// `fc2(silu(fc1 x) * fc3 x)`, without biases.
#[derive(Debug, Clone)]
pub struct SwiGlu {
    /// The gate, `[hidden, D]`.
    pub fc1: Linear,
    /// What is gated, `[hidden, D]`.
    pub fc3: Linear,
    /// Back to the tokens, `[D, hidden]`.
    pub fc2: Linear,
}
parameters!(SwiGlu { fc1, fc3, fc2 });

impl SwiGlu {
    /// From `width` to `hidden` values, gated, and back.
    #[must_use]
    pub fn new(init: &Initialise<'_>, width: usize, hidden: usize) -> Self {
        Self {
            fc1: Linear::new(&init.at("fc1"), width, hidden, false),
            fc3: Linear::new(&init.at("fc3"), width, hidden, false),
            fc2: Linear::new(&init.at("fc2"), hidden, width, false),
        }
    }

    /// `[N, D]` to `[N, D]`.
    #[must_use]
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let gate = self.fc1.forward(x.clone());
        let value = self.fc3.forward(x);
        self.fc2.forward(ops::swiglu(gate, value))
    }
}
