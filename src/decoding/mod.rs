//! Iterative parallel decoding (Supp. C): any tokens as inputs, any others as targets.
//!
//! Read in this order: [`settings`] (a registry entry), [`schedule`] (tokens and temperature per step), [`plan`] (which target
//! when, from what), [`model`] (what it needs of a model), [`filter`] (logits to a token), [`mod@generate`] (the
//! entry), `round` (**the loop**), [`mget`] (the model). [`crate::model`] puts it between tokenizers.

pub mod filter;
pub mod generate;
pub mod generated;
pub mod mget;
pub mod model;
pub mod plan;
mod round;
pub mod schedule;
pub mod settings;

pub use generate::{generate, generate_samples};
pub use generated::{Generated, GeneratedTokens};
pub use mget::MgetTokens;
pub use model::{DecodingError, Sample, Slot, TokenModality, TokenModel};
pub use settings::DecodingSettings;
