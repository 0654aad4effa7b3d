//! The binary under `mpirun`: real processes over the system's MPI (feature `mpi`).

use crate::run::artifacts;
use rand::RngExt;
use reviv::run::Cache;
use reviv::run::record::RunDirectory;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

const EXPERIMENT: &str = "
experiment: ranks
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 8, rooms: 3}}, train: 24, validation: 6}
  tok_camera:
    {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, steps: 6, warmup: {steps: 2},
     batch: 12, micro_batch: 1, reduction: ordered, validate_every: 3, keep: best, checkpoint_every: 2}
  tok_gaze:
    {op: train_tokenizer, clips: clips, modality: gaze, tokenizer: vq_temporal_small, steps: 6, warmup: {steps: 2},
     batch: 12, micro_batch: 1, reduction: ordered, checkpoint_every: 2}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_camera, tok_gaze]}
  mget:
    {op: train_mget, tokens: [tokens], size: laptop_small, masking: {use: dirichlet_mixture, input_tokens: 16, target_tokens: 16},
     steps: 8, warmup: {steps: 2}, batch: 12, micro_batch: 1, reduction: ordered, validate_every: 4, checkpoint_every: 2,
     optimizer: {shard: true}}
  predictions: {op: predict, model: mget, clips: clips, inputs: [camera], split: train}
";

fn mpirun(ranks: usize, folder: &Path, runs: &str) -> Command {
    let mut command = Command::new("mpirun");
    command
        .args([
            "--allow-run-as-root",
            "--oversubscribe",
            "--bind-to",
            "none",
            "-n",
        ])
        .arg(ranks.to_string())
        .arg(env!("CARGO_BIN_EXE_reviv"))
        .args(["run", "e.yaml", "--runs", runs])
        .current_dir(folder)
        .env("RAYON_NUM_THREADS", "1")
        .env("REVIV_PATIENCE", "10");
    command
}

fn setup() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("e.yaml"), EXPERIMENT).unwrap();
    folder
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn finished(output: &Output) {
    assert!(output.status.success(), "{}", text(output));
}

#[test]
fn two_three_and_four_processes_make_the_artifacts_of_one() {
    let folder = setup();
    let one = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["run", "e.yaml", "--runs", "1"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    finished(&one);
    let expected = artifacts(&Cache::of(&folder.path().join("1")));
    assert!(expected.len() > 10);
    for ranks in 2..=4 {
        let runs = ranks.to_string();
        let output = mpirun(ranks, folder.path(), &runs).output().unwrap();
        finished(&output);
        // One of them speaks.
        assert_eq!(
            text(&output).matches(": done: ").count(),
            1,
            "{}",
            text(&output)
        );
        let found = artifacts(&Cache::of(&folder.path().join(&runs)));
        assert_eq!(
            found.keys().collect::<Vec<_>>(),
            expected.keys().collect::<Vec<_>>()
        );
        for (name, bytes) in &found {
            assert!(*bytes == expected[name], "{ranks} processes: {name}");
        }
    }
}

/// The processes of a job, rank by rank.
fn processes(job: &Child) -> Vec<(usize, u32)> {
    let parent = format!("{}", job.id());
    let listing = Command::new("ps")
        .args(["-o", "pid=", "--ppid", &parent])
        .output()
        .unwrap();
    let listing = String::from_utf8(listing.stdout).unwrap();
    let mut found: Vec<(usize, u32)> = listing
        .split_whitespace()
        .filter_map(|pid| {
            let environment = std::fs::read(format!("/proc/{pid}/environ")).ok()?;
            let rank = environment.split(|byte| *byte == 0).find_map(|variable| {
                std::str::from_utf8(variable)
                    .ok()?
                    .strip_prefix("OMPI_COMM_WORLD_RANK=")
            })?;
            Some((rank.parse().ok()?, pid.parse().ok()?))
        })
        .collect();
    found.sort_unstable();
    found
}

fn signal(pid: u32, name: &str) {
    let sent = Command::new("kill")
        .args([name, &pid.to_string()])
        .status()
        .unwrap();
    assert!(sent.success());
}

/// Waits for the end, at most 30 s.
fn ends(mut job: Child) -> String {
    let start = Instant::now();
    while job.try_wait().unwrap().is_none() {
        assert!(
            start.elapsed() < Duration::from_secs(30),
            "the job goes on without a rank"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    let output = job.wait_with_output().unwrap();
    assert!(!output.status.success());
    text(&output)
}

/// Waits until the last training has come to `step`.
fn reaches(folder: &Path, runs: &str, job: &mut Child, step: u64) -> bool {
    loop {
        if job.try_wait().unwrap().is_some() {
            return false;
        }
        for run in RunDirectory::all(&folder.join(runs)).unwrap_or_default() {
            let metrics = run.path().join("stages/mget/metrics.jsonl");
            let steps = std::fs::read_to_string(metrics).unwrap_or_default();
            if steps.lines().count() as u64 >= step {
                return true;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_rank_killed_at_a_random_step_ends_the_job_and_another_number_of_ranks_continues() {
    let folder = setup();
    let seed = u64::from(std::process::id());
    finished(&mpirun(2, folder.path(), "whole").output().unwrap());
    let expected = artifacts(&Cache::of(&folder.path().join("whole")));
    let kills = std::env::var("REVIV_TEST_KILLS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(10);
    for attempt in 0..kills {
        let mut random = reviv::random::stream(seed, "test.ranks", attempt, 0);
        let (ranks, step) = (random.random_range(2..=4), random.random_range(1..7));
        let victim: usize = random.random_range(0..ranks);
        let runs = format!("killed{attempt}");
        let mut command = mpirun(ranks, folder.path(), &runs);
        let mut job = command
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let came = reaches(folder.path(), &runs, &mut job, step);
        assert!(came, "seed {seed}");
        let (_, pid) = processes(&job)[victim];
        signal(pid, "-KILL");
        let message = ends(job);
        assert!(
            message.contains(&format!("rank {victim} ")),
            "seed {seed}, rank {victim}: {message}"
        );
        let others = if ranks == 4 { 3 } else { ranks + 1 };
        finished(&mpirun(others, folder.path(), &runs).output().unwrap());
        let found = artifacts(&Cache::of(&folder.path().join(&runs)));
        assert_eq!(found.len(), expected.len());
        for (name, bytes) in &found {
            assert!(*bytes == expected[name], "seed {seed}: {name}");
        }
    }
}

#[test]
fn a_rank_that_hangs_ends_the_job_with_its_name() {
    let folder = setup();
    for victim in [1, 0] {
        let runs = format!("hangs{victim}");
        let mut command = mpirun(2, folder.path(), &runs);
        let mut job = command
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        assert!(reaches(folder.path(), &runs, &mut job, 1));
        let (_, pid) = processes(&job)[victim];
        signal(pid, "-STOP");
        let message = ends(job);
        let named = format!("rank {victim} of 2");
        assert!(
            message.contains(&named) && message.contains("silent"),
            "{message}"
        );
    }
}

#[test]
fn ranks_that_do_not_agree_are_named_before_anything_runs() {
    let folder = setup();
    let other = EXPERIMENT.replace("steps: 8", "steps: 9");
    std::fs::write(folder.path().join("other.yaml"), other).unwrap();
    let binary = env!("CARGO_BIN_EXE_reviv");
    let output = Command::new("mpirun")
        .args([
            "--allow-run-as-root",
            "--oversubscribe",
            "--bind-to",
            "none",
        ])
        .args([
            "-n",
            "1",
            binary,
            "run",
            "e.yaml",
            ":",
            "-n",
            "1",
            binary,
            "run",
            "other.yaml",
        ])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let message = text(&output);
    assert!(!output.status.success());
    assert!(message.contains("rank 1 of 2"), "{message}");
    assert!(
        message.contains("it reads another experiment than rank 0"),
        "{message}"
    );
    assert!(!folder.path().join("runs").join("index.jsonl").exists());
}
