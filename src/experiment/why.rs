//! Which layer set a value, and what it replaced.

use super::catalog::Catalog;
use super::diagnostic::Span;
use super::docs;
use super::graph::{Cell, Experiment, Graph, Head, Stage};
use super::names;
use super::source::Origin;
use super::typed::Trace;
use super::yaml::{self, Data, Node};
use serde::Serialize;
use serde_json::Value;
use std::fmt::Write as _;

/// The history of one value, newest first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Answer {
    /// The full key: `stages.mget.steps`, `params.x`.
    pub key: String,
    /// The value that holds, as text.
    pub value: String,
    /// The first line of the setting's docs; empty for keys that are no setting.
    pub about: String,
    /// Every layer that gave a value, the one that decided first; never empty.
    pub chain: Vec<Link>,
}

/// A layer that gave a value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Link {
    /// The value that it gave, as text.
    pub value: String,
    /// `experiments/tiny.yaml:11`.
    pub place: String,
    /// Which layer that is, in words.
    pub layer: String,
}

/// Explains a key (`stages.mget.steps`, or without `stages.`), or all keys of a stage.
///
/// # Errors
/// Words and a way out, when there is no such key.
pub fn explain(
    catalog: &Catalog,
    experiment: &Experiment,
    arm: Option<&str>,
    key: &str,
) -> Result<Vec<Answer>, (String, String)> {
    let cell = match arm {
        None => experiment.cells.first(),
        Some(arm) => experiment.cells.iter().find(|cell| cell.arm == arm),
    };
    let Some(cell) = cell else {
        let mut arms: Vec<&str> = experiment.cells.iter().map(|c| c.arm.as_str()).collect();
        arms.dedup();
        let arm = arm.unwrap_or("");
        return Err((
            format!("there is no arm `{arm}`"),
            names::suggest(arm, &arms).unwrap_or_default(),
        ));
    };
    let answers = head(experiment, cell, key);
    if !answers.is_empty() {
        return Ok(answers);
    }
    let short = key.strip_prefix("stages.").unwrap_or(key);
    let stages = stages_of(&cell.graph, short);
    if stages.is_empty() {
        let mut known: Vec<&str> = cell.graph.stages.iter().map(|s| s.name.as_str()).collect();
        known.extend(cell.graph.groups.iter().map(|group| group.name.as_str()));
        known.extend(["experiment", "about", "seed", "params"]);
        let wrong = short.split('.').next().unwrap_or(short);
        return Err((
            format!("`{key}` is in no stage"),
            names::suggest(wrong, &known).unwrap_or_default(),
        ));
    }
    let mut answers = Vec::new();
    let mut refused = None;
    for (stage, rest) in stages {
        match of_stage(catalog, experiment, cell, stage, rest) {
            Ok(found) => answers.extend(found),
            Err(error) => refused = refused.or(Some(error)),
        }
    }
    match refused {
        Some(error) if answers.is_empty() => Err(error),
        _ => Ok(answers),
    }
}

/// The stages that a key is about, each with the key inside it: one, or all of a group.
fn stages_of<'g, 'k>(graph: &'g Graph, key: &'k str) -> Vec<(&'g Stage, &'k str)> {
    let inside = |name: &str| {
        let rest = key.strip_prefix(name)?;
        let whole = rest.is_empty() || rest.starts_with('.');
        whole.then(|| rest.trim_start_matches('.'))
    };
    let one = graph.stages.iter().flat_map(|stage| {
        let path = stage.path.strip_prefix("stages.").unwrap_or(&stage.path);
        let names = [stage.name.as_str(), path].into_iter();
        names.filter_map(move |name| Some((name.len(), stage, inside(name)?)))
    });
    if let Some((_, stage, rest)) = one.max_by_key(|(length, ..)| *length) {
        return vec![(stage, rest)];
    }
    let groups = graph.groups.iter();
    let found = groups.filter_map(|group| Some((group, inside(&group.name)?)));
    let Some((group, rest)) = found.max_by_key(|(group, _)| group.name.len()) else {
        return Vec::new();
    };
    let rest = if rest == group.key { "" } else { rest };
    let stages = group.members.iter().filter_map(|name| graph.find(name));
    stages.map(|stage| (stage, rest)).collect()
}

/// The settings of one stage below `rest`, all of them where it is empty.
fn of_stage(
    catalog: &Catalog,
    experiment: &Experiment,
    cell: &Cell,
    stage: &Stage,
    rest: &str,
) -> Result<Vec<Answer>, (String, String)> {
    let mut values = values_of(cell, stage);
    if !rest.is_empty() {
        let inside = format!("{rest}.");
        let chosen: Vec<(String, String)> = values
            .iter()
            .filter(|(name, _)| name == rest || name.starts_with(&inside))
            .cloned()
            .collect();
        if chosen.is_empty() {
            let known: Vec<&str> = values.iter().map(|(name, _)| name.as_str()).collect();
            return Err((
                format!("stage `{}` has no `{rest}`", stage.name),
                names::suggest(rest, &known).unwrap_or_default(),
            ));
        }
        values = chosen;
    }
    let settings = catalog
        .schema(stage.op.name())
        .map(|schema| docs::settings(catalog, schema))
        .unwrap_or_default();
    let answers = values.into_iter().map(|(name, value)| {
        let about = settings
            .iter()
            .find(|setting| setting.key == name)
            .map(|setting| setting.about.clone())
            .unwrap_or_default();
        answer(experiment, cell, stage, &name, value, about)
    });
    Ok(answers.collect())
}

fn answer(
    experiment: &Experiment,
    cell: &Cell,
    stage: &Stage,
    name: &str,
    value: String,
    about: String,
) -> Answer {
    let mut chain = Vec::new();
    if let Some(trace) = stage.traces.get(name) {
        let places = std::iter::once((trace.span, value.clone())).chain(trace.before.clone());
        for (span, value) in places {
            chain.push(Link {
                value,
                place: experiment.sources.cite(span),
                layer: layer(experiment, cell, span),
            });
        }
    } else {
        let layer = match name {
            "seed" => "the seed of the run".to_owned(),
            "op" => "the stage".to_owned(),
            _ => format!("default of op `{}`", stage.op.name()),
        };
        chain.push(Link {
            value: value.clone(),
            place: String::new(),
            layer,
        });
    }
    Answer {
        key: format!("{}.{name}", stage.path),
        value,
        about,
        chain,
    }
}

fn layer(experiment: &Experiment, cell: &Cell, span: Span) -> String {
    let Some(source) = experiment.sources.get(span.layer) else {
        return String::new();
    };
    match &source.origin {
        Origin::File if experiment.sweep && of_all_arms(&source.text, span) => {
            "the sweep".to_owned()
        }
        Origin::File if experiment.sweep && !cell.arm.is_empty() => format!("arm `{}`", cell.arm),
        Origin::File => "the file".to_owned(),
        Origin::Extended(_) if experiment.sweep => "the base".to_owned(),
        Origin::Extended(by) => format!("extended by {by}"),
        Origin::Imported => "another experiment".to_owned(),
        Origin::Registry => "the registry".to_owned(),
        Origin::Set => "the command line".to_owned(),
        Origin::Environment => "the environment".to_owned(),
    }
}

/// Whether a place in a sweep's file is in the blocks that change every arm.
fn of_all_arms(text: &str, span: Span) -> bool {
    let Some(root) = yaml::parse(text, span.layer, &mut Vec::new()) else {
        return false;
    };
    let mut blocks = ["stages", "params"]
        .into_iter()
        .filter_map(|key| root.get(key));
    blocks.any(|block| block.span.start <= span.start && span.end <= block.span.end)
}

/// Every setting and edge of a stage as text.
fn values_of(cell: &Cell, stage: &Stage) -> Vec<(String, String)> {
    let mut values = vec![("op".to_owned(), stage.op.name().to_owned())];
    for edge in &stage.edges {
        let names: Vec<&str> = edge
            .from
            .iter()
            .map(|&index| cell.graph.stages[index].name.as_str())
            .collect();
        values.push((edge.port.to_owned(), names.join(", ")));
    }
    flatten("", stage.settings.json(), &mut values);
    values.push(("seed".to_owned(), stage.seed.to_string()));
    values
}

fn flatten(path: &str, value: &Value, into: &mut Vec<(String, String)>) {
    let inner = |key: &str| {
        if path.is_empty() {
            key.to_owned()
        } else {
            format!("{path}.{key}")
        }
    };
    match value {
        Value::Object(map) if !map.is_empty() => {
            for (key, value) in map {
                flatten(&inner(key), value, into);
            }
        }
        Value::Array(items) if items.iter().any(Value::is_object) => {
            for (index, value) in items.iter().enumerate() {
                flatten(&inner(&index.to_string()), value, into);
            }
        }
        Value::Object(_) if path.is_empty() => {}
        Value::String(text) => into.push((path.to_owned(), text.clone())),
        other => into.push((path.to_owned(), other.to_string())),
    }
}

/// The keys of an experiment beside its stages, with the layers that gave them.
pub(super) fn heads(root: &Node) -> Vec<Head> {
    fn collect(node: &Node, key: String, into: &mut Vec<Head>) {
        if let Data::Map(items) = &node.data {
            for item in items {
                collect(&item.value, format!("{key}.{}", item.key), into);
            }
            return;
        }
        into.push(Head {
            key,
            value: node.inline(),
            trace: Trace::of(node),
        });
    }
    let mut heads = Vec::new();
    for key in ["experiment", "about", "seed", "params"] {
        if let Some(node) = root.get(key) {
            collect(node, key.to_owned(), &mut heads);
        }
    }
    heads
}

/// What `key` names beside the stages: one value, or all `params`.
fn head(experiment: &Experiment, cell: &Cell, key: &str) -> Vec<Answer> {
    let inside = format!("{key}.");
    let links = |head: &Head| {
        let places = std::iter::once((head.trace.span, head.value.clone()));
        places
            .chain(head.trace.before.clone())
            .map(|(span, value)| Link {
                value,
                place: experiment.sources.cite(span),
                layer: layer(experiment, cell, span),
            })
            .collect()
    };
    let found = cell
        .graph
        .head
        .iter()
        .filter(|head| head.key == key || head.key.starts_with(&inside));
    found
        .map(|head| Answer {
            key: head.key.clone(),
            value: head.value.clone(),
            about: String::new(),
            chain: links(head),
        })
        .collect()
}

/// For people.
pub fn render(answers: &[Answer]) -> String {
    let mut text = String::new();
    for answer in answers {
        let _ = writeln!(text, "{} = {}", answer.key, answer.value);
        if !answer.about.is_empty() {
            let _ = writeln!(text, "  # {}", answer.about);
        }
        let width = |get: fn(&Link) -> &str| {
            answer
                .chain
                .iter()
                .map(|link| get(link).chars().count())
                .max()
                .unwrap_or(0)
        };
        let (value, place) = (width(|link| &link.value), width(|link| &link.place));
        for (index, link) in answer.chain.iter().enumerate() {
            let word = if index == 0 { "set by  " } else { "was     " };
            let line = format!(
                "  {word}{:value$}  {:place$}  {}",
                link.value, link.place, link.layer
            );
            let _ = writeln!(text, "{}", line.trim_end());
        }
    }
    text
}
