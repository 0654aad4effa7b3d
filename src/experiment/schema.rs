//! The JSON schema of the language, for editors: experiments, sweeps and registry entries.
//!
//! It is looser than `reviv check`: a file that extends another need not be complete, and `${params.x}` stands for anything.

use super::catalog::Catalog;
use super::graph::Compare;
use super::registry::Registry;
use super::stage::{AnyOp, Arity};
use serde_json::{Map, Value, json};

/// The schema as text, as `registry/schema.json` holds it.
pub fn text(catalog: &Catalog) -> String {
    let mut text = format!("{:#}", schema(catalog));
    text.push('\n');
    text
}

/// The schema.
pub fn schema(catalog: &Catalog) -> Value {
    let registry = Registry::new(catalog, None);
    let editor = Editor { catalog, registry };
    let mut definitions = Map::new();
    if let Some(all) = catalog.definitions().as_object() {
        for (name, definition) in all {
            if name != "compare" {
                definitions.insert(name.clone(), editor.loosen(definition));
            }
        }
    }
    let mut forms = vec![reference("experiment"), reference("sweep")];
    for kind in catalog.kinds() {
        let name = format!("entry_{}", kind.kind);
        definitions.insert(
            name.clone(),
            editor.entry(kind.kind, kind.about, &kind.schema),
        );
        forms.push(reference(&name));
    }
    definitions.insert("stage".to_owned(), editor.stage());
    definitions.insert("experiment".to_owned(), editor.experiment());
    definitions.insert("sweep".to_owned(), editor.sweep());
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "reviv experiments, sweeps and registry entries",
        "anyOf": forms,
        "$defs": definitions,
    })
}

fn reference(name: &str) -> Value {
    json!({ "$ref": format!("#/$defs/{name}") })
}

struct Editor<'a> {
    catalog: &'a Catalog,
    registry: Registry,
}

impl Editor<'_> {
    /// A settings schema as an editor should see it.
    fn loosen(&self, schema: &Value) -> Value {
        match schema {
            Value::Object(map) => {
                if let Some(kind) = map.get("x-registry").and_then(Value::as_str) {
                    let mut named = self.named(kind, map.get("x-settings"));
                    for word in ["description", "default"] {
                        if let (Some(value), Some(into)) = (map.get(word), named.as_object_mut()) {
                            into.insert(word.to_owned(), value.clone());
                        }
                    }
                    return named;
                }
                let mut out = Map::new();
                for (key, value) in map {
                    // A patch of a stage need not repeat what the file below has.
                    if key == "required" || key == "x-path" || key == "x-numbered" {
                        continue;
                    }
                    out.insert(key.clone(), self.loosen(value));
                }
                if let Some(Value::String(kind)) = map.get("type")
                    && matches!(kind.as_str(), "integer" | "number" | "boolean")
                {
                    out.insert("type".to_owned(), json!([kind, "string"]));
                    out.insert("pattern".to_owned(), json!(r"^\$\{[^}]*\}$|^\?\?\?$"));
                }
                Value::Object(out)
            }
            Value::Array(items) => {
                Value::Array(items.iter().map(|item| self.loosen(item)).collect())
            }
            other => other.clone(),
        }
    }

    /// A registry reference: a name, or a map with `use`.
    fn named(&self, kind: &str, settings: Option<&Value>) -> Value {
        let names = json!({ "enum": self.registry.names(kind) });
        let mut properties = Map::new();
        properties.insert(
            "use".to_owned(),
            json!({ "anyOf": [names, {"type": "string"}], "description": "The entry that is changed" }),
        );
        if let Some(settings) = settings {
            self.properties(settings, &mut properties);
        }
        json!({
            "anyOf": [
                names,
                { "type": "string" },
                { "type": "object", "properties": properties, "additionalProperties": false },
            ]
        })
    }

    /// All properties that a settings schema has in any of its forms.
    fn properties(&self, schema: &Value, into: &mut Map<String, Value>) {
        let mut schema = schema;
        while let Some(definition) = schema
            .get("$ref")
            .and_then(Value::as_str)
            .and_then(|name| name.strip_prefix("#/$defs/"))
            .and_then(|name| self.catalog.definition(name))
        {
            schema = definition;
        }
        for word in ["oneOf", "anyOf", "allOf"] {
            for form in schema
                .get(word)
                .and_then(Value::as_array)
                .into_iter()
                .flatten()
            {
                self.properties(form, into);
            }
        }
        for (key, property) in schema
            .get("properties")
            .and_then(Value::as_object)
            .into_iter()
            .flatten()
        {
            let property = self.loosen(property);
            match into.get_mut(key) {
                None => {
                    into.insert(key.clone(), property);
                }
                Some(other) if *other == property => {}
                Some(other) => {
                    let mut forms = match other.get("anyOf").and_then(Value::as_array) {
                        Some(forms) if other.as_object().is_some_and(|map| map.len() == 1) => {
                            forms.clone()
                        }
                        _ => vec![other.clone()],
                    };
                    if !forms.contains(&property) {
                        forms.push(property);
                    }
                    *other = json!({ "anyOf": forms });
                }
            }
        }
    }

    fn entry(&self, kind: &str, about: &str, settings: &Value) -> Value {
        let mut properties = Map::new();
        properties.insert(
            kind.to_owned(),
            json!({ "type": "string", "description": "The entry's name" }),
        );
        properties.insert(
            "about".to_owned(),
            json!({ "type": "string", "description": "What `reviv list` says of it" }),
        );
        properties.insert(
            "extends".to_owned(),
            json!({ "anyOf": [{ "enum": self.registry.names(kind) }, {"type": "string"}] }),
        );
        self.properties(settings, &mut properties);
        json!({
            "description": about,
            "type": "object",
            "properties": properties,
            "required": [kind],
            "additionalProperties": false,
        })
    }

    fn stage(&self) -> Value {
        let catalog = self.catalog;
        let named = |name: &str, about: &str| json!({ "const": name, "description": about });
        let ops = catalog.ops().iter().map(|op| named(op.name(), op.about()));
        let groups = catalog.groups().iter();
        let ops: Vec<Value> = ops
            .chain(groups.map(|group| named(group.name, group.about)))
            .collect();
        let rule = |name: &str, mut properties: Map<String, Value>| {
            properties.insert("op".to_owned(), json!({ "const": name }));
            json!({
                "if": { "properties": { "op": { "const": name } }, "required": ["op"] },
                "then": { "properties": properties, "additionalProperties": false },
            })
        };
        let single = catalog.ops().iter();
        let mut rules: Vec<Value> = single.map(|op| rule(op.name(), self.op(*op))).collect();
        for group in catalog.groups() {
            let mut shared = self.op(group.op);
            shared.remove(group.setting);
            let member = json!({
                "type": ["object", "null"], "properties": shared, "additionalProperties": false,
            });
            shared.insert(
                group.members.to_owned(),
                json!({
                    "type": "object",
                    "description": format!("A stage of `{}` for each; what stands beside this holds for all", group.op.name()),
                    "additionalProperties": member,
                }),
            );
            rules.push(rule(group.name, shared));
        }
        json!({
            "type": "object",
            "properties": { "op": { "oneOf": ops, "description": "What the stage does" } },
            "allOf": rules,
        })
    }

    /// What may stand in a stage of an op, but for `op` itself.
    fn op(&self, op: &dyn AnyOp) -> Map<String, Value> {
        let mut properties = Map::new();
        properties.insert("seed".to_owned(), seed());
        for port in op.inputs() {
            let kinds: Vec<&str> = port.kinds.iter().map(|kind| kind.name()).collect();
            let about = format!("{} ({})", port.about, kinds.join(" or "));
            let form = match port.arity {
                Arity::Many | Arity::Any => json!({
                    "type": "array", "items": {"type": "string"}, "description": about,
                }),
                Arity::OneOrMore => json!({
                    "anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}],
                    "description": about,
                }),
                Arity::One => json!({ "type": "string", "description": about }),
                Arity::Optional => {
                    json!({ "type": ["string", "null"], "description": about })
                }
            };
            properties.insert(port.name.to_owned(), form);
        }
        if let Some(schema) = self.catalog.schema(op.name()) {
            self.properties(schema, &mut properties);
        }
        properties
    }

    fn experiment(&self) -> Value {
        let _ = self;
        json!({
            "type": "object",
            "properties": {
                "experiment": { "type": "string", "description": "The experiment's name" },
                "about": { "type": "string", "description": "What it is for, how long it takes, what to expect" },
                "extends": extends(),
                "seed": seed(),
                "params": { "type": "object", "description": "Values for `${params.x}`" },
                "stages": {
                    "type": "object",
                    "description": "The stages, by name",
                    "additionalProperties": reference("stage"),
                },
            },
            "required": ["experiment"],
            "additionalProperties": false,
        })
    }

    fn sweep(&self) -> Value {
        let compare = schemars::schema_for!(Compare).to_value();
        let mut compare = self.loosen(&compare);
        if let Some(map) = compare.as_object_mut() {
            // Its definitions are those of the catalog.
            map.remove("$defs");
            map.remove("$schema");
        }
        json!({
            "type": "object",
            "properties": {
                "sweep": { "type": "string", "description": "The sweep's name" },
                "base": { "type": "string", "description": "The experiment that the arms change" },
                "about": { "type": "string", "description": "What it is for, how long it takes, what to expect" },
                "extends": extends(),
                "seeds": { "type": "array", "items": seed(), "description": "Every arm runs with every seed" },
                "arms": {
                    "type": "object",
                    "description": "Changes by name: `{stages.mget.masking: uniform}`",
                    "additionalProperties": { "type": ["object", "null"] },
                },
                "grid": {
                    "type": "object",
                    "description": "Key paths and their values; every combination runs",
                    "additionalProperties": { "type": "array" },
                },
                "compare": compare,
                "params": { "type": "object", "description": "Changes of the base's `params`" },
                "stages": { "type": "object", "description": "Changes of the base's stages, for all arms" },
            },
            "required": ["sweep"],
            "additionalProperties": false,
        })
    }
}

fn extends() -> Value {
    json!({
        "description": "Files whose values this one changes; earlier first",
        "anyOf": [{ "type": "string" }, { "type": "array", "items": { "type": "string" } }],
    })
}

fn seed() -> Value {
    json!({ "type": "integer", "minimum": 0, "description": "The seed of every random number" })
}
