//! The typed graph that an experiment becomes: stages with complete settings, edges, and what identifies them.

use super::artifact::Description;
pub use super::compare::{Compare, Interval, Resample};
use super::settings::Settings;
use super::source::Sources;
use super::stage::{AnyOp, DataInput, FileInput, InputFacts, Inputs, StagePlan};
use super::typed::Trace;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// The seed of the simulations that plans make. Averages over draws belong to the settings: stages with the same settings
/// get the same numbers, whatever they are trained with and whichever is planned first.
const PLAN_SEED: u64 = 0;

/// An experiment or a sweep, checked. A plain experiment has one cell.
#[derive(Clone)]
pub struct Experiment {
    /// From `experiment:` or `sweep:`.
    pub name: String,
    /// What it is for, from `about:`; empty where the file does not say.
    pub about: String,
    /// The file that was asked for.
    pub path: PathBuf,
    /// One per arm, grid point and seed, in the order of the file.
    pub cells: Vec<Cell>,
    /// True when the file is a sweep (even of one cell).
    pub sweep: bool,
    /// How the cells of a sweep are compared.
    pub compare: Option<Compare>,
    /// Where data sets lie: name to directory, from `data.yaml` and `REVIV_DATA_*`.
    pub data: BTreeMap<String, PathBuf>,
    /// Every text that took part, for byte copies in the record: files, registry entries, `--set`.
    pub sources: Sources,
}

/// One arm with one seed.
#[derive(Clone)]
pub struct Cell {
    /// The arm's name; empty for a plain experiment. A grid point is `arm-key=value-key=value`.
    pub arm: String,
    /// The seed of its stages, but for those that set their own.
    pub seed: u64,
    /// Its stages and how they are connected.
    pub graph: Graph,
}

impl Cell {
    /// A name for people and file names: `full-s0`, or `s0` where there is neither arm nor grid.
    pub fn label(&self) -> String {
        if self.arm.is_empty() {
            format!("s{}", self.seed)
        } else {
            format!("{}-s{}", self.arm, self.seed)
        }
    }
}

/// The stages of one cell in topological order: inputs come before what reads them.
#[derive(Clone, Default)]
pub struct Graph {
    /// A stage's edges refer to others by their index in this list.
    pub stages: Vec<Stage>,
    /// Names that stand for several of them.
    pub groups: Vec<Group>,
    /// The keys beside the stages, for `reviv why`: `experiment`, `about`, `seed`, `params.x`.
    pub head: Vec<Head>,
}

/// A name that stands for several stages, which one entry of the file makes (see [`super::GroupEntry`]).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// The key in `stages:`.
    pub name: String,
    /// The key of the map with an entry for each stage: `modalities`.
    pub key: &'static str,
    /// The names of its stages, in the order of the map: `tokenizers.rgb`.
    pub members: Vec<String>,
}

/// A value of the experiment itself.
#[derive(Debug, Clone)]
pub struct Head {
    /// Dotted key path.
    pub key: String,
    /// As text on one line.
    pub value: String,
    /// Where it was written, and what it replaced.
    pub trace: Trace,
}

/// A stage: an op with complete settings and resolved edges.
#[derive(Clone)]
pub struct Stage {
    /// The key in `stages:`, or `group.member`; a stage of another experiment keeps its `file/stage` name.
    pub name: String,
    /// Where its settings are written: `stages.mget`, `stages.tokenizers.modalities.rgb`.
    pub path: String,
    /// What it does.
    pub op: &'static dyn AnyOp,
    /// Every setting, defaults filled in, registry references resolved, paths resolved.
    pub settings: Settings,
    /// The seed; ops that are not seeded ignore it.
    pub seed: u64,
    /// One per connected port, in the order of the op's ports.
    pub edges: Vec<Edge>,
    /// Files outside the experiment that it reads.
    pub files: Vec<FileInput>,
    /// Data sets that it reads.
    pub data: Vec<DataInput>,
    /// What its artifact will be.
    pub description: Description,
    /// Where each value was written, and what it replaced: key path relative to the stage (`tokenizer.codebook`) to
    /// place. Values that are defaults have none.
    pub traces: BTreeMap<String, Trace>,
}

/// What is connected to a port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Edge {
    /// The op's key for this input: `clips`, `tokenizers`.
    pub port: &'static str,
    /// Indices into [`Graph::stages`].
    pub from: Vec<usize>,
}

impl Graph {
    /// The stage of a name.
    pub fn find(&self, name: &str) -> Option<&Stage> {
        self.stages.iter().find(|stage| stage.name == name)
    }

    /// The descriptions that arrive at a stage.
    pub fn inputs(&self, stage: &Stage) -> Inputs<'_> {
        Inputs::new(
            stage
                .edges
                .iter()
                .map(|edge| {
                    let facts = edge
                        .from
                        .iter()
                        .map(|&index| {
                            let from = &self.stages[index];
                            InputFacts {
                                stage: &from.name,
                                kind: from.op.output(),
                                description: &from.description,
                            }
                        })
                        .collect();
                    (edge.port, facts)
                })
                .collect(),
        )
    }

    /// What a stage will be; no compute, no allocation. It depends on the settings and on what arrives, not on the seed.
    pub fn plan(&self, stage: &Stage) -> StagePlan {
        stage
            .op
            .plan(&stage.settings, &self.inputs(stage), PLAN_SEED)
    }

    /// The artifact key of every stage, in order.
    ///
    /// A key is the blake3 hash of (op, version, settings, seed where the op is seeded, hashes of files and data sets, input
    /// keys). Names of stages, of files and of the experiment are not part of it: the same work is done once. Where a data
    /// set is not on this machine, keys only say what stages share.
    ///
    /// # Errors
    /// When `hash_file` cannot read a file or a folder.
    pub fn keys(
        &self,
        hash_file: &mut dyn FnMut(&Path) -> std::io::Result<blake3::Hash>,
    ) -> std::io::Result<Vec<ArtifactKey>> {
        let mut keys: Vec<ArtifactKey> = Vec::with_capacity(self.stages.len());
        for stage in &self.stages {
            let mut settings = stage.settings.json().clone();
            let mut hasher = blake3::Hasher::new();
            let mut part = |bytes: &[u8]| {
                hasher.update(&(bytes.len() as u64).to_le_bytes());
                hasher.update(bytes);
            };
            part(b"reviv artifact 1");
            part(stage.op.name().as_bytes());
            part(&stage.op.version().to_le_bytes());
            if stage.op.seeded() {
                part(&stage.seed.to_le_bytes());
            } else {
                part(&[]);
            }
            for file in &stage.files {
                part(file.key.as_bytes());
                part(hash_file(&file.path)?.as_bytes());
                if let Some(value) = at_mut(&mut settings, &file.key) {
                    *value = Value::Null;
                }
            }
            for data in &stage.data {
                part(b"data");
                part(data.key.as_bytes());
                match &data.path {
                    Some(path) => part(hash_file(path)?.as_bytes()),
                    None => part(&[]),
                }
            }
            part(canonical(&settings).as_bytes());
            for edge in &stage.edges {
                part(edge.port.as_bytes());
                for &index in &edge.from {
                    part(keys[index].0.as_bytes());
                }
            }
            keys.push(ArtifactKey(hasher.finalize()));
        }
        Ok(keys)
    }
}

/// The content address of an artifact: `cache/ab/abcdef...`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ArtifactKey(pub blake3::Hash);

impl fmt::Display for ArtifactKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.to_hex().as_str())
    }
}

/// JSON with sorted keys: the same value, the same text.
fn canonical(value: &Value) -> String {
    fn sorted(value: &Value) -> Value {
        match value {
            Value::Object(map) => {
                let ordered: BTreeMap<&String, &Value> = map.iter().collect();
                Value::Object(
                    ordered
                        .into_iter()
                        .map(|(key, value)| (key.clone(), sorted(value)))
                        .collect(),
                )
            }
            Value::Array(items) => Value::Array(items.iter().map(sorted).collect()),
            other => other.clone(),
        }
    }
    sorted(value).to_string()
}

/// The value at a dotted key path.
fn at_mut<'a>(value: &'a mut Value, path: &str) -> Option<&'a mut Value> {
    let mut value = value;
    for key in path.split('.') {
        value = match value {
            Value::Object(map) => map.get_mut(key)?,
            Value::Array(items) => items.get_mut(key.parse::<usize>().ok()?)?,
            _ => return None,
        };
    }
    Some(value)
}
