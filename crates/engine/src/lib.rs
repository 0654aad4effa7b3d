//! The engine: tensors on a device, the fused operations that training and generation spend their time in, and layers made of them.
//!
//! A crate of its own, so that an edit above it compiles nothing of it again. `reviv` re-exports both rooms under their own names.
#![recursion_limit = "256"]
// Tensors carry shape suffixes (`x_BND`): the field's own notation.
#![allow(non_snake_case)]
#![warn(missing_docs)]

pub mod engine;
pub mod nn;

use reviv_data::{formats, random};
