//! One integration test binary, a file per command or promise.

mod metrics;
mod parity;
mod shared;
mod trajectories;

mod language;
mod language_ops;
mod vq_structure;
