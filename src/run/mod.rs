//! Runs: from a checked graph of stages to artifacts and a complete, resumable record.
//!
//! Read in this order:
//! * [`record`] the run directory and its state; [`cache`] where artifacts live; [`lock`] who may write; [`files`] how anything
//!   is written; [`error`] what can go wrong
//! * [`checkpoint`] what a stage keeps to go on from; [`metrics`] and [`tensorboard`] what a stage records; [`progress`] what a person sees meanwhile; [`interrupt`] Ctrl-C
//! * [`schedule`] what there is to do; [`stage`] one piece of it, and `context` what its op sees; [`worker_pool`] several at once; [`stage::peers`] several processes at one; [`execute`] all of it
//! * [`inputs`] what lies outside; [`provenance`] where everything came from; [`report`] the run's page
//! * [`verify`] whether it still holds; [`gc`] what can go
//! * [`environment`] the only place that looks at machine, git and clock

pub mod cache;
pub mod checkpoint;
mod context;
mod curves;
pub mod environment;
pub mod error;
pub mod execute;
pub mod files;
pub mod gc;
pub mod inputs;
pub mod interrupt;
mod job;
pub mod lock;
pub mod markdown;
pub mod metrics;
pub mod progress;
pub mod provenance;
pub mod record;
pub mod report;
pub mod schedule;
pub mod stage;
mod stamps;
pub mod tensorboard;
pub mod verify;
pub mod worker_pool;

pub use cache::{Cache, Key, Manifest};
pub use error::RunError;
pub use interrupt::Interrupt;
pub use progress::Progress;
pub use record::{RunDirectory, Shard, State};
pub use stage::peers::Peers;
pub use worker_pool::WorkerPool;
