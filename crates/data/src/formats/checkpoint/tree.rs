//! What the objects of a torch pickle describe: the dictionary of tensors, or the tree of a compiled module, and the arguments
//! beside it.

use super::memory::{MAX_ENTRIES, MAX_NAME, identify};
use super::{BARE, Checkpoint, CheckpointError, Format, Source};
use crate::formats::pickle::{Global, Id, Node, Pickle, TensorView};
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::path::Path;

/// No object tree of a model is deeper.
const MAX_DEPTH: usize = 64;
/// Dictionaries around the one of the tensors.
const MAX_NESTING: usize = 8;
/// Names beside the model at the top level of a file.
const MAX_OTHERS: usize = 1000;
/// Bytes of text in the `args` of a checkpoint.
const MAX_ARGUMENTS: usize = 1 << 20;
/// Values and pairs in the `args` of a checkpoint.
const MAX_PLAIN: usize = 1 << 16;
const TOO_LARGE: &str = "its `args` are nested too deeply or too large";

/// Keys under which trainers store the weights, the first that is there counts.
pub(super) const WEIGHTS: [&str; 13] = [
    "model",
    "state_dict",
    "model_state_dict",
    "model_state",
    "module",
    "net",
    "network",
    "weights",
    "params",
    "ema",
    "model_ema",
    "ema_model",
    "ema_state_dict",
];
/// Keys of dictionaries with tensors that are no weights.
const NOT_WEIGHTS: [&str; 9] = [
    "optimizer",
    "optimizer_state_dict",
    "optimizer_states",
    "optim",
    "lr_scheduler",
    "scheduler",
    "scaler",
    "rng_state",
    "callbacks",
];

/// What a torch pickle holds.
pub(super) struct Contents {
    pub format: Format,
    pub entries: Vec<(String, TensorView)>,
    pub opaque: Vec<(String, &'static str)>,
    pub arguments: Map<String, Value>,
    pub others: Vec<String>,
    /// Keys that lead to the dictionary of the tensors.
    pub wrappers: Vec<String>,
}

impl Checkpoint {
    /// A checkpoint of what a torch pickle holds, whose storages have `stored` bytes together.
    pub(super) fn of_pickle(
        path: &Path,
        contents: Contents,
        stored: u64,
        source: Source,
    ) -> Result<Self, CheckpointError> {
        let (entries, overlap) = identify(contents.entries, stored)
            .map_err(|reason| CheckpointError::refused(path, reason))?;
        Ok(Self {
            path: path.to_owned(),
            format: contents.format,
            entries,
            arguments: contents.arguments,
            others: contents.others,
            wrappers: contents.wrappers,
            opaque: contents.opaque,
            source,
            overlap,
            verified: BTreeSet::new(),
        })
    }
}

/// Reads what a torch pickle describes.
pub(super) fn contents(pickle: &Pickle) -> Result<Contents, String> {
    let mut tree = Tree {
        pickle,
        entries: Vec::new(),
        opaque: Vec::new(),
        visits: 0,
    };
    let top = pickle.root();
    let mut arguments = Map::new();
    let mut others = Vec::new();
    let mut wrappers = Vec::new();
    let format = match pickle.node(top) {
        Node::Object { class, .. } if class.starts_with("__torch__.") => {
            tree.objects(top, "", 0)?;
            Format::TorchScript
        }
        Node::Dict(_) => {
            let model = tree.weights(top, &mut wrappers)?;
            for (key, _) in pickle.pairs(top) {
                if let Some(key) = pickle.text(*key)
                    && wrappers.first().is_some_and(|first| first != key)
                {
                    if key.len() > MAX_NAME || others.len() == MAX_OTHERS {
                        return Err("its dictionary is no checkpoint's".to_owned());
                    }
                    others.push(key.to_owned());
                }
            }
            tree.dictionary(model)?;
            if let Some(args) = pickle.get(top, "args") {
                let mut plain = Plain {
                    pickle,
                    visits: 0,
                    text: 0,
                };
                if let Value::Object(map) = plain.value(args, 0)? {
                    arguments = map;
                }
            }
            Format::Torch
        }
        // Without names: one tensor, or several in their order.
        Node::Tensor(view) => {
            tree.push(BARE, view)?;
            Format::Torch
        }
        Node::List(items) | Node::Tuple(items) => {
            for (index, item) in items.iter().enumerate() {
                if let Node::Tensor(view) = pickle.node(*item) {
                    tree.push(&index.to_string(), view)?;
                }
            }
            if tree.entries.is_empty() {
                return Err("it holds no dictionary of tensors".to_owned());
            }
            Format::Torch
        }
        _ => return Err("neither a dictionary nor a TorchScript module".to_owned()),
    };
    Ok(Contents {
        format,
        entries: tree.entries,
        opaque: tree.opaque,
        arguments,
        others,
        wrappers,
    })
}

/// Walks what a torch pickle describes.
struct Tree<'a> {
    pickle: &'a Pickle,
    entries: Vec<(String, TensorView)>,
    opaque: Vec<(String, &'static str)>,
    visits: usize,
}

impl Tree<'_> {
    /// Whether a dictionary has tensors under names of its own.
    fn has_tensors(&self, id: Id) -> bool {
        self.pickle.pairs(id).iter().any(|(key, value)| {
            self.pickle.text(*key).is_some()
                && matches!(self.pickle.node(*value), Node::Tensor(_) | Node::Opaque(_))
        })
    }

    /// Whether a dictionary, or one in it, has tensors.
    fn leads_to_tensors(&self, id: Id) -> bool {
        let mut met = BTreeSet::from([id]);
        let mut open = vec![id];
        while let Some(id) = open.pop() {
            if self.has_tensors(id) {
                return true;
            }
            for (key, value) in self.pickle.pairs(id) {
                if self.pickle.text(*key).is_some() && met.insert(*value) {
                    open.push(*value);
                }
            }
        }
        false
    }

    /// The dictionary of the weights at or below `top`; the keys that lead to it are added to `path`.
    fn weights(&self, top: Id, path: &mut Vec<String>) -> Result<Id, String> {
        let mut at = top;
        for _ in 0..MAX_NESTING {
            let named = WEIGHTS.iter().find_map(|key| {
                let inside = self.pickle.get(at, key)?;
                self.leads_to_tensors(inside).then_some((*key, inside))
            });
            let next = match named {
                Some(named) => Some(named),
                None if self.has_tensors(at) => None,
                None => self.only_dictionary(at)?,
            };
            let Some((key, inside)) = next else {
                return Ok(at);
            };
            if key.len() > MAX_NAME {
                return Err("its dictionary is no checkpoint's".to_owned());
            }
            path.push(key.to_owned());
            at = inside;
        }
        Err(format!("dictionaries nested more than {MAX_NESTING} deep"))
    }

    /// The only dictionary with tensors in a dictionary that has none itself.
    fn only_dictionary(&self, id: Id) -> Result<Option<(&str, Id)>, String> {
        let mut found: Option<(&str, Id)> = None;
        for (key, value) in self.pickle.pairs(id) {
            let Some(key) = self.pickle.text(*key) else {
                continue;
            };
            if NOT_WEIGHTS.contains(&key) || !self.leads_to_tensors(*value) {
                continue;
            }
            if let Some((first, _)) = found {
                let short = |name: &str| name.chars().take(60).collect::<String>();
                return Err(format!(
                    "it holds several dictionaries of tensors, `{}` and `{}`, and none is called `model` or `state_dict`",
                    short(first),
                    short(key)
                ));
            }
            found = Some((key, *value));
        }
        Ok(found)
    }

    /// The tensors of a state dictionary.
    fn dictionary(&mut self, id: Id) -> Result<(), String> {
        for (key, value) in self.pickle.pairs(id) {
            let Some(name) = self.pickle.text(*key) else {
                continue;
            };
            match self.pickle.node(*value) {
                Node::Tensor(view) => self.push(name, view)?,
                Node::Opaque(what) => self.opaque(name, what)?,
                _ => {}
            }
        }
        if self.entries.is_empty() && self.opaque.is_empty() {
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

    fn opaque(&mut self, name: &str, what: &'static str) -> Result<(), String> {
        if name.len() > MAX_NAME || self.opaque.len() == MAX_ENTRIES {
            return Err(format!(
                "a tensor's name of {} bytes, or too many tensors",
                name.len()
            ));
        }
        self.opaque.push((name.to_owned(), what));
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
                Node::Opaque(what) => self.opaque(&name, what)?,
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
            Node::Complex(real, imaginary) => format!("{real}{imaginary:+}j").into(),
            Node::Global(Global::TorchType(scalar)) => scalar.torch().into(),
            Node::Dtype(code) => code.clone().into(),
            Node::Tuple(items) | Node::List(items) | Node::Set(items) => {
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
