//! Ops that ranks do together, on ranks that are threads: the artifacts of one rank, byte for byte.

use crate::labelling::random_network;
use reviv::engine::Communicator;
use reviv::experiment::{InputArtifact, OpEntry, StageContext, StageError};
use reviv::labelling::DepthLabelKind;
use reviv::run::cache::Entry;
use reviv::run::files::files_below;
use reviv::run::schedule::{Schedule, Task};
use reviv::run::{Cache, RunDirectory};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// More than one shard of labels and more than one batch of predictions.
const EXPERIMENT: &str = "
experiment: ranks
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 8, rooms: 3}}, train: 40, validation: 6}
  labels: {op: label_depth, clips: clips, network: NETWORK, input_size: 28, replace: true}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, steps: 2, warmup: {steps: 1}, batch: 2}
  tok_gaze: {op: train_tokenizer, clips: clips, modality: gaze, tokenizer: vq_temporal_small, steps: 2, warmup: {steps: 1}, batch: 2}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_camera, tok_gaze]}
  mget:
    {op: train_mget, tokens: [tokens], size: laptop_small, masking: {use: dirichlet_mixture, input_tokens: 16, target_tokens: 16},
     steps: 2, warmup: {steps: 1}, batch: 4}
  predictions: {op: predict, model: mget, clips: clips, inputs: [camera], split: train, limit: 21, samples: 2}
";

/// What an op sees on one of several ranks.
struct Context {
    inputs: BTreeMap<String, Vec<InputArtifact>>,
    output: PathBuf,
    checkpoints: PathBuf,
    seed: u64,
    /// Stops when it has said so often how far it is.
    patience: usize,
}

impl StageContext for Context {
    fn stage(&self) -> &'static str {
        "stage"
    }
    fn inputs(&self, port: &str) -> &[InputArtifact] {
        self.inputs.get(port).map_or(&[], Vec::as_slice)
    }
    fn output(&self) -> &Path {
        &self.output
    }
    fn checkpoints(&self) -> &Path {
        &self.checkpoints
    }
    fn seed(&self) -> u64 {
        self.seed
    }
    fn data_root(&self, _: &str) -> Option<&Path> {
        None
    }
    fn record(&mut self, _: u64, _: &[(&str, f64)]) -> Result<(), StageError> {
        Ok(())
    }
    fn record_text(&mut self, _: u64, _: &str, _: &str) -> Result<(), StageError> {
        Ok(())
    }
    fn record_histogram(&mut self, _: u64, _: &str, _: &[f32]) -> Result<(), StageError> {
        Ok(())
    }
    fn progress(&mut self, _: u64, _: u64, _: &str) {
        self.patience = self.patience.saturating_sub(1);
    }
    fn log(&mut self, _: &str) {}
    fn interrupted(&self) -> bool {
        self.patience == 0
    }
}

/// A run of one process, and what it planned.
struct Made {
    folder: tempfile::TempDir,
    cache: Cache,
    schedule: Schedule,
}

impl Made {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        random_network(&folder.path().join("network"), DepthLabelKind::Metric);
        let network = folder.path().join("network");
        let experiment = EXPERIMENT.replace("NETWORK", network.to_str().unwrap());
        std::fs::write(folder.path().join("e.yaml"), experiment).unwrap();
        let run = std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
            .args(["run", "e.yaml"])
            .current_dir(folder.path())
            .output()
            .unwrap();
        assert!(
            run.status.success(),
            "{}",
            String::from_utf8_lossy(&run.stderr)
        );
        let runs = folder.path().join("runs");
        let run = RunDirectory::all(&runs).unwrap().remove(0);
        let plan = std::fs::read(run.path().join("plan.json")).unwrap();
        Self {
            cache: Cache::of(&runs),
            schedule: serde_json::from_slice(&plan).unwrap(),
            folder,
        }
    }

    fn task(&self, stage: &str) -> &Task {
        let mut works = self.schedule.works.iter();
        works.find(|work| work.stage == stage).unwrap()
    }

    fn inputs(&self, task: &Task) -> BTreeMap<String, Vec<InputArtifact>> {
        let artifact = |(stage, key): &(String, reviv::run::Key)| {
            let Entry::Whole(manifest) = self.cache.look(key) else {
                panic!("no artifact of {stage}");
            };
            InputArtifact {
                stage: stage.clone(),
                op: manifest.recipe.op,
                path: self.cache.path(key),
                contents: manifest.contents,
            }
        };
        let ports = task.inputs.iter();
        let ports = ports.map(|port| (port.port.clone(), port.from.iter().map(artifact).collect()));
        ports.collect()
    }

    /// Does a stage on `size` ranks in `folder`; what each rank says of it. Rank 0 stops after so many reports of progress, and to rank
    /// `blind` nothing is connected.
    fn on_ranks(
        &self,
        size: usize,
        stage: &str,
        folder: &Path,
        patience: usize,
        blind: Option<usize>,
    ) -> Vec<Result<Value, String>> {
        for name in ["output", "checkpoints"] {
            std::fs::create_dir_all(folder.join(name)).unwrap();
        }
        let task = self.task(stage);
        let mut linked = inventory::iter::<OpEntry>.into_iter();
        let op = linked.find(|op| op.0.name() == task.op);
        let op = op.unwrap().0;
        assert!(op.together(), "{stage}");
        std::thread::scope(|scope| {
            let threads = Communicator::threads(size).into_iter();
            let threads: Vec<_> = threads
                .map(|ranks| {
                    let mut context = Context {
                        inputs: if blind == Some(ranks.rank()) {
                            BTreeMap::new()
                        } else {
                            self.inputs(task)
                        },
                        output: folder.join("output"),
                        checkpoints: folder.join("checkpoints"),
                        seed: task.seed,
                        patience: if ranks.is_root() {
                            patience
                        } else {
                            usize::MAX
                        },
                    };
                    scope.spawn(move || {
                        let done = ranks.enter(|| op.run(&task.settings, &mut context));
                        let told = done.as_ref().map(drop).map_err(ToString::to_string);
                        let ended = ranks.settle(told);
                        assert!(ended.is_ok() || done.is_err(), "{ended:?}");
                        done.map_err(|error| error.to_string())
                    })
                })
                .collect();
            let ended = threads.into_iter().map(|thread| thread.join().unwrap());
            ended.collect()
        })
    }

    /// Compares what rank 0 of `size` made with what one process did.
    fn compare(&self, size: usize, stage: &str, folder: &Path, contents: &Value) {
        let task = self.task(stage);
        let expected = self.cache.path(&task.key);
        let Entry::Whole(manifest) = self.cache.look(&task.key) else {
            panic!("no artifact of {stage}");
        };
        assert_eq!(*contents, manifest.contents, "{stage} on {size} ranks");
        let output = folder.join("output");
        let found = files_below(&output).unwrap();
        let mut all = files_below(&expected).unwrap();
        all.retain(|file| file != Path::new("manifest.json"));
        assert_eq!(found, all, "{stage} on {size} ranks");
        assert!(found.len() > 3, "{found:?}");
        for file in found {
            let read = |root: &Path| std::fs::read(root.join(&file)).unwrap();
            let file = file.display();
            assert!(
                read(&output) == read(&expected),
                "{stage} on {size} ranks: {file}"
            );
        }
    }
}

#[test]
fn tokens_labels_and_predictions_of_several_ranks_are_those_of_one() {
    let made = Made::new();
    for stage in ["tokens", "labels", "predictions"] {
        for size in 1..=4 {
            let folder = made.folder.path().join(format!("{stage}{size}"));
            let done = made.on_ranks(size, stage, &folder, usize::MAX, None);
            assert!(done.iter().all(Result::is_ok), "{stage}: {done:?}");
            made.compare(size, stage, &folder, done[0].as_ref().unwrap());
        }
    }
    // Interrupted on rank 0, the others stop as well, and another number of ranks goes on with the shards that are there.
    let folder = made.folder.path().join("interrupted");
    let done = made.on_ranks(2, "labels", &folder, 10, None);
    let interrupted =
        |one: &Result<Value, String>| one.as_ref().err().map(String::as_str) == Some("interrupted");
    assert!(done.iter().all(interrupted), "{done:?}");
    let markers = files_below(&folder.join("checkpoints/depth_finished")).unwrap();
    assert_eq!(markers, [Path::new("train/shard-000001.json")]);
    let done = made.on_ranks(3, "labels", &folder, usize::MAX, None);
    made.compare(3, "labels", &folder, done[0].as_ref().unwrap());
    // What goes wrong on one rank is said on all.
    for stage in ["tokens", "labels", "predictions"] {
        let folder = made.folder.path().join(format!("{stage} blind"));
        let done = made.on_ranks(3, stage, &folder, usize::MAX, Some(1));
        for (rank, done) in done.iter().enumerate() {
            let message = done.as_ref().unwrap_err();
            assert!(
                rank == 1 || message.starts_with("rank 1 of 3: "),
                "{stage}, rank {rank}: {message}"
            );
        }
    }
}
