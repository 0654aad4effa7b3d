//! Killed at random moments, a sweep still ends with the bytes of one that nobody touched.

use crate::run::{artifacts, cell, experiment, run};
use reviv::experiment::Experiment;
use reviv::run::Cache;
use reviv::run::record::RunDirectory;
use reviv::run::{State, metrics};
use serde_json::json;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

const RUNS: &str = "REVIV_TEST_KILLED_RUNS";
const KILLS: u64 = 10;
const STEPS: u64 = 90;

/// Two arms with two seeds; the seeds' numbers are shared between the arms.
fn sweep() -> Experiment {
    let arms = [("one", 1.0), ("two", 2.0)];
    let cells = arms.iter().flat_map(|(arm, scale)| {
        [0, 1, 2].map(|seed| cell(arm, seed, json!({"steps": STEPS}), *scale))
    });
    experiment(cells.collect())
}

#[test]
#[ignore = "the process that the test below starts and kills"]
fn victim() {
    if let Some(runs) = std::env::var_os(RUNS) {
        run(&sweep(), Path::new(&runs));
    }
}

/// Whether the record of a killed run stops saying that somebody works on it. Killed while it was starting a program (git, for
/// the record), the process leaves that program with copies of its locks until it has loaded: a moment, longer on a busy machine.
pub fn comes_to_rest(run: &RunDirectory) -> bool {
    (0..1000).any(|_| {
        std::thread::sleep(Duration::from_millis(10));
        run.read().unwrap().state != State::Running
    })
}

#[test]
fn a_sweep_killed_ten_times_at_random_moments_ends_with_the_bytes_of_an_untouched_one() {
    use rand::RngExt;
    let killed = tempfile::tempdir().unwrap();
    let untouched = tempfile::tempdir().unwrap();
    // Other moments in every run of this test; said when it fails.
    let seed = u64::from(std::process::id());
    let mut survived = 0;
    for attempt in 0..KILLS {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kill::victim", "--ignored", "--nocapture"])
            .env(RUNS, killed.path())
            .env("REVIV_TEST_PAUSE_MS", "8")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let moment = reviv::random::stream(seed, "test.kill", attempt, 0).random_range(20..300);
        std::thread::sleep(Duration::from_millis(moment));
        child.kill().unwrap();
        let ended = child.wait().unwrap();
        survived += u64::from(ended.success());
        // Whatever was cut off, the record reads, and nobody is said to work on it.
        for run in RunDirectory::all(killed.path()).unwrap() {
            assert!(comes_to_rest(&run), "seed {seed}");
        }
    }
    assert!(
        survived < KILLS,
        "it was never killed: the work is too short"
    );
    let outcome = run(&sweep(), killed.path());
    assert_eq!(
        outcome.state,
        State::Done,
        "seed {seed}: {:?}",
        outcome.failures
    );
    run(&sweep(), untouched.path());
    assert_eq!(
        artifacts(&Cache::of(killed.path())),
        artifacts(&Cache::of(untouched.path())),
        "seed {seed}"
    );
    assert_eq!(RunDirectory::all(killed.path()).unwrap().len(), 1);
    for stage in std::fs::read_dir(outcome.run.path().join("stages/shared")).unwrap() {
        let rows = metrics::read(&stage.unwrap().path()).unwrap();
        let steps: Vec<u64> = rows.iter().map(|row| row.step).collect();
        assert_eq!(steps, (1..=STEPS).collect::<Vec<_>>(), "seed {seed}");
    }
}
