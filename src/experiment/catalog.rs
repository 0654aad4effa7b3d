//! Everything that is linked into the binary: ops, kinds of entries, built-in entries and experiments.

use super::entry::{KindEntry, LinkedEntry};
use super::settings::Settings;
use super::stage::{AnyOp, GroupEntry, OpEntry};
use schemars::generate::{SchemaGenerator, SchemaSettings};
use serde_json::Value;
use std::collections::BTreeMap;

/// Ops, kinds and entries under one look-up, with the schemas of their settings.
pub struct Catalog {
    ops: Vec<&'static dyn AnyOp>,
    groups: Vec<&'static GroupEntry>,
    kinds: Vec<KindFacts>,
    schemas: BTreeMap<&'static str, Value>,
    definitions: Value,
    /// Built-in and linked entries, as text.
    pub(super) entries: Vec<EntryText>,
    /// Shipped experiments by file name.
    experiments: &'static [(&'static str, &'static str)],
}

/// A kind of registry entries.
pub struct KindFacts {
    /// The first key of its entries' files, and their folder in `registry/`: `masking`.
    pub kind: &'static str,
    /// One line for `reviv list`.
    pub about: &'static str,
    /// Schema of the settings.
    pub schema: Value,
    /// Settings with every default filled in; fails where they do not fit the schema.
    pub parse: fn(Value) -> Result<Settings, serde_json::Error>,
}

/// An entry before it is parsed.
#[derive(Debug, Clone)]
pub struct EntryText {
    /// `registry/masking/uniform.yaml (built in)`.
    pub place: String,
    /// The entry's YAML, as written.
    pub text: std::borrow::Cow<'static, str>,
}

/// The files of `registry/` and `experiments/`, embedded by the build script: path and text.
mod embedded {
    include!(concat!(env!("OUT_DIR"), "/embedded.rs"));
}

impl Catalog {
    /// What is linked into this binary, plug-in crates included.
    pub fn linked() -> Self {
        let ops = inventory::iter::<OpEntry>.into_iter().map(|entry| entry.0);
        let kinds = inventory::iter::<KindEntry>.into_iter();
        let mut entries: Vec<EntryText> = embedded::REGISTRY
            .iter()
            .map(|(path, text)| EntryText {
                place: format!("{path} (built in)"),
                text: (*text).into(),
            })
            .collect();
        let mut linked: Vec<&LinkedEntry> = inventory::iter::<LinkedEntry>.into_iter().collect();
        linked.sort_by_key(|entry| (entry.origin, entry.text));
        entries.extend(linked.into_iter().map(|entry| EntryText {
            place: format!("{} (linked in)", entry.origin),
            text: entry.text.into(),
        }));
        let groups: Vec<&GroupEntry> = inventory::iter::<GroupEntry>.into_iter().collect();
        Self::new(ops, kinds, entries, embedded::EXPERIMENTS).with_groups(&groups)
    }

    /// A catalog of these and nothing else, for tests.
    pub fn of(ops: &[&'static dyn AnyOp], kinds: &[&KindEntry], entries: Vec<EntryText>) -> Self {
        Self::new(ops.iter().copied(), kinds.iter().copied(), entries, &[])
    }

    /// With these groups, whose ops it has, instead of its own.
    #[must_use]
    pub fn with_groups(mut self, groups: &[&'static GroupEntry]) -> Self {
        self.groups = groups.to_vec();
        self.groups.sort_by_key(|group| group.name);
        self
    }

    fn new<'k>(
        ops: impl Iterator<Item = &'static dyn AnyOp>,
        kinds: impl Iterator<Item = &'k KindEntry>,
        entries: Vec<EntryText>,
        experiments: &'static [(&'static str, &'static str)],
    ) -> Self {
        let mut generator = SchemaGenerator::new(SchemaSettings::draft2020_12());
        let mut ops: Vec<&'static dyn AnyOp> = ops.collect();
        ops.sort_by_key(|op| op.name());
        let mut kinds: Vec<&KindEntry> = kinds.collect();
        kinds.sort_by_key(|kind| kind.kind);
        kinds.dedup_by_key(|kind| kind.kind);
        let schemas = ops
            .iter()
            .map(|op| (op.name(), op.schema(&mut generator).to_value()))
            .collect();
        let kinds = kinds
            .into_iter()
            .map(|kind| KindFacts {
                kind: kind.kind,
                about: kind.about,
                schema: (kind.schema)(&mut generator).to_value(),
                parse: kind.parse,
            })
            .collect();
        let compare = generator
            .subschema_for::<super::compare::Compare>()
            .to_value();
        let mut definitions = serde_json::Map::new();
        definitions.extend(generator.take_definitions(true));
        definitions.insert("compare".to_owned(), compare);
        Self {
            ops,
            groups: Vec::new(),
            kinds,
            schemas,
            definitions: Value::Object(definitions),
            entries,
            experiments,
        }
    }

    /// All ops by name.
    pub fn ops(&self) -> &[&'static dyn AnyOp] {
        &self.ops
    }

    /// The op of a name.
    pub fn op(&self, name: &str) -> Option<&'static dyn AnyOp> {
        self.ops.iter().copied().find(|op| op.name() == name)
    }

    /// All ops that stand for several stages, by name.
    pub fn groups(&self) -> &[&'static GroupEntry] {
        &self.groups
    }

    /// The group of a name.
    pub fn group(&self, name: &str) -> Option<&'static GroupEntry> {
        self.groups.iter().copied().find(|group| group.name == name)
    }

    /// The schema of an op's settings.
    pub fn schema(&self, op: &str) -> Option<&Value> {
        self.schemas.get(op)
    }

    /// What `$ref: #/$defs/NAME` refers to.
    pub fn definition(&self, name: &str) -> Option<&Value> {
        self.definitions.get(name)
    }

    /// All definitions.
    pub fn definitions(&self) -> &Value {
        &self.definitions
    }

    /// All kinds by name.
    pub fn kinds(&self) -> &[KindFacts] {
        &self.kinds
    }

    /// The kind of a name.
    pub fn kind(&self, name: &str) -> Option<&KindFacts> {
        self.kinds.iter().find(|kind| kind.kind == name)
    }

    /// Shipped experiments: path and text.
    pub fn experiments(&self) -> &'static [(&'static str, &'static str)] {
        self.experiments
    }
}
