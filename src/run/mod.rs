//! Runs: from a checked graph of stages to artifacts and a complete, resumable record.
//!
//! Read in this order:
//! * [`record`] the run directory and its state; [`cache`] where artifacts live; [`lock`] who may write; [`files`] how anything
//!   is written; [`error`] what can go wrong
//! * [`checkpoint`] what a stage keeps to go on from; [`metrics`] and [`tensorboard`] what a stage records; [`progress`] what a person sees meanwhile; [`interrupt`] Ctrl-C
//! * [`environment`] the only place that looks at machine, git and clock

pub mod cache;
pub mod checkpoint;
pub mod environment;
pub mod error;
pub mod files;
pub mod interrupt;
pub mod lock;
pub mod metrics;
pub mod progress;
pub mod record;
pub mod tensorboard;

pub use cache::{Cache, Key, Manifest};
pub use error::RunError;
pub use interrupt::Interrupt;
pub use progress::Progress;
pub use record::{RunDirectory, Shard, State};
