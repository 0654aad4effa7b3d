//! Metrics, statistics and tables (Sec. 5).
//!
//! Read in this order: [`outcome`] (what a metric can say), the metrics [`joints`], [`trajectory`], [`gaze`], [`depth`],
//! [`motion`], [`tokens`], [`runtime`].
//!
//! Arithmetic is f64; inputs are metres and seconds; angles are reported in degrees.

#![allow(
    clippy::needless_pass_by_value,
    reason = "array views are passed by value, as ndarray does"
)]

pub mod columns;
pub mod depth;
pub mod gaze;
pub mod joints;
pub mod motion;
pub mod outcome;
pub mod runtime;
pub mod sample;
pub mod scores;
pub mod statistics;
pub mod tokens;
pub mod trajectory;
pub mod tum;

pub use outcome::{Outcome, Refusal};
