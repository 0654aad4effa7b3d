//! `${params.x}` and `${env.X}`: the only two substitutions of the language. `$${` writes a plain `${`.

use super::diagnostic::Diagnostic;
use super::names;
use super::problem::Code;
use super::yaml::{self, Data, Node};
use std::collections::BTreeMap;

/// Longest text that substitution may make.
const MAX_TEXT: usize = 1 << 16;
/// Values that substitution may make in one document.
const MAX_WEIGHT: usize = yaml::MAX_WEIGHT;
/// Substitutions in one document.
const MAX_STEPS: usize = 20_000;

/// The variables of the environment.
pub type Environment<'a> = &'a BTreeMap<String, String>;

/// Substitutes everywhere below `node`, with `params` of the same document.
pub fn interpolate(
    node: Node,
    params: &Node,
    environment: Environment<'_>,
    diagnostics: &mut Vec<Diagnostic>,
) -> Node {
    let mut pass = Pass {
        params,
        environment,
        diagnostics,
        weight: 0,
        steps: 0,
        inside: Vec::new(),
    };
    pass.node(node)
}

struct Pass<'a> {
    params: &'a Node,
    environment: Environment<'a>,
    diagnostics: &'a mut Vec<Diagnostic>,
    weight: usize,
    steps: usize,
    /// Parameters whose values are being substituted.
    inside: Vec<String>,
}

impl Pass<'_> {
    fn node(&mut self, mut node: Node) -> Node {
        node.data = match node.data {
            Data::List(nodes) => Data::List(nodes.into_iter().map(|n| self.node(n)).collect()),
            Data::Map(items) => Data::Map(
                items
                    .into_iter()
                    .map(|mut item| {
                        item.value = self.node(item.value);
                        item
                    })
                    .collect(),
            ),
            Data::Text(text) if text.contains("${") => {
                return self.text(&text, Node::new(Data::Null, node.span), node.before);
            }
            other => other,
        };
        node
    }

    fn text(&mut self, text: &str, place: Node, before: Option<Box<Node>>) -> Node {
        let fail = |mut place: Node| {
            place.data = Data::Text("???".to_owned());
            place
        };
        self.steps += 1;
        if self.steps > MAX_STEPS || self.weight > MAX_WEIGHT {
            return fail(place);
        }
        if self.steps == MAX_STEPS {
            self.report(&place, "too many substitutions", "check `params`");
            return fail(place);
        }
        // A whole value keeps its type.
        if let Some(name) = text
            .strip_prefix("${")
            .and_then(|rest| rest.strip_suffix('}'))
            && !name.contains('}')
        {
            let Some(mut node) = self.look_up(name, &place) else {
                return fail(place);
            };
            let source = Node::new(node.data.clone(), node.span);
            node.before = if node.span == place.span {
                before
            } else {
                Some(Box::new(Node { before, ..source }))
            };
            node.span = place.span;
            return node;
        }
        let mut out = String::new();
        let mut rest = text;
        while let Some(at) = rest.find("${") {
            if rest[..at].ends_with('$') {
                out.push_str(&rest[..at - 1]);
                out.push_str("${");
                rest = &rest[at + 2..];
                continue;
            }
            out.push_str(&rest[..at]);
            let Some(end) = rest[at..].find('}') else {
                self.report(
                    &place,
                    "`${` without `}`",
                    "write `$${` for the characters `${`",
                );
                return fail(place);
            };
            let name = &rest[at + 2..at + end];
            let Some(node) = self.look_up(name, &place) else {
                return fail(place);
            };
            if matches!(node.data, Data::List(_) | Data::Map(_) | Data::Null) {
                let message = format!(
                    "`${{{name}}}` is {} and cannot be part of a text",
                    node.what()
                );
                self.report(&place, &message, "");
                return fail(place);
            }
            out.push_str(&node.inline());
            rest = &rest[at + end + 1..];
            if out.len() > MAX_TEXT {
                self.report(
                    &place,
                    "substitution makes a text of more than 64 kB",
                    "check `params`",
                );
                return fail(place);
            }
        }
        out.push_str(rest);
        let mut node = place;
        node.data = Data::Text(out);
        node.before = before;
        node
    }

    /// What a name stands for, substituted inside; `None` after a report.
    fn look_up(&mut self, name: &str, place: &Node) -> Option<Node> {
        let node = self.named(name, place)?;
        self.inside.push(name.to_owned());
        let node = self.node(node);
        self.inside.pop();
        let reported = self.weight > MAX_WEIGHT;
        self.weight += node.weight();
        if self.weight > MAX_WEIGHT {
            if !reported {
                self.report(
                    place,
                    "substitution makes too many values",
                    "check `params`",
                );
            }
            return None;
        }
        Some(node)
    }

    fn named(&mut self, name: &str, place: &Node) -> Option<Node> {
        if self.inside.iter().any(|other| other == name) || self.inside.len() > 32 {
            let circle = format!("`${{{name}}}` stands for itself");
            self.report(place, &circle, "break the circle");
            return None;
        }
        if let Some(key) = name.strip_prefix("params.") {
            if let Some(node) = self.params.at(key) {
                return Some(node.clone());
            }
            let known: Vec<&str> = self
                .params
                .items()
                .iter()
                .map(|item| item.key.as_str())
                .collect();
            let help = if known.is_empty() {
                format!("add `params: {{{key}: ...}}`")
            } else {
                names::suggest(key, &known).unwrap_or_default()
            };
            self.report(place, &format!("unknown parameter `{key}`"), &help);
            return None;
        }
        if let Some(variable) = name.strip_prefix("env.") {
            if let Some(value) = self.environment.get(variable) {
                return Some(Node::new(yaml::plain(value), place.span));
            }
            self.report(
                place,
                &format!("the environment has no `{variable}`"),
                &format!("run with `{variable}=...` before the command"),
            );
            return None;
        }
        self.report(
            place,
            &format!("`${{{name}}}` is neither `${{params.x}}` nor `${{env.X}}`"),
            "the language has these two substitutions and no expressions; write `$${` for the characters `${`",
        );
        None
    }

    fn report(&mut self, place: &Node, message: &str, help: &str) {
        self.diagnostics
            .push(Diagnostic::new(Code::E0105, place.span, message).help(help));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_makes_too_much_is_said_once_and_ends_there() {
        let list = vec!["1"; 500].join(", ");
        for use_of in ["${params.big}", "x ${params.big}"] {
            let text = format!("params: {{big: [{list}]}}\n");
            let uses: Vec<String> = (0..2000).map(|n| format!("k{n}: {use_of}\n")).collect();
            let text = text + &uses.concat();
            let mut diagnostics = Vec::new();
            let root = yaml::parse(&text, 0, &mut diagnostics).unwrap();
            assert!(diagnostics.is_empty());
            let params = root.get("params").unwrap().clone();
            let whole = interpolate(root, &params, &BTreeMap::new(), &mut diagnostics);
            let said = |words: &str| {
                let fits = |d: &&Diagnostic| d.message.contains(words);
                diagnostics.iter().filter(fits).count()
            };
            assert_eq!(said("too many values"), 1);
            assert!(diagnostics.len() < 500, "{}", diagnostics.len());
            assert_eq!(whole.get("k1999").and_then(Node::text), Some("???"));
        }
    }
}
