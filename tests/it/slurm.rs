//! The shipped array scripts give every job of an array a part of its own, wherever the array's numbers start.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

/// Something that prints what it was called with, or runs it.
fn program(folder: &Path, name: &str, text: &str) {
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// The part that a job of an array asks for: `3/16`.
fn part(bin: &Path, script: &str, array: &[usize], step: usize, job: usize) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/slurm");
    let search = std::env::var_os("PATH").unwrap_or_default();
    let places = std::iter::once(bin.to_owned()).chain(std::env::split_paths(&search));
    let output = Command::new("bash")
        .arg(path.join(script))
        .args(["one", "two"])
        .env("PATH", std::env::join_paths(places).unwrap())
        .env("SLURM_ARRAY_TASK_COUNT", array.len().to_string())
        .env("SLURM_ARRAY_TASK_MIN", array[0].to_string())
        .env("SLURM_ARRAY_TASK_STEP", step.to_string())
        .env("SLURM_ARRAY_TASK_ID", job.to_string())
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let said = String::from_utf8(output.stdout).unwrap();
    let mut words = said.split_whitespace();
    words.find(|word| *word == "--shard").unwrap();
    words.next().unwrap().to_owned()
}

#[test]
fn every_job_of_an_array_has_its_own_part_wherever_the_numbers_start() {
    let folder = tempfile::tempdir().unwrap();
    program(folder.path(), "reviv", "echo \"$@\"");
    program(folder.path(), "srun", "shift\nexec \"$@\"");
    for script in ["data_array.sh", "convert.sh", "tokenize.sh"] {
        for (first, step) in [(1, 1), (0, 1), (7, 1), (0, 2), (10, 5)] {
            let array: Vec<usize> = (0..4).map(|i| first + i * step).collect();
            let parts: Vec<String> = array
                .iter()
                .map(|&job| part(folder.path(), script, &array, step, job))
                .collect();
            assert_eq!(parts, ["1/4", "2/4", "3/4", "4/4"], "{script} {array:?}");
        }
    }
}
