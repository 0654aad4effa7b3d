//! Runs an experiment that a test holds as text.

use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::{Request, load};
use reviv::run::execute::{Job, Outcome, execute};
use reviv::run::{Interrupt, Progress, WorkerPool};
use std::path::Path;

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
