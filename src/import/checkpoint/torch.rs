//! Torch archives: a zip with one pickle that describes tensors, and one stored member per storage.

use super::memory::{MAX_ENTRIES, MAX_NAME, identify};
use super::{Checkpoint, Format, Source};
use crate::formats::pickle::{Id, Node, Pickle, TensorView};
use crate::formats::zip::{Method, ZipArchive};
use crate::import::ImportError;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// No object tree of a model is deeper.
const MAX_DEPTH: usize = 64;
/// Names beside the model at the top level of a file.
const MAX_OTHERS: usize = 1000;
/// Bytes of text in the `args` of a checkpoint.
const MAX_ARGUMENTS: usize = 1 << 20;
/// Values and pairs in the `args` of a checkpoint.
const MAX_PLAIN: usize = 1 << 16;
const TOO_LARGE: &str = "its `args` are nested too deeply or too large";

impl Checkpoint {
    pub(super) fn archive(path: &Path, file: File) -> Result<Self, ImportError> {
        let refused = |reason: String| ImportError::refused(path, reason);
        let mut zip = ZipArchive::new(BufReader::new(file))?;
        let roots: Vec<String> = zip
            .entries()
            .iter()
            .filter_map(|e| e.name.strip_suffix("/data.pkl"))
            .filter(|root| !root.contains('/'))
            .map(str::to_owned)
            .collect();
        let [root] = roots.as_slice() else {
            return Err(refused(format!(
                "a zip archive with {} `*/data.pkl`, a torch archive has one",
                roots.len()
            )));
        };
        let root = root.clone();
        if let Some(order) = zip.find(&format!("{root}/byteorder")).cloned()
            && zip.read(&order.name, 16)? != b"little"
        {
            return Err(refused("written on a big-endian machine".to_owned()));
        }
        let bytes = zip.read(&format!("{root}/data.pkl"), 16 << 20)?;
        let pickle = Pickle::parse(&bytes).map_err(|e| refused(e.to_string()))?;
        drop(bytes);
        let mut tree = Tree {
            pickle: &pickle,
            entries: Vec::new(),
            visits: 0,
        };
        let top = pickle.root();
        let mut arguments = Map::new();
        let mut others = Vec::new();
        let format = match pickle.node(top) {
            Node::Object { class, .. } if class.starts_with("__torch__.") => {
                tree.objects(top, "", 0).map_err(refused)?;
                Format::TorchScript
            }
            Node::Dict(_) => {
                let model = pickle
                    .get(top, "model")
                    .or_else(|| pickle.get(top, "state_dict"));
                for (key, value) in pickle.pairs(top) {
                    if let Some(key) = pickle.text(*key)
                        && model.is_some_and(|model| *value != model)
                    {
                        if key.len() > MAX_NAME || others.len() == MAX_OTHERS {
                            return Err(refused("its dictionary is no checkpoint's".to_owned()));
                        }
                        others.push(key.to_owned());
                    }
                }
                tree.dictionary(model.unwrap_or(top)).map_err(refused)?;
                if let Some(args) = pickle.get(top, "args") {
                    let mut plain = Plain {
                        pickle: &pickle,
                        visits: 0,
                        text: 0,
                    };
                    if let Value::Object(map) = plain.value(args, 0).map_err(refused)? {
                        arguments = map;
                    }
                }
                Format::Torch
            }
            _ => {
                return Err(refused(
                    "neither a dictionary nor a TorchScript module".into(),
                ));
            }
        };
        let entries = tree.entries;
        let mut sizes = BTreeMap::new();
        for (name, view) in &entries {
            let storage = &view.storage;
            let member = zip
                .find(&format!("{root}/data/{}", storage.key))
                .ok_or_else(|| {
                    refused(format!("`{name}`: storage `{}` is missing", storage.key))
                })?;
            if member.method != Method::Stored {
                return Err(refused(format!(
                    "`{name}`: its storage is compressed, which torch never does"
                )));
            }
            let bytes = storage.elements.checked_mul(storage.scalar.width() as u64);
            if bytes.is_none_or(|bytes| bytes > member.size) {
                return Err(refused(format!(
                    "`{name}`: {} elements do not fit the {} bytes of storage `{}`",
                    storage.elements, member.size, storage.key
                )));
            }
            sizes.insert(storage.key.clone(), member.size);
        }
        let entries = identify(entries, sizes.values().sum()).map_err(refused)?;
        Ok(Self {
            path: path.to_owned(),
            format,
            entries,
            arguments,
            others,
            source: Source::Archive {
                zip: Box::new(zip),
                root,
            },
            verified: BTreeSet::new(),
        })
    }
}

/// Walks what a torch pickle describes.
struct Tree<'a> {
    pickle: &'a Pickle,
    entries: Vec<(String, TensorView)>,
    visits: usize,
}

impl Tree<'_> {
    /// The tensors of a state dictionary.
    fn dictionary(&mut self, id: Id) -> Result<(), String> {
        for (key, value) in self.pickle.pairs(id) {
            if let (Some(name), Node::Tensor(view)) =
                (self.pickle.text(*key), self.pickle.node(*value))
            {
                self.push(name, view)?;
            }
        }
        if self.entries.is_empty() {
            return Err("it holds no dictionary of tensors".to_owned());
        }
        Ok(())
    }

    fn push(&mut self, name: &str, view: &TensorView) -> Result<(), String> {
        if name.len() > MAX_NAME {
            return Err(format!("a tensor's name of {} bytes", name.len()));
        }
        if self.entries.len() == MAX_ENTRIES {
            return Err(format!("more than {MAX_ENTRIES} tensors"));
        }
        self.entries.push((name.to_owned(), view.clone()));
        Ok(())
    }

    /// The tensors of a tree of TorchScript objects, under dotted names.
    fn objects(&mut self, id: Id, path: &str, depth: usize) -> Result<(), String> {
        if depth > MAX_DEPTH {
            return Err(format!("objects nested more than {MAX_DEPTH} deep"));
        }
        for (key, value) in self.pickle.pairs(id) {
            self.visits += 1;
            if self.visits > MAX_ENTRIES {
                return Err(format!("an object tree of more than {MAX_ENTRIES} nodes"));
            }
            let Some(key) = self.pickle.text(*key) else {
                continue;
            };
            if path.len() + key.len() > MAX_NAME {
                return Err(format!("a name of more than {MAX_NAME} bytes"));
            }
            let name = if path.is_empty() {
                key.to_owned()
            } else {
                format!("{path}.{key}")
            };
            match self.pickle.node(*value) {
                Node::Tensor(view) => self.push(&name, view)?,
                Node::Object { .. } => self.objects(*value, &name, depth + 1)?,
                _ => {}
            }
        }
        Ok(())
    }
}

/// Turns a namespace into plain values.
struct Plain<'a> {
    pickle: &'a Pickle,
    visits: usize,
    /// Bytes copied so far.
    text: usize,
}

impl Plain<'_> {
    fn value(&mut self, id: Id, depth: usize) -> Result<Value, String> {
        self.visits += 1;
        if let Some(text) = self.pickle.text(id) {
            self.text += text.len();
        }
        if depth > 8 || self.visits > MAX_PLAIN || self.text > MAX_ARGUMENTS {
            return Err(TOO_LARGE.to_owned());
        }
        Ok(match self.pickle.node(id) {
            Node::Bool(value) => (*value).into(),
            Node::Int(value) => match i64::try_from(*value) {
                Ok(value) => value.into(),
                Err(_) => value.to_string().into(),
            },
            Node::Float(value) => (*value).into(),
            Node::Text(value) => value.clone().into(),
            Node::Tuple(items) | Node::List(items) => {
                let items: Result<Vec<Value>, String> =
                    items.iter().map(|&i| self.value(i, depth + 1)).collect();
                Value::Array(items?)
            }
            Node::Dict(_) | Node::Object { .. } => {
                let mut map = Map::new();
                for (key, value) in self.pickle.pairs(id) {
                    // A key that is not text leads to no value, but must be looked at.
                    self.visits += 1;
                    if self.visits > MAX_PLAIN {
                        return Err(TOO_LARGE.to_owned());
                    }
                    if let Some(key) = self.pickle.text(*key) {
                        self.text += key.len();
                        let value = self.value(*value, depth + 1)?;
                        map.insert(key.to_owned(), value);
                    }
                }
                Value::Object(map)
            }
            _ => Value::Null,
        })
    }
}
