//! What running an experiment would do: every different stage once, what its cells share, what is cached already.

use super::artifact::{ArtifactKind, Description, TokenFacts};
use super::graph::{ArtifactKey, Experiment, Graph, Stage};
use super::settings::Settings;
use super::stage::StagePlan;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// A planned experiment.
#[derive(Debug, Clone, Serialize)]
pub struct Plan {
    /// Name of the experiment or sweep.
    pub name: String,
    /// Labels of the cells: arm and seed.
    pub cells: Vec<String>,
    /// Every different piece of work, in an order in which it can be done.
    pub stages: Vec<PlannedStage>,
    /// Stages of all cells together; the difference to `stages` is what they share.
    pub total: usize,
}

/// The clips and tokens of all stages that are to do.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct DataToDo {
    /// At most so many: recordings may give fewer.
    pub clips: u64,
    /// At most so many: no clip has every modality.
    pub tokens: u64,
    /// On disk, clips and tokens.
    pub bytes: u64,
    /// Of one processor core, by what was measured on one machine: an order of magnitude.
    pub core_hours: f64,
}

/// One piece of work.
#[derive(Debug, Clone, Serialize)]
pub struct PlannedStage {
    /// The stage's name in the experiment.
    pub name: String,
    /// The op that does it.
    pub op: &'static str,
    /// The type of its artifact.
    pub makes: ArtifactKind,
    /// The artifact's address.
    pub key: String,
    /// Whether the artifact is there already.
    pub cached: bool,
    /// The cells that use it, as indices into [`Plan::cells`].
    pub cells: Vec<usize>,
    /// What the artifact will be.
    pub description: Description,
    /// Resolved.
    #[serde(skip)]
    pub settings: Settings,
    /// Shapes, parameters, memory and FLOP, as far as they are known.
    pub plan: StagePlan,
}

impl Plan {
    /// Pieces of work that are not cached.
    pub fn to_do(&self) -> impl Iterator<Item = &PlannedStage> {
        self.stages.iter().filter(|stage| !stage.cached)
    }

    /// Floating point operations of what is to do, as far as they are known.
    pub fn flop(&self) -> f64 {
        self.to_do().filter_map(|stage| stage.plan.flop).sum()
    }

    /// The largest peak memory of what is to do, in bytes.
    pub fn memory(&self) -> Option<u64> {
        self.to_do().filter_map(|stage| stage.plan.memory).max()
    }

    /// What there is to do with data: converting clips and tokenizing them. None where nothing of it is.
    #[must_use]
    pub fn data(&self) -> Option<DataToDo> {
        let mut sum = DataToDo::default();
        for stage in self.to_do() {
            let clips: u64 = stage.description.clips.values().sum();
            match stage.makes {
                ArtifactKind::Clips => sum.clips += clips,
                ArtifactKind::Tokens => {
                    let each = stage.description.tokens.values();
                    sum.tokens += clips * each.map(TokenFacts::count).sum::<u64>();
                }
                _ => continue,
            }
            sum.bytes += stage.plan.disk.unwrap_or_default();
            sum.core_hours += stage.plan.core_seconds.unwrap_or_default() / 3600.0;
        }
        (sum.clips + sum.tokens > 0).then_some(sum)
    }

    /// Seconds of what is to do, as far as they are known, and of how many stages they are not.
    pub fn seconds(&self) -> (f64, usize) {
        let known = self.to_do().filter_map(|stage| stage.plan.seconds).sum();
        let unknown = self.to_do().filter(|stage| stage.plan.seconds.is_none());
        (known, unknown.count())
    }
}

/// Plans an experiment: no compute, no allocation of a model.
///
/// Stages that differ in their seed alone have the same plan, which is made once.
///
/// `cached` says whether an artifact is there; `hash_file` hashes outside files.
///
/// # Errors
/// When an outside file cannot be read.
pub fn plan(
    experiment: &Experiment,
    cached: &dyn Fn(&ArtifactKey) -> bool,
    hash_file: &mut dyn FnMut(&Path) -> std::io::Result<blake3::Hash>,
) -> std::io::Result<Plan> {
    let mut stages: Vec<PlannedStage> = Vec::new();
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    let mut answers: BTreeMap<String, StagePlan> = BTreeMap::new();
    let mut total = 0;
    for (index, cell) in experiment.cells.iter().enumerate() {
        let keys = cell.graph.keys(hash_file)?;
        for (stage, key) in cell.graph.stages.iter().zip(keys) {
            total += 1;
            let address = key.to_string();
            if let Some(&place) = seen.get(&address) {
                if !stages[place].cells.contains(&index) {
                    stages[place].cells.push(index);
                }
                continue;
            }
            seen.insert(address.clone(), stages.len());
            stages.push(PlannedStage {
                name: stage.name.clone(),
                op: stage.op.name(),
                makes: stage.op.output(),
                key: address,
                cached: cached(&key),
                cells: vec![index],
                description: stage.description.clone(),
                settings: stage.settings.clone(),
                plan: answers
                    .entry(question(&cell.graph, stage))
                    .or_insert_with(|| cell.graph.plan(stage))
                    .clone(),
            });
        }
    }
    Ok(Plan {
        name: experiment.name.clone(),
        cells: experiment.cells.iter().map(super::Cell::label).collect(),
        stages,
        total,
    })
}

/// Everything that the plan of a stage depends on.
fn question(graph: &Graph, stage: &Stage) -> String {
    let edges = stage.edges.iter().map(|edge| {
        let descriptions: Vec<&Description> = edge
            .from
            .iter()
            .map(|&index| &graph.stages[index].description)
            .collect();
        (edge.port, descriptions)
    });
    let edges: Vec<_> = edges.collect();
    serde_json::json!([stage.op.name(), stage.settings.json(), edges]).to_string()
}
