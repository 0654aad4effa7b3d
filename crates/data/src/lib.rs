//! Recordings and clips: the floor that knows no tensor, no model and no experiment.
//!
//! * what a clip is and which signals it carries: [`clip`], [`modality`]
//! * where clips come from: [`datasets`], [`video`], the synthetic [`world`]
//! * below them: [`formats`], [`geometry`], [`random`], [`flow`]
//!
//! A crate of its own, so that an edit above it compiles nothing of it again. `reviv` re-exports every room under its own name.
// Transforms are named `T_to_from`, tensors carry shape suffixes (`x_BND`): the field's own notation.
#![allow(non_snake_case)]
#![warn(missing_docs)]

pub mod clip;
pub mod datasets;
pub mod flow;
pub mod formats;
pub mod geometry;
pub mod modality;
pub mod random;
pub mod video;
pub mod world;
