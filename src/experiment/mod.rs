//! The experiment language: YAML layers become a typed, checked, planned graph of stages.
//!
//! # Writing an op
//! One file in `ops/`: a settings struct, a unit struct that implements [`Op`], and `inventory::submit! { OpEntry(&It) }`.
//! The language does the rest: it parses, merges layers, resolves registry references and paths, fills defaults, checks
//! keys, types and ranges against the schema of the settings, resolves the edges and checks their artifact kinds.
//! An op that stands for several stages of another one is a [`GroupEntry`].

pub mod artifact;
pub mod catalog;
pub mod clashes;
mod compare;
mod compose;
pub mod context;
pub mod data;
pub mod diagnostic;
pub mod docs;
pub mod entry;
mod external_inputs;
pub mod files;
pub mod graph;
mod group;
mod interpolate;
pub mod load;
pub mod merge;
mod names;
pub mod path;
pub mod plan;
pub mod problem;
pub mod registry;
mod resolve;
pub mod resolved;
pub mod scaling;
pub mod schema;
mod settings;
pub mod source;
pub mod stage;
mod sweep;
pub mod typed;
pub mod why;
pub mod yaml;

pub use artifact::{ArtifactKind, Description, SignalFacts, TokenFacts};
pub use context::{InputArtifact, StageContext, StageError};
pub use entry::{Entry, Kind, KindEntry, LinkedEntry};
pub use graph::{ArtifactKey, Cell, Compare, Edge, Experiment, Graph, Group, Interval, Stage};
pub use names::{nearest, suggest};
pub use path::FilePath;
pub use problem::{Code, Problem};
pub use settings::Settings;
pub use stage::{
    AnyOp, Arity, DataInput, FileInput, GroupEntry, InputFacts, Inputs, Op, OpEntry, Port,
    StagePlan, TokenPlan,
};
