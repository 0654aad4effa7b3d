//! Masking: which tokens of a sample are given, and which are asked for (Sec. 4.3, Supp. B, Alg. 1).
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
    /// Whether it may be given.
    pub input: bool,
    /// Whether it may be asked for.
    pub target: bool,
}

impl Slot {
    /// A modality that may be given and asked for.
    #[must_use]
    pub fn both(name: &str, tokens: usize) -> Self {
        Self {
            name: name.to_owned(),
            tokens,
            input: true,
            target: true,
        }
    }

    /// A modality that is only ever given, such as raw video.
    #[must_use]
    pub fn input_only(name: &str, tokens: usize) -> Self {
        Self {
            target: false,
            ..Self::both(name, tokens)
        }
    }
}

/// The masks of one sample: per slot the positions that are given and those that are asked for, each ascending, disjoint.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Mask {
    /// `[slots][given positions]`.
    pub input: Vec<Vec<u32>>,
    /// `[slots][asked positions]`.
    pub target: Vec<Vec<u32>>,
}

impl Mask {
    /// How many positions are given.
    #[must_use]
    pub fn input_tokens(&self) -> usize {
        self.input.iter().map(Vec::len).sum()
    }

    /// How many positions are asked for.
    #[must_use]
    pub fn target_tokens(&self) -> usize {
        self.target.iter().map(Vec::len).sum()
    }
}
