//! Lists and maps: how many, which keys, which are missing.

use super::{ANYTHING, Validator, below, last};
use crate::experiment::diagnostic::Diagnostic;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::yaml::{Data, Item, Node};
use serde_json::{Map, Value};

impl<'c> Validator<'c, '_> {
    pub(super) fn list(
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

    pub(super) fn map(
        &mut self,
        schema: &'c Value,
        items: &[Item],
        node: &Node,
        path: &str,
    ) -> Option<Value> {
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
    pub(super) fn registry_of(&self, schema: &'c Value) -> Option<(&'c str, &'c Value)> {
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

    pub(super) fn unknown_key(&mut self, properties: &Map<String, Value>, item: &Item, path: &str) {
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
        diagnostic = if let Some(new) = names::renamed(&item.key, &known) {
            diagnostic.help(format!("it is called `{new}` now"))
        } else if known.is_empty() {
            diagnostic.help("there are no settings here: remove it")
        } else {
            diagnostic.help(names::suggest(&item.key, &known).unwrap_or_default())
        };
        self.report(diagnostic);
    }
}

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or("").trim_end_matches('.')
}
