//! What there is to do: every distinct piece of work of an experiment or a sweep, once, in an order in which inputs come first.
//!
//! Arms and seeds that agree on a stage share it, because they agree on its key. `plan.json` is a [`Schedule`]: it is enough
//! to do any of the work again without the YAML that asked for it.

use super::cache::{Cache, Entry, Key};
use super::error::{AtPath, RunError};
use super::files;
use super::inputs::Fingerprints;
use super::record::{RunDirectory, Shard};
use crate::experiment::{AnyOp, Experiment, Graph, OpEntry, Settings, Stage};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The file of a run that holds its [`Schedule`].
pub const PLAN: &str = "plan.json";

/// All work of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Schedule {
    /// The name of the experiment or sweep.
    pub name: String,
    /// What it is for, from `about:`; empty where the file does not say.
    pub about: String,
    /// The hash of the name, the cells, their stages and all keys: what is asked for again has the same.
    pub identity: Key,
    /// Whether the file is a sweep, even of one cell.
    pub sweep: bool,
    /// One per arm, grid point and seed, in the order of the file.
    pub cells: Vec<CellPlan>,
    /// Inputs come before what reads them.
    pub works: Vec<Task>,
    /// Data sets that are read: name to directory.
    pub data: BTreeMap<String, PathBuf>,
}

/// One arm with one seed, and what its stages are.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellPlan {
    /// A name for people: `full-s0`.
    pub label: String,
    /// Name of the arm and its grid point; empty for a plain experiment.
    pub arm: String,
    /// Seed of the cell.
    pub seed: u64,
    /// Stage name to key, in topological order.
    pub stages: Vec<(String, Key)>,
    /// The keys of the stages that no other stage reads: what the cell is for.
    pub results: Vec<Key>,
}

/// One piece of work.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// Address of the artifact that it makes.
    pub key: Key,
    /// The stage's name where it appears first.
    pub stage: String,
    /// Its directory below the run's `stages/`.
    pub directory: String,
    /// Labels of the cells that share it.
    pub cells: Vec<String>,
    /// The op that does it.
    pub op: String,
    /// The op's version when the run was planned.
    pub version: u32,
    /// The artifact's type.
    pub kind: String,
    /// Seed of the stage; without effect where [`Task::seeded`] is false.
    pub seed: u64,
    /// Whether the artifact depends on the seed.
    pub seeded: bool,
    /// Resolved: no reference, no default left open.
    pub settings: Settings,
    /// What it reads from other stages, in the order of the op's ports.
    pub inputs: Vec<PortPlan>,
    /// Outside files and data sets that it reads.
    pub files: Vec<FilePlan>,
    /// Names of the data sets it reads.
    pub data: Vec<String>,
    /// Shapes, parameters, memory, FLOP as promised.
    pub plan: Value,
}

/// What arrives at one port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PortPlan {
    /// The op's key for this input.
    pub port: String,
    /// Stage name and key, in the order of the YAML.
    pub from: Vec<(String, Key)>,
}

/// An outside file or data set as it was when the run was planned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FilePlan {
    /// The settings key that names it; `data:NAME` for a data set.
    pub key: String,
    /// Where it lies on the machine that planned the run.
    #[serde(serialize_with = "crate::formats::text::serialize_path")]
    pub path: PathBuf,
    /// Its fingerprint in hexadecimal.
    pub blake3: String,
    /// Size of the file, or of all files of the data set together.
    pub bytes: u64,
}

impl Schedule {
    /// Lays out the work of a checked experiment, with the fingerprints of the outside files and data sets that it reads.
    pub fn of(experiment: &Experiment, mut prints: Fingerprints<'_>) -> Result<Self, RunError> {
        let mut cells = Vec::new();
        let mut works: Vec<Task> = Vec::new();
        let mut places: BTreeMap<Key, usize> = BTreeMap::new();
        for cell in &experiment.cells {
            let label = cell.label();
            let keys = keys(&cell.graph, &mut prints)?;
            for (stage, &key) in cell.graph.stages.iter().zip(&keys) {
                if let Some(&at) = places.get(&key) {
                    if !works[at].cells.contains(&label) {
                        works[at].cells.push(label.clone());
                    }
                    continue;
                }
                places.insert(key, works.len());
                works.push(work(&cell.graph, stage, key, &keys, &label, &prints));
            }
            let read: BTreeSet<usize> = cell
                .graph
                .stages
                .iter()
                .flat_map(|s| s.edges.iter().flat_map(|e| e.from.iter().copied()))
                .collect();
            cells.push(CellPlan {
                arm: cell.arm.clone(),
                seed: cell.seed,
                stages: cell
                    .graph
                    .stages
                    .iter()
                    .zip(&keys)
                    .map(|(s, &k)| (s.name.clone(), k))
                    .collect(),
                results: keys
                    .iter()
                    .enumerate()
                    .filter(|(i, _)| !read.contains(i))
                    .map(|(_, &k)| k)
                    .collect(),
                label,
            });
        }
        name_directories(&mut works, experiment.sweep);
        let used: BTreeSet<&String> = works.iter().flat_map(|work| &work.data).collect();
        let data = experiment
            .data
            .iter()
            .filter(|(name, _)| used.contains(name));
        let data = data
            .map(|(name, path)| (name.clone(), path.clone()))
            .collect();
        let identity = identity(&experiment.name, &cells);
        Ok(Self {
            name: experiment.name.clone(),
            about: experiment.about.clone(),
            identity,
            sweep: experiment.sweep,
            cells,
            works,
            data,
        })
    }

    /// What a run was planned to do.
    ///
    /// # Errors
    /// When its plan is not there or cannot be read.
    pub fn read(run: &RunDirectory) -> Result<Self, RunError> {
        files::read_json(&run.path().join(PLAN))
    }

    /// The work that makes the artifact of `key`.
    pub fn work(&self, key: &Key) -> Option<&Task> {
        self.works.iter().find(|work| work.key == *key)
    }

    /// The keys of what the run is for.
    pub fn results(&self) -> BTreeSet<Key> {
        self.cells
            .iter()
            .flat_map(|cell| cell.results.iter().copied())
            .collect()
    }

    /// What a process aims at: the results of its shard's cells, or the stage (or all stages of the group) it was asked for in
    /// them.
    pub fn targets(&self, only: Option<&str>, shard: Shard) -> Result<BTreeSet<Key>, RunError> {
        let count = shard.count as usize;
        let mine = self
            .cells
            .iter()
            .skip(shard.index as usize - 1)
            .step_by(count.max(1));
        let Some(only) = only else {
            return Ok(mine.flat_map(|cell| cell.results.iter().copied()).collect());
        };
        let names: BTreeSet<&str> = self
            .cells
            .iter()
            .flat_map(|cell| cell.stages.iter().map(|(name, _)| name.as_str()))
            .collect();
        let group = format!("{only}.");
        let of_group = |name: &str| name.starts_with(&group);
        let whole = names.contains(only);
        if !whole && !names.iter().any(|name| of_group(name)) {
            let names: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
            return Err(RunError::Request {
                message: format!("no stage `{only}` in `{}`", self.name),
                help: format!("its stages are {}", names.join(", ")),
            });
        }
        let stages = mine.flat_map(|cell| &cell.stages);
        Ok(stages
            .filter(|(name, _)| if whole { name == only } else { of_group(name) })
            .map(|(_, key)| *key)
            .collect())
    }

    /// The work that `targets` need and the cache does not have, and what lies damaged in it, inputs first.
    pub fn to_do(&self, targets: &BTreeSet<Key>, cache: &Cache) -> Vec<&Task> {
        let mut missing: BTreeSet<Key> = BTreeSet::new();
        let mut needed: BTreeSet<Key> = targets.clone();
        // Inputs come first in `works`, so that walking backwards meets every reader before what it reads.
        for work in self.works.iter().rev() {
            let is_missing = match cache.look(&work.key) {
                Entry::Whole(_) => false,
                Entry::Absent => needed.contains(&work.key),
                Entry::Damaged(_) => true,
            };
            if is_missing {
                missing.insert(work.key);
                needed.extend(work.input_keys());
            }
        }
        self.works
            .iter()
            .filter(|work| missing.contains(&work.key))
            .collect()
    }
}

impl Task {
    /// Keys of all artifacts that it reads, port by port.
    pub fn input_keys(&self) -> impl Iterator<Item = Key> + '_ {
        self.inputs
            .iter()
            .flat_map(|port| port.from.iter().map(|(_, key)| *key))
    }

    /// A name for people: the stage, and the cell it belongs to if it is one cell's alone.
    pub fn label(&self, sweep: bool) -> String {
        match self.cells.as_slice() {
            [only] if sweep => format!("{} ({only})", self.stage),
            cells if sweep => format!("{} (shared by {})", self.stage, cells.len()),
            _ => self.stage.clone(),
        }
    }

    /// The op that does it, as linked into this binary.
    pub fn op(&self) -> Result<&'static dyn AnyOp, RunError> {
        let mut linked = inventory::iter::<OpEntry>.into_iter();
        let found = linked.find(|entry| entry.0.name() == self.op);
        found.map(|entry| entry.0).ok_or_else(|| RunError::Request {
            message: format!("this binary has no op `{}`", self.op),
            help: "use the binary that planned the run; plug-in ops live in their own".into(),
        })
    }
}

fn work(
    graph: &Graph,
    stage: &Stage,
    key: Key,
    keys: &[Key],
    label: &str,
    prints: &Fingerprints<'_>,
) -> Task {
    let from = |index: &usize| (graph.stages[*index].name.clone(), keys[*index]);
    let inputs = stage.edges.iter().map(|edge| PortPlan {
        port: edge.port.to_owned(),
        from: edge.from.iter().map(from).collect(),
    });
    let files = stage
        .files
        .iter()
        .map(|file| (file.key.clone(), &file.path));
    let data = stage.data.iter().filter_map(|data| {
        let path = data.path.as_ref()?;
        Some((format!("data:{}", data.name), path))
    });
    let files = files.chain(data).map(|(key, path)| {
        let print = prints.known(path);
        FilePlan {
            key,
            path: path.clone(),
            blake3: print.map_or_else(String::new, |print| print.hash.to_hex().to_string()),
            bytes: print.map_or(0, |print| print.bytes),
        }
    });
    Task {
        key,
        stage: stage.name.clone(),
        directory: String::new(),
        cells: vec![label.to_owned()],
        op: stage.op.name().to_owned(),
        version: stage.op.version(),
        kind: stage.op.output().name().to_owned(),
        seed: stage.seed,
        seeded: stage.op.seeded(),
        settings: stage.settings.clone(),
        inputs: inputs.collect(),
        files: files.collect(),
        data: stage.data.iter().map(|data| data.name.clone()).collect(),
        plan: serde_json::to_value(graph.plan(stage)).unwrap_or(Value::Null),
    }
}

fn keys(graph: &Graph, prints: &mut Fingerprints<'_>) -> Result<Vec<Key>, RunError> {
    let mut failed = None;
    let keys = graph.keys(&mut |path| {
        prints.of(path).map(|print| print.hash).map_err(|error| {
            failed = Some(error);
            std::io::Error::other("see the error kept beside")
        })
    });
    if let Some(error) = failed {
        return Err(error);
    }
    let keys = keys.at("reading", Path::new("the inputs"))?;
    Ok(keys.into_iter().map(Key::from).collect())
}

/// The hash of the name and of every cell's keys: what was asked for, however it was written.
fn identity(name: &str, cells: &[CellPlan]) -> Key {
    let mut hasher = blake3::Hasher::new();
    let mut part = |text: &str| {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    };
    part("reviv run 1");
    part(name);
    for cell in cells {
        part("cell");
        part(&cell.label);
        for (stage, key) in &cell.stages {
            part(stage);
            part(&key.to_string());
        }
    }
    hasher.finalize().into()
}

/// `mget` in an experiment; `full-s0/mget` or `shared/clips` in a sweep, with digits of the key where two want one name.
fn name_directories(works: &mut [Task], sweep: bool) {
    let mut taken = BTreeSet::new();
    for work in works {
        let stage = work.stage.replace(['/', '\\'], ".");
        let home = match work.cells.as_slice() {
            _ if !sweep => stage,
            [only] => format!("{only}/{stage}"),
            _ => format!("shared/{stage}"),
        };
        let digits = work.key.to_string();
        let names = std::iter::once(home.clone())
            .chain((4..=digits.len()).map(|n| format!("{home}-{}", &digits[..n])));
        work.directory = names
            .into_iter()
            .find(|name| !taken.contains(name))
            .unwrap_or(home);
        taken.insert(work.directory.clone());
    }
}
