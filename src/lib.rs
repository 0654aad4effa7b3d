//! `reviv` reconstructs the viewer and the view in 4D from one head-mounted video: body, both hands, gaze, camera
//! trajectory and depth, by masked generative modelling over discrete tokens of all modalities.
//!
//! The rooms, from the door down (`ARCHITECTURE.md` is the map; arrows point down only, and a test holds them to it):
//!
//! * the door: [`cli`]
//! * where experiments meet science: [`ops`]
//! * the framework, which knows no model: [`experiment`], [`run`]
//! * the science, which knows no YAML, no run directory and no terminal: [`training`], [`decoding`], [`reconstruction`],
//!   [`evaluation`], [`view`], [`import`]; below them [`tokenizer`], [`mget`], [`masking`],
//!   [`labelling`]; below them [`modality`],
//!   [`clip`], [`datasets`], [`world`], [`video`]; and at the bottom [`nn`], [`engine`], [`geometry`], [`formats`], [`random`]
#![recursion_limit = "256"]
// Transforms are named `T_to_from`, tensors carry shape suffixes (`x_BND`): the field's own notation.
#![allow(non_snake_case)]

pub mod cli;
pub mod ops;

pub mod experiment;
pub mod run;

pub mod decoding;
pub mod evaluation;
pub mod import;
pub mod reconstruction;
pub mod training;
pub mod view;

pub mod labelling;
pub mod masking;
pub mod mget;
pub mod tokenizer;

pub mod clip;
pub mod datasets;
pub mod modality;
pub mod video;
pub mod world;

pub mod engine;
pub mod formats;
pub mod geometry;
pub mod nn;
pub mod random;
