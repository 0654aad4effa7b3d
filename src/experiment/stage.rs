//! The [`Op`] trait: what a stage of an experiment can do. One file per op in `ops/`.
//!
//! An op never parses YAML. It gets its settings typed, its edges resolved and type-checked, and the descriptions of what
//! arrives on them. It is asked three times: [`Op::check`] (no compute, reports every problem and describes its output),
//! [`Op::plan`] (no compute, no allocation: shapes, parameters, tokens, memory, FLOP) and [`Op::run`].

use super::artifact::{ArtifactKind, Description};
use super::context::{StageContext, StageError};
use super::problem::Problem;
use super::settings::Settings;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::path::PathBuf;

/// How many stages a port takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arity {
    /// Exactly one: `clips: clips`.
    One,
    /// One or none.
    Optional,
    /// A list of at least one: `tokens: [tokens_adt, tokens_taco]`.
    Many,
    /// One, a group or a list of at least one: `clips: nymeria`, `tokenizers: tokenizers` or `clips: [nymeria, egoexo]`.
    OneOrMore,
    /// A list that may be empty or absent.
    Any,
}

/// An input of an op: the YAML key that names the stage(s) it reads.
#[derive(Debug, Clone, Copy)]
pub struct Port {
    /// The key beside the settings; must not be a settings key.
    pub name: &'static str,
    /// The artifact kinds it accepts.
    pub kinds: &'static [ArtifactKind],
    /// How many stages may be connected to it.
    pub arity: Arity,
    /// One line for the schema and `reviv list`.
    pub about: &'static str,
}

/// What arrives at one edge of a port, before any compute.
#[derive(Debug, Clone)]
pub struct InputFacts<'a> {
    /// The stage at the other end.
    pub stage: &'a str,
    /// The type of the artifact that arrives.
    pub kind: ArtifactKind,
    /// What the artifact will be.
    pub description: &'a Description,
}

/// The descriptions of everything that arrives, by port. An op is only checked and planned when all of them are known.
#[derive(Debug, Clone, Default)]
pub struct Inputs<'a> {
    ports: Vec<(&'static str, Vec<InputFacts<'a>>)>,
}

impl<'a> Inputs<'a> {
    /// From what arrives at each port.
    pub fn new(ports: Vec<(&'static str, Vec<InputFacts<'a>>)>) -> Self {
        Self { ports }
    }

    /// All inputs of a port, in the order of the YAML.
    pub fn all(&self, port: &str) -> &[InputFacts<'a>] {
        self.ports
            .iter()
            .find(|(name, _)| *name == port)
            .map_or(&[], |(_, inputs)| inputs.as_slice())
    }

    /// The description at a port of arity one or optional.
    pub fn one(&self, port: &str) -> Option<&'a Description> {
        self.all(port).first().map(|facts| facts.description)
    }
}

/// A file outside the experiment that a stage reads; it must exist, and its bytes are part of the stage's identity.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileInput {
    /// The settings key that names it, for the diagnostic.
    pub key: String,
    /// The file, or a folder of files; a relative path has been resolved.
    pub path: PathBuf,
}

/// A data set that a stage reads; the bytes of its files are part of the stage's identity, where it lies is not.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataInput {
    /// Its name in `data.yaml`.
    pub name: String,
    /// The settings key that names it, for the diagnostic.
    pub key: String,
    /// The folder; `None` where an experiment is only checked and planned, and the data is elsewhere.
    pub path: Option<PathBuf>,
}

/// What a stage will be, without making it. Everything is optional; what is not known stays out.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct StagePlan {
    /// Named shapes: `("encoder input", [2048, 768])`.
    pub shapes: Vec<(String, Vec<usize>)>,
    /// Exact number of trainable parameters.
    pub parameters: Option<u64>,
    /// Where they are: `("trunk", 198829056)`.
    pub parameter_parts: Vec<(String, u64)>,
    /// Tokens per clip, and how many different ones there are.
    pub tokens: Vec<TokenPlan>,
    /// Steps, clips or whatever the stage counts, with its name.
    pub work: Option<(u64, String)>,
    /// Peak memory in bytes.
    pub memory: Option<u64>,
    /// Bytes the artifact will take on disk.
    pub disk: Option<u64>,
    /// Floating point operations of the whole stage.
    pub flop: Option<f64>,
    /// Seconds, where a throughput has been measured on this machine.
    pub seconds: Option<f64>,
    /// Seconds of one processor core for work on data, by what was measured on one machine: an order of magnitude.
    pub core_seconds: Option<f64>,
    /// Of a training: nominal tokens of one step, over all devices.
    pub tokens_per_step: Option<f64>,
    /// Anything worth a line.
    pub lines: Vec<String>,
}

/// One modality's tokens in a plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TokenPlan {
    /// The modality that the tokens stand for.
    pub modality: String,
    /// Tokens per clip.
    pub tokens: u64,
    /// How many different tokens there are.
    pub vocabulary: u64,
    /// Mean number of tokens that masking shows to the encoder, by seeded simulation.
    pub mean_input: Option<f64>,
    /// Mean number of tokens that masking asks for, by seeded simulation.
    pub mean_target: Option<f64>,
}

/// What a stage of an experiment does. `ops/` has one file per op, each a unit struct:
///
/// ```ignore
/// pub struct Clips;
/// impl Op for Clips { type Settings = ClipsSettings; ... }
/// inventory::submit! { OpEntry(&Clips) }
/// ```
pub trait Op: Send + Sync + 'static {
    /// The settings beside `op:` and the ports: `#[serde(deny_unknown_fields, default)]`, doc comments on every field
    /// (they are what `reviv list` and the editor show), `#[schemars(range(min = 1))]` for bounds.
    /// [`super::entry::Entry<T>`] is a registry reference, [`super::path::FilePath`] a file.
    type Settings: Serialize + DeserializeOwned + JsonSchema + Send + Sync + 'static;

    /// The name after `op:`.
    fn name(&self) -> &'static str;

    /// Part of the identity of what it makes: raise it when the same settings give other bytes.
    fn version(&self) -> u32;

    /// One line for `reviv list ops`.
    fn about(&self) -> &'static str;

    /// The edges it takes.
    fn inputs(&self) -> &'static [Port];

    /// What it makes.
    fn output(&self) -> ArtifactKind;

    /// Whether what it makes depends on the seed. Ops without randomness say no and are shared between seeds.
    fn seeded(&self) -> bool {
        true
    }

    /// Whether the processes of a job do it together: its `run` is called on every rank with the same folders. Every file has one
    /// writer, and what rank 0 returns and has written is the artifact.
    fn together(&self) -> bool {
        false
    }

    /// Files outside the experiment that it reads.
    fn files(&self, _settings: &Self::Settings) -> Vec<FileInput> {
        Vec::new()
    }

    /// Data sets (names of `data.yaml`) that it reads, with the settings key that asks for each.
    fn data(&self, _settings: &Self::Settings) -> Vec<(String, String)> {
        Vec::new()
    }

    /// Data sets that it reads where they are there and does without where they are not.
    fn optional_data(&self, _settings: &Self::Settings) -> Vec<(String, String)> {
        Vec::new()
    }

    /// Reports everything wrong that types and ranges do not catch, and describes the output. No compute, no files.
    fn check(
        &self,
        settings: &Self::Settings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description;

    /// What the stage will be: called only when `check` found no error. No compute beyond a seeded simulation of
    /// milliseconds, no allocation of a model. `seed` is for such a simulation: the same for every stage, not the stage's own.
    fn plan(&self, _settings: &Self::Settings, _inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        StagePlan::default()
    }

    /// What a panic of the op with this text means, where it is no bug of it: a library that panics where a device's memory is full.
    fn explain_panic(&self, _text: &str) -> Option<StageError> {
        None
    }

    /// Does it. Writes files below `context.output()` and returns the `contents` of the artifact's `manifest.json`, which
    /// later stages find in [`super::context::InputArtifact::contents`].
    fn run(
        &self,
        settings: &Self::Settings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError>;
}

/// An [`Op`] with its settings type erased: what the graph holds. Implemented for every [`Op`].
pub trait AnyOp: Send + Sync + 'static {
    /// [`Op::name`]: what follows `op:`.
    fn name(&self) -> &'static str;
    /// [`Op::version`]: part of the identity of what it makes.
    fn version(&self) -> u32;
    /// [`Op::about`]: one line for `reviv list ops`.
    fn about(&self) -> &'static str;
    /// [`Op::inputs`]: the edges it takes.
    fn inputs(&self) -> &'static [Port];
    /// [`Op::output`]: what it makes.
    fn output(&self) -> ArtifactKind;
    /// [`Op::seeded`]: whether what it makes depends on the seed.
    fn seeded(&self) -> bool;
    /// [`Op::together`]: whether all ranks of a job run it together.
    fn together(&self) -> bool;
    /// The schema of the settings, without `op` and the ports.
    fn schema(&self, generator: &mut SchemaGenerator) -> Schema;
    /// Settings with every default filled in, typed for this op.
    ///
    /// # Errors
    /// When they do not fit the settings struct.
    fn parse(&self, settings: Value) -> Result<Settings, serde_json::Error>;
    /// [`Op::files`]; none where the settings do not fit.
    fn files(&self, settings: &Settings) -> Vec<FileInput>;
    /// [`Op::data`]: names of data sets, each with the settings key that asks for it; none where the settings do not fit.
    fn data(&self, settings: &Settings) -> Vec<(String, String)>;
    /// [`Op::optional_data`], as [`AnyOp::data`] gives it; none where the settings do not fit.
    fn optional_data(&self, settings: &Settings) -> Vec<(String, String)>;
    /// [`Op::check`]; `None`, and nothing reported, where the settings do not fit.
    fn check(
        &self,
        settings: &Settings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Option<Description>;
    /// [`Op::plan`]; empty where the settings do not fit.
    fn plan(&self, settings: &Settings, inputs: &Inputs<'_>, seed: u64) -> StagePlan;
    /// [`Op::explain_panic`].
    fn explain_panic(&self, text: &str) -> Option<StageError>;
    /// [`Op::run`]; fails before any work where the settings do not fit.
    fn run(&self, settings: &Settings, context: &mut dyn StageContext)
    -> Result<Value, StageError>;
}

impl<O: Op> AnyOp for O {
    fn name(&self) -> &'static str {
        Op::name(self)
    }
    fn version(&self) -> u32 {
        Op::version(self)
    }
    fn about(&self) -> &'static str {
        Op::about(self)
    }
    fn inputs(&self) -> &'static [Port] {
        Op::inputs(self)
    }
    fn output(&self) -> ArtifactKind {
        Op::output(self)
    }
    fn seeded(&self) -> bool {
        Op::seeded(self)
    }
    fn together(&self) -> bool {
        Op::together(self)
    }
    fn schema(&self, generator: &mut SchemaGenerator) -> Schema {
        generator.subschema_for::<O::Settings>()
    }
    fn parse(&self, settings: Value) -> Result<Settings, serde_json::Error> {
        Settings::parse::<O::Settings>(settings)
    }
    fn files(&self, settings: &Settings) -> Vec<FileInput> {
        settings
            .with(|own: &O::Settings| Op::files(self, own))
            .unwrap_or_default()
    }
    fn data(&self, settings: &Settings) -> Vec<(String, String)> {
        settings
            .with(|own: &O::Settings| Op::data(self, own))
            .unwrap_or_default()
    }
    fn optional_data(&self, settings: &Settings) -> Vec<(String, String)> {
        let data = settings.with(|own: &O::Settings| Op::optional_data(self, own));
        data.unwrap_or_default()
    }
    fn check(
        &self,
        settings: &Settings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Option<Description> {
        settings
            .with(|own: &O::Settings| Op::check(self, own, inputs, problems))
            .ok()
    }
    fn plan(&self, settings: &Settings, inputs: &Inputs<'_>, seed: u64) -> StagePlan {
        let plan = settings.with(|own: &O::Settings| Op::plan(self, own, inputs, seed));
        plan.unwrap_or_default()
    }
    fn explain_panic(&self, text: &str) -> Option<StageError> {
        Op::explain_panic(self, text)
    }
    fn run(
        &self,
        settings: &Settings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let made = settings.with(|own: &O::Settings| Op::run(self, own, context));
        made.map_err(StageError::other)?
    }
}

/// An op that is linked in: `inventory::submit! { OpEntry(&Clips) }`. Plug-in crates do the same.
#[derive(Clone, Copy)]
pub struct OpEntry(pub &'static dyn AnyOp);

inventory::collect!(OpEntry);

/// A name after `op:` that stands for several stages of one op: `inventory::submit! { GroupEntry { ... } }`.
///
/// What stands beside the map holds for all of them; what stands in an entry of the map is a layer over it.
pub struct GroupEntry {
    /// The name after `op:`.
    pub name: &'static str,
    /// One line for `reviv list ops`.
    pub about: &'static str,
    /// What each of the stages does.
    pub op: &'static dyn AnyOp,
    /// The key of the map with an entry for each stage.
    pub members: &'static str,
    /// The setting of the op that the key of an entry is the value of.
    pub setting: &'static str,
}

inventory::collect!(GroupEntry);
