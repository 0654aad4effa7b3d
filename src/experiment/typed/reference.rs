//! What a value refers to: an entry of the registry, or a file.

use super::{Validator, below, last, wrong_type};
use crate::experiment::diagnostic::Diagnostic;
use crate::experiment::merge;
use crate::experiment::problem::Code;
use crate::experiment::registry::noun;
use crate::experiment::yaml::{Data, Item, Node};
use serde_json::{Map, Value};
use std::path::Path;

impl<'c> Validator<'c, '_> {
    pub(super) fn path(&mut self, node: &Node, path: &str, optional: bool) -> Option<Value> {
        if node.data == Data::Null && optional {
            return Some(Value::Null);
        }
        let Some(text) = node.text() else {
            self.report(wrong_type(&["string"], node, path));
            return None;
        };
        let folder = self
            .sources
            .get(node.span.layer)
            .and_then(|source| source.path.as_deref())
            .and_then(Path::parent);
        let resolved = match folder {
            Some(folder) if Path::new(text).is_relative() && !folder.as_os_str().is_empty() => {
                folder.join(text).display().to_string()
            }
            _ => text.to_owned(),
        };
        Some(Value::String(resolved))
    }

    /// A registry reference: `uniform`, or `{use: dirichlet, alpha: 0.001}`.
    pub(super) fn entry(
        &mut self,
        kind: &str,
        settings: &'c Value,
        node: &Node,
        path: &str,
    ) -> Option<Value> {
        let (name, span, changes) = match &node.data {
            Data::Text(name) => (name.clone(), node.span, None),
            Data::Map(items) => {
                let Some(name) = node.get("use") else {
                    self.report(
                        Diagnostic::new(
                            Code::E0204,
                            node.span,
                            format!(
                                "`{}` does not say which {} it changes",
                                last(path),
                                noun(kind)
                            ),
                        )
                        .label("needs `use: NAME`")
                        .help(format!("`reviv list {kind}` shows the names")),
                    );
                    return None;
                };
                let Some(text) = name.text() else {
                    self.report(wrong_type(&["string"], name, &below(path, "use")));
                    return None;
                };
                self.trace(name, &below(path, "use"));
                let changes: Vec<Item> = items
                    .iter()
                    .filter(|item| item.key != "use")
                    .cloned()
                    .collect();
                let changes = Node::new(Data::Map(changes), node.span);
                (text.to_owned(), name.span, Some(changes))
            }
            _ => {
                self.report(
                    Diagnostic::new(
                        Code::E0202,
                        node.span,
                        format!(
                            "`{}` must name a {}, not {}",
                            last(path),
                            noun(kind),
                            node.what()
                        ),
                    )
                    .help(format!("`reviv list {kind}` shows the names")),
                );
                return None;
            }
        };
        let base = self
            .registry
            .settings(kind, &name, span, self.sources, self.diagnostics)?;
        let whole = match changes {
            Some(changes) => merge::merge(base, changes, self.diagnostics),
            None => base,
        };
        let known = self.diagnostics.len();
        let depth = path.split('.').count();
        if depth > 32 {
            self.report(Diagnostic::new(
                Code::E0104,
                node.span,
                format!("registry entries refer to each other in a circle at `{name}`"),
            ));
            return None;
        }
        let beside = std::mem::take(&mut self.beside);
        let value = self.value(settings, &whole, path);
        self.beside = beside;
        // What is wrong inside an entry says who asked for it.
        let cite = self.sources.cite(span);
        let layer = span.layer;
        for diagnostic in &mut self.diagnostics[known..] {
            if diagnostic.span.layer != layer {
                diagnostic.notes.push(format!("`{name}` is used at {cite}"));
            }
        }
        // The reference itself is where the setting was written.
        self.trace(node, path);
        let mut map = Map::new();
        map.insert("use".to_owned(), Value::String(name));
        match value? {
            Value::Object(settings) => map.extend(settings),
            Value::Null => {}
            _ => return None,
        }
        Some(Value::Object(map))
    }
}
