//! Training that can be trusted: step, schedule, optimizer, checkpoints (Supp. B).

pub mod optimizer;
pub mod schedule;
pub mod tokenizer;

pub use optimizer::{AdamW, AdamWSettings};
pub use schedule::Schedule;
