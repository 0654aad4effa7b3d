//! Nodes against the schema of a settings struct: every error at once, each at its place, and JSON that fits the struct.
//!
//! The schema is what `schemars` derives from the struct, so there is one source of truth for the struct, the editor and
//! the check. Registry references and paths are resolved on the way.

mod choice;
mod container;
mod reference;

use super::catalog::Catalog;
use super::diagnostic::{Diagnostic, Span};
use super::problem::Code;
use super::registry::Registry;
use super::source::Sources;
use super::yaml::{Data, Node};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Where a setting comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// The layer that decided.
    pub span: Span,
    /// The values it replaced, newest first.
    pub before: Vec<(Span, String)>,
}

impl Trace {
    /// Where a node was written, and what it replaced.
    pub fn of(node: &Node) -> Self {
        let earlier = std::iter::successors(node.before.as_deref(), |node| node.before.as_deref());
        Self {
            span: node.span,
            before: earlier.map(|node| (node.span, node.inline())).collect(),
        }
    }
}

/// Turns nodes into settings.
pub struct Validator<'c, 'm> {
    /// Schemas of all ops and kinds.
    pub catalog: &'c Catalog,
    /// Where registry references are looked up.
    pub registry: &'m mut Registry,
    /// The texts read so far; registry entries that are referred to are added.
    pub sources: &'m mut Sources,
    /// Where everything that is wrong is reported.
    pub diagnostics: &'m mut Vec<Diagnostic>,
    /// Key path to where it was written.
    pub traces: BTreeMap<String, Trace>,
    /// Keys that are allowed beside the settings at the top: ports, `op`, `seed`.
    pub beside: Vec<&'static str>,
    /// What the key paths start at, for messages: `stages.mget.`.
    pub prefix: String,
}

/// A key path one level down.
fn below(path: &str, key: &str) -> String {
    if path.is_empty() {
        key.to_owned()
    } else {
        format!("{path}.{key}")
    }
}

/// The last key of a path, for messages.
fn last(path: &str) -> &str {
    let mut parts = path.rsplit('.');
    let last = parts.next().unwrap_or(path);
    if last.bytes().all(|byte| byte.is_ascii_digit()) {
        parts.next().unwrap_or(last)
    } else {
        last
    }
}

/// Takes any value.
static ANYTHING: Value = Value::Bool(true);

impl<'c> Validator<'c, '_> {
    /// The settings that a node makes; `None` after a report.
    pub fn value(&mut self, schema: &'c Value, node: &Node, path: &str) -> Option<Value> {
        self.trace(node, path);
        if node.text() == Some("???") {
            // A substitution that failed has been reported.
            if self.sources.slice(node.span).contains("${") {
                return None;
            }
            self.report(
                Diagnostic::new(
                    Code::E0204,
                    node.span,
                    format!("`{}` must be given", last(path)),
                )
                .label("left open here")
                .help(format!(
                    "give it in the file, or with `--set {}{path}=VALUE`",
                    self.prefix
                )),
            );
            return None;
        }
        let schema = self.follow(schema);
        if let Some(kind) = schema.get("x-registry").and_then(Value::as_str) {
            let settings = schema.get("x-settings").unwrap_or(&ANYTHING);
            return self.entry(kind, settings, node, path);
        }
        if schema.get("x-path").is_some() {
            // An optional path has the type `["string", "null"]`.
            let optional = schema.get("type").is_some_and(Value::is_array);
            return self.path(node, path, optional);
        }
        if let Some(all) = schema.get("allOf").and_then(Value::as_array)
            && let [only] = all.as_slice()
        {
            return self.value(only, node, path);
        }
        if choice::numbered(schema, node) {
            return Some(node.to_json());
        }
        for word in ["anyOf", "oneOf"] {
            if let Some(choices) = schema.get(word).and_then(Value::as_array) {
                let choices: Vec<&'c Value> =
                    choices.iter().map(|choice| self.follow(choice)).collect();
                return self.choice(&choices, node, path);
            }
        }
        if let Some(names) = choice::constants(schema) {
            return self.constant(&names, node, path);
        }
        self.plain(schema, node, path)
    }

    fn trace(&mut self, node: &Node, path: &str) {
        self.traces.insert(path.to_owned(), Trace::of(node));
    }

    fn report(&mut self, diagnostic: Diagnostic) {
        self.diagnostics.push(diagnostic);
    }

    /// Follows `$ref`, keeping it simple: what stands beside a reference is documentation.
    fn follow(&self, schema: &'c Value) -> &'c Value {
        let mut schema = schema;
        for _ in 0..16 {
            match schema
                .get("$ref")
                .and_then(Value::as_str)
                .and_then(|name| name.strip_prefix("#/$defs/"))
                .and_then(|name| self.catalog.definition(name))
            {
                Some(definition) => schema = definition,
                None => break,
            }
        }
        schema
    }

    fn plain(&mut self, schema: &'c Value, node: &Node, path: &str) -> Option<Value> {
        let types: Vec<&str> = match schema.get("type") {
            Some(Value::String(name)) => vec![name.as_str()],
            Some(Value::Array(names)) => names.iter().filter_map(Value::as_str).collect(),
            _ => return self.anything(node, path),
        };
        let accepts = |name: &str| types.contains(&name);
        match &node.data {
            Data::Null if accepts("null") => Some(Value::Null),
            Data::Bool(value) if accepts("boolean") => Some(Value::Bool(*value)),
            Data::Int(value) if accepts("integer") || accepts("number") => {
                self.bounds(schema, *value as f64, node, path)?;
                // A schema of a float takes `3` as `3.0`.
                Some(if accepts("integer") {
                    Value::from(*value)
                } else {
                    Value::from(*value as f64)
                })
            }
            Data::Float(value) if accepts("number") => {
                if !value.is_finite() {
                    self.report(Diagnostic::new(
                        Code::E0202,
                        node.span,
                        format!("`{}` must be a finite number", last(path)),
                    ));
                    return None;
                }
                self.bounds(schema, *value, node, path)?;
                Some(Value::from(*value))
            }
            // `steps: 1e5` is a whole number.
            Data::Float(value)
                if accepts("integer") && value.fract() == 0.0 && value.abs() < 9e15 =>
            {
                self.bounds(schema, *value, node, path)?;
                Some(Value::from(*value as i64))
            }
            Data::Text(text) if accepts("string") => Some(Value::String(text.clone())),
            Data::List(nodes) if accepts("array") => self.list(schema, nodes, node, path),
            Data::Map(items) if accepts("object") => self.map(schema, items, node, path),
            _ => {
                self.report(wrong_type(&types, node, path));
                None
            }
        }
    }

    fn anything(&mut self, node: &Node, path: &str) -> Option<Value> {
        match &node.data {
            Data::Float(value) if !value.is_finite() => {
                self.report(Diagnostic::new(
                    Code::E0202,
                    node.span,
                    format!("`{}` must be a finite number", last(path)),
                ));
                None
            }
            Data::List(nodes) => {
                let values: Vec<Option<Value>> = nodes
                    .iter()
                    .enumerate()
                    .map(|(index, node)| {
                        self.value(&ANYTHING, node, &below(path, &index.to_string()))
                    })
                    .collect();
                values
                    .into_iter()
                    .collect::<Option<Vec<_>>>()
                    .map(Value::Array)
            }
            Data::Map(items) => {
                let mut map = Map::new();
                let mut whole = true;
                for item in items {
                    match self.value(&ANYTHING, &item.value, &below(path, &item.key)) {
                        Some(value) => {
                            map.insert(item.key.clone(), value);
                        }
                        None => whole = false,
                    }
                }
                whole.then_some(Value::Object(map))
            }
            _ => Some(node.to_json()),
        }
    }

    fn bounds(&mut self, schema: &Value, value: f64, node: &Node, path: &str) -> Option<()> {
        let bound = |name: &str| schema.get(name).and_then(Value::as_f64);
        let number = |bound: f64| {
            Value::from(bound)
                .to_string()
                .trim_end_matches(".0")
                .to_owned()
        };
        let mut wanted = Vec::new();
        let mut fits = true;
        if let Some(low) = bound("minimum") {
            fits &= value >= low;
            wanted.push(format!("at least {}", number(low)));
        }
        if let Some(low) = bound("exclusiveMinimum") {
            fits &= value > low;
            wanted.push(format!("above {}", number(low)));
        }
        // The largest value of a machine type says nothing to a reader.
        if let Some(high) = bound("maximum") {
            fits &= value <= high;
            if high < 1e9 {
                wanted.push(format!("at most {}", number(high)));
            }
        }
        if let Some(high) = bound("exclusiveMaximum") {
            fits &= value < high;
            wanted.push(format!("below {}", number(high)));
        }
        if fits {
            return Some(());
        }
        self.report(
            Diagnostic::new(
                Code::E0202,
                node.span,
                format!("`{}` is out of range: {}", last(path), node.inline()),
            )
            .label(format!("must be {}", wanted.join(" and "))),
        );
        None
    }
}

fn wrong_type(types: &[&str], node: &Node, path: &str) -> Diagnostic {
    let mut wanted: Vec<&str> = types
        .iter()
        .filter(|name| **name != "null")
        .map(|name| match *name {
            "boolean" => "`true` or `false`",
            "integer" => "a whole number",
            "number" => "a number",
            "string" => "text",
            "array" => "a list",
            "object" => "a map",
            other => other,
        })
        .collect();
    wanted.dedup();
    let mut diagnostic = Diagnostic::new(
        Code::E0202,
        node.span,
        if node.data == Data::Null {
            format!("`{}` has no value", last(path))
        } else {
            format!("`{}` must be {}", last(path), wanted.join(" or "))
        },
    )
    .label(if node.data == Data::Null {
        format!("must be {}", wanted.join(" or "))
    } else {
        format!("this is {}", node.what())
    });
    if let Data::Text(text) = &node.data {
        let digits = text.replace('_', "");
        if types.contains(&"boolean") && matches!(text.as_str(), "yes" | "on" | "Yes" | "On") {
            diagnostic = diagnostic.help("YAML 1.2 writes `true`");
        } else if types.contains(&"boolean") && matches!(text.as_str(), "no" | "off" | "No" | "Off")
        {
            diagnostic = diagnostic.help("YAML 1.2 writes `false`");
        } else if (types.contains(&"integer") || types.contains(&"number"))
            && digits.parse::<f64>().is_ok()
        {
            diagnostic = diagnostic.help(format!("write `{digits}`, without quotes or `_`"));
        }
    }
    if types.contains(&"string")
        && matches!(node.data, Data::Int(_) | Data::Float(_) | Data::Bool(_))
    {
        diagnostic = diagnostic.help(format!("quote it: `\"{}\"`", node.inline()));
    }
    if types.contains(&"array") && !matches!(node.data, Data::List(_) | Data::Map(_) | Data::Null) {
        diagnostic = diagnostic.help(format!("write `[{}]`", node.inline()));
    }
    diagnostic
}
