//! Values of several forms: enums in each of the ways in which a schema writes them.

use super::{Validator, below, last, wrong_type};
use crate::experiment::diagnostic::Diagnostic;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::yaml::{Data, Node};
use serde_json::Value;

impl<'c> Validator<'c, '_> {
    /// A value that may have one of several forms.
    pub(super) fn choice(
        &mut self,
        choices: &[&'c Value],
        node: &Node,
        path: &str,
    ) -> Option<Value> {
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
            let mut inner = Validator {
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

    pub(super) fn constant(&mut self, names: &[String], node: &Node, path: &str) -> Option<Value> {
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

    pub(super) fn tagged(
        &mut self,
        tag: &str,
        maps: &[&'c Value],
        node: &Node,
        path: &str,
    ) -> Option<Value> {
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
}

/// Whether a value is one of several of a kind, `cuda:1`, where the schema says that kinds are numbered.
pub(super) fn numbered(schema: &Value, node: &Node) -> bool {
    let kinds = schema.get("x-numbered").and_then(Value::as_array);
    let Some((kinds, (kind, number))) = kinds.zip(node.text().and_then(|t| t.split_once(':')))
    else {
        return false;
    };
    let digits = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    digits && number.parse::<usize>().is_ok() && kinds.iter().any(|known| known == kind)
}

/// The names of an enum without data.
pub(super) fn constants(schema: &Value) -> Option<Vec<String>> {
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
pub(super) fn tag_of(maps: &[&Value]) -> Option<String> {
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
pub(super) fn single_key(schema: &Value) -> Option<(&str, &Value)> {
    let properties = schema.get("properties")?.as_object()?;
    let required = schema.get("required")?.as_array()?;
    (properties.len() == 1 && required.len() == 1)
        .then(|| properties.iter().next())
        .flatten()
        .map(|(key, schema)| (key.as_str(), schema))
}
