//! The ops of the experiment language: one file per op, with its settings, its ports and what it runs.

mod clip_signals;
pub mod clips;
mod device;
mod evaluate;
mod import;
mod kinds;
pub mod label_depth;
mod modality_entry;
mod predict;
mod reconstruct;
mod statistics;
mod table;
mod together;
pub mod tokenize;
pub mod tokenizer_entry;
pub mod train_mget;
pub mod train_tokenizer;
mod train_tokenizers;

pub use reconstruct::ReconstructSettings;
pub use tokenizer_entry::TokenizerEntry;
