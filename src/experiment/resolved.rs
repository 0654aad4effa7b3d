//! `resolved.yaml`: every value of an experiment with the place it came from.

use super::graph::{Cell, Experiment, Stage};
use super::stage::Arity;
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// Every value of every cell, each with `# from file:line`: a YAML document per cell. The document of an experiment that is
/// no sweep reads back as the same experiment; the cells of a sweep write a stage that they share once.
pub fn to_yaml(experiment: &Experiment) -> String {
    let mut text = String::from("# Every value, and where it was written.\n");
    let mut seen = BTreeSet::new();
    for cell in &experiment.cells {
        if experiment.sweep {
            let _ = writeln!(text, "---\n# cell {}", on_one_line(&cell.label()));
        }
        let _ = writeln!(text, "experiment: {}", scalar(&experiment.name));
        let _ = writeln!(text, "seed: {}\nstages:", cell.seed);
        for stage in &cell.graph.stages {
            let name = scalar(&stage.name);
            let written = stage_to_yaml(experiment, cell, stage);
            if seen.insert(format!("{name}\n{written}")) {
                let _ = write!(text, "  {name}:\n{written}");
            } else {
                let _ = writeln!(text, "  {name}: {{}}  # as above");
            }
        }
    }
    text
}

fn stage_to_yaml(experiment: &Experiment, cell: &Cell, stage: &Stage) -> String {
    let mut text = format!("    op: {}\n", stage.op.name());
    for edge in &stage.edges {
        let names: Vec<String> = edge
            .from
            .iter()
            .map(|&index| scalar(&cell.graph.stages[index].name))
            .collect();
        let port = stage.op.inputs().iter().find(|port| port.name == edge.port);
        let many = port.is_some_and(|port| match port.arity {
            Arity::Many | Arity::Any => true,
            Arity::OneOrMore => names.len() > 1,
            Arity::One | Arity::Optional => false,
        });
        let value = if many {
            format!("[{}]", names.join(", "))
        } else {
            names.concat()
        };
        line(
            &mut text, experiment, stage, 4, edge.port, &value, edge.port,
        );
    }
    if let Value::Object(map) = stage.settings.json() {
        for (key, value) in map {
            emit(&mut text, experiment, stage, 4, key, value, key);
        }
    }
    if stage.op.seeded() {
        let seed = stage.seed.to_string();
        match stage.traces.get("seed") {
            Some(_) => line(&mut text, experiment, stage, 4, "seed", &seed, "seed"),
            None => _ = writeln!(text, "    seed: {seed}  # of the run"),
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
        // What is nothing by default stays unwritten, for the eye alone.
        value if is_nothing(value) && !stage.traces.contains_key(path) => {
            let _ = writeln!(
                text,
                "{:indent$}# {}: {}  # default",
                "",
                scalar(key),
                flow(value)
            );
        }
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
    let written = |path: &str| stage.traces.get(path);
    let trace = written(path)
        // A list is written where its first item is,
        .or_else(|| written(&format!("{path}.0")))
        // and the name of a registry entry may stand for all of it.
        .or_else(|| path.strip_suffix(".use").and_then(written));
    let from = trace.map_or_else(
        || "default".to_owned(),
        |trace| format!("from {}", on_one_line(&experiment.sources.cite(trace.span))),
    );
    let _ = writeln!(text, "{:indent$}{}: {value}  # {from}", "", scalar(key));
}

/// Null, or a map of nothing else.
fn is_nothing(value: &Value) -> bool {
    match value {
        Value::Null => true,
        Value::Object(map) => !map.is_empty() && map.values().all(is_nothing),
        _ => false,
    }
}

/// Text that ends no comment.
fn on_one_line(text: &str) -> String {
    text.replace(char::is_control, " ")
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
