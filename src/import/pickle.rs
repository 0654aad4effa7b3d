//! Pickle, read as data: an interpreter with an allow-list that can build numbers, text, containers and descriptions of
//! tensors, and nothing else.
//!
//! A pickle is a program. This one runs on an arena: every object is an index, so that deep nesting cannot overflow the
//! stack, sharing through the memo cannot multiply memory, and the work is linear in the length of the file. An opcode or a
//! global name outside the lists is an error that names it; nothing in the file is ever called.

use std::collections::BTreeMap;

/// Why a pickle is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("pickle: byte {offset}: {reason}")]
pub struct PickleError {
    pub offset: usize,
    pub reason: String,
}

/// An object of the arena.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Id(u32);

/// What a pickle can build here.
#[derive(Debug, Clone, PartialEq)]
pub enum Node {
    None,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(String),
    Bytes(Vec<u8>),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    /// Keys in the order of insertion; `OrderedDict` too.
    Dict(Vec<(Id, Id)>),
    /// A global name that stands on the allow-list but has not been applied to anything.
    Global(Global),
    /// An instance of `argparse.Namespace` or of a TorchScript class, with the dictionary it was given.
    Object {
        class: String,
        state: Option<Id>,
    },
    /// A piece of memory in the archive.
    Storage(Storage),
    Tensor(TensorView),
    /// A NumPy type such as `f8`.
    Dtype(String),
}

/// The element types of tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scalar {
    F64,
    F32,
    F16,
    BF16,
    I64,
    I32,
    I16,
    I8,
    U8,
    Bool,
}

impl Scalar {
    /// Bytes per element.
    pub fn width(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::BF16 | Self::I16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// `f32`, `bf16`, `i64`, ...
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::BF16 => "bf16",
            Self::I64 => "i64",
            Self::I32 => "i32",
            Self::I16 => "i16",
            Self::I8 => "i8",
            Self::U8 => "u8",
            Self::Bool => "bool",
        }
    }

    /// Whether values of this type are model weights.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F64 | Self::F32 | Self::F16 | Self::BF16)
    }
}

/// A storage of a torch archive: the member `data/<key>`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Storage {
    pub key: String,
    pub scalar: Scalar,
    /// Declared number of elements.
    pub elements: u64,
}

/// A strided view of a storage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorView {
    pub storage: Storage,
    /// In elements.
    pub offset: u64,
    pub shape: Vec<u64>,
    /// In elements.
    pub strides: Vec<u64>,
}

/// The global names that may appear.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Global {
    OrderedDict,
    Namespace,
    RebuildTensor,
    RebuildParameter,
    StorageType(Scalar),
    NumpyScalar,
    NumpyDtype,
    Encode,
    /// `torch.jit._pickle.build_intlist` and its kin: the list itself.
    TypedList,
    /// A class compiled by TorchScript, `__torch__.module.Class`.
    Script(String),
}

/// The result of reading a pickle.
#[derive(Debug, Clone)]
pub struct Pickle {
    nodes: Vec<Node>,
    root: Id,
}

/// More than any checkpoint's object tree; the tensors themselves are elsewhere.
const MAX_BYTES: usize = 64 << 20;
const MAX_TEXT: usize = 1 << 20;

impl Pickle {
    /// Reads a pickle.
    pub fn parse(bytes: &[u8]) -> Result<Self, PickleError> {
        if bytes.len() > MAX_BYTES {
            return Err(PickleError {
                offset: 0,
                reason: format!("{} bytes; the limit is {MAX_BYTES}", bytes.len()),
            });
        }
        let mut machine = Machine {
            bytes,
            at: 0,
            start: 0,
            nodes: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: BTreeMap::new(),
        };
        let root = machine.run()?;
        Ok(Self {
            nodes: machine.nodes,
            root,
        })
    }

    pub fn root(&self) -> Id {
        self.root
    }

    pub fn node(&self, id: Id) -> &Node {
        &self.nodes[id.0 as usize]
    }

    /// The text of a node that is text.
    pub fn text(&self, id: Id) -> Option<&str> {
        match self.node(id) {
            Node::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The pairs of a dictionary, or of an object's dictionary; empty for anything else.
    pub fn pairs(&self, id: Id) -> &[(Id, Id)] {
        match self.node(id) {
            Node::Dict(pairs) => pairs,
            Node::Object {
                state: Some(state), ..
            } => match self.node(*state) {
                Node::Dict(pairs) => pairs,
                _ => &[],
            },
            _ => &[],
        }
    }

    /// The value under a text key (the last one wins, as in Python).
    pub fn get(&self, id: Id, key: &str) -> Option<Id> {
        self.pairs(id)
            .iter()
            .rev()
            .find(|(k, _)| self.text(*k) == Some(key))
            .map(|(_, v)| *v)
    }
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Where the current opcode starts.
    start: usize,
    nodes: Vec<Node>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: BTreeMap<u32, Id>,
}

impl<'a> Machine<'a> {
    fn run(&mut self) -> Result<Id, PickleError> {
        loop {
            self.start = self.at;
            let opcode = self.u8()?;
            match opcode {
                // PROTO
                0x80 => {
                    let version = self.u8()?;
                    if !(2..=5).contains(&version) {
                        return self.refuse(format!("protocol {version} is not read"));
                    }
                }
                // FRAME
                0x95 => drop(self.take(8)?),
                b'.' => return self.pop(),
                b'(' => self.marks.push(self.stack.len()),
                b'0' => drop(self.pop()?),
                b'1' => drop(self.pop_mark()?),
                b'N' => self.push(Node::None),
                0x88 => self.push(Node::Bool(true)),
                0x89 => self.push(Node::Bool(false)),
                b'K' => {
                    let value = self.u8()?;
                    self.push(Node::Int(value.into()));
                }
                b'M' => {
                    let value = u16::from_le_bytes(self.array()?);
                    self.push(Node::Int(value.into()));
                }
                b'J' => {
                    let value = i32::from_le_bytes(self.array()?);
                    self.push(Node::Int(value.into()));
                }
                // LONG1
                0x8a => {
                    let length = self.u8()?;
                    let bytes = self.take(length.into())?;
                    let Some(value) = long(bytes) else {
                        return self.refuse("an integer of more than 16 bytes");
                    };
                    self.push(Node::Int(value));
                }
                b'G' => {
                    let value = f64::from_be_bytes(self.array()?);
                    self.push(Node::Float(value));
                }
                b'X' => {
                    let length = self.u32()? as usize;
                    let text = self.text(length)?;
                    self.push(Node::Text(text));
                }
                // SHORT_BINUNICODE
                0x8c => {
                    let length = self.u8()?;
                    let text = self.text(length.into())?;
                    self.push(Node::Text(text));
                }
                b'B' => {
                    let length = self.u32()? as usize;
                    let bytes = self.take(length)?.to_vec();
                    self.push(Node::Bytes(bytes));
                }
                b'C' => {
                    let length = self.u8()?;
                    let bytes = self.take(length.into())?.to_vec();
                    self.push(Node::Bytes(bytes));
                }
                b')' => self.push(Node::Tuple(Vec::new())),
                b']' => self.push(Node::List(Vec::new())),
                b'}' => self.push(Node::Dict(Vec::new())),
                b't' => {
                    let items = self.pop_mark()?;
                    self.push(Node::Tuple(items));
                }
                0x85..=0x87 => {
                    let count = usize::from(opcode - 0x84);
                    let mut items = Vec::with_capacity(count);
                    for _ in 0..count {
                        items.push(self.pop()?);
                    }
                    items.reverse();
                    self.push(Node::Tuple(items));
                }
                b'a' => {
                    let item = self.pop()?;
                    self.append(&[item])?;
                }
                b'e' => {
                    let items = self.pop_mark()?;
                    self.append(&items)?;
                }
                b's' => {
                    let value = self.pop()?;
                    let key = self.pop()?;
                    self.set(&[key, value])?;
                }
                b'u' => {
                    let items = self.pop_mark()?;
                    self.set(&items)?;
                }
                b'q' => {
                    let slot = self.u8()?;
                    self.remember(slot.into())?;
                }
                b'r' => {
                    let slot = self.u32()?;
                    self.remember(slot)?;
                }
                // MEMOIZE
                0x94 => {
                    let slot = self.memo.len() as u32;
                    self.remember(slot)?;
                }
                b'h' => {
                    let slot = self.u8()?;
                    self.recall(slot.into())?;
                }
                b'j' => {
                    let slot = self.u32()?;
                    self.recall(slot)?;
                }
                b'c' => {
                    let module = self.line()?;
                    let name = self.line()?;
                    let global = self.global(module, name)?;
                    self.push(Node::Global(global));
                }
                // STACK_GLOBAL
                0x93 => {
                    let (name, module) = (self.pop()?, self.pop()?);
                    let (Node::Text(module), Node::Text(name)) =
                        (self.node(module).clone(), self.node(name).clone())
                    else {
                        return self.refuse("a global whose name is not text");
                    };
                    let global = self.global(&module, &name)?;
                    self.push(Node::Global(global));
                }
                b'R' => self.reduce()?,
                // NEWOBJ
                0x81 => self.new_object()?,
                b'b' => self.build()?,
                b'Q' => self.persistent()?,
                other => {
                    return self.refuse(format!(
                        "opcode {other:#04x} is not on the list of those that only describe data"
                    ));
                }
            }
        }
    }

    fn refuse<T>(&self, reason: impl Into<String>) -> Result<T, PickleError> {
        Err(PickleError {
            offset: self.start,
            reason: reason.into(),
        })
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], PickleError> {
        let Some(bytes) = self.bytes[self.at..].get(..count) else {
            return self.refuse("the pickle is cut short");
        };
        self.at += count;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }

    fn u8(&mut self) -> Result<u8, PickleError> {
        Ok(self.array::<1>()?[0])
    }

    fn u32(&mut self) -> Result<u32, PickleError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn text(&mut self, length: usize) -> Result<String, PickleError> {
        if length > MAX_TEXT {
            return self.refuse(format!("a text of {length} bytes"));
        }
        match std::str::from_utf8(self.take(length)?) {
            Ok(text) => Ok(text.to_owned()),
            Err(_) => self.refuse("a text that is not UTF-8"),
        }
    }

    fn line(&mut self) -> Result<&'a str, PickleError> {
        let rest = &self.bytes[self.at..];
        let Some(end) = rest.iter().take(1024).position(|&b| b == b'\n') else {
            return self.refuse("a name without an end");
        };
        self.at += end + 1;
        match std::str::from_utf8(&rest[..end]) {
            Ok(text) => Ok(text),
            Err(_) => self.refuse("a name that is not UTF-8"),
        }
    }

    fn push(&mut self, node: Node) {
        self.stack.push(Id(self.nodes.len() as u32));
        self.nodes.push(node);
    }

    fn pop(&mut self) -> Result<Id, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= floor {
            return self.refuse("the stack is empty");
        }
        match self.stack.pop() {
            Some(id) => Ok(id),
            None => self.refuse("the stack is empty"),
        }
    }

    fn pop_mark(&mut self) -> Result<Vec<Id>, PickleError> {
        let Some(mark) = self.marks.pop() else {
            return self.refuse("no mark on the stack");
        };
        Ok(self.stack.split_off(mark))
    }

    fn top(&self) -> Result<Id, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&id) if self.stack.len() > floor => Ok(id),
            _ => self.refuse("the stack is empty"),
        }
    }

    fn node(&self, id: Id) -> &Node {
        &self.nodes[id.0 as usize]
    }

    fn append(&mut self, items: &[Id]) -> Result<(), PickleError> {
        let list = self.top()?;
        match &mut self.nodes[list.0 as usize] {
            Node::List(list) => list.extend(items),
            _ => return self.refuse("items appended to something that is not a list"),
        }
        Ok(())
    }

    fn set(&mut self, items: &[Id]) -> Result<(), PickleError> {
        let dict = self.top()?;
        if !items.len().is_multiple_of(2) {
            return self.refuse("a key without a value");
        }
        match &mut self.nodes[dict.0 as usize] {
            Node::Dict(pairs) => pairs.extend(items.chunks_exact(2).map(|p| (p[0], p[1]))),
            _ => return self.refuse("items set on something that is not a dictionary"),
        }
        Ok(())
    }

    fn remember(&mut self, slot: u32) -> Result<(), PickleError> {
        let top = self.top()?;
        self.memo.insert(slot, top);
        Ok(())
    }

    fn recall(&mut self, slot: u32) -> Result<(), PickleError> {
        match self.memo.get(&slot) {
            Some(&id) => self.stack.push(id),
            None => return self.refuse(format!("memo slot {slot} is empty")),
        }
        Ok(())
    }

    /// The allow-list.
    fn global(&self, module: &str, name: &str) -> Result<Global, PickleError> {
        Ok(match (module, name) {
            ("collections", "OrderedDict") => Global::OrderedDict,
            ("argparse", "Namespace") => Global::Namespace,
            ("torch._utils", "_rebuild_tensor_v2") => Global::RebuildTensor,
            ("torch._utils", "_rebuild_parameter") => Global::RebuildParameter,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Global::NumpyScalar,
            ("numpy", "dtype") => Global::NumpyDtype,
            ("_codecs", "encode") => Global::Encode,
            (
                "torch.jit._pickle",
                "build_intlist" | "build_doublelist" | "build_boollist" | "build_tensorlist",
            ) => Global::TypedList,
            ("torch", storage) => match storage {
                "DoubleStorage" => Global::StorageType(Scalar::F64),
                "FloatStorage" => Global::StorageType(Scalar::F32),
                "HalfStorage" => Global::StorageType(Scalar::F16),
                "BFloat16Storage" => Global::StorageType(Scalar::BF16),
                "LongStorage" => Global::StorageType(Scalar::I64),
                "IntStorage" => Global::StorageType(Scalar::I32),
                "ShortStorage" => Global::StorageType(Scalar::I16),
                "CharStorage" => Global::StorageType(Scalar::I8),
                "ByteStorage" => Global::StorageType(Scalar::U8),
                "BoolStorage" => Global::StorageType(Scalar::Bool),
                _ => return self.forbidden(module, name),
            },
            (module, name) if module.starts_with("__torch__.") => {
                Global::Script(format!("{module}.{name}"))
            }
            _ => return self.forbidden(module, name),
        })
    }

    fn forbidden<T>(&self, module: &str, name: &str) -> Result<T, PickleError> {
        self.refuse(format!(
            "it wants to call `{module}.{name}`, which no checkpoint of a model needs; nothing was executed"
        ))
    }

    fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, function) = (self.pop()?, self.pop()?);
        let Node::Tuple(arguments) = self.node(arguments).clone() else {
            return self.refuse("a call whose arguments are not a tuple");
        };
        let Node::Global(function) = self.node(function).clone() else {
            return self.refuse("a call of something that is not a name");
        };
        let node = match (function, arguments.as_slice()) {
            (Global::OrderedDict, []) => Node::Dict(Vec::new()),
            (Global::RebuildTensor, [storage, offset, shape, strides, ..]) => {
                Node::Tensor(self.tensor(*storage, *offset, *shape, *strides)?)
            }
            (Global::RebuildParameter, [tensor, ..]) | (Global::TypedList, [tensor]) => {
                self.stack.push(*tensor);
                return Ok(());
            }
            (Global::NumpyDtype, [code, ..]) => match self.node(*code) {
                Node::Text(code) => Node::Dtype(code.clone()),
                _ => return self.refuse("a NumPy type without a name"),
            },
            (Global::NumpyScalar, [dtype, bytes]) => self.numpy_scalar(*dtype, *bytes)?,
            (Global::Encode, [text, codec]) => self.latin1(*text, *codec)?,
            (function, _) => return self.refuse(format!("{function:?} called in an unknown way")),
        };
        self.push(node);
        Ok(())
    }

    fn new_object(&mut self) -> Result<(), PickleError> {
        let (arguments, class) = (self.pop()?, self.pop()?);
        let empty = matches!(self.node(arguments), Node::Tuple(items) if items.is_empty());
        let class = match self.node(class) {
            Node::Global(Global::Namespace) if empty => "argparse.Namespace".to_owned(),
            Node::Global(Global::Script(class)) if empty => class.clone(),
            Node::Global(Global::OrderedDict) if empty => {
                self.push(Node::Dict(Vec::new()));
                return Ok(());
            }
            _ => return self.refuse("an instance of something that is not a plain record"),
        };
        self.push(Node::Object { class, state: None });
        Ok(())
    }

    fn build(&mut self) -> Result<(), PickleError> {
        let given = self.pop()?;
        let target = self.top()?;
        let is_dict = matches!(self.node(given), Node::Dict(_));
        match &mut self.nodes[target.0 as usize] {
            Node::Object { state, .. } if is_dict => *state = Some(given),
            // `OrderedDict._metadata` and the byte order of a NumPy type: not needed.
            Node::Dict(_) if is_dict => {}
            Node::Dtype(_) => {
                let Node::Tuple(state) = self.node(given) else {
                    return self.refuse("a NumPy type with an unknown state");
                };
                let order = state.get(1).map(|&id| self.node(id));
                if !matches!(order, Some(Node::Text(o)) if o == "<" || o == "|") {
                    return self.refuse("a NumPy type that is not little-endian");
                }
            }
            _ => return self.refuse("a state for something that has none"),
        }
        Ok(())
    }

    /// `("storage", type, key, location, elements)`.
    fn persistent(&mut self) -> Result<(), PickleError> {
        let id = self.pop()?;
        let Node::Tuple(parts) = self.node(id) else {
            return self.refuse("a persistent object that is not a tuple");
        };
        let [kind, scalar, key, _, elements] = parts.as_slice() else {
            return self.refuse("a persistent object with an unknown form");
        };
        let storage = match (
            self.node(*kind),
            self.node(*scalar),
            self.node(*key),
            self.node(*elements),
        ) {
            (
                Node::Text(kind),
                Node::Global(Global::StorageType(scalar)),
                Node::Text(key),
                Node::Int(elements),
            ) if kind == "storage" && (0..=1 << 48).contains(elements) => Storage {
                key: key.clone(),
                scalar: *scalar,
                elements: *elements as u64,
            },
            _ => return self.refuse("a storage with an unknown form"),
        };
        self.push(Node::Storage(storage));
        Ok(())
    }

    fn tensor(
        &self,
        storage: Id,
        offset: Id,
        shape: Id,
        strides: Id,
    ) -> Result<TensorView, PickleError> {
        let Node::Storage(storage) = self.node(storage) else {
            return self.refuse("a tensor without a storage");
        };
        let offset = self.size(offset)?;
        let shape = self.sizes(shape)?;
        let strides = self.sizes(strides)?;
        if shape.len() != strides.len() || shape.len() > 8 {
            return self.refuse(format!(
                "a tensor of shape {shape:?} with strides {strides:?}"
            ));
        }
        let view = TensorView {
            storage: storage.clone(),
            offset,
            shape,
            strides,
        };
        match view.check() {
            Ok(()) => Ok(view),
            Err(reason) => self.refuse(reason),
        }
    }

    fn size(&self, id: Id) -> Result<u64, PickleError> {
        match self.node(id) {
            Node::Int(value) if (0..=1 << 48).contains(value) => Ok(*value as u64),
            other => self.refuse(format!("{other:?} is not a size")),
        }
    }

    fn sizes(&self, id: Id) -> Result<Vec<u64>, PickleError> {
        match self.node(id) {
            Node::Tuple(items) if items.len() <= 8 => {
                items.iter().map(|&item| self.size(item)).collect()
            }
            _ => self.refuse("a shape that is not a tuple of at most 8 sizes"),
        }
    }

    fn numpy_scalar(&self, dtype: Id, bytes: Id) -> Result<Node, PickleError> {
        let (Node::Dtype(dtype), Node::Bytes(bytes)) = (self.node(dtype), self.node(bytes)) else {
            return self.refuse("a NumPy number with an unknown form");
        };
        let node = match (dtype.as_str(), bytes.as_slice()) {
            ("f8", &[a, b, c, d, e, f, g, h]) => {
                Some(Node::Float(f64::from_le_bytes([a, b, c, d, e, f, g, h])))
            }
            ("f4", &[a, b, c, d]) => Some(Node::Float(f32::from_le_bytes([a, b, c, d]).into())),
            ("i8", bytes) if bytes.len() == 8 => long(bytes).map(Node::Int),
            ("i4", bytes) if bytes.len() == 4 => long(bytes).map(Node::Int),
            ("b1", &[value @ (0 | 1)]) => Some(Node::Bool(value == 1)),
            _ => None,
        };
        match node {
            Some(node) => Ok(node),
            None => self.refuse(format!("a NumPy number of type `{dtype}`")),
        }
    }

    /// `_codecs.encode(text, "latin1")` is how old protocols write bytes.
    fn latin1(&self, text: Id, codec: Id) -> Result<Node, PickleError> {
        let (Node::Text(text), Node::Text(codec)) = (self.node(text), self.node(codec)) else {
            return self.refuse("bytes with an unknown form");
        };
        let bytes: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
        match bytes {
            Some(bytes) if codec == "latin1" => Ok(Node::Bytes(bytes)),
            _ => self.refuse(format!("bytes in the encoding `{codec}`")),
        }
    }
}

impl TensorView {
    /// Number of elements.
    pub fn elements(&self) -> u64 {
        self.shape.iter().product()
    }

    /// One past the last element of the storage that the view touches.
    pub fn end(&self) -> u64 {
        if self.elements() == 0 {
            return self.offset;
        }
        let last: u64 = self
            .shape
            .iter()
            .zip(&self.strides)
            .map(|(d, s)| (d - 1) * s)
            .sum();
        self.offset + last + 1
    }

    /// Whether the elements lie in order without gaps.
    pub fn is_contiguous(&self) -> bool {
        let mut expected = 1;
        for (&d, &s) in self.shape.iter().zip(&self.strides).rev() {
            if d != 1 && s != expected {
                return false;
            }
            expected *= d;
        }
        true
    }

    /// The view must lie inside its storage, and no two of its elements may be the same one.
    fn check(&self) -> Result<(), String> {
        let elements = self
            .shape
            .iter()
            .try_fold(1u64, |n, &d| n.checked_mul(d))
            .filter(|&n| n <= self.storage.elements)
            .ok_or_else(|| {
                format!(
                    "a tensor of shape {:?} over a storage of {} elements",
                    self.shape, self.storage.elements
                )
            })?;
        if elements == 0 {
            return Ok(());
        }
        let mut axes: Vec<(u64, u64)> = self
            .strides
            .iter()
            .copied()
            .zip(self.shape.iter().copied())
            .filter(|&(_, d)| d > 1)
            .collect();
        axes.sort_unstable();
        let mut reach = 0u64;
        for (stride, d) in axes {
            if stride <= reach {
                return Err(format!(
                    "a tensor of shape {:?} with strides {:?} overlaps itself",
                    self.shape, self.strides
                ));
            }
            reach = stride
                .checked_mul(d - 1)
                .and_then(|r| r.checked_add(reach))
                .ok_or("strides that overflow")?;
        }
        let end = self
            .offset
            .checked_add(reach)
            .and_then(|e| e.checked_add(1));
        if end.is_none_or(|end| end > self.storage.elements) {
            return Err(format!(
                "a tensor of shape {:?} with strides {:?} at {} leaves its storage of {} elements",
                self.shape, self.strides, self.offset, self.storage.elements
            ));
        }
        Ok(())
    }
}

/// A little-endian two's complement integer.
fn long(bytes: &[u8]) -> Option<i128> {
    let sign = if bytes.last().is_some_and(|b| b & 0x80 != 0) {
        0xff
    } else {
        0
    };
    let mut wide = [sign; 16];
    wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
    Some(i128::from_le_bytes(wide))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn refused(bytes: &[u8]) -> String {
        Pickle::parse(bytes).unwrap_err().to_string()
    }

    #[test]
    fn numbers_texts_and_containers_are_read() {
        // pickle.dumps({"a": [1, -2, 2.5, None, True], "b": (1 << 40,)}, 2)
        let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aq\x01]q\x02(K\x01J\xfe\xff\xff\xffG@\x04\x00\x00\x00\x00\x00\x00N\x88eX\x01\x00\x00\x00bq\x03\x8a\x06\x00\x00\x00\x00\x00\x01\x85q\x04u.";
        let pickle = Pickle::parse(bytes).unwrap();
        let list = pickle.get(pickle.root(), "a").unwrap();
        let Node::List(items) = pickle.node(list) else {
            panic!("not a list")
        };
        let nodes: Vec<&Node> = items.iter().map(|&i| pickle.node(i)).collect();
        assert_eq!(
            nodes,
            [
                &Node::Int(1),
                &Node::Int(-2),
                &Node::Float(2.5),
                &Node::None,
                &Node::Bool(true)
            ]
        );
        let tuple = pickle.get(pickle.root(), "b").unwrap();
        let Node::Tuple(items) = pickle.node(tuple) else {
            panic!("not a tuple")
        };
        assert_eq!(pickle.node(items[0]), &Node::Int(1 << 40));
    }

    #[test]
    fn whatever_would_run_code_is_refused_by_name() {
        for (bytes, part) in [
            (&b"cos\nsystem\n(X\x04\x00\x00\x00truetR."[..], "os.system"),
            (b"cposix\nsystem\n.", "posix.system"),
            (b"cbuiltins\neval\n(X\x01\x00\x00\x001tR.", "builtins.eval"),
            (b"c__builtin__\ngetattr\n.", "getattr"),
            (b"\x80\x04\x8c\x02os\x8c\x06system\x93.", "os.system"),
            (b"ctorch.hub\nload\n.", "torch.hub.load"),
            (b"ctorch\nload\n.", "torch.load"),
            (b"ccollections\nOrderedDict.__init__\n.", "__init__"),
            (b"(S'true'\nios\nsystem\n.", "opcode"),
            (b"\x82\x01.", "opcode"),
        ] {
            let error = refused(bytes);
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn deep_nesting_and_memo_bombs_cost_no_more_than_their_length() {
        let mut deep = b"\x80\x02".to_vec();
        deep.extend(std::iter::repeat_n(b"]", 200_000).flatten());
        deep.extend(std::iter::repeat_n(b"a", 199_999).flatten());
        deep.push(b'.');
        assert_eq!(Pickle::parse(&deep).unwrap().nodes.len(), 200_000);
        // Sixty lists, each holding the one before twice: 2^60 leaves for a reader that copies.
        let mut bomb = b"\x80\x02]q\x00".to_vec();
        for level in 0..60u8 {
            bomb.extend([
                b'0',
                b']',
                b'q',
                level + 1,
                b'(',
                b'h',
                level,
                b'h',
                level,
                b'e',
            ]);
        }
        bomb.push(b'.');
        assert_eq!(Pickle::parse(&bomb).unwrap().nodes.len(), 61);
    }

    fn view(offset: u64, shape: &[u64], strides: &[u64], elements: u64) -> Result<(), String> {
        TensorView {
            storage: Storage {
                key: "0".to_owned(),
                scalar: Scalar::F32,
                elements,
            },
            offset,
            shape: shape.to_vec(),
            strides: strides.to_vec(),
        }
        .check()
    }

    #[test]
    fn views_must_stay_inside_their_storage_and_not_repeat_elements() {
        assert!(view(0, &[2, 3], &[3, 1], 6).is_ok());
        assert!(view(0, &[3, 2], &[1, 3], 6).is_ok());
        assert!(view(1, &[], &[], 2).is_ok());
        assert!(view(0, &[0, 3], &[3, 1], 0).is_ok());
        assert!(view(0, &[2, 2], &[4, 2], 7).is_ok());
        assert!(view(1, &[2, 3], &[3, 1], 6).is_err());
        assert!(view(0, &[1000, 1000], &[0, 0], 1).is_err());
        assert!(view(0, &[2, 3], &[1, 1], 6).is_err());
        assert!(view(0, &[1 << 40, 1 << 40], &[1, 1], 6).is_err());
        assert!(view(0, &[2, 2], &[1 << 47, 1 << 47], 6).is_err());
    }

    /// Opcodes that make progress, so that random programs get further than their first byte.
    fn program() -> impl Strategy<Value = Vec<u8>> {
        let pieces: Vec<&'static [u8]> = vec![
            b"]",
            b"}",
            b")",
            b"(",
            b"a",
            b"e",
            b"s",
            b"u",
            b"t",
            b"0",
            b"1",
            b"N",
            b"K\x03",
            b"q\x00",
            b"h\x00",
            b"h\x01",
            b"q\x01",
            b"\x85",
            b"\x86",
            b"\x87",
            b"R",
            b"b",
            b"Q",
            b"\x81",
            b"X\x01\x00\x00\x00a",
            b"X\x07\x00\x00\x00storage",
            b"ctorch\nFloatStorage\n",
            b"ctorch._utils\n_rebuild_tensor_v2\n",
            b"ccollections\nOrderedDict\n",
            b"cnumpy\ndtype\n",
            b"\x8a\x02\xff\xff",
            b"G\x00\x00\x00\x00\x00\x00\x00\x00",
            b"c__torch__.a\nB\n",
        ];
        proptest::collection::vec(proptest::sample::select(pieces), 0..60)
            .prop_map(|pieces| pieces.concat())
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Pickle::parse(&bytes);
        }

        #[test]
        fn no_program_of_allowed_opcodes_makes_it_panic(mut bytes in program()) {
            bytes.push(b'.');
            let _ = Pickle::parse(&bytes);
        }
    }
}
