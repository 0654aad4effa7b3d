//! Training that can be trusted (Supp. B).
//!
//! Read in this order: [`settings`], [`source`] (where tokens come from), [`sampler`] (which clip stands where), [`loader`]
//! (batches prepared ahead), [`trainer`] (**one step, and the state between steps**), [`mod@fit`] (the loop), [`validation`],
//! [`optimizer`], [`schedule`]. Trained are [`mget`] and [`tokenizer`]s; [`kmeans`] is what the latter have to beat.
//!
//! Data order, masks and initial weights are functions of the seed and the step, so a run that was killed and resumed has the
//! same bytes as one that was not.

pub mod fit;
pub mod kmeans;
pub mod loader;
pub mod mget;
pub mod optimizer;
pub mod sampler;
pub mod schedule;
pub mod settings;
pub mod shards;
pub mod source;
pub mod tokenizer;
pub mod trainer;
pub mod validation;
pub mod video_kmeans;

pub use fit::{Event, Fitted, Flow, Intervals, fit};
pub use loader::{BatchSource, Loader};
pub use mget::MaskedPrediction;
pub use optimizer::{AdamW, AdamWSettings};
pub use sampler::Sampler;
pub use schedule::Schedule;
pub use settings::{DatasetSize, Duration, Keep, TrainingSettings};
pub use shards::Shards;
pub use source::{DataError, InMemory, TokenSample, TokenSource};
pub use trainer::{HeldOut, Objective, Progress, StepReport, Trainer, TrainingError};
pub use validation::{Score, Unigram, Validation};
