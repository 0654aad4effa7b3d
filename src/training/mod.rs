//! Training that can be trusted (Supp. B).
//!
//! Read in this order: [`settings`], [`source`] (where tokens come from), [`sampler`] (which clip stands where), [`loader`]
//! (batches prepared ahead), [`trainer`] (**one step, and the state between steps**), [`trainer::ranks`] (a step on several
//! processes), [`trainer::checkpoint`], [`mod@fit`] (the loop), [`validation`], [`optimizer`], [`schedule`]. Trained are [`mget`] and [`tokenizer`]s;
//! [`kmeans`] is what the latter have to beat. [`mget_fit`] and [`tokenizer_fit`] are the way from clips to a model; a
//! tokenizer learns from a [`mixture`], in [`epochs`].
//!
//! Data order, masks and initial weights are functions of the seed and the step, so a run that was killed and resumed has the
//! same bytes as one that was not.

pub mod epochs;
pub mod fit;
pub mod kmeans;
pub mod loader;
pub mod memory;
pub mod mget;
pub mod mget_fit;
pub mod mixture;
pub mod muon;
pub mod optimizer;
pub mod sampler;
pub mod schedule;
pub mod settings;
pub mod shards;
pub mod signals;
pub mod source;
pub mod token_folder;
pub mod tokenizer;
mod tokenizer_errors;
pub mod tokenizer_fit;
pub mod tokenizer_scores;
pub mod trainer;
pub mod validation;
pub mod video_kmeans;

pub use crate::flow::Flow;
pub use fit::{Callback, Event, Intervals, fit};
pub use loader::{BatchSource, Loader};
pub use mget::MaskedPrediction;
pub use mget_fit::{FittedMget, MgetFit, TrainOptions};
pub use mixture::Mixture;
pub use optimizer::{AdamW, AdamWSettings};
pub use sampler::Sampler;
pub use schedule::Schedule;
pub use settings::{DatasetSize, Duration, Keep, TrainingSettings};
pub use shards::TokenShards;
pub use source::{DataError, InMemory, TokenSample, TokenSource};
pub use tokenizer_fit::{FittedTokenizer, TokenizerFit, TokenizerOptions};
pub use trainer::checkpoint::{Checkpoint, Snapshot};
pub use trainer::ranks::Ranks;
pub use trainer::{HeldOut, Objective, Progress, StepReport, Trainer, TrainingError};
pub use validation::{Score, Unigram, Validation};
