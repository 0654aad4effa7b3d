//! Metrics, statistics and tables (Sec. 5).
//!
//! Read in this order: [`outcome`] (what a metric can say), the metrics [`joints`], [`trajectory`], [`gaze`], [`depth`],
//! [`motion`], [`tmr`] (the encoder of motions), [`tokens`], [`runtime`]; then [`metric`] (what a modality brings: [`sets`] are the
//! built-in ones), [`evaluate`] (every clip of a [`suite`] into [`scores`]), [`statistics`], and [`compare`]
//! (many scores into one [`table`], a `side` per row, which [`render`] prints and
//! [`intervals`] draws; `verdict` says what beats the trivial baselines, [`mod@conclusion`] what a
//! comparison shows). [`tum`] compares trajectory files.
//!
//! Arithmetic is f64; inputs are metres and seconds; angles are reported in degrees.

#![allow(
    clippy::needless_pass_by_value,
    reason = "array views are passed by value, as ndarray does"
)]

pub mod columns;
pub mod compare;
pub mod conclusion;
pub mod depth;
pub mod evaluate;
pub mod folders;
pub mod gaze;
pub mod intervals;
pub mod joints;
pub mod metric;
pub mod motion;
pub mod outcome;
pub mod published;
pub mod render;
mod row_scores;
pub mod runtime;
pub mod sample;
pub mod samples;
pub mod scores;
pub mod sets;
pub mod statistics;
pub mod suite;
pub mod table;
pub mod tmr;
pub mod tokens;
pub mod trajectory;
pub mod tum;
mod verdict;

pub use outcome::{MetricError, Outcome};
