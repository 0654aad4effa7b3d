//! Bytes that flip in the cache: who notices, who lists them, who makes them again, and that pruning beside a run loses nothing.

use crate::run::{artifacts, cell, experiment, run};
use reviv::run::execute::{Job, execute};
use reviv::run::gc::{Options, prune};
use reviv::run::verify::{Check, How, Redo, Verdict, verify};
use reviv::run::{Cache, Interrupt, Progress, RunDirectory, Shard, State, WorkerPool, files};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Flips one bit in the middle of a file; its size stays.
fn flip(path: &Path) {
    let mut bytes = std::fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(path, bytes).unwrap();
}

fn numbers_of(runs: &Path) -> PathBuf {
    let mut found: Vec<PathBuf> = Cache::of(runs)
        .entries()
        .unwrap()
        .into_iter()
        .filter(|leaf| leaf.extension.is_empty())
        .map(|leaf| leaf.path.join("numbers.json"))
        .filter(|path| path.is_file())
        .collect();
    assert_eq!(found.len(), 1);
    found.remove(0)
}

fn look(run: &RunDirectory, redo: Redo, repair: bool) -> Vec<Check> {
    let how = How { redo, repair };
    verify(run, how, &Progress::silent(), &Interrupt::default()).unwrap()
}

fn verdict(checks: &[Check], what: &str) -> Verdict {
    let found = checks.iter().find(|check| check.what == what);
    found.unwrap_or_else(|| panic!("{checks:?}")).verdict
}

#[test]
fn a_run_notices_a_flipped_bit_that_nothing_reads_and_makes_it_again() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]);
    run(&asked, dir.path());
    let whole = artifacts(&Cache::of(dir.path()));
    // The sum is whole, so that nothing would have to read the numbers.
    flip(&numbers_of(dir.path()));
    let again = run(&asked, dir.path());
    assert_eq!((again.state, again.made), (State::Done, 1));
    assert_eq!(run(&asked, dir.path()).made, 0);
    let mut now = artifacts(&Cache::of(dir.path()));
    now.retain(|name, _| whole.contains_key(name));
    assert!(now == whole);
}

#[test]
fn with_check_a_run_finds_what_changed_behind_the_back_of_the_file_system() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 25}), 1.0)]);
    run(&asked, dir.path());
    let numbers = numbers_of(dir.path());
    flip(&numbers);
    // A disk that went bad tells nobody: the note of when the files were seen has the times they have now.
    let artifact = numbers.parent().unwrap();
    let seen = artifact.with_extension("seen.json");
    let mut note: serde_json::Value = files::read_json(&seen).unwrap();
    for (name, stamp) in note.as_object_mut().unwrap() {
        use std::os::unix::fs::MetadataExt;
        let meta = std::fs::metadata(artifact.join(name)).unwrap();
        *stamp = json!([
            meta.mtime(),
            meta.mtime_nsec(),
            meta.ctime(),
            meta.ctime_nsec()
        ]);
    }
    files::write_json(&seen, &note).unwrap();
    assert_eq!(run(&asked, dir.path()).made, 0, "believed");
    let checked = execute(&Job {
        experiment: &asked,
        runs: dir.path(),
        only: None,
        shard: Shard::WHOLE,
        check: true,
        crew: WorkerPool::alone(),
        progress: &Progress::silent(),
        interrupt: &Interrupt::default(),
    })
    .unwrap();
    assert_eq!((checked.state, checked.made), (State::Done, 1));
}

#[test]
fn verify_lists_everything_although_a_stage_cannot_be_redone_and_repairs_it() {
    let dir = tempfile::tempdir().unwrap();
    let asked = experiment(vec![cell("", 0, json!({"steps": 5}), 1.0)]);
    let first = run(&asked, dir.path());
    let whole = artifacts(&Cache::of(dir.path()));
    flip(&numbers_of(dir.path()));
    let checks = look(&first.run, Redo::All, false);
    assert_eq!(verdict(&checks, "numbers"), Verdict::Changed);
    assert_eq!(verdict(&checks, "total"), Verdict::Same);
    // What it reads is damaged: a finding, and not the end of the list.
    assert!(
        [Verdict::Changed, Verdict::Failed].contains(&verdict(&checks, "total, again")),
        "{checks:?}"
    );
    let checks = look(&first.run, Redo::All, true);
    assert_eq!(verdict(&checks, "numbers"), Verdict::Repaired);
    assert_eq!(verdict(&checks, "total, again"), Verdict::Same);
    let mut now = artifacts(&Cache::of(dir.path()));
    now.retain(|name, _| whole.contains_key(name));
    assert!(now == whole);
    let checks = look(&first.run, Redo::All, false);
    assert!(
        checks.iter().all(|check| check.verdict == Verdict::Same),
        "{checks:?}"
    );

    std::fs::remove_dir_all(numbers_of(dir.path()).parent().unwrap()).unwrap();
    let checks = look(&first.run, Redo::Nothing, true);
    assert_eq!(verdict(&checks, "numbers"), Verdict::Repaired, "{checks:?}");
}

#[test]
fn pruning_beside_runs_loses_nothing_that_they_refer_to() {
    let dir = tempfile::tempdir().unwrap();
    let over = AtomicBool::new(false);
    let runs = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                prune(dir.path(), Options::default()).unwrap();
            }
        });
        let workers: Vec<_> = (0..2_u64)
            .map(|worker| {
                let path = dir.path();
                scope.spawn(move || {
                    let one = |round: u64| {
                        let settings = json!({"steps": 20 + round});
                        run(&experiment(vec![cell("", worker, settings, 1.0)]), path)
                    };
                    (0..6).map(one).collect::<Vec<_>>()
                })
            })
            .collect();
        let done: Vec<_> = workers
            .into_iter()
            .flat_map(|w| w.join().unwrap())
            .collect();
        over.store(true, Ordering::Relaxed);
        done
    });
    for outcome in &runs {
        assert_eq!(outcome.state, State::Done, "{:?}", outcome.failures);
        let checks = look(&outcome.run, Redo::Nothing, false);
        assert!(
            checks.iter().all(|check| check.verdict == Verdict::Same),
            "{checks:?}"
        );
    }
    let kept = prune(dir.path(), Options::default()).unwrap().kept;
    assert_eq!(kept, 2 * runs.len());
}
