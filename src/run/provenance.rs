//! Where everything came from: `source/` (byte copies of every layer), `resolved.yaml` (every value with the place that set
//! it), `plan.json` (what was promised) and `lock.json` (input hashes, git, machine, binary).

use super::environment::{Environment, now_text};
use super::error::RunError;
use super::files;
use super::job::Job;
use super::record::RunDirectory;
use super::schedule::{FilePlan, PLAN, Schedule};
use crate::experiment::resolved;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// `lock.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LockFile {
    /// When a process last began to work on the run, UTC.
    pub at: String,
    /// The machine, the binary, the command line and the state of git at that time.
    pub environment: Environment,
    /// Outside files and data sets that stages read, by path.
    pub files: Vec<FilePlan>,
}

/// Writes all four. A resumed run gets them anew; they say the same but for the machine and the time.
pub fn write(job: &Job<'_>, schedule: &Schedule, run: &RunDirectory) -> Result<(), RunError> {
    let project = match job.experiment.path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let environment = Environment::look(project);
    write_source(job, &environment, &run.path().join("source"))?;
    let resolved = resolved::to_yaml(job.experiment);
    files::write(&run.path().join("resolved.yaml"), resolved.as_bytes())?;
    files::write_json(&run.path().join(PLAN), schedule)?;
    let mut files: BTreeMap<&Path, &FilePlan> = BTreeMap::new();
    for file in schedule.works.iter().flat_map(|work| &work.files) {
        files.insert(&file.path, file);
    }
    let lock = LockFile {
        at: now_text(),
        environment,
        files: files.into_values().cloned().collect(),
    };
    files::write_json(&run.path().join("lock.json"), &lock)
}

/// Copies of the layers, numbered from weak to strong, and what was typed.
fn write_source(
    job: &Job<'_>,
    environment: &Environment,
    directory: &Path,
) -> Result<(), RunError> {
    files::create_directory(directory)?;
    let mut names = Vec::new();
    for (index, layer) in job.experiment.sources.iter().enumerate() {
        let file = format!("{index:02}-{}", file_name(&layer.name));
        files::write(&directory.join(&file), layer.text.as_bytes())?;
        names.push(serde_json::json!({"file": file, "layer": layer.name}));
    }
    files::write_json(&directory.join("layers.json"), &names)?;
    files::write_json(&directory.join("argv.json"), &environment.argv)?;
    let patch = directory.join("dirty.patch");
    match &environment.git {
        Some(git) if git.dirty => files::write(&patch, &git.patch),
        _ => files::remove(&patch),
    }
}

/// A layer's name as one file name.
fn file_name(layer: &str) -> String {
    let base = layer
        .trim_end_matches(" (built in)")
        .rsplit(['/', '\\'])
        .next()
        .unwrap_or(layer);
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() || ".-_=".contains(c) {
            c
        } else {
            '_'
        }
    };
    base.chars().map(plain).take(80).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_become_plain_file_names() {
        assert_eq!(
            file_name("registry/masking/uniform.yaml (built in)"),
            "uniform.yaml"
        );
        assert_eq!(
            file_name("--set stages.mget.steps=10"),
            "--set_stages.mget.steps=10"
        );
        assert_eq!(file_name("../../etc/passwd"), "passwd");
    }
}
