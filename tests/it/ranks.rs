//! Training on several ranks: the same bytes as promised, and a job that ends when a rank does.

use crate::training::{Setup, clips, spec};
use reviv::engine::communicator::reduce::Reduction;
use reviv::engine::{Communicator, Compute, Parameters};
use reviv::training::{Event, Flow, HeldOut, Keep, MgetFit, TrainingError, TrainingSettings};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const STEPS: u64 = 8;

fn settings(reduction: Reduction, micro_batch: usize) -> TrainingSettings {
    TrainingSettings {
        steps: Some(STEPS),
        batch: 12,
        micro_batch,
        reduction,
        learning_rate: 4e-3,
        validate_every: 3,
        checkpoint_every: 5,
        keep: Keep::Best,
        ..TrainingSettings::default()
    }
}

/// What a rank has in the end, and what it was told on the way.
#[derive(Debug, PartialEq)]
struct Trained {
    weights: Vec<u8>,
    held_out: HeldOut,
    losses: Vec<u64>,
}

fn train(
    ranks: Communicator,
    settings: &TrainingSettings,
    checkpoints: &Path,
    resume: Option<PathBuf>,
) -> Result<Trained, TrainingError> {
    let root = ranks.is_root();
    let mut losses = Vec::new();
    let fitted = MgetFit {
        spec: spec(),
        masking: Setup::masking(),
        sources: vec![Arc::new(clips(64, 1))],
        lengths: vec![64],
        weights: None,
        held_out: &clips(20, 2),
        settings,
        compute: &Compute::cpu(),
        ranks,
        seed: 5,
        resume,
        clock: &|| 0.0,
    }
    .run::<TrainingError>(&mut |event| {
        match event {
            Event::Step { report, .. } => losses.push(report.loss.to_bits()),
            Event::Checkpoint(state) if root => {
                let folder = checkpoints.join(state.step().to_string());
                std::fs::create_dir_all(&folder).unwrap();
                state.save(&folder)?;
            }
            _ => {}
        }
        Ok(Flow::Continue)
    })?;
    Ok(Trained {
        weights: fitted.model.weights().to_bytes(),
        held_out: fitted.held_out,
        losses,
    })
}

/// The same on `size` threads; what rank 0 has, once all are found to have it.
fn together(
    size: usize,
    settings: &TrainingSettings,
    checkpoints: &Path,
    resume: Option<&Path>,
) -> Trained {
    let mut all = std::thread::scope(|scope| {
        let threads: Vec<_> = Communicator::threads(size)
            .into_iter()
            .map(|ranks| {
                let resume = resume.map(Path::to_path_buf);
                scope.spawn(move || train(ranks, settings, checkpoints, resume).unwrap())
            })
            .collect();
        let ended = threads.into_iter().map(|thread| thread.join().unwrap());
        ended.collect::<Vec<_>>()
    });
    let first = all.swap_remove(0);
    for other in &all {
        assert_eq!(*other, first, "{size} ranks do not have the same");
    }
    first
}

/// The checkpoints after five steps have the same bytes.
fn assert_same_checkpoint(found: &Path, expected: &Path, size: usize) {
    for file in [
        "weights.safetensors",
        "optimizer.safetensors",
        "progress.json",
    ] {
        let read = |run: &Path| std::fs::read(run.join("5").join(file)).unwrap();
        assert!(read(found) == read(expected), "{size} ranks: {file}");
    }
}

#[test]
fn in_the_order_of_samples_any_number_of_ranks_trains_to_the_same_bytes() {
    let settings = settings(Reduction::Ordered, 1);
    let folder = tempfile::tempdir().unwrap();
    let alone = folder.path().join("alone");
    let expected = train(Communicator::alone(), &settings, &alone, None).unwrap();
    for size in 1..=4 {
        let own = folder.path().join(size.to_string());
        assert_eq!(
            together(size, &settings, &own, None),
            expected,
            "{size} ranks"
        );
        assert_same_checkpoint(&own, &alone, size);
        // What was begun by one number of ranks goes on with another.
        let resumed = together(5 - size, &settings, &own, Some(&own.join("5")));
        assert_eq!(
            resumed.weights, expected.weights,
            "{size} ranks, then others"
        );
    }
}

#[test]
fn the_same_number_of_ranks_trains_to_the_same_bytes_and_others_to_rounding() {
    let folder = tempfile::tempdir().unwrap();
    for micro_batch in [0, 2] {
        let settings = settings(Reduction::Fast, micro_batch);
        let alone = train(Communicator::alone(), &settings, folder.path(), None).unwrap();
        for size in [2, 3] {
            let first = together(size, &settings, folder.path(), None);
            assert_eq!(together(size, &settings, folder.path(), None), first);
            // A step's loss is a mean of means over micro-batches: another cut is another loss, the same cut the same to rounding.
            let (a, b) = (
                f64::from_bits(alone.losses[7]),
                f64::from_bits(first.losses[7]),
            );
            assert!(
                micro_batch == 0 || (a - b).abs() < 1e-3 * a,
                "{size} ranks: {a} {b}"
            );
        }
    }
}

#[test]
fn ranks_that_share_the_optimizer_s_state_train_to_the_same_bytes_and_checkpoints_are_those_of_one()
{
    let folder = tempfile::tempdir().unwrap();
    for (reduction, micro_batch) in [(Reduction::Ordered, 1), (Reduction::Fast, 2)] {
        let settings = settings(reduction, micro_batch);
        let mut sharded = settings.clone();
        sharded.optimizer.shard = true;
        for size in [2, 3, 4] {
            if reduction == Reduction::Fast && size == 4 {
                continue;
            }
            let name = |what: &str| folder.path().join(format!("{reduction:?} {size} {what}"));
            let (own, other) = (name("sharded"), name("whole"));
            let expected = together(size, &settings, &other, None);
            assert_eq!(
                together(size, &sharded, &own, None),
                expected,
                "{size} ranks"
            );
            assert_same_checkpoint(&own, &other, size);
            if reduction == Reduction::Ordered {
                let checkpoint = own.join("5");
                let resumed = together(6 - size, &sharded, &own, Some(&checkpoint));
                assert_eq!(
                    resumed.weights, expected.weights,
                    "{size} ranks, then others"
                );
                let alone = train(
                    Communicator::alone(),
                    &sharded,
                    &name("alone"),
                    Some(checkpoint),
                );
                assert_eq!(alone.unwrap().weights, expected.weights, "then one");
            }
        }
    }
}

/// With activation checkpointing a block's gradients are complete as well while backward goes on.
#[test]
fn activation_checkpointing_trains_to_the_same_bytes_on_any_number_of_ranks() {
    let settings = TrainingSettings {
        activation_checkpointing: true,
        steps: Some(3),
        checkpoint_every: 0,
        ..settings(Reduction::Ordered, 1)
    };
    let folder = tempfile::tempdir().unwrap();
    let expected = train(Communicator::alone(), &settings, folder.path(), None).unwrap();
    for size in [2, 3] {
        let found = together(size, &settings, folder.path(), None);
        assert_eq!(found, expected, "{size} ranks");
    }
}

#[test]
fn a_batch_that_does_not_divide_is_refused_with_the_way_out() {
    let refused = |reduction, micro_batch, size: usize| {
        let settings = settings(reduction, micro_batch);
        let ranks = Communicator::threads(size).swap_remove(0);
        let error = train(ranks, &settings, Path::new(""), None).unwrap_err();
        error.to_string()
    };
    let message = refused(Reduction::Fast, 0, 5);
    assert!(
        message.contains("`batch` of 12") && message.contains("multiple of 5"),
        "{message}"
    );
    let message = refused(Reduction::Ordered, 0, 2);
    assert!(message.contains("makes 1 parts"), "{message}");
    let message = refused(Reduction::Fast, 4, 2);
    assert!(
        message.contains("micro-batches of 4 makes 3 parts"),
        "{message}"
    );
}

/// A build without MPI that a launcher starts several times is told once, and nothing is written.
#[cfg(not(feature = "mpi"))]
#[test]
fn processes_that_cannot_reach_each_other_say_so_once() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("e.yaml"), crate::kill_binary::BASE).unwrap();
    let start = |rank: &str| {
        std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
            .args(["run", "e.yaml"])
            .current_dir(folder.path())
            .env("OMPI_COMM_WORLD_SIZE", "4")
            .env("OMPI_COMM_WORLD_RANK", rank)
            .output()
            .unwrap()
    };
    let (first, second) = (start("0"), start("1"));
    assert_eq!(
        (first.status.code(), second.status.code()),
        (Some(1), Some(1))
    );
    let message = String::from_utf8(first.stderr).unwrap();
    assert!(
        message.contains("started 4 processes") && message.contains("--features mpi"),
        "{message}"
    );
    assert!(second.stderr.is_empty() && second.stdout.is_empty());
    assert!(!folder.path().join("runs").exists());
}
