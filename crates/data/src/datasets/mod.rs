//! Where clips come from: recordings and data sets (Sec. 3, Table 1).
//!
//! Everything is a [`ClipSource`]: a named list of clips that are made when they are asked for, by index, from any thread. Read in
//! this order:
//!
//! * [`recording`]: how a recording is cut into clips, once for all data sets; [`track`]: signals with clocks of their own
//! * [`aria`]: recordings of Project Aria glasses; [`umetrack`] and [`mano`]: hands from joint angles and from the
//!   parameters of a model
//! * one file per data set: [`adt`], [`hot3d`], [`hot3d_clips`], [`nymeria`], [`ego_exo4d`], [`holoassist`], [`arctic`], [`taco`],
//!   [`h2o`], [`egogen`]; [`mps`] (any Aria recording), [`neutral`] (the folder format that any data set can be written as),
//!   [`egom2p`] (the ancestors' layout)
//! * [`dataset`] (many recordings), [`open`] (whatever a path holds), [`split`] (for training, for the test),
//!   [`convert`] into [`shards`], which are a source again, [`verify`] (whether they are whole), [`survey`] (a look at what is
//!   there), [`status`] (how much there is)
//!
//! A further data set is one file that fills a [`recording::Recording`], and one line in [`kind::Dataset`].

pub mod adt;
pub mod arctic;
pub mod aria;
pub mod coded;
pub mod convert;
pub mod csv;
pub mod cut;
pub mod dataset;
mod declared;
pub mod ego_exo4d;
pub mod egogen;
pub mod egom2p;
mod files;
pub mod h2o;
pub mod holoassist;
pub mod hot3d;
pub mod hot3d_clips;
pub mod kind;
pub mod mano;
pub mod mps;
pub mod neutral;
pub mod nymeria;
pub mod open;
mod pipeline;
pub mod recording;
pub mod shards;
pub mod split;
pub mod status;
pub mod survey;
pub mod taco;
pub mod track;
pub mod umetrack;
pub mod verify;
mod video_frames;

pub use crate::clip::source::{ClipSource, Clips, DropReason, Excluded, Outcome, clips};
pub use crate::formats::ReadError;
