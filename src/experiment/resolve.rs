//! One cell's nodes to a [`Graph`]: ops, settings, edges, order, and what flows along the edges.

mod compare;
mod draft;
mod edges;
mod imported;

use super::artifact::Description;
use super::catalog::Catalog;
use super::data::DataRoot;
use super::diagnostic::{Diagnostic, Span};
use super::external_inputs;
use super::graph::{Edge, Graph, Stage};
use super::group;
use super::interpolate::interpolate;
use super::problem::{Code, Problem};
use super::registry::Registry;
use super::settings::Settings;
use super::source::{Origin, Sources};
use super::stage::{AnyOp, Port};
use super::sweep;
use super::typed::Trace;
use super::why;
use super::yaml::{Data, Node};
use std::collections::BTreeMap;
use std::path::PathBuf;

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
    path: String,
    key_span: Span,
    span: Span,
    op: &'static dyn AnyOp,
    op_span: Span,
    settings: Option<Settings>,
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
        if let Some(name) = root.get("experiment") {
            sweep::check_name(name, "an experiment", self.diagnostics);
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
        let opened = group::open(self.catalog, items, self.diagnostics);
        let written = opened.stages;
        let mut graph = Graph {
            groups: opened.groups,
            head: why::heads(&root),
            ..Graph::default()
        };
        let mut places = BTreeMap::new();
        let mut drafts: Vec<Option<Draft>> = Vec::new();
        for stage in &written {
            drafts.push(self.draft(stage, &written, seed, &mut graph, &mut places));
        }
        for draft in drafts.iter_mut().flatten() {
            for (_, targets) in &mut draft.edges {
                for target in targets {
                    let mut names = written.iter().map(|stage| &stage.item.key);
                    if let Some(index) = names.position(|name| *name == target.name) {
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
            path: draft.path,
            op: draft.op,
            files: draft.op.files(&settings),
            data: external_inputs::data(
                draft.op.data(&settings),
                draft.op.optional_data(&settings),
                self.data,
            ),
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
                .extend(external_inputs::missing_file(file, place(&file.key)));
        }
        for data in &stage.data {
            let root = self.data.get(&data.name);
            self.diagnostics.extend(external_inputs::missing_data(
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
