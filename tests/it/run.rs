//! Runs as the library executes them, with two small ops of the tests' own: what is cached, redone, resumed, refused.

use reviv::experiment::{
    Arity, ArtifactKind, Cell, DataInput, Description, Edge, Experiment, Graph, Inputs, Op,
    OpEntry, Port, Problem, Stage, StageContext, StageError,
};
use reviv::run::execute::{Job, Outcome, execute};
use reviv::run::record::RunDirectory;
use reviv::run::verify::{Check, Redo, Verdict};
use reviv::run::{
    Cache, Interrupt, Progress, RunError, Shard, State, WorkerPool, checkpoint, files, metrics,
};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Random numbers, one per step, with a checkpoint every ten.
struct Numbers;

#[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
struct NumbersSettings {
    steps: u64,
    /// Interrupts itself at this step of its first attempt.
    stop_at: Option<u64>,
    /// `input`, `panic`, `full_disk`, `full_checkpoint`: fails in this way.
    fail: Option<String>,
    /// A file that it writes to although it only reads it.
    touch: Option<String>,
}

impl Op for Numbers {
    type Settings = NumbersSettings;
    fn name(&self) -> &'static str {
        "test_numbers"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "Numbers for the tests of runs."
    }
    fn inputs(&self) -> &'static [Port] {
        &[]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Tokens
    }
    fn check(&self, _: &NumbersSettings, _: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        Description::default()
    }
    fn run(
        &self,
        settings: &NumbersSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        use rand::RngExt;
        let mut numbers: Vec<f64> = Vec::new();
        if let Some((_, path)) = checkpoint::latest(context.checkpoints()) {
            let bytes = std::fs::read(path.join("numbers.json")).map_err(StageError::io(&path))?;
            numbers = serde_json::from_slice(&bytes).map_err(StageError::other)?;
        }
        let resumed = !numbers.is_empty();
        // Not a setting: what is made does not depend on how long it takes.
        let pause = std::env::var("REVIV_TEST_PAUSE_MS")
            .ok()
            .and_then(|text| text.parse().ok());
        for step in numbers.len() as u64 + 1..=settings.steps {
            if let Some(pause) = pause {
                std::thread::sleep(std::time::Duration::from_millis(pause));
            }
            numbers.push(reviv::random::stream(context.seed(), "test.numbers", step, 0).random());
            context.record(step, &[("value", numbers[numbers.len() - 1])])?;
            context.progress(step, settings.steps, "steps");
            if step % 10 == 0 {
                checkpoint::save(context, step, |context, directory| {
                    if settings.fail.as_deref() == Some("full_checkpoint") {
                        return Err(StageError::io(directory)(
                            std::io::ErrorKind::StorageFull.into(),
                        ));
                    }
                    context.log("checkpoint");
                    let text = serde_json::to_string(&numbers).map_err(StageError::other)?;
                    Ok(files::write(
                        &directory.join("numbers.json"),
                        text.as_bytes(),
                    )?)
                })?;
            }
            match settings.fail.as_deref() {
                Some("input") => {
                    return Err(StageError::Input {
                        code: reviv::experiment::Code::E0601,
                        message: "no recording fits".into(),
                        help: "give another".into(),
                    });
                }
                Some("panic") => panic!("a bug on purpose"),
                Some("full_disk") => {
                    let error = std::io::Error::from(std::io::ErrorKind::StorageFull);
                    return Err(StageError::other(error));
                }
                _ => {}
            }
            if context.interrupted() || (settings.stop_at == Some(step) && !resumed) {
                return Err(StageError::Interrupted);
            }
        }
        if let Some(path) = &settings.touch {
            std::fs::write(path, "changed").map_err(StageError::io(Path::new(path)))?;
        }
        let path = context.output().join("numbers.json");
        let text = serde_json::to_string(&numbers).map_err(StageError::other)?;
        std::fs::write(&path, text).map_err(StageError::io(&path))?;
        Ok(json!({"count": numbers.len()}))
    }
}

/// The sum of numbers, with a section for the page.
struct Total;

#[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
struct TotalSettings {
    scale: f64,
}

impl Op for Total {
    type Settings = TotalSettings;
    fn name(&self) -> &'static str {
        "test_total"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "A sum for the tests of runs."
    }
    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "numbers",
            kinds: &[ArtifactKind::Tokens],
            arity: Arity::One,
            about: "What to add up.",
        }]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Scores
    }
    fn seeded(&self) -> bool {
        false
    }
    fn check(&self, _: &TotalSettings, _: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        Description::default()
    }
    fn run(
        &self,
        settings: &TotalSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let input = &context.inputs("numbers")[0];
        let bytes =
            std::fs::read(input.path.join("numbers.json")).map_err(StageError::io(&input.path))?;
        let numbers: Vec<f64> = serde_json::from_slice(&bytes).map_err(StageError::other)?;
        assert_eq!(input.contents["count"], numbers.len());
        let sum = numbers.iter().sum::<f64>() * settings.scale;
        files::create_directory(&context.output().join("report"))?;
        files::write(
            &context.output().join("report/sum.md"),
            format!("The sum is **{sum}** <b>.").as_bytes(),
        )?;
        Ok(json!({"sum": sum}))
    }
}

inventory::submit! { OpEntry(&Numbers) }
inventory::submit! { OpEntry(&Total) }

fn stage(
    name: &str,
    op: &'static dyn reviv::experiment::AnyOp,
    settings: Value,
    seed: u64,
    edges: Vec<Edge>,
) -> Stage {
    Stage {
        name: name.into(),
        path: format!("stages.{name}"),
        op,
        settings: op.parse(settings).unwrap(),
        seed,
        edges,
        files: Vec::new(),
        data: Vec::new(),
        description: Description::default(),
        traces: BTreeMap::new(),
    }
}

pub fn cell(arm: &str, seed: u64, numbers: Value, scale: f64) -> Cell {
    let edge = Edge {
        port: "numbers",
        from: vec![0],
    };
    let stages = vec![
        stage("numbers", &Numbers, numbers, seed, Vec::new()),
        stage("total", &Total, json!({"scale": scale}), seed, vec![edge]),
    ];
    Cell {
        arm: arm.into(),
        seed,
        graph: Graph {
            stages,
            ..Graph::default()
        },
    }
}

pub fn experiment(cells: Vec<Cell>) -> Experiment {
    Experiment {
        name: "totals".into(),
        about: "Sums.".into(),
        path: "experiments/totals.yaml".into(),
        sweep: cells.len() > 1,
        cells,
        compare: None,
        data: BTreeMap::new(),
        sources: reviv::experiment::source::Sources::default(),
    }
}

fn run_as(
    experiment: &Experiment,
    runs: &Path,
    only: Option<&str>,
    shard: &str,
) -> Result<Outcome, RunError> {
    run_by(experiment, runs, only, shard, WorkerPool::alone())
}

fn run_by(
    experiment: &Experiment,
    runs: &Path,
    only: Option<&str>,
    shard: &str,
    crew: WorkerPool,
) -> Result<Outcome, RunError> {
    execute(&Job {
        experiment,
        runs,
        only,
        shard: shard.parse().unwrap(),
        check: false,
        crew,
        progress: &Progress::silent(),
        interrupt: &Interrupt::default(),
    })
}

pub fn run(experiment: &Experiment, runs: &Path) -> Outcome {
    run_as(experiment, runs, None, "1/1").unwrap()
}

/// Every artifact of a cache: relative path to bytes.
pub fn artifacts(cache: &Cache) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    for leaf in cache
        .entries()
        .unwrap()
        .iter()
        .filter(|leaf| leaf.extension.is_empty())
    {
        for file in files::files_below(&leaf.path).unwrap() {
            let bytes = std::fs::read(leaf.path.join(&file)).unwrap();
            all.insert(format!("{}/{}", leaf.key, file.display()), bytes);
        }
    }
    all
}

#[test]
fn the_same_experiment_asked_for_twice_does_the_work_once() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]);
    let first = run(&asked, dir.path());
    assert_eq!((first.state, first.made), (State::Done, 2));
    let before = artifacts(&Cache::of(dir.path()));
    let second = run(&asked, dir.path());
    assert_eq!((second.state, second.made), (State::Done, 0));
    assert_eq!(first.run.path(), second.run.path());
    assert_eq!(before, artifacts(&Cache::of(dir.path())));
    let page = std::fs::read_to_string(second.run.report()).unwrap();
    assert!(
        page.contains("The sum is <strong>")
            && page.contains("&lt;b&gt;")
            && page.contains("data:image/svg+xml")
    );
}

#[test]
fn changing_one_setting_redoes_only_what_depends_on_it() {
    let dir = tempfile::tempdir().unwrap();
    run(
        &experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]),
        dir.path(),
    );
    let scaled = run(
        &experiment(vec![cell("", 0, json!({"steps": 25}), 2.0)]),
        dir.path(),
    );
    assert_eq!((scaled.made, scaled.found), (1, 1));
    let longer = run(
        &experiment(vec![cell("", 0, json!({"steps": 26}), 2.0)]),
        dir.path(),
    );
    assert_eq!((longer.made, longer.found), (2, 0));
}

#[test]
fn a_data_set_is_its_bytes_wherever_it_lies() {
    let dir = tempfile::tempdir().unwrap();
    let asked = |folder: &str| {
        let mut asked = experiment(vec![cell("", 0, json!({"steps": 5}), 1.0)]);
        asked.cells[0].graph.stages[0].data = vec![DataInput {
            name: "adt".into(),
            key: "source".into(),
            path: Some(dir.path().join(folder)),
        }];
        asked
    };
    let runs = dir.path().join("runs");
    for folder in ["here", "there"] {
        std::fs::create_dir(dir.path().join(folder)).unwrap();
        std::fs::write(dir.path().join(folder).join("a.csv"), "1").unwrap();
    }
    let first = run(&asked("here"), &runs);
    assert_eq!((first.state, first.made), (State::Done, 2));
    let manifest = Cache::of(&runs);
    let prints: Vec<_> = manifest
        .entries()
        .unwrap()
        .iter()
        .filter_map(|leaf| match manifest.look(&leaf.key) {
            reviv::run::cache::Entry::Whole(manifest) => Some(manifest.recipe.files),
            _ => None,
        })
        .filter(|files| !files.is_empty())
        .collect();
    assert!(prints.iter().any(|files| files.contains_key("data:adt")));
    assert_eq!(run(&asked("there"), &runs).made, 0);
    // One byte of it, and everything that was made from it is another.
    std::fs::write(dir.path().join("there/a.csv"), "2").unwrap();
    assert_eq!(run(&asked("there"), &runs).made, 2);
    assert_eq!(run(&asked("here"), &runs).made, 0);
    std::fs::write(dir.path().join("here/b.csv"), "").unwrap();
    assert_eq!(run(&asked("here"), &runs).made, 2);
    let checks = verify(&first.run);
    assert!(
        checks
            .iter()
            .any(|c| c.what.starts_with("input") && c.verdict == Verdict::Changed)
    );
}

fn verify(run: &RunDirectory) -> Vec<Check> {
    let (progress, interrupt) = (Progress::silent(), Interrupt::default());
    reviv::run::verify::verify(run, Redo::Nothing, &progress, &interrupt).unwrap()
}

#[test]
fn a_data_set_that_changes_under_the_work_spoils_it() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    std::fs::create_dir(&data).unwrap();
    std::fs::write(data.join("a.csv"), "1").unwrap();
    let touch = data.join("a.csv").display().to_string();
    let mut asked = experiment(vec![cell("", 0, json!({"steps": 5, "touch": touch}), 1.0)]);
    asked.cells[0].graph.stages[0].data = vec![DataInput {
        name: "adt".into(),
        key: "source".into(),
        path: Some(data),
    }];
    let outcome = run(&asked, &dir.path().join("runs"));
    assert_eq!((outcome.state, outcome.made), (State::Failed, 0));
    assert_eq!(outcome.failures[0].code(), "E0602");
}

#[test]
fn arms_and_seeds_share_what_they_agree_on() {
    let dir = tempfile::tempdir().unwrap();
    let cells = [("one", 1.0), ("two", 2.0)]
        .iter()
        .flat_map(|(arm, scale)| [0, 1].map(|seed| cell(arm, seed, json!({"steps": 12}), *scale)));
    let outcome = run(&experiment(cells.collect()), dir.path());
    // Numbers once per seed, totals once per arm and seed.
    assert_eq!((outcome.state, outcome.made), (State::Done, 2 + 4));
    assert!(
        outcome
            .run
            .path()
            .join("stages/one-s1/total/stage.json")
            .exists()
    );
    assert!(
        outcome
            .run
            .path()
            .join("stages/shared/numbers/metrics.jsonl")
            .exists()
    );
}

#[test]
fn stages_made_at_the_same_time_have_the_same_bytes() {
    let cells = [0, 1, 2].map(|seed| cell("one", seed, json!({"steps": 12}), 1.0));
    let asked = experiment(cells.into());
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let outcomes = [1, 4].map(|jobs| {
        let crew = WorkerPool {
            jobs,
            ..WorkerPool::alone()
        };
        let dir = dirs[usize::from(jobs > 1)].path();
        run_by(&asked, dir, None, "1/1", crew).unwrap()
    });
    for outcome in &outcomes {
        assert_eq!((outcome.state, outcome.made), (State::Done, 6));
    }
    let [one, several] = dirs.map(|dir| artifacts(&Cache::of(dir.path())));
    assert_eq!(one, several);
}

#[test]
fn an_interrupted_run_goes_on_from_its_checkpoint_and_ends_with_the_same_bytes() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let asked = experiment(vec![cell("", 3, json!({"steps": 40, "stop_at": 27}), 1.0)]);
    let stopped = run(&asked, dirs[0].path());
    assert_eq!((stopped.state, stopped.made), (State::Interrupted, 0));
    assert_eq!(stopped.run.read().unwrap().state, State::Interrupted);
    let stage = stopped.run.path().join("stages/numbers");
    assert_eq!(metrics::read(&stage).unwrap().len(), 27);
    let resumed = run(&asked, dirs[0].path());
    assert_eq!((resumed.state, resumed.made), (State::Done, 2));
    assert_eq!(resumed.run.path(), stopped.run.path());
    let steps: Vec<u64> = metrics::read(&stage)
        .unwrap()
        .iter()
        .map(|row| row.step)
        .collect();
    assert_eq!(steps, (1..=40).collect::<Vec<_>>());

    // The other one is only ever asked to finish: a checkpoint at its beginning keeps it from stopping.
    let copy = dirs[1].path();
    run(&asked, copy);
    run(&asked, copy);
    assert_eq!(
        artifacts(&Cache::of(dirs[0].path())),
        artifacts(&Cache::of(copy))
    );
}

#[test]
fn a_failed_stage_leaves_a_legible_run_and_everything_that_does_not_need_it() {
    let dir = tempfile::tempdir().unwrap();
    for (fail, code, exit) in [("input", "E0601", 1), ("panic", "E0806", 2)] {
        let cells = vec![
            cell("bad", 0, json!({"steps": 5, "fail": fail}), 1.0),
            cell("good", 0, json!({"steps": 5}), 1.0),
        ];
        let outcome = run(&experiment(cells), dir.path());
        assert_eq!(outcome.state, State::Failed);
        assert_eq!(outcome.failures.len(), 1);
        assert_eq!(
            (outcome.failures[0].code(), outcome.failures[0].exit_code()),
            (code, exit)
        );
        let read = outcome.run.read().unwrap();
        assert_eq!(read.state, State::Failed);
        assert_eq!(read.parts["1/1"].error.as_ref().unwrap().code, code);
        assert!(
            outcome
                .run
                .path()
                .join("stages/good-s0/total/stage.json")
                .exists()
        );
        assert!(
            !outcome
                .run
                .path()
                .join("stages/bad-s0/total/stage.json")
                .exists()
        );
        assert!(
            std::fs::read_to_string(outcome.run.report())
                .unwrap()
                .contains(code)
        );
    }
}

#[test]
fn a_full_disk_fails_the_run_cleanly_and_what_was_finished_stays() {
    for fail in ["full_disk", "full_checkpoint"] {
        let dir = tempfile::tempdir().unwrap();
        let cells = vec![
            cell("a", 0, json!({"steps": 15}), 1.0),
            cell("b", 0, json!({"steps": 15, "fail": fail}), 1.0),
        ];
        let outcome = run(&experiment(cells), dir.path());
        assert_eq!((outcome.state, outcome.made), (State::Failed, 2));
        assert_eq!(
            (outcome.failures[0].code(), outcome.failures[0].exit_code()),
            ("E0502", 2)
        );
        assert_eq!(outcome.run.read().unwrap().state, State::Failed);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_while_metrics_are_written_fails_the_run_cleanly() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 40, "stop_at": 15}), 1.0)]);
    let stopped = run(&asked, dir.path());
    let file = stopped.run.path().join("stages/numbers/metrics.jsonl");
    std::fs::remove_file(&file).unwrap();
    std::os::unix::fs::symlink("/dev/full", &file).unwrap();
    let full = run(&asked, dir.path());
    assert_eq!(
        (full.state, full.failures[0].code()),
        (State::Failed, "E0502")
    );
    std::fs::remove_file(&file).unwrap();
    // The metrics are lost with their disk; the work continues.
    assert_eq!(run(&asked, dir.path()).state, State::Done);
}

#[test]
fn a_run_that_another_process_owns_is_refused_with_its_holder() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 20, "stop_at": 15}), 1.0)]);
    let stopped = run(&asked, dir.path());
    let owner = stopped.run.own(Shard::WHOLE).unwrap();
    let refused = run_as(&asked, dir.path(), None, "1/1").unwrap_err();
    assert_eq!((refused.code(), refused.exit_code()), ("E0801", 1));
    assert!(
        refused
            .to_string()
            .contains(&format!("pid {}", std::process::id())),
        "{refused}"
    );
    drop(owner);
    assert_eq!(run(&asked, dir.path()).state, State::Done);
}

#[test]
fn a_half_written_cache_entry_is_made_again() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]);
    run(&asked, dir.path());
    let cache = Cache::of(dir.path());
    let before = artifacts(&cache);
    for leaf in cache
        .entries()
        .unwrap()
        .iter()
        .filter(|leaf| leaf.extension.is_empty())
    {
        for file in files::files_below(&leaf.path).unwrap() {
            std::fs::write(leaf.path.join(file), b"{").unwrap();
        }
    }
    let again = run(&asked, dir.path());
    assert_eq!((again.state, again.made), (State::Done, 2));
    assert_eq!(before, artifacts(&cache));
}

#[test]
fn shards_split_a_sweep_without_a_server() {
    let dir = tempfile::tempdir().unwrap();
    let cells = || {
        (0..4)
            .map(|seed| cell("a", seed, json!({"steps": 12}), 1.0))
            .collect()
    };
    let first = run_as(&experiment(cells()), dir.path(), None, "1/2").unwrap();
    assert_eq!((first.state, first.made), (State::Queued, 4));
    assert_eq!(first.run.read().unwrap().state, State::Queued);
    let second = run_as(&experiment(cells()), dir.path(), None, "2/2").unwrap();
    assert_eq!((second.state, second.made), (State::Done, 4));
    assert_eq!(second.run.path(), first.run.path());
}

#[test]
fn a_run_is_busy_while_a_shard_of_it_is_at_work() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 2}), 1.0)]);
    let directory = run(&asked, dir.path()).run;
    assert!(!directory.is_busy());
    let owned = directory.own("1/2".parse().unwrap()).unwrap();
    owned.begin().unwrap();
    assert!(directory.is_busy());
    owned.end(State::Done, None, || true).unwrap();
    drop(owned);
    assert!(!directory.is_busy());
}

#[test]
fn the_shard_that_writes_last_knows_what_the_others_made() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 2}), 1.0)]);
    let directory = run(&asked, dir.path()).run;
    let [first, second] = ["1/2", "2/2"].map(|shard| {
        let owned = directory.own(shard.parse().unwrap()).unwrap();
        owned.begin().unwrap();
        owned
    });
    std::thread::scope(|scope| {
        let unfinished = || {
            // While the first looks, the second makes the rest; it must wait with its word until the first has spoken.
            scope.spawn(|| second.end(State::Done, None, || true).unwrap());
            std::thread::sleep(std::time::Duration::from_millis(50));
            false
        };
        first.end(State::Done, None, unfinished).unwrap();
    });
    assert_eq!(directory.read().unwrap().state, State::Done);
}

#[test]
fn the_seed_of_a_stage_is_in_the_record() {
    let dir = tempfile::tempdir().unwrap();
    let mut own = cell("a", 3, json!({"steps": 2}), 1.0);
    own.graph.stages[0].seed = 9;
    let cells = vec![own, cell("b", 3, json!({"steps": 2}), 1.0)];
    let done = run(&experiment(cells), dir.path());
    let resolved = std::fs::read_to_string(done.run.path().join("resolved.yaml")).unwrap();
    assert!(resolved.contains("    seed: 9  #"), "{resolved}");
    assert!(resolved.contains("    seed: 3  #"), "{resolved}");
}

#[test]
fn only_one_stage_can_be_asked_for_by_a_name_that_exists() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]);
    let some = run_as(&asked, dir.path(), Some("numbers"), "1/1").unwrap();
    assert_eq!((some.state, some.made), (State::Queued, 1));
    let none = run_as(&asked, dir.path(), Some("number"), "1/1").unwrap_err();
    assert!(none.help().contains("`numbers`"));
    assert_eq!(run(&asked, dir.path()).made, 1);
}

#[test]
fn two_processes_that_ask_at_once_do_the_work_once() {
    let dir = tempfile::tempdir().unwrap();
    let cells = || {
        (0..6)
            .map(|seed| cell("once", seed, json!({"steps": 300}), 1.0))
            .collect()
    };
    let made: usize = std::thread::scope(|scope| {
        let workers = ["1/3", "2/3", "3/3"].map(|shard| {
            let path = dir.path();
            scope.spawn(move || {
                run_as(&experiment(cells()), path, None, shard)
                    .unwrap()
                    .made
            })
        });
        workers.map(|worker| worker.join().unwrap()).iter().sum()
    });
    assert_eq!(made, 12);
    let runs = RunDirectory::all(dir.path()).unwrap();
    assert_eq!(runs.len(), 1);
    assert_eq!(runs[0].read().unwrap().state, State::Done);
}

#[test]
fn a_read_only_directory_is_refused_with_words() {
    // Root may write anywhere; a file in the directory's place stops everybody.
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    std::fs::write(&file, b"").unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 1}), 1.0)]);
    let refused = run_as(&asked, &file.join("runs"), None, "1/1").unwrap_err();
    assert!(["E0802", "E0803"].contains(&refused.code()), "{refused}");

    #[cfg(target_os = "linux")]
    {
        let refused = run_as(&asked, Path::new("/proc/self"), None, "1/1").unwrap_err();
        assert!(!refused.to_string().is_empty());
    }
}
