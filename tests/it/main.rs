//! One integration test binary, a file per command or promise.
#![allow(clippy::unwrap_used)] // a test that panics is a test that fails

mod metrics;
mod parity;
mod shared;
mod trajectories;

mod language;
mod language_ops;
mod vq_structure;
