//! `resolved.yaml`: every value of a cell with the place it came from.

use super::graph::{Cell, Experiment, Stage};
use serde_json::Value;
use std::fmt::Write as _;

/// The resolved stages of a cell as YAML, each value with `# from file:line`.
pub fn to_yaml(experiment: &Experiment, cell: &Cell) -> String {
    let mut text = String::new();
    let _ = writeln!(text, "experiment: {}", scalar(&experiment.name));
    if !cell.arm.is_empty() {
        let _ = writeln!(text, "# arm {}", cell.arm);
    }
    let _ = writeln!(text, "seed: {}\nstages:", cell.seed);
    for stage in &cell.graph.stages {
        let _ = writeln!(text, "  {}:", scalar(&stage.name));
        let _ = writeln!(text, "    op: {}", stage.op.name());
        for edge in &stage.edges {
            let names: Vec<String> = edge
                .from
                .iter()
                .map(|&index| scalar(&cell.graph.stages[index].name))
                .collect();
            let value = if stage.traces.contains_key(&format!("{}.1", edge.port)) || names.len() > 1
            {
                format!("[{}]", names.join(", "))
            } else {
                names.join(", ")
            };
            line(
                &mut text, experiment, stage, 4, edge.port, &value, edge.port,
            );
        }
        if let Value::Object(map) = &stage.settings {
            for (key, value) in map {
                emit(&mut text, experiment, stage, 4, key, value, key);
            }
        }
        if stage.op.seeded() {
            let _ = writeln!(text, "    seed: {}", stage.seed);
        }
    }
    text
}

fn emit(
    text: &mut String,
    experiment: &Experiment,
    stage: &Stage,
    indent: usize,
    key: &str,
    value: &Value,
    path: &str,
) {
    match value {
        Value::Object(map) if !map.is_empty() => {
            let _ = writeln!(text, "{:indent$}{}:", "", scalar(key));
            for (key, value) in map {
                let path = format!("{path}.{key}");
                emit(text, experiment, stage, indent + 2, key, value, &path);
            }
        }
        other => line(text, experiment, stage, indent, key, &flow(other), path),
    }
}

fn line(
    text: &mut String,
    experiment: &Experiment,
    stage: &Stage,
    indent: usize,
    key: &str,
    value: &str,
    path: &str,
) {
    let from = stage.traces.get(path).map_or_else(
        || "default".to_owned(),
        |trace| format!("from {}", experiment.sources.cite(trace.span)),
    );
    let _ = writeln!(text, "{:indent$}{}: {value}  # {from}", "", scalar(key));
}

fn flow(value: &Value) -> String {
    match value {
        Value::String(text) => scalar(text),
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(flow).collect();
            format!("[{}]", items.join(", "))
        }
        Value::Object(map) => {
            let items: Vec<String> = map
                .iter()
                .map(|(key, value)| format!("{}: {}", scalar(key), flow(value)))
                .collect();
            format!("{{{}}}", items.join(", "))
        }
        other => other.to_string(),
    }
}

/// Text as a YAML scalar: plain where it reads back as the same text, quoted otherwise.
fn scalar(text: &str) -> String {
    let plain = !text.is_empty()
        && text
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | '/' | '@'))
        && !text.starts_with('-')
        && matches!(super::yaml::plain(text), super::yaml::Data::Text(_));
    if plain {
        text.to_owned()
    } else {
        Value::String(text.to_owned()).to_string()
    }
}
