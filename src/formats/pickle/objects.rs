//! What may be built: the allow-list of names, and what a call of each of them describes. Nothing is ever called.

use super::machine::Machine;
use super::{Global, Id, MAX_COPIED, MAX_GLOBAL, Node, PickleError, Scalar, Storage, TensorView};

impl Machine<'_> {
    /// The allow-list.
    pub(super) fn global(&self, module: &str, name: &str) -> Result<Global, PickleError> {
        let length = module.len() + name.len();
        if length > MAX_GLOBAL {
            return self.refuse(format!("a global whose name has {length} bytes"));
        }
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
            (module, name) if module == "__torch__" || module.starts_with("__torch__.") => {
                Global::Script(format!("{module}.{name}").into())
            }
            _ => return self.forbidden(module, name),
        })
    }

    fn forbidden<T>(&self, module: &str, name: &str) -> Result<T, PickleError> {
        self.refuse(format!(
            "it wants to call `{module}.{name}`, which no checkpoint of a model needs; nothing was executed"
        ))
    }

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
        if arguments.len() > 16 {
            return self.refuse(format!("a call with {} arguments", arguments.len()));
        }
        let arguments = arguments.clone();
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
                Node::Text(code) => Node::Dtype(self.short(code)?),
                _ => return self.refuse("a NumPy type without a name"),
            },
            (Global::NumpyScalar, [dtype, bytes]) => self.numpy_scalar(*dtype, *bytes)?,
            (Global::Encode, [text, codec]) => self.latin1(*text, *codec)?,
            (function, _) => return self.refuse(format!("{function:?} called in an unknown way")),
        };
        self.push(node);
        Ok(())
    }

    pub(super) fn new_object(&mut self) -> Result<(), PickleError> {
        let (arguments, class) = (self.pop()?, self.pop()?);
        let empty = matches!(self.node(arguments), Node::Tuple(items) if items.is_empty());
        let class = match self.node(class) {
            Node::Global(Global::Namespace) if empty => "argparse.Namespace".into(),
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

    pub(super) fn build(&mut self) -> Result<(), PickleError> {
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
    pub(super) fn persistent(&mut self) -> Result<(), PickleError> {
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
                key: self.short(key)?,
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
        let text = self.short(text)?;
        let bytes: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
        match bytes {
            Some(bytes) if codec == "latin1" => Ok(Node::Bytes(bytes)),
            _ => self.refuse(format!("bytes in the encoding `{codec}`")),
        }
    }
}

/// A little-endian two's complement integer.
pub(super) fn long(bytes: &[u8]) -> Option<i128> {
    let sign = if bytes.last().is_some_and(|b| b & 0x80 != 0) {
        0xff
    } else {
        0
    };
    let mut wide = [sign; 16];
    wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
    Some(i128::from_le_bytes(wide))
}
