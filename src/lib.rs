//! `reviv` reconstructs the viewer and the view in 4D from one head-mounted video: body, both hands, gaze, camera
//! trajectory and depth, by masked generative modelling over discrete tokens of all modalities.
//!
//! # From a video to arrays in memory
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use reviv::{Compute, Joint, Model, ReconstructOptions, Video};
//!
//! let model = Model::open("models/reviv_500b", &Compute::cpu())?;
//! let result = reviv::reconstruct(&Video::open("walk.mp4")?, &model, &ReconstructOptions::default())?;
//! println!("{:?}", result.body().position(Joint::LeftWrist, 1.5)?); // metres, z up
//! result.write("out/")?; // the folder and the page
//! # Ok(())
//! # }
//! ```
//!
//! # From clips to a model
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use reviv::{Flow, Model, Tokenizers, TokenizerOptions, TrainOptions, World};
//!
//! let clips = World::small().clips(0..800);
//! let tokenizers = Tokenizers::fit(&clips, &TokenizerOptions::small())?;
//! let model = Model::train(&tokenizers, &clips, &TrainOptions::default(), |_| Flow::Continue)?;
//! model.write("models/mine")?;
//!
//! let scores = reviv::evaluate(&model, &World::small().clips(900..932), &Default::default(), |_, _| Flow::Continue)?;
//! println!("{}", reviv::evaluation::render::render(&reviv::table("held out", &[scores])?, Default::default()));
//! # Ok(())
//! # }
//! ```
//!
//! `examples/{reconstruct,train,evaluate}.rs` are these as programs.
//!
//! # The rooms
//!
//! From the door down (`ARCHITECTURE.md` is the map; arrows point down only, and a test holds them to it):
//!
//! * the door: [`cli`]
//! * where experiments meet science: [`ops`]
//! * the framework, which knows no model: [`experiment`], [`run`]
//! * the science, which knows no YAML, no run directory and no terminal: [`training`], [`model`], [`decoding`], [`reconstruction`],
//!   [`evaluation`], [`view`], [`import`]; below them [`tokenizer`], [`mget`], [`masking`], [`labelling`]; below them [`modality`],
//!   [`clip`], [`datasets`], [`world`], [`video`]; and at the bottom [`nn`], [`engine`], [`geometry`], [`formats`], [`random`]
#![recursion_limit = "256"]
// Transforms are named `T_to_from`, tensors carry shape suffixes (`x_BND`): the field's own notation.
#![allow(non_snake_case)]
#![warn(missing_docs)]

pub mod cli;
pub mod ops;

pub mod experiment;
pub mod run;

pub mod decoding;
pub mod evaluation;
pub mod import;
pub mod model;
pub mod reconstruction;
pub mod training;
pub mod view;

pub mod labelling;
pub mod masking;
pub mod mget;
pub mod tokenizer;

pub use reviv_data::{clip, datasets, flow, formats, geometry, modality, random, video, world};
pub use reviv_engine::{engine, nn, parameters};

pub use clip::source::ClipSource;
pub use engine::Compute;
pub use flow::Flow;
pub use geometry::skeleton::{HandJoint, Joint};
pub use mget::Size;
pub use model::{EvaluateOptions, Model, Tokenizers, evaluate, table};
pub use reconstruction::{ReconstructOptions, Reconstruction, reconstruct};
pub use training::{TokenizerOptions, TrainOptions};
pub use video::Video;
pub use world::World;
