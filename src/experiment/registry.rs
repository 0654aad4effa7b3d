//! The registry: built-in entries, the project's `registry/` folder and linked entries under one look-up.
//!
//! An entry is a YAML file whose first key is `<kind>: <name>`, then `about:`, then its settings. It may say
//! `extends: NAME` of the same kind. A project adds entries under new names; two entries of one name are refused.

use super::catalog::{Catalog, EntryText};
use super::diagnostic::{Diagnostic, Span};
use super::merge;
use super::names;
use super::problem::Code;
use super::source::{Origin, Source, Sources};
use super::yaml::{self, Data, Node};
use std::collections::BTreeMap;
use std::path::Path;

/// More files than any project has; a folder named `registry` by accident may have more.
const MAX_FILES: usize = 2000;

/// All entries a document can name.
#[derive(Default)]
pub struct Registry {
    /// By kind and name.
    entries: BTreeMap<(String, String), Slot>,
    /// Files that are no entries, and names given twice.
    pub problems: Vec<Problem>,
}

/// What is wrong with a file of the folder, and the way out.
type Problem = (EntryText, String, &'static str);

struct Slot {
    text: EntryText,
    parsed: Option<Node>,
    layer: Option<u32>,
}

/// An entry as `reviv list` shows it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Listed {
    /// The entry's first key: `masking`, `size`, `tokenizer`, ...
    pub kind: String,
    /// The name by which experiments refer to it.
    pub name: String,
    /// Its `about:`; empty where it has none.
    pub about: String,
    /// Where it is written: `registry/masking/uniform.yaml (built in)`.
    pub place: String,
}

impl Registry {
    /// The entries of the catalog and of the `registry/` folder of a project, if it has one.
    pub fn new(catalog: &Catalog, folder: Option<&Path>) -> Self {
        let mut registry = Self::default();
        for entry in &catalog.entries {
            registry.insert(entry.clone());
        }
        if let Some(folder) = folder {
            for (entry, unread) in project(folder) {
                match unread {
                    None => registry.insert(entry),
                    Some(reason) => registry.problems.push((entry, reason, "")),
                }
            }
        }
        registry
    }

    fn insert(&mut self, entry: EntryText) {
        let Some((kind, name)) = head(&entry.text) else {
            self.problems.push((
                entry,
                "a registry entry starts with `KIND: NAME`".to_owned(),
                "move what is no entry out of `registry/`",
            ));
            return;
        };
        let key = (kind.to_owned(), name.to_owned());
        if let Some(other) = self.entries.get(&key) {
            // The repository's own `registry/` beside its own experiments is what is built in.
            if other.text.text == entry.text {
                return;
            }
            let message = format!(
                "two {} entries are named `{}`: {} and {}",
                key.0, key.1, other.text.place, entry.place
            );
            self.problems.push((entry, message, "give it another name"));
            return;
        }
        self.entries.insert(
            key,
            Slot {
                text: entry,
                parsed: None,
                layer: None,
            },
        );
    }

    /// Puts an entry that has been read already in place of what has its name.
    pub(super) fn put(&mut self, kind: &str, name: &str, layer: u32, text: &str, path: &Path) {
        self.entries.insert(
            (kind.to_owned(), name.to_owned()),
            Slot {
                text: EntryText {
                    place: path.display().to_string(),
                    text: text.to_owned().into(),
                },
                parsed: None,
                layer: Some(layer),
            },
        );
    }

    /// Names of a kind, sorted.
    pub fn names(&self, kind: &str) -> Vec<&str> {
        self.entries
            .keys()
            .filter(|(other, _)| other == kind)
            .map(|(_, name)| name.as_str())
            .collect()
    }

    /// All kinds that have entries.
    pub fn kinds(&self) -> Vec<&str> {
        let mut kinds: Vec<&str> = self.entries.keys().map(|(kind, _)| kind.as_str()).collect();
        kinds.dedup();
        kinds
    }

    /// Entries with their docs, of one kind or all.
    pub fn list(&self, kind: Option<&str>) -> Vec<Listed> {
        self.entries
            .iter()
            .filter(|((other, _), _)| kind.is_none_or(|kind| kind == other))
            .map(|((kind, name), slot)| {
                let about = yaml::parse(&slot.text.text, 0, &mut Vec::new())
                    .and_then(|node| {
                        node.get("about")
                            .and_then(Node::text)
                            .map(|text| text.trim().to_owned())
                    })
                    .unwrap_or_default();
                Listed {
                    kind: kind.clone(),
                    name: name.clone(),
                    about,
                    place: slot.text.place.clone(),
                }
            })
            .collect()
    }

    /// The text of an entry.
    pub fn text(&self, kind: &str, name: &str) -> Option<&EntryText> {
        self.entries
            .get(&(kind.to_owned(), name.to_owned()))
            .map(|slot| &slot.text)
    }

    /// The settings of an entry: its file without the kind and `about`, over what it extends.
    ///
    /// Reports at `asked` when there is no such entry; `None` after a report.
    pub fn settings(
        &mut self,
        kind: &str,
        name: &str,
        asked: Span,
        sources: &mut Sources,
        diagnostics: &mut Vec<Diagnostic>,
    ) -> Option<Node> {
        self.resolve(kind, name, asked, sources, diagnostics, 0)
    }

    fn resolve(
        &mut self,
        kind: &str,
        name: &str,
        asked: Span,
        sources: &mut Sources,
        diagnostics: &mut Vec<Diagnostic>,
        depth: usize,
    ) -> Option<Node> {
        if depth > 16 {
            diagnostics.push(
                Diagnostic::new(
                    Code::E0104,
                    asked,
                    format!("{kind} entries extend each other: `{name}` again"),
                )
                .help("break the circle"),
            );
            return None;
        }
        let key = (kind.to_owned(), name.to_owned());
        let Some(slot) = self.entries.get_mut(&key) else {
            diagnostics.push(self.unknown(kind, name, asked));
            return None;
        };
        if let Some(node) = &slot.parsed {
            return Some(node.clone());
        }
        let layer = *slot.layer.get_or_insert_with(|| {
            sources.add(Source {
                name: slot.text.place.clone(),
                path: None,
                text: slot.text.text.to_string(),
                origin: Origin::Registry,
            })
        });
        let text = slot.text.text.clone();
        let node = yaml::parse(&text, layer, diagnostics)?;
        let Data::Map(mut items) = node.data else {
            return None;
        };
        items.retain(|item| item.key != kind && item.key != "about");
        let extends = items.iter().position(|item| item.key == "extends");
        let below = match extends.map(|index| items.remove(index)) {
            None => None,
            Some(item) => {
                let Some(parent) = item.value.text().map(str::to_owned) else {
                    diagnostics.push(Diagnostic::new(
                        Code::E0202,
                        item.value.span,
                        format!("`extends` of an entry names one {kind}"),
                    ));
                    return None;
                };
                Some(self.resolve(
                    kind,
                    &parent,
                    item.value.span,
                    sources,
                    diagnostics,
                    depth + 1,
                )?)
            }
        };
        let own = Node::new(Data::Map(items), node.span);
        let whole = match below {
            Some(below) => merge::merge(below, own, diagnostics),
            None => merge::clean(own),
        };
        if let Some(slot) = self.entries.get_mut(&key) {
            slot.parsed = Some(whole.clone());
        }
        Some(whole)
    }

    fn unknown(&self, kind: &str, name: &str, asked: Span) -> Diagnostic {
        let names = self.names(kind);
        let diagnostic = Diagnostic::new(
            Code::E0203,
            asked,
            format!("unknown {} `{name}`", noun(kind)),
        )
        .label("not in the registry");
        if names.is_empty() {
            return diagnostic.help(format!(
                "the registry has no {} yet: add registry/{kind}/{name}.yaml",
                noun(kind)
            ));
        }
        let all = format!("`reviv list {kind}` shows all {}", names.len());
        match names::nearest(name, names.iter().copied()) {
            Some(near) => diagnostic.help(format!("did you mean `{near}`? {all}")),
            None => diagnostic.help(format!(
                "{}; {all}",
                names::suggest(name, &names).unwrap_or_default()
            )),
        }
    }
}

/// What a kind is called in a sentence.
pub fn noun(kind: &str) -> String {
    match kind {
        "masking" => "masking policy".to_owned(),
        "size" => "model size".to_owned(),
        "decoding" => "decoding preset".to_owned(),
        "suite" => "evaluation suite".to_owned(),
        "published" => "published table".to_owned(),
        other => other.to_owned(),
    }
}

/// Kind and name from the first line that says something.
pub fn head(text: &str) -> Option<(&str, &str)> {
    let line = text
        .trim_start_matches('\u{feff}')
        .lines()
        .map(str::trim_end)
        .find(|line| {
            !line.trim_start().starts_with('#') && !line.trim().is_empty() && *line != "---"
        })?;
    let (kind, name) = line.split_once(':')?;
    let name = name
        .split(" #")
        .next()
        .unwrap_or("")
        .trim()
        .trim_matches(['"', '\'']);
    let plain = |text: &str| {
        !text.is_empty()
            && text
                .chars()
                .all(|c| c.is_alphanumeric() || matches!(c, '_' | '-' | '/' | '.' | '@'))
    };
    (plain(kind) && plain(name)).then_some((kind, name))
}

/// The entries of a project folder, sorted by path. Unreadable files are skipped: they are no entries.
fn project(folder: &Path) -> Vec<(EntryText, Option<String>)> {
    let mut entries = Vec::new();
    let mut folders = vec![folder.to_owned()];
    let mut seen = 0;
    while let Some(folder) = folders.pop() {
        let Ok(listing) = std::fs::read_dir(&folder) else {
            continue;
        };
        for item in listing.flatten() {
            seen += 1;
            if seen > MAX_FILES {
                break;
            }
            let path = item.path();
            let Ok(kind) = item.file_type() else { continue };
            if kind.is_dir() {
                folders.push(path);
            } else if path
                .extension()
                .is_some_and(|extension| extension == "yaml" || extension == "yml")
            {
                let (text, unread) = match super::files::read(&path) {
                    Ok(text) => (text, None),
                    Err(reason) => (String::new(), Some(format!("cannot be read: {reason}"))),
                };
                let entry = EntryText {
                    place: path.display().to_string(),
                    text: text.into(),
                };
                entries.push((entry, unread));
            }
        }
    }
    entries.sort_by(|(a, _), (b, _)| a.place.cmp(&b.place));
    entries
}
