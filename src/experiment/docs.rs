//! Settings as a table: key, form, default and what it does, read from the schema of the settings struct.

use super::catalog::Catalog;
use super::registry::noun;
use serde::Serialize;
use serde_json::Value;

/// One setting.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setting {
    /// `tokenizer.codebook`.
    pub key: String,
    /// `whole number`, `masking policy`, `cosine | linear`.
    pub form: String,
    /// The first line of its docs.
    pub about: String,
    /// Its default, a registry reference by its name; `None` where the schema has none.
    pub default: Option<Value>,
}

/// The settings of a schema, nested ones with dotted keys.
pub fn settings(catalog: &Catalog, schema: &Value) -> Vec<Setting> {
    let mut settings = Vec::new();
    collect(catalog, schema, "", 0, &mut settings);
    settings
}

fn follow<'a>(catalog: &'a Catalog, schema: &'a Value) -> &'a Value {
    let mut schema = schema;
    for _ in 0..16 {
        let definition = schema
            .get("$ref")
            .and_then(Value::as_str)
            .and_then(|name| name.strip_prefix("#/$defs/"))
            .and_then(|name| catalog.definition(name));
        match definition {
            Some(definition) => schema = definition,
            None => break,
        }
    }
    schema
}

fn collect(catalog: &Catalog, schema: &Value, path: &str, depth: usize, into: &mut Vec<Setting>) {
    let schema = follow(catalog, schema);
    if let Some(variants) = schema.get("oneOf").and_then(Value::as_array) {
        for variant in variants {
            collect(catalog, variant, path, depth, into);
        }
        return;
    }
    for (key, property) in schema
        .get("properties")
        .and_then(Value::as_object)
        .into_iter()
        .flatten()
    {
        let key = if path.is_empty() {
            key.clone()
        } else {
            format!("{path}.{key}")
        };
        let inner = follow(catalog, property);
        let nested = inner.get("properties").is_some() && depth < 3;
        let about = property
            .get("description")
            .or_else(|| inner.get("description"))
            .and_then(Value::as_str)
            .and_then(|text| text.lines().next())
            .unwrap_or("")
            .to_owned();
        if nested {
            collect(catalog, inner, &key, depth + 1, into);
            continue;
        }
        into.push(Setting {
            key,
            form: form(catalog, property),
            about,
            default: property.get("default").map(short),
        });
    }
}

/// A default that is a registry reference is shown by its name.
fn short(value: &Value) -> Value {
    value.get("use").unwrap_or(value).clone()
}

/// The form of a value in a few words.
pub fn form(catalog: &Catalog, schema: &Value) -> String {
    let schema = follow(catalog, schema);
    if let Some(kind) = schema.get("x-registry").and_then(Value::as_str) {
        return noun(kind);
    }
    if schema.get("x-path").is_some() {
        return "file".to_owned();
    }
    if let Some(value) = schema.get("const") {
        return value
            .as_str()
            .map_or_else(|| value.to_string(), str::to_owned);
    }
    if let Some(values) = schema.get("enum").and_then(Value::as_array) {
        let names: Vec<&str> = values.iter().filter_map(Value::as_str).collect();
        return names.join(" | ");
    }
    for word in ["anyOf", "oneOf"] {
        if let Some(choices) = schema.get(word).and_then(Value::as_array) {
            let mut forms: Vec<String> = choices
                .iter()
                .map(|choice| form(catalog, choice))
                .filter(|form| form != "null")
                .collect();
            forms.dedup();
            if let (Some(kinds), Some(last)) = (schema.get("x-numbered"), forms.last_mut())
                && let Some(kind) = kinds.get(0).and_then(Value::as_str)
            {
                *last = format!("{kind}:1");
            }
            return forms.join(" | ");
        }
    }
    let name = |name: &str| {
        match name {
            "integer" => "whole number",
            "number" => "number",
            "boolean" => "true | false",
            "string" => "text",
            "object" => "map",
            other => other,
        }
        .to_owned()
    };
    match schema.get("type") {
        Some(Value::String(kind)) if kind == "array" => schema.get("items").map_or_else(
            || "list".to_owned(),
            |items| format!("[{}]", form(catalog, items)),
        ),
        Some(Value::String(kind)) => name(kind),
        Some(Value::Array(kinds)) => {
            let kinds: Vec<String> = kinds
                .iter()
                .filter_map(Value::as_str)
                .filter(|kind| *kind != "null")
                .map(name)
                .collect();
            kinds.join(" | ")
        }
        _ => "anything".to_owned(),
    }
}
