//! Training that can be trusted (Supp. B).
//!
//! Read in this order: [`settings`], [`source`] (where tokens come from), [`order`] (which clip stands where), [`loader`]
//! (batches prepared ahead), [`trainer`] (**one step, and the state between steps**), [`validation`], [`optimizer`],
//! [`schedule`]; [`tokenizer`] trains VQ-VAEs, [`video_tokenizer`] video tokenizers, [`kmeans`] is what both have to beat.
//!
//! Data order, masks and initial weights are functions of the seed and the step, so a run that was killed and resumed has the
//! same bytes as one that was not.

pub mod kmeans;
pub mod loader;
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
pub mod video_tokenizer;

pub use loader::{BatchSource, Loader};
pub use optimizer::{AdamW, AdamWSettings};
pub use sampler::Sampler;
pub use schedule::Schedule;
pub use settings::{DatasetSize, Duration, TrainingSettings};
pub use shards::Shards;
pub use source::{DataError, InMemory, TokenSample, TokenSource};
pub use trainer::{Progress, StepReport, Trainer, TrainingError};
pub use validation::{Score, Unigram, Validation};
