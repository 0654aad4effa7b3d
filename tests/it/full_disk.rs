//! A disk that is really full, at every size: the run fails cleanly, what was finished stays, and it goes on with more space.
#![cfg(target_os = "linux")]

use crate::kill_binary::BASE;
use crate::run::artifacts;
use reviv::run::Cache;
use reviv::run::record::RunDirectory;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Set for the process that has a disk of its own.
const FOLDER: &str = "REVIV_TEST_FULL_DISK";

/// A disk of that many KiB in memory, seen by this process and its children only.
fn mount(at: &Path, kib: u64, again: bool) {
    let options = format!("{}size={kib}k", if again { "remount," } else { "" });
    let mut mount = Command::new("mount");
    mount.args(["-t", "tmpfs", "-o", &options, "tmpfs"]).arg(at);
    assert!(mount.status().unwrap().success(), "mount {options}");
}

fn used_kib(at: &Path) -> u64 {
    let output = Command::new("df")
        .args(["-k", "--output=used"])
        .arg(at)
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().last().unwrap().trim().parse().unwrap()
}

fn run(file: &Path, runs: &Path) -> Output {
    let mut reviv = Command::new(env!("CARGO_BIN_EXE_reviv"));
    reviv
        .arg("run")
        .arg(file)
        .arg("--runs")
        .arg(runs)
        .output()
        .unwrap()
}

/// Runs on a disk that is too small for it. Gives what was finished.
fn must_fail(file: &Path, runs: &Path, kib: u64) -> BTreeMap<String, Vec<u8>> {
    let before = artifacts(&Cache::of(runs));
    let output = run(file, runs);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{kib} KiB: {said}");
    assert!(
        said.contains("error[E0502]: no space left"),
        "{kib} KiB: {said}"
    );
    assert!(said.contains("help: free some space"), "{kib} KiB: {said}");
    assert!(!said.contains("panicked"), "{kib} KiB: {said}");
    assert_eq!(said.matches("error[").count(), 1, "told once: {said}");
    let after = artifacts(&Cache::of(runs));
    for (name, bytes) in &before {
        assert!(after.get(name) == Some(bytes), "{kib} KiB: lost {name}");
    }
    for run in RunDirectory::all(runs).unwrap() {
        run.read().unwrap();
    }
    after
}

#[test]
#[ignore = "the process with a disk of its own that the test below starts"]
fn inside() {
    let Some(folder) = std::env::var_os(FOLDER).map(PathBuf::from) else {
        return;
    };
    let file = folder.join("base.yaml");
    let (disk, untouched) = (folder.join("disk"), folder.join("untouched"));
    let runs = disk.join("runs");
    assert!(run(&file, &untouched).status.success());
    mount(&disk, 16, false);
    // Too small for the run's own record, then for the clips.
    for kib in [16, 40, 80, 160, 320] {
        mount(&disk, kib, true);
        must_fail(&file, &runs, kib);
    }
    // Clips and their statistics fit, a checkpoint of the tokenizer does not.
    mount(&disk, 1200, true);
    let finished = must_fail(&file, &runs, 1200);
    let whole = |op: &str| {
        let manifests = finished
            .iter()
            .filter(|(name, _)| name.ends_with("/manifest.json"));
        manifests
            .filter(|(_, bytes)| {
                String::from_utf8_lossy(bytes).contains(&format!("\"op\": \"{op}\""))
            })
            .count()
    };
    assert_eq!(
        (
            whole("clips"),
            whole("statistics"),
            whole("train_tokenizer")
        ),
        (1, 1, 0)
    );
    // Full to the last page, and a page more each time: the record, the metrics, the events, the log.
    let used = used_kib(&disk);
    for pages in 0..8 {
        mount(&disk, used + 4 * pages, true);
        must_fail(&file, &runs, used + 4 * pages);
    }
    // One checkpoint, then two, but no room for what comes after them.
    for kib in [3000, 4500] {
        mount(&disk, kib, true);
        must_fail(&file, &runs, kib);
    }
    mount(&disk, 65536, true);
    let output = run(&file, &runs);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("1 made, 2 found in the cache"), "{said}");
    assert!(artifacts(&Cache::of(&runs)) == artifacts(&Cache::of(&untouched)));
    assert_eq!(RunDirectory::all(&runs).unwrap().len(), 1);
}

#[test]
fn a_run_on_a_full_disk_fails_cleanly_and_continues_with_more_space() {
    let folder = tempfile::tempdir().unwrap();
    let disk = folder.path().join("disk");
    std::fs::create_dir(&disk).unwrap();
    std::fs::write(folder.path().join("base.yaml"), BASE).unwrap();
    let namespace = ["--user", "--map-root-user", "--mount"];
    let allowed = Command::new("unshare")
        .args(namespace)
        .args(["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs"])
        .arg(&disk)
        .output();
    if !allowed.is_ok_and(|output| output.status.success()) {
        crate::skipped::skipped("no disk of one's own in a user namespace here");
        return;
    }
    let output = Command::new("unshare")
        .args(namespace)
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "full_disk::inside", "--ignored", "--nocapture"])
        .env(FOLDER, folder.path())
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}
