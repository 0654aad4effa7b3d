//! Runs an experiment that a test holds as text.

use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::{Request, load};
use reviv::run::execute::{Job, Outcome, execute};
use reviv::run::{Cache, Interrupt, Progress, State, WorkerPool};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Writes `text` into `folder` and runs it there, in `runs`, one stage after the other. What `check` would say is the error.
pub fn run_text(folder: &Path, text: &str) -> Result<Outcome, String> {
    let file = folder.join("experiment.yaml");
    std::fs::write(&file, text).unwrap();
    let request = Request {
        path: file,
        ..Request::default()
    };
    let (experiment, report) = load(&Catalog::linked(), &request);
    let experiment = experiment.ok_or_else(|| report.render(false))?;
    let outcome = execute(&Job {
        experiment: &experiment,
        runs: &folder.join("runs"),
        only: None,
        shard: "1/1".parse().unwrap(),
        check: false,
        crew: WorkerPool::alone(),
        progress: &Progress::silent(),
        interrupt: &Interrupt::default(),
    });
    Ok(outcome.unwrap())
}

/// What the stages that failed say.
pub fn failures(outcome: &Outcome) -> Vec<String> {
    outcome.failures.iter().map(ToString::to_string).collect()
}

/// Runs `text` as [`run_text`] does, to its end; gives every artifact by its op and modality: its folder, and what its manifest says.
pub fn artifacts(folder: &Path, text: &str) -> Vec<(String, PathBuf, Value)> {
    let outcome = run_text(folder, text).unwrap_or_else(|report| panic!("{report}"));
    assert_eq!(outcome.state, State::Done, "{:?}", failures(&outcome));
    let mut artifacts = Vec::new();
    for leaf in Cache::of(&folder.join("runs")).entries().unwrap() {
        let Ok(text) = std::fs::read_to_string(leaf.path.join("manifest.json")) else {
            continue;
        };
        let manifest: Value = serde_json::from_str(&text).unwrap();
        let contents = manifest["contents"].clone();
        let op = manifest["recipe"]["op"].as_str().unwrap_or_default();
        let modality = contents["modality"].as_str().unwrap_or_default();
        artifacts.push((format!("{op} {modality}"), leaf.path, contents));
    }
    artifacts
}
