//! Nodes against the schema of a settings struct: every error at once, each at its place, and JSON that fits the struct.
//!
//! The schema is what `schemars` derives from the struct, so there is one source of truth for the struct, the editor and
//! the check. Registry references and paths are resolved on the way.

use super::catalog::Catalog;
use super::diagnostic::{Diagnostic, Span};
use super::merge;
use super::names;
use super::problem::Code;
use super::registry::{Registry, noun};
use super::source::Sources;
use super::yaml::{Data, Item, Node};
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::path::Path;

/// Where a setting comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// The layer that decided.
    pub span: Span,
    /// The values it replaced, newest first.
    pub before: Vec<(Span, String)>,
}

/// Turns nodes into settings.
pub struct Typer<'c, 'm> {
    pub catalog: &'c Catalog,
    pub registry: &'m mut Registry,
    pub sources: &'m mut Sources,
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

impl<'c> Typer<'c, '_> {
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
        for word in ["anyOf", "oneOf"] {
            if let Some(choices) = schema.get(word).and_then(Value::as_array) {
                let choices: Vec<&'c Value> =
                    choices.iter().map(|choice| self.follow(choice)).collect();
                return self.choice(&choices, node, path);
            }
        }
        if let Some(names) = constants(schema) {
            return self.constant(&names, node, path);
        }
        self.plain(schema, node, path)
    }

    fn trace(&mut self, node: &Node, path: &str) {
        let mut before = Vec::new();
        let mut earlier = node.before.as_deref();
        while let Some(node) = earlier {
            before.push((node.span, node.inline()));
            earlier = node.before.as_deref();
        }
        self.traces.insert(
            path.to_owned(),
            Trace {
                span: node.span,
                before,
            },
        );
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

    fn list(
        &mut self,
        schema: &'c Value,
        nodes: &[Node],
        node: &Node,
        path: &str,
    ) -> Option<Value> {
        let count = |name: &str| schema.get(name).and_then(Value::as_u64);
        let (least, most) = (count("minItems"), count("maxItems"));
        let len = nodes.len() as u64;
        let mut whole = true;
        if least.is_some_and(|least| len < least) || most.is_some_and(|most| len > most) {
            let wanted = match (least, most) {
                (Some(least), Some(most)) if least == most => format!("{least}"),
                (Some(least), Some(most)) => format!("{least} to {most}"),
                (Some(least), None) => format!("at least {least}"),
                (_, most) => format!("at most {}", most.unwrap_or(0)),
            };
            self.report(Diagnostic::new(
                Code::E0202,
                node.span,
                format!("`{}` needs {wanted} values, not {len}", last(path)),
            ));
            whole = false;
        }
        let prefix = schema.get("prefixItems").and_then(Value::as_array);
        let items = schema.get("items").unwrap_or(&ANYTHING);
        let mut values = Vec::with_capacity(nodes.len());
        for (index, node) in nodes.iter().enumerate() {
            let schema = prefix.and_then(|prefix| prefix.get(index)).unwrap_or(items);
            match self.value(schema, node, &below(path, &index.to_string())) {
                Some(value) => values.push(value),
                None => whole = false,
            }
        }
        if schema.get("uniqueItems") == Some(&ANYTHING) {
            for index in 1..values.len() {
                if values[..index].contains(&values[index]) {
                    self.report(Diagnostic::new(
                        Code::E0202,
                        nodes[index].span,
                        format!("`{}` twice in `{}`", nodes[index].inline(), last(path)),
                    ));
                    whole = false;
                }
            }
        }
        whole.then_some(Value::Array(values))
    }

    fn map(&mut self, schema: &'c Value, items: &[Item], node: &Node, path: &str) -> Option<Value> {
        static NONE: std::sync::LazyLock<Map<String, Value>> = std::sync::LazyLock::new(Map::new);
        let properties = schema
            .get("properties")
            .and_then(Value::as_object)
            .unwrap_or(&NONE);
        let rest = schema
            .get("additionalProperties")
            .or_else(|| schema.get("unevaluatedProperties"));
        let mut map = Map::new();
        let mut whole = true;
        for item in items {
            let path = below(path, &item.key);
            let schema = match (properties.get(&item.key), rest) {
                (Some(schema), _) => schema,
                (None, Some(schema)) if *schema != Value::Bool(false) => schema,
                (None, None) if properties.is_empty() => &ANYTHING,
                _ => {
                    self.unknown_key(properties, item, &path);
                    whole = false;
                    continue;
                }
            };
            match self.value(schema, &item.value, &path) {
                Some(value) => {
                    map.insert(item.key.clone(), value);
                }
                None => whole = false,
            }
        }
        for (name, property) in properties {
            if items.iter().any(|item| item.key == *name) {
                continue;
            }
            // A default that is a registry entry means the entry as the registry has it.
            let default = property.pointer("/default/use").and_then(Value::as_str);
            if let Some(entry) = default
                && let Some((kind, settings)) = self.registry_of(property)
            {
                let path = below(path, name);
                let named = Node::new(Data::Text(entry.to_owned()), node.span);
                match self.entry(kind, settings, &named, &path) {
                    Some(value) => {
                        map.insert(name.clone(), value);
                    }
                    None => whole = false,
                }
                self.traces.remove(&path);
            }
        }
        for name in schema
            .get("required")
            .and_then(Value::as_array)
            .into_iter()
            .flatten()
            .filter_map(Value::as_str)
        {
            if !items.iter().any(|item| item.key == name) {
                let about = properties
                    .get(name)
                    .and_then(|schema| schema.get("description"))
                    .and_then(Value::as_str)
                    .map(|text| format!(": {}", first_line(text)))
                    .unwrap_or_default();
                self.report(
                    Diagnostic::new(Code::E0204, node.span, format!("`{name}` is missing"))
                        .label(format!("needs `{name}`"))
                        .help(format!("add `{name}`{about}")),
                );
                whole = false;
            }
        }
        whole.then_some(Value::Object(map))
    }

    /// The kind and settings of a registry reference, optional or not.
    fn registry_of(&self, schema: &'c Value) -> Option<(&'c str, &'c Value)> {
        let schema = self.follow(schema);
        if let Some(kind) = schema.get("x-registry").and_then(Value::as_str) {
            return Some((kind, schema.get("x-settings").unwrap_or(&ANYTHING)));
        }
        schema
            .get("anyOf")
            .and_then(Value::as_array)?
            .iter()
            .find_map(|choice| self.registry_of(choice))
    }

    fn unknown_key(&mut self, properties: &Map<String, Value>, item: &Item, path: &str) {
        let mut known: Vec<&str> = properties.keys().map(String::as_str).collect();
        if path == item.key {
            known.extend(self.beside.iter().copied());
        }
        known.sort_unstable();
        let mut diagnostic = Diagnostic::new(
            Code::E0201,
            item.key_span,
            format!("unknown key `{}`", item.key),
        )
        .label("nothing reads this");
        diagnostic = if known.is_empty() {
            diagnostic.help("there are no settings here: remove it")
        } else {
            diagnostic.help(names::suggest(&item.key, &known).unwrap_or_default())
        };
        self.report(diagnostic);
    }

    /// A value that may have one of several forms.
    fn choice(&mut self, choices: &[&'c Value], node: &Node, path: &str) -> Option<Value> {
        let is_null = |schema: &Value| schema.get("type").and_then(Value::as_str) == Some("null");
        if node.data == Data::Null && choices.iter().copied().any(is_null) {
            return Some(Value::Null);
        }
        let choices: Vec<&'c Value> = choices
            .iter()
            .copied()
            .filter(|choice| !is_null(choice))
            .collect();
        if let [only] = choices.as_slice() {
            return self.value(only, node, path);
        }
        let names: Vec<String> = choices
            .iter()
            .filter_map(|c| constants(c))
            .flatten()
            .collect();
        let maps: Vec<&'c Value> = choices
            .iter()
            .copied()
            .filter(|choice| choice.get("type").and_then(Value::as_str) == Some("object"))
            .collect();
        // Only names: an enum without data, each variant with its own docs.
        if names.len() >= choices.len() {
            return self.constant(&names, node, path);
        }
        // A tag inside each map: `{family: kinematic, codebook: 256}`.
        if maps.len() == choices.len()
            && let Some(tag) = tag_of(&maps)
        {
            return self.tagged(&tag, &maps, node, path);
        }
        // A map of one key, or a name: `{fixed: 3}` or `none`.
        let by_key: Vec<(&str, &'c Value)> = maps.iter().filter_map(|m| single_key(m)).collect();
        if by_key.len() == maps.len() && by_key.len() + names.len() >= choices.len() {
            if let Data::Text(_) = &node.data {
                return self.constant(&names, node, path);
            }
            if let [item] = node.items()
                && let Some((key, schema)) = by_key.iter().find(|(key, _)| *key == item.key)
            {
                let value = self.value(schema, &item.value, &below(path, key))?;
                return Some(Value::Object(
                    [((*key).to_owned(), value)].into_iter().collect(),
                ));
            }
            let known: Vec<String> = by_key
                .iter()
                .map(|(key, _)| format!("`{{{key}: ...}}`"))
                .chain(names.iter().map(|name| format!("`{name}`")))
                .collect();
            self.report(
                Diagnostic::new(
                    Code::E0202,
                    node.span,
                    format!("`{}` does not take {}", last(path), node.what()),
                )
                .help(format!("one of {}", known.join(", "))),
            );
            return None;
        }
        // Anything else: the form with the fewest complaints.
        let mut best: Option<(usize, Vec<Diagnostic>)> = None;
        let traces = self.traces.clone();
        for choice in &choices {
            let mut diagnostics = Vec::new();
            let mut inner = Typer {
                catalog: self.catalog,
                registry: self.registry,
                sources: self.sources,
                diagnostics: &mut diagnostics,
                traces: traces.clone(),
                beside: self.beside.clone(),
                prefix: self.prefix.clone(),
            };
            let value = inner.value(choice, node, path);
            let traces = inner.traces;
            if let Some(value) = value {
                self.traces = traces;
                return Some(value);
            }
            // A form of the right type that fails inside tells more than a wrong type.
            let shallow = diagnostics.iter().any(|d| d.span == node.span);
            let score = diagnostics.len() + if shallow { 1000 } else { 0 };
            if best.as_ref().is_none_or(|(least, _)| score < *least) {
                best = Some((score, diagnostics));
            }
        }
        if let Some((score, diagnostics)) = best
            && score < 1000
        {
            self.diagnostics.extend(diagnostics);
            return None;
        }
        let forms: Vec<&str> = choices
            .iter()
            .filter_map(|choice| choice.get("type").and_then(Value::as_str))
            .collect();
        self.report(wrong_type(&forms, node, path));
        None
    }

    fn constant(&mut self, names: &[String], node: &Node, path: &str) -> Option<Value> {
        let text = match &node.data {
            Data::Text(text) => text.clone(),
            Data::Int(_) | Data::Float(_) | Data::Bool(_) => node.to_json().to_string(),
            _ => {
                let all: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
                self.report(
                    Diagnostic::new(
                        Code::E0202,
                        node.span,
                        format!("`{}` must be a name, not {}", last(path), node.what()),
                    )
                    .help(format!("one of {}", all.join(", "))),
                );
                return None;
            }
        };
        if names.contains(&text) {
            return Some(Value::String(text));
        }
        let known: Vec<&str> = names.iter().map(String::as_str).collect();
        self.report(
            Diagnostic::new(
                Code::E0203,
                node.span,
                format!("unknown value `{text}` of `{}`", last(path)),
            )
            .label("not one of its values")
            .help(names::suggest(&text, &known).unwrap_or_default()),
        );
        None
    }

    fn tagged(&mut self, tag: &str, maps: &[&'c Value], node: &Node, path: &str) -> Option<Value> {
        let name_of = |schema: &Value| {
            schema
                .pointer(&format!("/properties/{tag}"))
                .and_then(constants)
                .and_then(|names| names.into_iter().next())
                .unwrap_or_default()
        };
        let names: Vec<String> = maps.iter().map(|schema| name_of(schema)).collect();
        let known: Vec<&str> = names.iter().map(String::as_str).collect();
        if !matches!(node.data, Data::Map(_)) {
            self.report(wrong_type(&["object"], node, path));
            return None;
        }
        let Some(value) = node.get(tag) else {
            self.report(
                Diagnostic::new(Code::E0204, node.span, format!("`{tag}` is missing"))
                    .help(names::suggest("", &known).unwrap_or_default()),
            );
            return None;
        };
        let chosen = value.text().and_then(|text| {
            maps.iter()
                .zip(&names)
                .find(|(_, name)| *name == text)
                .map(|(schema, _)| *schema)
        });
        let Some(schema) = chosen else {
            self.constant(&names, value, &below(path, tag));
            return None;
        };
        self.plain(schema, node, path)
    }

    fn path(&mut self, node: &Node, path: &str, optional: bool) -> Option<Value> {
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
    fn entry(&mut self, kind: &str, settings: &'c Value, node: &Node, path: &str) -> Option<Value> {
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

/// The names of an enum without data.
fn constants(schema: &Value) -> Option<Vec<String>> {
    let name = |value: &Value| match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    if let Some(value) = schema.get("const") {
        return Some(vec![name(value)]);
    }
    schema
        .get("enum")
        .and_then(Value::as_array)
        .map(|values| values.iter().map(name).collect())
}

/// The key that every map of an internally tagged enum has with a constant.
fn tag_of(maps: &[&Value]) -> Option<String> {
    let first = maps.first()?.get("properties")?.as_object()?;
    first
        .iter()
        .filter(|(_, schema)| schema.get("const").is_some())
        .map(|(key, _)| key.clone())
        .find(|key| {
            maps.iter().all(|schema| {
                schema
                    .pointer(&format!("/properties/{key}/const"))
                    .is_some()
            })
        })
}

/// The only key of a variant of an externally tagged enum.
fn single_key(schema: &Value) -> Option<(&str, &Value)> {
    let properties = schema.get("properties")?.as_object()?;
    let required = schema.get("required")?.as_array()?;
    (properties.len() == 1 && required.len() == 1)
        .then(|| properties.iter().next())
        .flatten()
        .map(|(key, schema)| (key.as_str(), schema))
}

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or("").trim_end_matches('.')
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
