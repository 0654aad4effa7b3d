//! The entries of any checkpoint file: names, types, shapes, shared memory; and their values, streamed.
//!
//! Three containers: torch's zip with a pickled dictionary (`.pth`), TorchScript archives (`.jit`, `.pt`: a tree of objects
//! whose tensors get dotted names), and safetensors. Opening reads no tensor.

use super::ImportError;
use super::pickle::{Id, Node, Pickle, Scalar, Storage, TensorView};
use crate::formats::zip::{Method, ZipArchive};
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The container a checkpoint lies in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Torch,
    TorchScript,
    Safetensors,
}

/// One named tensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub name: String,
    pub view: TensorView,
    /// The first entry that is the same view of the same memory.
    pub same_as: Option<usize>,
}

impl Entry {
    pub fn shape(&self) -> Vec<usize> {
        self.view.shape.iter().map(|&d| d as usize).collect()
    }

    pub fn scalar(&self) -> Scalar {
        self.view.storage.scalar
    }

    /// Size of the values in bytes.
    pub fn bytes(&self) -> u64 {
        self.view.elements() * self.scalar().width() as u64
    }
}

/// An open checkpoint.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    format: Format,
    entries: Vec<Entry>,
    arguments: Map<String, Value>,
    others: Vec<String>,
    source: Source,
    /// Archive members whose checksum has been verified.
    verified: BTreeSet<String>,
}

#[derive(Debug)]
enum Source {
    Archive {
        zip: Box<ZipArchive<BufReader<File>>>,
        root: String,
    },
    Flat {
        file: BufReader<File>,
        start: u64,
    },
}

/// No object tree of a model is deeper or has more nodes.
const MAX_DEPTH: usize = 64;
const MAX_VISITS: usize = 1 << 20;
/// Values are handed out in pieces of at most this many.
const CHUNK: usize = 1 << 18;

impl Checkpoint {
    /// Opens a checkpoint and checks its structure; no tensor is read.
    pub fn open(path: &Path) -> Result<Self, ImportError> {
        let refused = |reason: String| ImportError::refused(path, reason);
        let mut file = File::open(path).map_err(ImportError::io(path))?;
        let mut magic = [0; 10];
        let got = file.read(&mut magic).map_err(ImportError::io(path))?;
        file.rewind().map_err(ImportError::io(path))?;
        if magic.starts_with(b"PK\x03\x04") {
            return Self::archive(path, file);
        }
        if got == 10 && magic[8..10] == *b"{\"" {
            return Self::safetensors(path, file);
        }
        Err(refused(if magic.starts_with(b"\x80\x02") {
            "a torch file older than version 1.6; save it again with a newer torch".to_owned()
        } else {
            "neither a torch archive (`.pth`, `.pt`, `.jit`) nor a safetensors file".to_owned()
        }))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn format(&self) -> Format {
        self.format
    }

    /// Named tensors, in the order of the file.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The `argparse.Namespace` under `args`, as plain values.
    pub fn arguments(&self) -> &Map<String, Value> {
        &self.arguments
    }

    /// What else lies at the top level of the file (`optimizer`, `epoch`, ...).
    pub fn others(&self) -> &[String] {
        &self.others
    }

    fn archive(path: &Path, file: File) -> Result<Self, ImportError> {
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
        let bytes = zip.read(&format!("{root}/data.pkl"), 64 << 20)?;
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
                        others.push(key.to_owned());
                    }
                }
                tree.dictionary(model.unwrap_or(top)).map_err(refused)?;
                if let Some(args) = pickle.get(top, "args") {
                    let mut plain = Plain {
                        pickle: &pickle,
                        visits: 0,
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

    fn safetensors(path: &Path, file: File) -> Result<Self, ImportError> {
        let refused = |reason: String| ImportError::refused(path, reason);
        let length = file.metadata().map_err(ImportError::io(path))?.len();
        let mut file = BufReader::new(file);
        let mut prefix = [0; 8];
        file.read_exact(&mut prefix)
            .map_err(ImportError::io(path))?;
        let header = u64::from_le_bytes(prefix);
        if header > (length - 8).min(64 << 20) {
            return Err(refused(format!("a header of {header} bytes")));
        }
        let mut text = vec![0; header as usize];
        file.read_exact(&mut text).map_err(ImportError::io(path))?;
        let parsed: Map<String, Value> = serde_json::from_slice(&text)
            .map_err(|e| refused(format!("the header is not JSON: {e}")))?;
        let available = length - 8 - header;
        let mut entries = Vec::new();
        for (name, entry) in parsed.iter().filter(|(name, _)| *name != "__metadata__") {
            let view = safetensors_view(entry, available)
                .ok_or_else(|| refused(format!("the header's entry for `{name}` is not valid")))?;
            entries.push((name.clone(), view));
        }
        let entries = identify(entries, available).map_err(refused)?;
        Ok(Self {
            path: path.to_owned(),
            format: Format::Safetensors,
            entries,
            arguments: Map::new(),
            others: Vec::new(),
            source: Source::Flat {
                file,
                start: 8 + header,
            },
            verified: BTreeSet::new(),
        })
    }

    /// Hands the values of an entry to `sink` in pieces, in C order, widened to f32 (64-bit numbers are rounded).
    pub fn stream(
        &mut self,
        index: usize,
        sink: &mut dyn FnMut(&[f32]) -> Result<(), ImportError>,
    ) -> Result<(), ImportError> {
        let view = self.entries[index].view.clone();
        let width = view.storage.scalar.width();
        let mut floats = vec![0f32; CHUNK];
        let mut bytes = vec![0u8; CHUNK * width];
        if view.elements() == 0 {
            return Ok(());
        }
        if view.is_contiguous() {
            let mut reader = self.reader(&view)?;
            let mut left = view.elements() as usize;
            while left > 0 {
                let count = left.min(CHUNK);
                let piece = &mut bytes[..count * width];
                reader.fill(piece)?;
                widen(piece, view.storage.scalar, &mut floats[..count]);
                sink(&floats[..count])?;
                left -= count;
            }
            return reader.finish();
        }
        // A strided view: read the piece of storage it spans, gather in C order.
        let span = view.end() - view.offset;
        if span > view.elements().saturating_mul(4).max(1 << 24) {
            return Err(ImportError::refused(
                &self.path,
                format!(
                    "`{}` picks {} of {span} elements of its storage: too sparse to be a weight",
                    self.entries[index].name,
                    view.elements()
                ),
            ));
        }
        let mut dense = vec![0u8; span as usize * width];
        let whole = TensorView {
            shape: vec![span],
            strides: vec![1],
            ..view.clone()
        };
        let mut reader = self.reader(&whole)?;
        reader.fill(&mut dense)?;
        reader.finish()?;
        let mut filled = 0;
        for at in positions(&view) {
            let from = at as usize * width;
            bytes[filled * width..(filled + 1) * width].copy_from_slice(&dense[from..from + width]);
            filled += 1;
            if filled == CHUNK {
                widen(&bytes, view.storage.scalar, &mut floats);
                sink(&floats)?;
                filled = 0;
            }
        }
        widen(
            &bytes[..filled * width],
            view.storage.scalar,
            &mut floats[..filled],
        );
        sink(&floats[..filled])
    }

    /// All values of an entry at once (for small ones).
    pub fn values(&mut self, index: usize) -> Result<Vec<f32>, ImportError> {
        let mut all = Vec::with_capacity(self.entries[index].view.elements() as usize);
        self.stream(index, &mut |piece| {
            all.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(all)
    }

    /// A reader over a contiguous view. The member's checksum is verified on the way, or once beforehand.
    fn reader(&mut self, view: &TensorView) -> Result<Bytes<'_>, ImportError> {
        let width = view.storage.scalar.width() as u64;
        let path = self.path.as_path();
        match &mut self.source {
            Source::Flat { file, start } => {
                file.seek(SeekFrom::Start(*start + view.offset * width))
                    .map_err(ImportError::io(path))?;
                Ok(Bytes {
                    path,
                    source: Box::new(file),
                    to_end: false,
                })
            }
            Source::Archive { zip, root } => {
                let member = format!("{root}/data/{}", view.storage.key);
                let size = zip.find(&member).map_or(0, |e| e.size);
                let whole = view.offset == 0 && view.elements() * width == size;
                if !whole && self.verified.insert(member.clone()) {
                    let mut reader = zip.reader(&member)?;
                    std::io::copy(&mut reader, &mut std::io::sink())
                        .map_err(ImportError::io(path))?;
                }
                let mut reader = zip.reader(&member)?;
                if !whole {
                    reader.skip_stored(view.offset * width)?;
                }
                Ok(Bytes {
                    path,
                    source: Box::new(reader),
                    to_end: whole,
                })
            }
        }
    }
}

/// The bytes of a view.
struct Bytes<'a> {
    path: &'a Path,
    source: Box<dyn Read + 'a>,
    /// Whether the end of the view is the end of the source, where the checksum is compared.
    to_end: bool,
}

impl Bytes<'_> {
    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), ImportError> {
        self.source
            .read_exact(buffer)
            .map_err(ImportError::io(self.path))
    }

    fn finish(mut self) -> Result<(), ImportError> {
        if self.to_end {
            self.source
                .read(&mut [0])
                .map_err(ImportError::io(self.path))?;
        }
        Ok(())
    }
}

/// Marks entries that are the same view, and refuses tensors that overlap otherwise.
fn identify(tensors: Vec<(String, TensorView)>, memory: u64) -> Result<Vec<Entry>, String> {
    let mut names = BTreeSet::new();
    let mut owners: BTreeMap<(String, u64, Vec<u64>, Vec<u64>), usize> = BTreeMap::new();
    let mut entries = Vec::with_capacity(tensors.len());
    let mut claimed = 0u64;
    for (index, (name, view)) in tensors.into_iter().enumerate() {
        if name.is_empty() || name.len() > 1024 || name.chars().any(char::is_control) {
            return Err(format!("a tensor is called {name:?}"));
        }
        if !names.insert(name.clone()) {
            return Err(format!("two tensors are called `{name}`"));
        }
        let key = (
            view.storage.key.clone(),
            view.offset,
            view.shape.clone(),
            view.strides.clone(),
        );
        let owner = *owners.entry(key).or_insert(index);
        let entry = Entry {
            name,
            view,
            same_as: (owner != index).then_some(owner),
        };
        if owner == index {
            claimed = claimed.saturating_add(entry.bytes());
        }
        entries.push(entry);
    }
    if claimed > memory {
        return Err(format!(
            "the tensors overlap: they claim {claimed} bytes of {memory}"
        ));
    }
    let mut spans: Vec<(&str, u64, u64, &str)> = entries
        .iter()
        .filter(|e| e.same_as.is_none() && e.view.is_contiguous() && e.view.elements() > 0)
        .map(|e| {
            let key = e.view.storage.key.as_str();
            (key, e.view.offset, e.view.end(), e.name.as_str())
        })
        .collect();
    spans.sort_unstable();
    for pair in spans.windows(2) {
        let (first, second) = (pair[0], pair[1]);
        let same = (first.1, first.2) == (second.1, second.2);
        if first.0 == second.0 && second.1 < first.2 && !same {
            return Err(format!("`{}` and `{}` overlap", first.3, second.3));
        }
    }
    Ok(entries)
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
                self.entries.push((name.to_owned(), view.clone()));
            }
        }
        if self.entries.is_empty() {
            return Err("it holds no dictionary of tensors".to_owned());
        }
        Ok(())
    }

    /// The tensors of a tree of TorchScript objects, under dotted names.
    fn objects(&mut self, id: Id, path: &str, depth: usize) -> Result<(), String> {
        if depth > MAX_DEPTH {
            return Err(format!("objects nested more than {MAX_DEPTH} deep"));
        }
        for (key, value) in self.pickle.pairs(id) {
            self.visits += 1;
            if self.visits > MAX_VISITS {
                return Err("an object tree of more than a million nodes".to_owned());
            }
            let Some(key) = self.pickle.text(*key) else {
                continue;
            };
            let name = if path.is_empty() {
                key.to_owned()
            } else {
                format!("{path}.{key}")
            };
            match self.pickle.node(*value) {
                Node::Tensor(view) => self.entries.push((name, view.clone())),
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
}

impl Plain<'_> {
    fn value(&mut self, id: Id, depth: usize) -> Result<Value, String> {
        self.visits += 1;
        if depth > 8 || self.visits > 1 << 16 {
            return Err("its `args` are nested too deeply or too large".to_owned());
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
                    if let Some(key) = self.pickle.text(*key) {
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

fn safetensors_view(entry: &Value, available: u64) -> Option<TensorView> {
    let scalar = match entry["dtype"].as_str()? {
        "F64" => Scalar::F64,
        "F32" => Scalar::F32,
        "F16" => Scalar::F16,
        "BF16" => Scalar::BF16,
        "I64" => Scalar::I64,
        "I32" => Scalar::I32,
        "I16" => Scalar::I16,
        "I8" => Scalar::I8,
        "U8" => Scalar::U8,
        "BOOL" => Scalar::Bool,
        _ => return None,
    };
    let numbers = |value: &Value| -> Option<Vec<u64>> {
        value.as_array()?.iter().map(Value::as_u64).collect()
    };
    let shape = numbers(&entry["shape"]).filter(|shape| shape.len() <= 8)?;
    let offsets = numbers(&entry["data_offsets"])?;
    let [begin, end] = offsets[..] else {
        return None;
    };
    let width = scalar.width() as u64;
    let elements = shape.iter().try_fold(1u64, |n, &d| n.checked_mul(d))?;
    let fits = begin <= end
        && end <= available
        && elements.checked_mul(width) == Some(end - begin)
        && begin.is_multiple_of(width);
    let mut strides = vec![1; shape.len()];
    for axis in (1..shape.len()).rev() {
        strides[axis - 1] = strides[axis] * shape[axis].max(1);
    }
    fits.then(|| TensorView {
        storage: Storage {
            key: String::new(),
            scalar,
            elements: available / width,
        },
        offset: begin / width,
        shape,
        strides,
    })
}

/// Offsets of the elements of a view in C order, relative to its start.
fn positions(view: &TensorView) -> impl Iterator<Item = u64> {
    let axes: Vec<(u64, u64)> = view
        .shape
        .iter()
        .copied()
        .zip(view.strides.iter().copied())
        .collect();
    (0..view.elements()).map(move |mut i| {
        let mut at = 0;
        for (d, stride) in axes.iter().rev() {
            at += i % d * stride;
            i /= d;
        }
        at
    })
}

/// Little-endian elements as f32. `bytes` holds exactly `out.len()` of them.
fn widen(bytes: &[u8], scalar: Scalar, out: &mut [f32]) {
    fn each<const N: usize>(bytes: &[u8], out: &mut [f32], value: impl Fn([u8; N]) -> f32) {
        for (out, chunk) in out.iter_mut().zip(bytes.as_chunks::<N>().0) {
            *out = value(*chunk);
        }
    }
    match scalar {
        Scalar::F64 => each(bytes, out, |b| f64::from_le_bytes(b) as f32),
        Scalar::F32 => each(bytes, out, f32::from_le_bytes),
        Scalar::F16 => each(bytes, out, |b| half::f16::from_le_bytes(b).to_f32()),
        Scalar::BF16 => each(bytes, out, |b| half::bf16::from_le_bytes(b).to_f32()),
        Scalar::I64 => each(bytes, out, |b| i64::from_le_bytes(b) as f32),
        Scalar::I32 => each(bytes, out, |b| i32::from_le_bytes(b) as f32),
        Scalar::I16 => each(bytes, out, |b| f32::from(i16::from_le_bytes(b))),
        Scalar::I8 => each(bytes, out, |b: [u8; 1]| f32::from(b[0] as i8)),
        Scalar::U8 | Scalar::Bool => each(bytes, out, |b: [u8; 1]| f32::from(b[0])),
    }
}
