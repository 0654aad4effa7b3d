//! The ops of the experiment language: one file per op, with its settings, its ports and what it runs.

pub mod clips;
mod clip_signals;
mod evaluate;
mod kinds;
mod table;
pub mod tokenizer_entry;
pub mod train_mget;
pub mod train_tokenizer;

pub use tokenizer_entry::TokenizerEntry;
