//! A stage by itself: its op, its settings, the names of its inputs.

use super::{Draft, Resolver};
use crate::experiment::diagnostic::{Diagnostic, Span};
use crate::experiment::graph::Graph;
use crate::experiment::group::Written;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::stage::AnyOp;
use crate::experiment::sweep;
use crate::experiment::typed::{Trace, Validator};
use crate::experiment::yaml::{Data, Item, Node};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::PathBuf;

impl Resolver<'_> {
    /// Op, settings and the names of the inputs of a stage.
    pub(super) fn draft(
        &mut self,
        written: &Written,
        all: &[Written],
        seed: u64,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
    ) -> Option<Draft> {
        let item = &written.item;
        let node = &item.value;
        if !sweep::is_name(&item.key) {
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    item.key_span,
                    format!("`{}` cannot name a stage", item.key),
                )
                .help("use letters, digits, `_` and `-`: it becomes part of folder names"),
            );
        }
        let op = self.op(item, all)?;
        let op_span = node.get("op").map_or(node.span, |op| op.span);
        let mut sound = true;
        let mut seed = seed;
        let mut traces = BTreeMap::new();
        if let Some(own) = node.get("seed") {
            traces.insert("seed".to_owned(), Trace::of(own));
            match sweep::seed_of(Some(own), self.diagnostics) {
                Some(own) => seed = own,
                None => sound = false,
            }
        }
        let ports = op.inputs();
        let mut edges = Vec::new();
        for port in ports {
            let targets = self.targets(port, item, op, graph, places, &mut traces);
            match targets {
                Some(targets) if targets.is_empty() => {}
                Some(targets) => edges.push((port, targets)),
                None => sound = false,
            }
        }
        let own: Vec<Item> = node
            .items()
            .iter()
            .filter(|item| {
                item.key != "op"
                    && item.key != "seed"
                    && !ports.iter().any(|port| port.name == item.key)
            })
            .cloned()
            .collect();
        let own = Node::new(Data::Map(own), node.span);
        let mut beside = vec!["op", "seed"];
        beside.extend(ports.iter().map(|port| port.name));
        let schema = self.catalog.schema(op.name())?;
        let mut typer = Validator {
            catalog: self.catalog,
            registry: self.registry,
            sources: self.sources,
            diagnostics: self.diagnostics,
            traces,
            beside,
            prefix: format!("{}.", written.path),
        };
        let value = typer.value(schema, &own, "");
        let traces = typer.traces;
        let settings = value.and_then(|value| match op.parse(value.clone()) {
            Ok(settings) => Some(settings),
            Err(error) => {
                let (key, span) = culprit(op, &value, &traces).unwrap_or((None, node.span));
                let words = error.to_string();
                let message = match key {
                    Some(key) => format!("`{key}`: {words}"),
                    None => words,
                };
                self.diagnostics
                    .push(Diagnostic::new(Code::E0202, span, message));
                None
            }
        });
        sound &= settings.is_some();
        Some(Draft {
            name: item.key.clone(),
            path: written.path.clone(),
            key_span: item.key_span,
            span: node.span,
            op,
            op_span,
            settings,
            traces,
            seed,
            edges,
            sound,
        })
    }

    pub(super) fn op(&mut self, item: &Item, all: &[Written]) -> Option<&'static dyn AnyOp> {
        let node = &item.value;
        let mut ops: Vec<&str> = self.catalog.ops().iter().map(|op| op.name()).collect();
        ops.extend(self.catalog.groups().iter().map(|group| group.name));
        if !matches!(node.data, Data::Map(_)) {
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    node.span,
                    format!("stage `{}` must be a map", item.key),
                )
                .label(format!("this is {}", node.what()))
                .help("`{op: NAME, ...}`; `reviv list ops` shows the ops"),
            );
            return None;
        }
        let Some(op) = node.get("op") else {
            // A patch of a stage that does not exist looks like this.
            let others: Vec<&str> = all
                .iter()
                .map(|other| other.item.key.as_str())
                .filter(|name| *name != item.key)
                .collect();
            let near = names::nearest(&item.key, others.iter().copied());
            let message = format!("stage `{}` has no `op`", item.key);
            let diagnostic = Diagnostic::new(Code::E0204, item.key_span, message);
            self.diagnostics.push(match near {
                Some(near) => diagnostic.help(format!("did you mean the stage `{near}`?")),
                None => diagnostic.help(format!(
                    "add `op: NAME`{}",
                    names::suggest("", &ops)
                        .map(|all| format!(", {all}"))
                        .unwrap_or_default()
                )),
            });
            return None;
        };
        let Some(name) = op.text() else {
            self.diagnostics.push(Diagnostic::new(
                Code::E0202,
                op.span,
                format!("`op` must be a name, not {}", op.what()),
            ));
            return None;
        };
        let found = self.catalog.op(name);
        if found.is_none() {
            self.diagnostics.push(
                Diagnostic::new(Code::E0203, op.span, format!("unknown op `{name}`"))
                    .label("no such op")
                    .help(names::suggest(name, &ops).unwrap_or_default())
                    .help("`reviv list ops` shows what each does"),
            );
        }
        found
    }
}

/// The setting that the settings struct refuses although its schema takes it.
fn culprit(
    op: &'static dyn AnyOp,
    value: &Value,
    traces: &BTreeMap<String, Trace>,
) -> Option<(Option<String>, Span)> {
    let whole = value.as_object()?;
    for key in whole.keys() {
        let mut without = whole.clone();
        without.remove(key);
        if op.parse(Value::Object(without)).is_ok() {
            return traces.get(key).map(|trace| (Some(key.clone()), trace.span));
        }
    }
    None
}
