//! Masking: which tokens of a sample are inputs, and which are targets (Sec. 4.3, Supp. B, Alg. 1).
//!
//! Read in this order: [`settings`] (a registry entry), [`dirichlet`] (proportions in log space), [`budget`] (proportions to
//! token counts), [`policy`] (the draw for one sample), [`statistics`] (what a policy does on average, for `reviv plan`).

pub mod budget;
pub mod dirichlet;
pub mod policy;
pub mod settings;
pub mod statistics;

pub use policy::Masking;
pub use settings::{Alphas, MaskingError, MaskingSettings, Overflow, Policy, TokenBudget};
pub use statistics::{Statistics, simulate};

/// The name under which raw video takes part in masking: an input like any other, never a target.
pub const PIXELS: &str = "pixels";

/// A modality as masking sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Slot {
    /// The modality's name, or [`PIXELS`].
    pub name: String,
    /// How many tokens a sample has of it.
    pub tokens: usize,
    /// Whether it may be an input.
    pub input: bool,
    /// Whether it may be a target.
    pub target: bool,
}

impl Slot {
    /// A modality that may be input and target.
    #[must_use]
    pub fn both(name: &str, tokens: usize) -> Self {
        Self {
            name: name.to_owned(),
            tokens,
            input: true,
            target: true,
        }
    }

    /// A modality that is only ever an input, such as raw video.
    #[must_use]
    pub fn input_only(name: &str, tokens: usize) -> Self {
        Self {
            target: false,
            ..Self::both(name, tokens)
        }
    }
}

/// The masks of one sample: per slot the input positions and the target positions, each ascending, disjoint.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Mask {
    /// `[slots][input positions]`.
    pub input: Vec<Vec<u32>>,
    /// `[slots][target positions]`.
    pub target: Vec<Vec<u32>>,
}

impl Mask {
    /// How many positions are inputs.
    #[must_use]
    pub fn input_tokens(&self) -> usize {
        self.input.iter().map(Vec::len).sum()
    }

    /// How many positions are targets.
    #[must_use]
    pub fn target_tokens(&self) -> usize {
        self.target.iter().map(Vec::len).sum()
    }
}
