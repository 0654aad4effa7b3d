//! The binary killed ten times at random moments of a sweep over real ops, and the bytes it ends with.

use crate::kill::comes_to_rest;
use crate::run::artifacts;
use reviv::run::Cache;
use reviv::run::record::RunDirectory;
use reviv::run::{State, metrics};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const KILLS: u64 = 10;
const STEPS: u64 = 12;

pub const BASE: &str = "
experiment: killed
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 8, rooms: 3}}, train: 4, validation: 2}
  statistics: {op: statistics, clips: clips}
  tok_gaze:
    op: train_tokenizer
    clips: clips
    modality: gaze
    tokenizer: vq_temporal_small
    steps: 12
    warmup: {steps: 2}
    batch: 4
    checkpoint_every: 3
";

/// Clips once per seed, the tokenizer and the statistics once per arm and seed.
const SWEEP: &str = "
sweep: killed
base: base.yaml
seeds: [0, 1]
arms:
  gaze: {stages.statistics.modalities: [gaze]}
  fast: {stages.tok_gaze.learning_rate: 0.01}
";

fn begin(folder: &Path, runs: &Path) -> Child {
    Command::new(env!("CARGO_BIN_EXE_reviv"))
        .arg("run")
        .arg(folder.join("sweep.yaml"))
        .arg("--runs")
        .arg(runs)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn complete(folder: &Path, runs: &Path) {
    assert!(begin(folder, runs).wait().unwrap().success());
}

#[test]
fn a_sweep_of_real_ops_killed_ten_times_ends_with_the_bytes_of_an_untouched_one() {
    use rand::RngExt;
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("base.yaml"), BASE).unwrap();
    std::fs::write(folder.path().join("sweep.yaml"), SWEEP).unwrap();
    let (untouched, killed) = (
        folder.path().join("untouched"),
        folder.path().join("killed"),
    );
    let start = Instant::now();
    complete(folder.path(), &untouched);
    let whole = start.elapsed();
    let wanted = artifacts(&Cache::of(&untouched));

    // Other moments in every run of this test; said when it fails.
    let seed = u64::from(std::process::id());
    let (mut kills, mut finished, mut moments) = (0, 0, Vec::new());
    for attempt in 0.. {
        let mut child = begin(folder.path(), &killed);
        let part = reviv::random::stream(seed, "test.kill", attempt, 0).random_range(0.01..0.2);
        let moment: Duration = whole.mul_f64(part);
        std::thread::sleep(moment);
        if child.try_wait().unwrap().is_some() {
            // All of it was done before: once more from the beginning.
            finished += 1;
            assert!(finished < KILLS, "the work is too short to be killed");
            assert_eq!(artifacts(&Cache::of(&killed)), wanted, "seed {seed}");
            std::fs::remove_dir_all(&killed).unwrap();
            continue;
        }
        // SIGKILL: nothing of it can clean up.
        child.kill().unwrap();
        child.wait().unwrap();
        kills += 1;
        moments.push(moment);
        // Whatever was cut off, the record reads, and nobody is said to work on it.
        if killed.is_dir() {
            for run in RunDirectory::all(&killed).unwrap() {
                assert!(comes_to_rest(&run), "seed {seed}");
            }
        }
        if kills == KILLS {
            break;
        }
    }
    complete(folder.path(), &killed);
    eprintln!(
        "untouched in {whole:.1?}; {kills} kills after {moments:.0?}; complete in {:.1?}",
        start.elapsed()
    );
    assert_eq!(
        artifacts(&Cache::of(&killed)),
        wanted,
        "seed {seed}, killed after {moments:?}"
    );
    let runs = RunDirectory::all(&killed).unwrap();
    assert_eq!(runs.len(), 1, "the run is found again and continues");
    assert_eq!(runs[0].read().unwrap().state, State::Done);
    for cell in ["gaze-s0", "gaze-s1", "fast-s0", "fast-s1"] {
        let stage = runs[0].path().join("stages").join(cell).join("tok_gaze");
        let steps: Vec<u64> = metrics::read(&stage)
            .unwrap()
            .iter()
            .map(|row| row.step)
            .collect();
        let mut once = steps.clone();
        once.dedup();
        assert_eq!(once, (1..=STEPS).collect::<Vec<_>>(), "seed {seed}: {cell}");
    }
}
