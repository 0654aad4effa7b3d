//! Bad input at the door: whatever it is given, the binary says what is wrong, exits with 1 and never panics.

use reviv::run::Cache;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

const SMALL: &str = "
experiment: small
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 8, rooms: 2}}, train: 2}
  statistics: {op: statistics, clips: clips}
";

fn reviv(arguments: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(arguments)
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Every command that reads an experiment refuses it with this code, soon, in few words.
fn refused(folder: &Path, file: &str, code: &str) {
    for arguments in [
        &["check", file][..],
        &["plan", file],
        &["run", file],
        &["why", file, "stages"],
    ] {
        let start = Instant::now();
        let output = reviv(arguments, folder);
        let said = said(&output);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
        assert!(said.contains(code), "{arguments:?} without {code}: {said}");
        assert!(!said.contains("panicked"), "{arguments:?}: {said}");
        assert!(
            said.len() < 20_000,
            "{arguments:?} says {} bytes",
            said.len()
        );
        assert!(start.elapsed() < Duration::from_secs(20), "{arguments:?}");
    }
    assert!(!folder.join("runs").exists(), "nothing was begun");
}

#[test]
fn files_that_are_no_experiments_are_refused_at_the_door() {
    let mut block = String::from("experiment: a\nparams:\n");
    for level in 0..1000 {
        let _ = writeln!(block, "{}k:", " ".repeat(level + 1));
    }
    let mut bomb =
        String::from("experiment: a\nparams:\n  l0: &l0 [x, x, x, x, x, x, x, x, x, x]\n");
    for level in 1..12 {
        let below = vec![format!("*l{}", level - 1); 10].join(", ");
        let _ = writeln!(bomb, "  l{level}: &l{level} [{below}]");
    }
    let cases: Vec<(&str, Vec<u8>, &str)> = vec![
        ("empty", Vec::new(), "E0101"),
        (
            "binary",
            b"\x7fELF\x02\x01\x01\x00\x00\xff".to_vec(),
            "E0101",
        ),
        ("large", b"a: b\n".repeat(2_000_000), "E0101"),
        (
            "flow",
            format!("experiment: {}{}", "[".repeat(1000), "]".repeat(1000)).into(),
            "E0103",
        ),
        ("block", block.into(), "E0103"),
        ("bomb", bomb.into(), "E0103"),
        ("itself", b"experiment: &a [*a]\n".to_vec(), "E0102"),
        (
            "tabs",
            b"experiment: a\nstages:\n\tclips: {op: clips}\n".to_vec(),
            "E0102",
        ),
        ("latin", b"experiment: caf\xe9\n".to_vec(), "E0101"),
        ("wide", b"\xff\xfee\x00x\x00".to_vec(), "E0101"),
        (
            "circle",
            b"extends: circle.yaml\nexperiment: a\n".to_vec(),
            "E0104",
        ),
        (
            "one",
            b"extends: other.yaml\nexperiment: a\n".to_vec(),
            "E0104",
        ),
        (
            "stages",
            b"experiment: a\nstages: {s: {op: statistics, clips: stages/s}}\n".to_vec(),
            "E0302",
        ),
        (
            "base",
            b"sweep: a\nbase: base.yaml\narms: {a: {}}\n".to_vec(),
            "E0206",
        ),
        (
            "set",
            b"experiment: ''\nseed: -1\nstages: [1]\n".to_vec(),
            "E0202",
        ),
    ];
    for (name, bytes, code) in cases {
        let folder = tempfile::tempdir().unwrap();
        let file = format!("{name}.yaml");
        std::fs::write(folder.path().join(&file), bytes).unwrap();
        std::fs::write(folder.path().join("other.yaml"), "extends: one.yaml\n").unwrap();
        refused(folder.path(), &file, code);
    }
    let folder = tempfile::tempdir().unwrap();
    refused(folder.path(), "absent.yaml", "E0101");
    refused(folder.path(), ".", "E0101");
    if cfg!(target_os = "linux") {
        refused(folder.path(), "/dev/zero", "E0101");
    }
}

#[test]
fn what_lies_beside_an_experiment_is_no_more_trusted() {
    for (name, code) in [("registry/masking/a.yaml", "E0"), ("data.yaml", "E010")] {
        for bytes in [
            &b"\x00\x01\x02"[..],
            b"\xff\xfe\xfd",
            b"masking: uniform\n\t- x\n",
            b"{{{{",
        ] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, bytes).unwrap();
            std::fs::write(folder.path().join("a.yaml"), SMALL).unwrap();
            refused(folder.path(), "a.yaml", code);
        }
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.yaml"), SMALL).unwrap();
    for set in [
        "",
        "=",
        "stages",
        "stages.clips.train={{{",
        "a.b.c.d=[",
        "stages.clips.train=&a [*a]",
    ] {
        let output = reviv(&["check", "a.yaml", "--set", set], folder.path());
        assert_eq!(output.status.code(), Some(1), "{set}: {}", said(&output));
        assert!(!said(&output).contains("panicked"), "{set}");
    }
}

/// The artifact of an op: its folder in the cache.
fn artifact(runs: &Path, file: &str) -> PathBuf {
    let entries = Cache::of(runs).entries().unwrap();
    let mut found = entries.into_iter().map(|leaf| leaf.path.join(file));
    found.find(|path| path.is_file()).unwrap()
}

#[test]
fn a_cache_entry_that_is_half_there_is_made_again() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.yaml"), SMALL).unwrap();
    assert!(reviv(&["run", "a.yaml"], folder.path()).status.success());
    let runs = folder.path().join("runs");
    let path = artifact(&runs, "statistics.json");
    let whole = std::fs::read(&path).unwrap();
    let manifest = path.with_file_name("manifest.json");
    for damage in ["cut", "no manifest", "half a manifest", "a folder"] {
        match damage {
            "cut" => std::fs::write(&path, &whole[..whole.len() / 2]).unwrap(),
            "no manifest" => std::fs::remove_file(&manifest).unwrap(),
            "half a manifest" => {
                let text = std::fs::read(&manifest).unwrap();
                std::fs::write(&manifest, &text[..text.len() / 2]).unwrap();
            }
            _ => {
                std::fs::remove_file(&path).unwrap();
                std::fs::create_dir(&path).unwrap();
            }
        }
        let output = reviv(&["run", "a.yaml"], folder.path());
        let said = said(&output);
        assert!(output.status.success(), "{damage}: {said}");
        assert!(said.contains("damaged"), "{damage}: {said}");
        assert!(said.contains("1 made, 1 found"), "{damage}: {said}");
        assert_eq!(std::fs::read(&path).unwrap(), whole, "{damage}");
    }
}

#[test]
fn a_run_that_another_live_process_owns_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let long = SMALL.replace("train: 2", "train: 100000");
    std::fs::write(folder.path().join("a.yaml"), long).unwrap();
    let mut owner = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["run", "a.yaml"])
        .current_dir(folder.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let start = Instant::now();
    let working = || {
        let runs = reviv::run::RunDirectory::all(&folder.path().join("runs")).unwrap_or_default();
        runs.iter()
            .any(|run| run.path().join("stages/clips/stage.json").exists())
    };
    while !working() && start.elapsed() < Duration::from_mins(1) {
        std::thread::sleep(Duration::from_millis(20));
    }
    let output = reviv(&["run", "a.yaml"], folder.path());
    let pid = format!("pid {}", owner.id());
    owner.kill().unwrap();
    owner.wait().unwrap();
    let said = said(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("error[E0801]") && said.contains(&pid),
        "{said}"
    );
}

#[cfg(target_os = "linux")]
#[test]
fn a_folder_that_cannot_be_written_is_refused_with_the_way_out() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.yaml"), SMALL).unwrap();
    let closed = folder.path().join("closed");
    std::fs::create_dir(&closed).unwrap();
    // Permissions do not stop everybody; a disk mounted read-only does.
    let script = "mount -t tmpfs -o ro tmpfs closed && exec \"$0\" run a.yaml --runs closed/runs";
    let output = Command::new("unshare")
        .args(["--user", "--map-root-user", "--mount", "sh", "-c", script])
        .arg(env!("CARGO_BIN_EXE_reviv"))
        .current_dir(folder.path())
        .output();
    match output {
        Ok(output) if !said(&output).contains("unshare") && !said(&output).contains("mount:") => {
            let said = said(&output);
            assert_eq!(output.status.code(), Some(1), "{said}");
            assert!(
                said.contains("error[E0802]") && said.contains("--runs DIR"),
                "{said}"
            );
        }
        _ => crate::skipped::skipped("no disk of one's own in a user namespace here"),
    }
    // Where a file stands in the way, nobody gets through.
    std::fs::write(folder.path().join("file"), "").unwrap();
    let output = reviv(&["run", "a.yaml", "--runs", "file/runs"], folder.path());
    assert!(
        matches!(output.status.code(), Some(1 | 2)),
        "{}",
        said(&output)
    );
    assert!(!said(&output).contains("panicked"));
}
