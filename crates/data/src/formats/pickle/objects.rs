//! What a call of each name of the allow-list describes. Nothing is ever called.

use super::machine::Machine;
use super::scalars::{long, ucs4, unsigned};
use super::{
    ArrayView, Global, Id, MAX_COPIED, MAX_COPIES, Node, PickleError, Scalar, Storage, StoredBytes,
    TensorView,
};

/// More than any function of the list has.
const MAX_ARGUMENTS: usize = 16;
/// A tensor of quantised numbers that share their bytes.
const PACKED: &str = "a quantised tensor of several numbers to a byte";
/// A tensor whose state has not come.
const EMPTY: &str = "a tensor without a state";

impl Machine<'_> {
    /// A text that a call copies.
    fn short(&self, text: &str) -> Result<String, PickleError> {
        if text.len() > MAX_COPIED {
            return self.refuse(format!("a name of {} bytes", text.len()));
        }
        Ok(text.to_owned())
    }

    pub(super) fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, function) = (self.pop()?, self.pop()?);
        let Node::Tuple(arguments) = self.node(arguments) else {
            return self.refuse("a call whose arguments are not a tuple");
        };
        if arguments.len() > MAX_ARGUMENTS {
            return self.refuse(format!("a call with {} arguments", arguments.len()));
        }
        let arguments = arguments.clone();
        let Node::Global(function) = self.node(function).clone() else {
            return self.refuse("a call of something that is not a name");
        };
        self.call(function, &arguments)
    }

    /// Pushes what a call of `function` would give.
    fn call(&mut self, function: Global, arguments: &[Id]) -> Result<(), PickleError> {
        let node = match (function, arguments) {
            (Global::Dictionary | Global::DefaultDict, []) | (Global::DefaultDict, [_]) => {
                Node::Dict(Vec::new())
            }
            (Global::Dictionary, [items]) | (Global::DefaultDict, [_, items]) => {
                match self.node(*items) {
                    // What the call gives is its argument.
                    Node::Dict(_) => {
                        self.stack.push(*items);
                        return Ok(());
                    }
                    Node::List(pairs) | Node::Tuple(pairs) => {
                        let pairs = pairs.clone();
                        self.dictionary(&pairs)?
                    }
                    _ => return self.refuse("a dictionary of something that is no list of pairs"),
                }
            }
            (Global::Container, []) => Node::Tuple(Vec::new()),
            (Global::Bytes, []) => Node::Bytes(Vec::new()),
            (Global::Bytes | Global::Encode, [text, codec]) => self.latin1(*text, *codec)?,
            (Global::StorageFromBytes, [bytes]) => Node::Storage(self.storage_from_bytes(*bytes)?),
            (Global::Complex, [real, imaginary]) => {
                Node::Complex(self.float(*real)?, self.float(*imaginary)?)
            }
            (
                Global::Parameter | Global::Container | Global::Bytes | Global::Layout,
                [same, ..],
            ) => {
                self.stack.push(*same);
                return Ok(());
            }
            (Global::Tensor, []) => Node::Opaque(EMPTY),
            (Global::RebuildTensor, [storage, ..])
                if matches!(self.node(*storage), Node::Opaque(_)) =>
            {
                Node::Opaque(PACKED)
            }
            (Global::RebuildTensor, [storage, offset, shape, strides, ..]) => {
                Node::Tensor(self.tensor(*storage, None, *offset, *shape, *strides)?)
            }
            (Global::RebuildTyped, [storage, offset, shape, strides, _, _, dtype, ..]) => {
                let Node::Global(Global::TorchType(scalar)) = *self.node(*dtype) else {
                    return self.refuse("a tensor without the type of its elements");
                };
                Node::Tensor(self.tensor(*storage, Some(scalar), *offset, *shape, *strides)?)
            }
            (Global::RebuildOther(what), _) => Node::Opaque(what),
            (Global::RebuildFromType, [function, _, arguments, ..]) => {
                let Node::Global(function) = self.node(*function).clone() else {
                    return self.refuse("a tensor that is rebuilt by something that is not a name");
                };
                let arguments = match self.node(*arguments) {
                    Node::Tuple(arguments) if arguments.len() <= MAX_ARGUMENTS => arguments.clone(),
                    _ => return self.refuse("a tensor that is rebuilt from no tuple"),
                };
                // One level: a chain of them would call itself as often as the file likes.
                if function == Global::RebuildFromType {
                    return self.refuse("a tensor that is given a type twice");
                }
                return self.call(function, &arguments);
            }
            (Global::Reconstruct, [class, ..]) => {
                let Node::Global(class) = self.node(*class).clone() else {
                    return self.refuse("an instance of something that is not a name");
                };
                return self.construct(class, &[]);
            }
            (Global::Device, [name]) => match self.node(*name) {
                Node::Text(name) => Node::Text(self.short(name)?),
                _ => return self.refuse("a device without a name"),
            },
            (Global::Device, [name, index]) => match (self.node(*name), self.node(*index)) {
                (Node::Text(name), Node::Int(index)) => {
                    Node::Text(format!("{}:{index}", self.short(name)?))
                }
                _ => return self.refuse("a device without a name"),
            },
            (Global::NumpyDtype, [code, ..]) => match self.node(*code) {
                Node::Text(code) => Node::Dtype(self.short(code)?),
                _ => return self.refuse("a NumPy type without a name"),
            },
            (Global::NumpyScalar, [dtype, bytes]) => self.numpy_scalar(*dtype, *bytes)?,
            (Global::NumpyReconstruct, [class, ..])
                if *self.node(*class) == Node::Global(Global::NumpyArray) =>
            {
                Node::Array(ArrayView {
                    dtype: String::new(),
                    shape: Vec::new(),
                    fortran: false,
                    bytes: None,
                })
            }
            (Global::NumpyFromBuffer, [bytes, dtype, shape, order]) => {
                let fortran = matches!(self.node(*order), Node::Text(order) if order == "F");
                Node::Array(self.array_view(*dtype, *shape, fortran, *bytes)?)
            }
            (function, _) => return self.refuse(format!("{function:?} called in an unknown way")),
        };
        self.push(node);
        Ok(())
    }

    /// A dictionary of a list of pairs.
    fn dictionary(&mut self, pairs: &[Id]) -> Result<Node, PickleError> {
        self.copies(8 * pairs.len())?;
        let pairs: Option<Vec<(Id, Id)>> = pairs
            .iter()
            .map(|&pair| match self.node(pair) {
                Node::List(pair) | Node::Tuple(pair) => match pair[..] {
                    [key, value] => Some((key, value)),
                    _ => None,
                },
                _ => None,
            })
            .collect();
        match pairs {
            Some(pairs) => Ok(Node::Dict(pairs)),
            None => self.refuse("a dictionary of something that is no pair"),
        }
    }

    /// Counts what a call copies.
    fn copies(&mut self, bytes: usize) -> Result<(), PickleError> {
        self.copied = self.copied.saturating_add(bytes);
        if self.copied > MAX_COPIES {
            return self.refuse(format!("calls that copy more than {MAX_COPIES} bytes"));
        }
        Ok(())
    }

    fn float(&self, id: Id) -> Result<f64, PickleError> {
        match self.node(id) {
            Node::Float(value) => Ok(*value),
            Node::Int(value) => Ok(*value as f64),
            _ => self.refuse("a complex number of something that is no number"),
        }
    }

    pub(super) fn new_object(&mut self) -> Result<(), PickleError> {
        let (arguments, class) = (self.pop()?, self.pop()?);
        let arguments = match self.node(arguments) {
            Node::Tuple(arguments) if arguments.len() <= MAX_ARGUMENTS => arguments.clone(),
            _ => return self.refuse("an instance made from no tuple"),
        };
        let Node::Global(class) = self.node(class).clone() else {
            return self.refuse("an instance of something that is not a plain record");
        };
        self.construct(class, &arguments)
    }

    /// Pushes an instance of `class`.
    pub(super) fn construct(&mut self, class: Global, arguments: &[Id]) -> Result<(), PickleError> {
        let class = match class {
            Global::Namespace if arguments.is_empty() => "argparse.Namespace".into(),
            Global::Script(class) if arguments.is_empty() => class,
            Global::Namespace | Global::Script(_) => {
                return self.refuse("an instance of something that is not a plain record");
            }
            class => return self.call(class, arguments),
        };
        self.push(Node::Object { class, state: None });
        Ok(())
    }

    pub(super) fn build(&mut self) -> Result<(), PickleError> {
        let given = self.pop()?;
        let target = self.top()?;
        let is_dict = matches!(self.node(given), Node::Dict(_));
        match &mut self.nodes[target.0 as usize] {
            Node::Object { state, .. } if is_dict => *state = Some(given),
            // `OrderedDict._metadata` and what somebody hung onto a parameter: not needed.
            Node::Dict(_) | Node::Tensor(_) if is_dict => {}
            Node::Array(_) => {
                let view = self.array_state(given)?;
                self.nodes[target.0 as usize] = Node::Array(view);
            }
            Node::Opaque(what) if *what == EMPTY => {
                let view = self.tensor_state(given)?;
                self.nodes[target.0 as usize] = Node::Tensor(view);
            }
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
    pub(super) fn persistent(&mut self) -> Result<(), PickleError> {
        let id = self.pop()?;
        let Node::Tuple(parts) = self.node(id) else {
            return self.refuse("a persistent object that is not a tuple");
        };
        let (kind, scalar, key, elements) = match parts.as_slice() {
            [kind, scalar, key, _, elements] => (kind, scalar, key, elements),
            // Files that are no archives also say of which storage this one is a part: of none, since torch 0.4.
            [kind, scalar, key, _, elements, part] if *self.node(*part) == Node::None => {
                (kind, scalar, key, elements)
            }
            _ => return self.refuse("a persistent object with an unknown form"),
        };
        if *self.node(*scalar) == Node::Global(Global::PackedStorage) {
            self.push(Node::Opaque(PACKED));
            return Ok(());
        }
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
                key: self.short(key)?,
                scalar: *scalar,
                elements: *elements as u64,
            },
            _ => return self.refuse("a storage with an unknown form"),
        };
        self.push(Node::Storage(storage));
        Ok(())
    }

    /// The state of a tensor that was made empty: `(storage, offset, shape, strides)`.
    fn tensor_state(&self, state: Id) -> Result<TensorView, PickleError> {
        match self.node(state) {
            Node::Tuple(parts) if parts.len() >= 4 => {
                self.tensor(parts[0], None, parts[1], parts[2], parts[3])
            }
            _ => self.refuse("a tensor with an unknown state"),
        }
    }

    /// The state of a NumPy array: `(version, shape, type, whether in Fortran order, bytes)`, without a version at first.
    fn array_state(&self, state: Id) -> Result<ArrayView, PickleError> {
        let (shape, dtype, fortran, bytes) = match self.node(state) {
            Node::Tuple(parts) => match parts[..] {
                [_, shape, dtype, fortran, bytes] | [shape, dtype, fortran, bytes] => {
                    (shape, dtype, fortran, bytes)
                }
                _ => return self.refuse("a NumPy array with an unknown state"),
            },
            _ => return self.refuse("a NumPy array with an unknown state"),
        };
        let fortran = matches!(self.node(fortran), Node::Bool(true) | Node::Int(1));
        self.array_view(dtype, shape, fortran, bytes)
    }

    fn array_view(
        &self,
        dtype: Id,
        shape: Id,
        fortran: bool,
        bytes: Id,
    ) -> Result<ArrayView, PickleError> {
        let Node::Dtype(dtype) = self.node(dtype) else {
            return self.refuse("a NumPy array without a type");
        };
        // Python 2 did not tell text from bytes; arrays of objects hold a list.
        let there = match self.node(bytes) {
            Node::Bytes(_) | Node::Stored(_) | Node::Text(_) => true,
            Node::List(_) => dtype.starts_with('O'),
            _ => false,
        };
        if !there {
            return self.refuse(format!("a NumPy array of type `{dtype}` without bytes"));
        }
        Ok(ArrayView {
            dtype: dtype.clone(),
            shape: self.sizes(shape)?.into_iter().map(|d| d as usize).collect(),
            fortran,
            bytes: Some(bytes),
        })
    }

    /// `torch.storage._load_from_bytes`: a whole file of torch's first format inside a string. It holds five pickles (a magic
    /// number, a version, sizes of types, the storage, the list of keys), then the number of elements and their bytes.
    fn storage_from_bytes(&mut self, id: Id) -> Result<Storage, PickleError> {
        const MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
        let bytes = match self.node(id) {
            Node::Bytes(bytes) => bytes.as_slice(),
            Node::Stored(stored) => match self.earlier(stored) {
                Some(bytes) => bytes,
                None => return self.refuse("a storage whose bytes are not there"),
            },
            _ => return self.refuse("a storage that is not made of bytes"),
        };
        let length = bytes.len();
        if length > self.storage_budget {
            return self.refuse("more storages read than the pickle has bytes");
        }
        let wrong = |reason: &str| self.refuse(format!("inside a torch storage: {reason}"));
        let (mut inner, mut at) = (None, 0);
        for number in 0..5 {
            let mut machine = Machine::new(&bytes[at..]);
            // A storage in a storage would run this function inside itself.
            machine.storage_budget = 0;
            let (root, end) = match machine.run() {
                Ok(done) => done,
                Err(error) => return wrong(&error.reason),
            };
            at += end;
            match (number, machine.node(root)) {
                (0, Node::Int(MAGIC)) | (1 | 2 | 4, _) => {}
                (3, Node::Storage(storage)) => inner = Some(storage.clone()),
                _ => return wrong("not torch's first format"),
            }
        }
        let Some(inner) = inner else {
            return wrong("there is no storage");
        };
        let Some((count, data)) = bytes[at..].split_first_chunk::<8>() else {
            return wrong("cut short");
        };
        let needed = inner.elements.checked_mul(inner.scalar.width() as u64);
        if u64::from_le_bytes(*count) != inner.elements || needed != Some(data.len() as u64) {
            return wrong("its bytes are not as many as its elements need");
        }
        let start = at as u64 + 8;
        let key = format!("bytes of object {}", id.0);
        let stored = match self.node(id) {
            Node::Stored(StoredBytes::File { offset, length }) => StoredBytes::File {
                offset: offset + start,
                length: length - start,
            },
            _ => StoredBytes::Node { id, start },
        };
        self.storage_budget -= length;
        self.storages.insert(key.clone(), stored);
        Ok(Storage { key, ..inner })
    }

    fn tensor(
        &self,
        storage: Id,
        scalar: Option<Scalar>,
        offset: Id,
        shape: Id,
        strides: Id,
    ) -> Result<TensorView, PickleError> {
        let Node::Storage(storage) = self.node(storage) else {
            return self.refuse("a tensor without a storage");
        };
        let mut storage = storage.clone();
        if let Some(scalar) = scalar {
            let bytes = storage.elements * storage.scalar.width() as u64;
            storage.elements = bytes / scalar.width() as u64;
            storage.scalar = scalar;
        }
        let offset = self.size(offset)?;
        let shape = self.sizes(shape)?;
        let strides = self.sizes(strides)?;
        if shape.len() != strides.len() || shape.len() > 8 {
            return self.refuse(format!(
                "a tensor of shape {shape:?} with strides {strides:?}"
            ));
        }
        let view = TensorView {
            storage,
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
            Node::Tuple(items) | Node::List(items) if items.len() <= 8 => {
                items.iter().map(|&item| self.size(item)).collect()
            }
            _ => self.refuse("a shape that is not a tuple of at most 8 sizes"),
        }
    }

    fn numpy_scalar(&self, dtype: Id, bytes: Id) -> Result<Node, PickleError> {
        let (Node::Dtype(dtype), Node::Bytes(bytes)) = (self.node(dtype), self.node(bytes)) else {
            return self.refuse("a NumPy number with an unknown form");
        };
        let width = bytes.len();
        let signed = || long(bytes).map(Node::Int);
        let node = match (dtype.trim_start_matches(['<', '|', '=']), bytes.as_slice()) {
            ("f8", &[a, b, c, d, e, f, g, h]) => {
                Some(Node::Float(f64::from_le_bytes([a, b, c, d, e, f, g, h])))
            }
            ("f4", &[a, b, c, d]) => Some(Node::Float(f32::from_le_bytes([a, b, c, d]).into())),
            ("f2", &[a, b]) => Some(Node::Float(half::f16::from_le_bytes([a, b]).into())),
            ("i8", _) if width == 8 => signed(),
            ("i4", _) if width == 4 => signed(),
            ("i2", _) if width == 2 => signed(),
            ("i1", _) if width == 1 => signed(),
            ("u8", _) if width == 8 => unsigned(bytes),
            ("u4", _) if width == 4 => unsigned(bytes),
            ("u2", _) if width == 2 => unsigned(bytes),
            ("u1", _) if width == 1 => unsigned(bytes),
            ("b1", &[value @ (0 | 1)]) => Some(Node::Bool(value == 1)),
            // `numpy.str_`: four bytes a character, filled up with zeros.
            (code, bytes) if code.starts_with('U') => ucs4(bytes).map(Node::Text),
            _ => None,
        };
        match node {
            Some(node) => Ok(node),
            None => self.refuse(format!("a NumPy number of type `{dtype}`")),
        }
    }

    /// `_codecs.encode(text, "latin1")` is how old protocols write bytes.
    fn latin1(&mut self, text: Id, codec: Id) -> Result<Node, PickleError> {
        let (Node::Text(text), Node::Text(codec)) = (self.node(text), self.node(codec)) else {
            return self.refuse("bytes with an unknown form");
        };
        if !matches!(codec.as_str(), "latin1" | "latin-1") {
            return self.refuse(format!("bytes in the encoding `{}`", self.short(codec)?));
        }
        let bytes: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
        let Some(bytes) = bytes else {
            return self.refuse("bytes that are beyond Latin-1");
        };
        self.copies(bytes.len())?;
        Ok(Node::Bytes(bytes))
    }
}
