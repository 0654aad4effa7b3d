//! One cell's nodes to a [`Graph`]: ops, settings, edges, order, and what flows along the edges.

use super::artifact::Description;
use super::catalog::Catalog;
use super::compose::Composer;
use super::data::DataRoot;
use super::diagnostic::{Diagnostic, Span};
use super::graph::{Compare, Edge, Graph, Stage};
use super::interpolate::interpolate;
use super::load::canonical;
use super::names;
use super::outside;
use super::problem::{Code, Problem};
use super::registry::Registry;
use super::source::{Origin, Sources};
use super::stage::{AnyOp, Arity, Port};
use super::sweep;
use super::typed::{Trace, Typer};
use super::why;
use super::yaml::{Data, Item, Node};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The keys of an experiment.
pub const KEYS: [&str; 5] = ["experiment", "about", "seed", "params", "stages"];

/// Turns cells into graphs; remembers other experiments it has read.
pub struct Resolver<'a> {
    pub catalog: &'a Catalog,
    pub registry: &'a mut Registry,
    pub sources: &'a mut Sources,
    pub diagnostics: &'a mut Vec<Diagnostic>,
    pub data: &'a BTreeMap<String, DataRoot>,
    pub environment: &'a BTreeMap<String, String>,
    /// See [`super::load::Request`].
    pub data_may_be_absent: bool,
    /// Experiments whose stages are read; `None` where one is broken.
    pub imports: BTreeMap<PathBuf, Option<Graph>>,
    /// Files that are being resolved: each reads stages of the next.
    pub importing: Vec<PathBuf>,
}

/// A stage while it is put together.
struct Draft {
    name: String,
    key_span: Span,
    span: Span,
    op: &'static dyn AnyOp,
    op_span: Span,
    settings: Option<Value>,
    traces: BTreeMap<String, Trace>,
    seed: u64,
    edges: Vec<(&'static Port, Vec<Target>)>,
    /// False once something about it has been reported.
    sound: bool,
}

/// One end of an edge.
struct Target {
    name: String,
    span: Span,
    to: To,
}

#[derive(Clone, Copy, PartialEq)]
enum To {
    /// A stage of this experiment.
    Local(usize),
    /// A stage of another one, by its index in the graph.
    Imported(usize),
    Unknown,
}

impl Resolver<'_> {
    /// The graph of a cell; `None` where it has errors.
    pub fn graph(&mut self, root: &Node, seed: u64) -> Option<Graph> {
        let before = self.errors();
        sweep::keys(root, &KEYS, self.diagnostics);
        if let Some(name) = root.get("experiment")
            && !super::load::scalar(name).is_some_and(|name| sweep::is_name(&name))
        {
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    name.span,
                    format!("`{}` cannot name an experiment", name.inline()),
                )
                .help("use letters, digits, `_` and `-`: it becomes part of folder names"),
            );
        }
        let empty = Node::new(Data::Map(Vec::new()), root.span);
        let params = root.get("params").unwrap_or(&empty).clone();
        let root = interpolate(root.clone(), &params, self.environment, self.diagnostics);
        let stages = root.get("stages");
        if stages.is_none_or(|stages| stages.items().is_empty()) {
            let span = stages.map_or(
                Span::point(root.span.layer, root.span.start as usize),
                |s| s.span,
            );
            self.diagnostics.push(
                Diagnostic::new(Code::E0204, span, "an experiment needs `stages`")
                    .help("`stages: {clips: {op: clips}}`; `reviv list ops` shows the ops"),
            );
            return None;
        }
        let items = stages.map(Node::items).unwrap_or_default();
        let mut graph = Graph {
            head: why::heads(&root),
            ..Graph::default()
        };
        let mut places = BTreeMap::new();
        let mut drafts: Vec<Option<Draft>> = Vec::new();
        for item in items {
            drafts.push(self.draft(item, items, seed, &mut graph, &mut places));
        }
        for draft in drafts.iter_mut().flatten() {
            for (_, targets) in &mut draft.edges {
                for target in targets {
                    if let Some(index) = items.iter().position(|item| item.key == target.name) {
                        target.to = To::Local(index);
                    }
                }
            }
        }
        self.edges(&mut drafts, &graph);
        let order = self.order(&drafts);
        let mut at: BTreeMap<usize, usize> = BTreeMap::new();
        for index in order {
            let Some(draft) = drafts[index].take() else {
                continue;
            };
            if let Some(stage) = self.finish(draft, &graph, &at) {
                at.insert(index, graph.stages.len());
                graph.stages.push(stage);
            }
        }
        (self.errors() == before).then_some(graph)
    }

    fn errors(&self) -> usize {
        self.diagnostics
            .iter()
            .filter(|diagnostic| !diagnostic.code.is_warning())
            .count()
    }

    /// Op, settings and the names of the inputs of a stage.
    fn draft(
        &mut self,
        item: &Item,
        all: &[Item],
        seed: u64,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
    ) -> Option<Draft> {
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
        if let Some(own) = node.get("seed") {
            match sweep::seed_of(Some(own), self.diagnostics) {
                Some(own) => seed = own,
                None => sound = false,
            }
        }
        let ports = op.inputs();
        let mut edges = Vec::new();
        let mut traces = BTreeMap::new();
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
        let mut typer = Typer {
            catalog: self.catalog,
            registry: self.registry,
            sources: self.sources,
            diagnostics: self.diagnostics,
            traces,
            beside,
            prefix: format!("stages.{}.", item.key),
        };
        let value = typer.value(schema, &own, "");
        let traces = typer.traces;
        let settings = value.and_then(|value| match op.normalize(value.clone()) {
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

    fn op(&mut self, item: &Item, all: &[Item]) -> Option<&'static dyn AnyOp> {
        let node = &item.value;
        let ops: Vec<&str> = self.catalog.ops().iter().map(|op| op.name()).collect();
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
                .map(|other| other.key.as_str())
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

    /// The stages that a port names; `None` after a report.
    fn targets(
        &mut self,
        port: &'static Port,
        item: &Item,
        op: &'static dyn AnyOp,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
        traces: &mut BTreeMap<String, Trace>,
    ) -> Option<Vec<Target>> {
        let kinds: Vec<&str> = port.kinds.iter().map(|kind| kind.name()).collect();
        let kinds = kinds.join(" or ");
        let value = item
            .value
            .get(port.name)
            .filter(|node| node.data != Data::Null);
        let Some(node) = value else {
            if matches!(port.arity, Arity::Optional | Arity::Any) {
                return Some(Vec::new());
            }
            let list = if port.arity == Arity::Many {
                format!("`{}: [STAGE, ...]`", port.name)
            } else {
                format!("`{}: STAGE`", port.name)
            };
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0301,
                    item.key_span,
                    format!("stage `{}` needs `{}`: {}", item.key, port.name, port.about),
                )
                .label(format!("op `{}` reads {kinds} here", op.name()))
                .help(format!("add {list}")),
            );
            return None;
        };
        traces.insert(
            port.name.to_owned(),
            Trace {
                span: node.span,
                before: Vec::new(),
            },
        );
        let many = matches!(port.arity, Arity::Many | Arity::Any);
        let nodes: Vec<&Node> = match (&node.data, many) {
            (Data::List(nodes), true) => nodes.iter().collect(),
            (Data::Text(_), false) => vec![node],
            (_, many) => {
                let wanted = if many {
                    "a list of stages"
                } else {
                    "the name of one stage"
                };
                let help = match (&node.data, many) {
                    (Data::Text(name), true) => format!("write `[{name}]`"),
                    _ => String::new(),
                };
                self.diagnostics.push(
                    Diagnostic::new(
                        Code::E0301,
                        node.span,
                        format!("`{}` must be {wanted}", port.name),
                    )
                    .label(format!("this is {}", node.what()))
                    .help(help),
                );
                return None;
            }
        };
        if nodes.is_empty() && port.arity == Arity::Many {
            self.diagnostics.push(Diagnostic::new(
                Code::E0301,
                node.span,
                format!("`{}` must name at least one stage", port.name),
            ));
            return None;
        }
        let mut targets = Vec::new();
        for (index, node) in nodes.into_iter().enumerate() {
            let Some(name) = node.text() else {
                self.diagnostics.push(Diagnostic::new(
                    Code::E0301,
                    node.span,
                    format!("`{}` must name stages, not {}", port.name, node.what()),
                ));
                continue;
            };
            if name == "???" {
                self.diagnostics.push(
                    Diagnostic::new(
                        Code::E0204,
                        node.span,
                        format!("`{}` must be given", port.name),
                    )
                    .label("left open here"),
                );
                continue;
            }
            traces.insert(
                format!("{}.{index}", port.name),
                Trace {
                    span: node.span,
                    before: Vec::new(),
                },
            );
            let to = if name.contains('/') {
                self.import(name, node.span, graph, places)
            } else {
                To::Unknown
            };
            targets.push(Target {
                name: name.to_owned(),
                span: node.span,
                to,
            });
        }
        Some(targets)
    }

    /// A stage of another experiment, with everything it needs, put into the graph.
    fn import(
        &mut self,
        name: &str,
        asked: Span,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
    ) -> To {
        let (file, stage) = name.rsplit_once('/').unwrap_or(("", name));
        let file = if Path::new(file).extension().is_some() {
            file.to_owned()
        } else {
            format!("{file}.yaml")
        };
        let mut composer = Composer::new(self.catalog, self.sources, self.diagnostics);
        let path = composer.relative(&file, asked);
        let identity = canonical(&path);
        if self.importing.contains(&identity) {
            composer.diagnostics.push(
                Diagnostic::new(
                    Code::E0302,
                    asked,
                    "experiments read stages of each other in a circle",
                )
                .label("this closes it"),
            );
            return To::Unknown;
        }
        if !self.imports.contains_key(&identity) {
            let root = composer.named(&file, asked, Origin::Imported(String::new()));
            let imported = root.and_then(|root| {
                if root.get("sweep").is_some() {
                    self.diagnostics.push(
                        Diagnostic::new(
                            Code::E0301,
                            asked,
                            format!("`{file}` is a sweep: its stages exist once per arm"),
                        )
                        .help("name a stage of an experiment"),
                    );
                    return None;
                }
                let seed = sweep::seed_of(root.get("seed"), self.diagnostics).unwrap_or(0);
                self.importing.push(identity.clone());
                let graph = self.graph(&root, seed);
                self.importing.pop();
                graph
            });
            self.imports.insert(identity.clone(), imported);
        }
        let Some(Some(imported)) = self.imports.get(&identity) else {
            return To::Unknown;
        };
        let Some(wanted) = imported.stages.iter().position(|s| s.name == stage) else {
            let known: Vec<&str> = imported.stages.iter().map(|s| s.name.as_str()).collect();
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0301,
                    asked,
                    format!("`{file}` has no stage `{stage}`"),
                )
                .help(names::suggest(stage, &known).unwrap_or_default()),
            );
            return To::Unknown;
        };
        let prefix = Path::new(&file)
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        To::Imported(copy(imported, wanted, &identity, &prefix, graph, places))
    }

    /// Every edge must end at a stage that makes what the port reads.
    fn edges(&mut self, drafts: &mut [Option<Draft>], graph: &Graph) {
        let facts: Vec<Option<(String, super::ArtifactKind, Span)>> = drafts
            .iter()
            .map(|draft| {
                draft
                    .as_ref()
                    .map(|draft| (draft.name.clone(), draft.op.output(), draft.op_span))
            })
            .collect();
        for draft in drafts.iter_mut().flatten() {
            for (port, targets) in &draft.edges {
                for target in targets {
                    let kinds: Vec<&str> = port.kinds.iter().map(|kind| kind.name()).collect();
                    let kinds = kinds.join(" or ");
                    let fitting: Vec<&str> = facts
                        .iter()
                        .flatten()
                        .filter(|(name, kind, _)| port.kinds.contains(kind) && *name != draft.name)
                        .map(|(name, ..)| name.as_str())
                        .collect();
                    let (kind, made) = match target.to {
                        To::Local(index) => {
                            let Some((_, kind, span)) = &facts[index] else {
                                // It is there, and it is broken: that has been said.
                                draft.sound = false;
                                continue;
                            };
                            (*kind, Some(*span))
                        }
                        To::Imported(index) => (graph.stages[index].op.output(), None),
                        To::Unknown => {
                            draft.sound = false;
                            if !target.name.contains('/') {
                                self.diagnostics.push(
                                    Diagnostic::new(
                                        Code::E0301,
                                        target.span,
                                        format!("there is no stage `{}`", target.name),
                                    )
                                    .label(format!("`{}` reads {kinds} here", port.name))
                                    .help(
                                        names::suggest(&target.name, &fitting).unwrap_or_default(),
                                    ),
                                );
                            }
                            continue;
                        }
                    };
                    if !port.kinds.contains(&kind) {
                        draft.sound = false;
                        let mut diagnostic = Diagnostic::new(
                            Code::E0303,
                            target.span,
                            format!("stage `{}` makes {kind}, not {kinds}", target.name),
                        )
                        .label(format!("`{}` reads {kinds}", port.name));
                        if let Some(span) = made {
                            diagnostic = diagnostic.also(span, format!("makes {kind}"));
                        }
                        if !fitting.is_empty() {
                            diagnostic = diagnostic
                                .help(names::suggest(&target.name, &fitting).unwrap_or_default());
                        }
                        self.diagnostics.push(diagnostic);
                    }
                }
            }
        }
    }

    /// Stages with inputs before readers, in the order of the file where it does not matter. Reports circles.
    fn order(&mut self, drafts: &[Option<Draft>]) -> Vec<usize> {
        let needs: Vec<Vec<usize>> = drafts
            .iter()
            .map(|draft| {
                draft
                    .iter()
                    .flat_map(|draft| &draft.edges)
                    .flat_map(|(_, targets)| targets)
                    .filter_map(|target| match target.to {
                        To::Local(index) => Some(index),
                        _ => None,
                    })
                    .collect()
            })
            .collect();
        let mut order = Vec::new();
        let mut done = vec![false; drafts.len()];
        loop {
            let next = (0..drafts.len())
                .find(|&index| !done[index] && needs[index].iter().all(|&need| done[need]));
            let Some(next) = next else { break };
            done[next] = true;
            order.push(next);
        }
        if let Some(start) = done.iter().position(|done| !done) {
            // Follow unfinished needs until one comes again: that is the circle.
            let mut path = vec![start];
            let circle = loop {
                let last = path[path.len() - 1];
                let Some(&next) = needs[last].iter().find(|&&need| !done[need]) else {
                    break path.clone();
                };
                if let Some(at) = path.iter().position(|&index| index == next) {
                    break path[at..].to_vec();
                }
                path.push(next);
            };
            let names: Vec<String> = circle
                .iter()
                .chain(circle.first())
                .filter_map(|&index| drafts[index].as_ref())
                .map(|draft| format!("`{}`", draft.name))
                .collect();
            if let Some(draft) = circle.first().and_then(|&index| drafts[index].as_ref()) {
                let span = draft
                    .edges
                    .iter()
                    .flat_map(|(_, targets)| targets)
                    .find(|target| matches!(target.to, To::Local(index) if circle.contains(&index)))
                    .map_or(draft.key_span, |target| target.span);
                self.diagnostics.push(
                    Diagnostic::new(Code::E0302, span, "stages wait for each other")
                        .label("this closes the circle")
                        .note(names.join(" reads ")),
                );
            }
        }
        order
    }

    /// Settings and inputs are known: ask the op.
    fn finish(
        &mut self,
        draft: Draft,
        graph: &Graph,
        at: &BTreeMap<usize, usize>,
    ) -> Option<Stage> {
        let mut edges = Vec::new();
        for (port, targets) in &draft.edges {
            let mut from = Vec::new();
            for target in targets {
                match target.to {
                    To::Local(index) => from.push(*at.get(&index)?),
                    To::Imported(index) => from.push(index),
                    To::Unknown => return None,
                }
            }
            edges.push(Edge {
                port: port.name,
                from,
            });
        }
        if !draft.sound {
            return None;
        }
        let settings = draft.settings?;
        let mut stage = Stage {
            name: draft.name,
            op: draft.op,
            files: draft.op.files(&settings),
            data: outside::data(draft.op.data(&settings), self.data),
            settings,
            seed: draft.seed,
            edges,
            description: Description::default(),
            traces: draft.traces,
        };
        let before = self.diagnostics.len();
        let place = |key: &str| place(key, &stage.traces, draft.span);
        for file in &stage.files {
            self.diagnostics
                .extend(outside::missing_file(file, place(&file.key)));
        }
        for data in &stage.data {
            let root = self.data.get(&data.name);
            self.diagnostics.extend(outside::missing_data(
                data,
                root,
                self.data_may_be_absent,
                place(&data.key),
            ));
        }
        let mut problems: Vec<Problem> = Vec::new();
        let description = {
            let inputs = graph.inputs(&stage);
            draft.op.check(&stage.settings, &inputs, &mut problems)
        };
        let failed = problems.iter().any(|problem| !problem.code.is_warning());
        for problem in problems {
            let span = if problem.key.is_empty() {
                draft.key_span
            } else {
                place(&problem.key)
            };
            self.diagnostics.push(
                Diagnostic::new(problem.code, span, problem.message)
                    .label(problem.label)
                    .help(problem.help),
            );
        }
        for diagnostic in &mut self.diagnostics[before..] {
            if let Some(note) = used_at(diagnostic.span, &stage.traces, self.sources) {
                diagnostic.notes.push(note);
            }
        }
        stage.description = description?;
        (!failed).then_some(stage)
    }

    /// The `compare:` block of a sweep.
    pub fn compare(&mut self, node: &Node, arms: &[String], columns: &[String]) -> Option<Compare> {
        let schema = self.catalog.definition("compare")?;
        let mut typer = Typer {
            catalog: self.catalog,
            registry: self.registry,
            sources: self.sources,
            diagnostics: self.diagnostics,
            traces: BTreeMap::new(),
            beside: Vec::new(),
            prefix: "compare.".to_owned(),
        };
        let value = typer.value(schema, node, "")?;
        let compare: Compare = serde_json::from_value(value).ok()?;
        let mut unknown = |key: &str, what: &str, name: &str, known: &[&str]| {
            if !known.contains(&name) {
                self.diagnostics.push(
                    Diagnostic::new(
                        Code::E0203,
                        node.at(key).map_or(node.span, |node| node.span),
                        format!("unknown {what} `{name}`"),
                    )
                    .help(names::suggest(name, known).unwrap_or_default()),
                );
            }
        };
        let arms: Vec<&str> = arms.iter().map(String::as_str).collect();
        if let Some(name) = &compare.baseline {
            unknown("baseline", "arm", name, &arms);
        }
        // `depth.abs_rel` stands for `depth.abs_rel@depth` and every other space of it.
        let stems = columns.iter().filter_map(|name| name.split_once('@'));
        let columns: Vec<&str> = columns
            .iter()
            .map(String::as_str)
            .chain(stems.map(|(stem, _)| stem))
            .collect();
        if !columns.is_empty() {
            for (index, name) in compare.columns.iter().enumerate() {
                unknown(&format!("columns.{index}"), "column", name, &columns);
            }
        }
        if let Some(name) = &compare.against {
            let known = self.registry.names("published");
            unknown("against", "published table", name, &known);
        }
        Some(compare)
    }
}

/// Where a key (or the nearest one around it) was written.
fn place(key: &str, traces: &BTreeMap<String, Trace>, otherwise: Span) -> Span {
    let mut key = key;
    loop {
        if let Some(trace) = traces.get(key) {
            return trace.span;
        }
        match key.rsplit_once('.') {
            Some((parent, _)) => key = parent,
            None => return otherwise,
        }
    }
}

/// For a mistake inside a registry entry: where the experiment names the entry.
fn used_at(span: Span, traces: &BTreeMap<String, Trace>, sources: &Sources) -> Option<String> {
    let inside = |span: Span| {
        sources
            .get(span.layer)
            .is_some_and(|source| source.origin == Origin::Registry)
    };
    if !inside(span) {
        return None;
    }
    let (key, _) = traces.iter().find(|(_, trace)| trace.span == span)?;
    let mut key = key.as_str();
    while let Some((parent, _)) = key.rsplit_once('.') {
        key = parent;
        if let Some(trace) = traces.get(key).filter(|trace| !inside(trace.span)) {
            return Some(format!("`{key}` is set at {}", sources.cite(trace.span)));
        }
    }
    None
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
        if op.normalize(Value::Object(without)).is_ok() {
            return traces.get(key).map(|trace| (Some(key.clone()), trace.span));
        }
    }
    None
}

/// Copies a stage and what it reads into another graph, once.
fn copy(
    from: &Graph,
    index: usize,
    file: &Path,
    prefix: &str,
    into: &mut Graph,
    places: &mut BTreeMap<(PathBuf, String), usize>,
) -> usize {
    let stage = &from.stages[index];
    let key = (file.to_owned(), stage.name.clone());
    if let Some(&place) = places.get(&key) {
        return place;
    }
    let mut copied = stage.clone();
    for edge in &mut copied.edges {
        for source in &mut edge.from {
            *source = copy(from, *source, file, prefix, into, places);
        }
    }
    // A stage that the other experiment reads from a third keeps that name.
    if !copied.name.contains('/') {
        copied.name = format!("{prefix}/{}", stage.name);
    }
    into.stages.push(copied);
    places.insert(key, into.stages.len() - 1);
    into.stages.len() - 1
}
