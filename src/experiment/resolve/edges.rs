//! What stages read: the ends of edges, whether they fit, and the order that follows.

use super::{Draft, Resolver, Target, To};
use crate::experiment::ArtifactKind;
use crate::experiment::diagnostic::{Diagnostic, Span};
use crate::experiment::graph::Graph;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::stage::{AnyOp, Arity, Port};
use crate::experiment::typed::Trace;
use crate::experiment::yaml::{Data, Item, Node};
use std::collections::BTreeMap;
use std::path::PathBuf;

impl Resolver<'_> {
    /// The stages that a port names; `None` after a report.
    pub(super) fn targets(
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
            let list = if port.arity == Arity::OneOrMore {
                format!("`{0}: STAGE` or `{0}: [STAGE, ...]`", port.name)
            } else if port.arity == Arity::Many {
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
        traces.insert(port.name.to_owned(), Trace::of(node));
        let one = matches!(node.data, Data::Text(_)) && port.arity == Arity::OneOrMore;
        let many = !one && !matches!(port.arity, Arity::One | Arity::Optional);
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
        if nodes.is_empty() && matches!(port.arity, Arity::Many | Arity::OneOrMore) {
            self.diagnostics.push(Diagnostic::new(
                Code::E0301,
                node.span,
                format!("`{}` must name at least one stage", port.name),
            ));
            return None;
        }
        let mut targets = Vec::new();
        let single = matches!(port.arity, Arity::One | Arity::Optional);
        let mut sound = true;
        for node in nodes {
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
            let ends = if name.contains('/') {
                self.import(name, node.span, graph, places)
            } else if let Some(group) = graph.groups.iter().find(|group| group.name == name) {
                let members = group.members.iter();
                members.map(|own| (own.clone(), To::Unknown)).collect()
            } else {
                vec![(name.to_owned(), To::Unknown)]
            };
            // A group with mistakes stands for nothing: that has been said.
            sound &= !ends.is_empty();
            if single && ends.len() > 1 {
                let names: Vec<String> = ends.iter().map(|(name, _)| format!("`{name}`")).collect();
                let message = format!(
                    "`{}` takes one stage, and `{name}` stands for {}",
                    port.name,
                    names.len()
                );
                self.diagnostics.push(
                    Diagnostic::new(Code::E0301, node.span, message)
                        .help(format!("name one of {}", names.join(", "))),
                );
                return None;
            }
            for (name, to) in ends {
                traces.insert(format!("{}.{}", port.name, targets.len()), Trace::of(node));
                targets.push(Target {
                    name,
                    span: node.span,
                    to,
                });
            }
        }
        sound.then_some(targets)
    }

    /// Every edge must end at a stage that makes what the port reads.
    pub(super) fn edges(&mut self, drafts: &mut [Option<Draft>], graph: &Graph) {
        let facts: Vec<Option<(String, ArtifactKind, Span)>> = drafts
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
                    let mut fitting: Vec<&str> = facts
                        .iter()
                        .flatten()
                        .filter(|(name, kind, _)| port.kinds.contains(kind) && *name != draft.name)
                        .map(|(name, ..)| name.as_str())
                        .collect();
                    for group in &graph.groups {
                        let mut members = group.members.iter();
                        if members.any(|own| fitting.contains(&own.as_str())) {
                            fitting.push(&group.name);
                        }
                    }
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
    pub(super) fn order(&mut self, drafts: &[Option<Draft>]) -> Vec<usize> {
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
}
