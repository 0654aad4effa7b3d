//! Where everything came from: `source/` (byte copies of every layer), `resolved.yaml` (every value with the place that set
//! it), `plan.json` (what was promised) and `lock.json` (input hashes, git, machine, binary).

use super::environment::{Environment, now_text};
use super::error::RunError;
use super::execute::Job;
use super::files;
use super::record::RunDirectory;
use super::schedule::{FilePlan, Schedule};
use crate::experiment::Stage;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

/// `lock.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LockFile {
    /// When a process last began to work on the run, UTC.
    pub at: String,
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
    files::write(&run.path().join("resolved.yaml"), resolved(job).as_bytes())?;
    files::write_json(&run.path().join("plan.json"), schedule)?;
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

/// Every value of every stage, each with `# from file:line`.
fn resolved(job: &Job<'_>) -> String {
    let mut text = String::new();
    let experiment = job.experiment;
    let _ = writeln!(
        text,
        "# Every value of `{}`, and where it was written. Values without a place are defaults.",
        experiment.name
    );
    // Cells that agree on a stage show it once.
    let mut seen: BTreeSet<String> = BTreeSet::new();
    for cell in &experiment.cells {
        let _ = writeln!(text, "---");
        if experiment.sweep {
            let _ = writeln!(text, "cell: {}", scalar(&Value::String(cell.label())));
        }
        let _ = writeln!(text, "seed: {}\nstages:", cell.seed);
        for stage in &cell.graph.stages {
            let name = scalar(&Value::String(stage.name.clone()));
            let written = write_stage(job, stage, &cell.graph.stages);
            if seen.insert(format!("{name}{written}")) {
                let _ = write!(text, "  {name}:\n{written}");
            } else {
                let _ = writeln!(text, "  {name}: {{}} # as above");
            }
        }
    }
    text
}

fn write_stage(job: &Job<'_>, stage: &Stage, all: &[Stage]) -> String {
    let mut text = format!("    op: {}\n", stage.op.name());
    for edge in &stage.edges {
        let names: Vec<String> = edge
            .from
            .iter()
            .map(|&i| scalar(&Value::String(all[i].name.clone())))
            .collect();
        let names = if names.len() == 1 {
            names.concat()
        } else {
            format!("[{}]", names.join(", "))
        };
        let from = origin(job, stage, edge.port);
        let _ = writeln!(text, "    {}: {names}{from}", edge.port);
    }
    if let Value::Object(settings) = &stage.settings {
        for (key, value) in settings {
            write_value(&mut text, job, stage, key, key, value, 4);
        }
    }
    if stage.op.seeded() {
        let from = origin(job, stage, "seed");
        let _ = writeln!(text, "    seed: {}{from}", stage.seed);
    }
    text
}

fn write_value(
    text: &mut String,
    job: &Job<'_>,
    stage: &Stage,
    path: &str,
    key: &str,
    value: &Value,
    indent: usize,
) {
    let key = if key == "-" {
        "-".to_owned()
    } else {
        format!("{}:", scalar(&Value::String(key.to_owned())))
    };
    let _ = write!(text, "{:indent$}{key}", "");
    let simple = |value: &Value| !value.is_object() && !value.is_array();
    match value {
        Value::Object(map) if !map.is_empty() => {
            let _ = writeln!(text);
            for (name, value) in map {
                write_value(
                    text,
                    job,
                    stage,
                    &format!("{path}.{name}"),
                    name,
                    value,
                    indent + 2,
                );
            }
        }
        Value::Array(items) if !items.iter().all(simple) => {
            let _ = writeln!(text);
            for (index, value) in items.iter().enumerate() {
                write_value(
                    text,
                    job,
                    stage,
                    &format!("{path}.{index}"),
                    "-",
                    value,
                    indent + 2,
                );
            }
        }
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(scalar).collect();
            let _ = writeln!(text, " [{}]{}", items.join(", "), origin(job, stage, path));
        }
        value => {
            let _ = writeln!(text, " {}{}", scalar(value), origin(job, stage, path));
        }
    }
}

/// `  # from file:line` of a key, or of the nearest thing around it that was written.
fn origin(job: &Job<'_>, stage: &Stage, path: &str) -> String {
    let mut path = path;
    loop {
        if let Some(trace) = stage.traces.get(path) {
            return format!("  # from {}", job.experiment.sources.cite(trace.span));
        }
        match path.rsplit_once('.') {
            Some((outer, _)) => path = outer,
            None => return String::new(),
        }
    }
}

/// A scalar as YAML; a string stays plain only where no reader can take it for anything else.
fn scalar(value: &Value) -> String {
    if let Value::String(text) = value {
        let first = text
            .chars()
            .next()
            .is_some_and(|c| c.is_ascii_alphabetic() || c == '_');
        let plain = text
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c));
        let word = ["true", "false", "null", "yes", "no", "on", "off"]
            .contains(&text.to_lowercase().as_str());
        if first && plain && !word {
            return text.clone();
        }
    }
    // JSON's scalars are YAML's.
    value.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn strings_that_look_like_something_else_are_quoted() {
        let written: Vec<String> = ["body", "a-b/c.d", "true", "1e3", "", "a: b", "#x", "No"]
            .map(|s| scalar(&json!(s)))
            .into();
        assert_eq!(
            written,
            [
                "body", "a-b/c.d", "\"true\"", "\"1e3\"", "\"\"", "\"a: b\"", "\"#x\"", "\"No\""
            ]
        );
    }

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
