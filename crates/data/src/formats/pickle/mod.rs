//! Pickle, read as data: an interpreter with an allow-list that can build numbers, text, containers and descriptions of
//! tensors, and nothing else.
//!
//! A pickle is a program. This one runs on an arena: every object is an index, so that deep nesting cannot overflow the
//! stack, sharing through the memo cannot multiply memory, and the work is linear in the length of the file. An opcode or a
//! global name outside the lists is an error that names it; nothing in the file is ever called.
//!
//! Checkpoints are parsed in memory ([`Pickle::parse`]); of the pickles of data sets, which hold arrays, the arrays stay in the file
//! until they are asked for ([`Pickle::open`], [`StoredArray`]).

mod literal;
mod machine;
mod names;
mod numbers;
mod objects;
mod scalars;
mod tensor;

pub use numbers::StoredArray;
pub use tensor::{Scalar, Storage, TensorView};

use super::npy::{self, NpyArray};
use super::read_error::Position;
use super::{FormatError, ReadError};
use machine::Machine;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Why a pickle is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("pickle: byte {offset}: {reason}")]
pub struct PickleError {
    /// Bytes from the start of the pickle.
    pub offset: usize,
    /// What is refused there.
    pub reason: String,
}

impl PickleError {
    /// Whether the bytes end before the pickle does.
    pub fn is_cut(&self) -> bool {
        self.reason == CUT
    }
}

const CUT: &str = "the pickle is cut short";

/// An object of the arena.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Id(u32);

/// What a pickle can build here.
#[derive(Debug, Clone, PartialEq)]
pub enum Node {
    /// Python's `None`.
    None,
    /// Python's `True` or `False`.
    Bool(bool),
    /// An integer; one that does not fit is refused.
    Int(i128),
    /// A float.
    Float(f64),
    /// A string.
    Text(String),
    /// A byte string that is held in memory.
    Bytes(Vec<u8>),
    /// Bytes that are elsewhere: in the file.
    Stored(StoredBytes),
    /// A tuple, or an empty container that was called by its name.
    Tuple(Vec<Id>),
    /// A list.
    List(Vec<Id>),
    /// Keys in the order of insertion; `OrderedDict` too.
    Dict(Vec<(Id, Id)>),
    /// A global name that stands on the allow-list but has not been applied to anything.
    Global(Global),
    /// An instance of `argparse.Namespace` or of a TorchScript class, with the dictionary it was given.
    Object {
        /// Module and name: `argparse.Namespace`, `__torch__.module.Class`.
        class: Arc<str>,
        /// The dictionary; `None` for an instance that was given none.
        state: Option<Id>,
    },
    /// A piece of memory in the archive.
    Storage(Storage),
    /// A torch tensor over a storage.
    Tensor(TensorView),
    /// A NumPy type such as `f8`.
    Dtype(String),
    /// Each once, in the order of insertion.
    Set(Vec<Id>),
    /// Real and imaginary part.
    Complex(f64, f64),
    /// A NumPy array; of one whose elements are objects, a list of them.
    Array(ArrayView),
    /// A tensor without strided values: what it is, in words.
    Opaque(&'static str),
}

/// Where bytes are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StoredBytes {
    /// In the pickle's file.
    File {
        /// From the start of the file, what stands before the pickle included.
        offset: u64,
        /// How many bytes.
        length: u64,
    },
    /// In an object of bytes, from `start` to its end.
    Node {
        /// The object that holds them.
        id: Id,
        /// The first byte, counted from the start of that object.
        start: u64,
    },
}

/// A NumPy array; its bytes are another node, so that nothing is copied.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrayView {
    /// `f8`, `i4`, ...
    pub dtype: String,
    /// The length of each axis, the slowest first in C order.
    pub shape: Vec<usize>,
    /// Whether the first axis varies fastest in the bytes, instead of the last.
    pub fortran: bool,
    /// `None` for an array whose state has not come.
    pub bytes: Option<Id>,
}

/// The global names that may appear.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Global {
    /// `OrderedDict`, `Counter`, `dict`.
    Dictionary,
    /// A dictionary whose first argument makes missing values.
    DefaultDict,
    /// `list`, `tuple`, `set`, `frozenset`, `torch.Size`, `torch.jit._pickle.build_intlist` and its kin: all of them hold the items
    /// of one other container.
    Container,
    /// `bytes` and `bytearray`.
    Bytes,
    /// `complex`, from a real and an imaginary part.
    Complex,
    /// `int`, `str`, ...: a plain type that stands for itself.
    Type(&'static str),
    /// `argparse.Namespace`: a record of the options of a command.
    Namespace,
    /// `copyreg._reconstructor`: an instance by its class.
    Reconstruct,
    /// `torch._utils._rebuild_tensor` and its kin: a view of a storage.
    RebuildTensor,
    /// Of elements whose type is an argument of its own.
    RebuildTyped,
    /// By another function, whose result is given a type.
    RebuildFromType,
    /// A tensor that this product does not read: what it is, in words.
    RebuildOther(&'static str),
    /// `Parameter` and what rebuilds one.
    Parameter,
    /// A tensor that is empty until its state comes.
    Tensor,
    /// `torch.FloatStorage` and its kin, by the type of their elements.
    StorageType(Scalar),
    /// Of numbers that share their bytes.
    PackedStorage,
    /// `torch.float32` and its kin.
    TorchType(Scalar),
    /// `torch.device`.
    Device,
    /// `torch.serialization._get_layout`: its name.
    Layout,
    /// `numpy.core.multiarray.scalar`: one number from its type and its bytes.
    NumpyScalar,
    /// `numpy.dtype`, from a code such as `f8`.
    NumpyDtype,
    /// `numpy.ndarray`, as an argument of what makes arrays.
    NumpyArray,
    /// `numpy.core.multiarray._reconstruct`: an array that is empty until its state comes.
    NumpyReconstruct,
    /// `numpy.core.numeric._frombuffer`: an array from bytes, type, shape and order.
    NumpyFromBuffer,
    /// `_codecs.encode`: bytes that an old protocol wrote as text.
    Encode,
    /// `torch.storage._load_from_bytes`
    StorageFromBytes,
    /// A class compiled by TorchScript, `__torch__.module.Class`, or one of chumpy or SciPy: nothing but its dictionary.
    Script(Arc<str>),
}

/// The result of reading a pickle.
#[derive(Debug, Clone)]
pub struct Pickle {
    nodes: Vec<Node>,
    root: Id,
    storages: BTreeMap<String, StoredBytes>,
    /// The file in which long byte strings stayed.
    path: Option<PathBuf>,
}

/// More than any checkpoint's object tree; the tensors themselves are elsewhere.
const MAX_BYTES: usize = 16 << 20;
/// A training checkpoint of the largest released model has some twenty thousand objects.
const MAX_NODES: usize = 1 << 19;
const MAX_TEXT: usize = 1 << 20;
/// The splits of ARCTIC name 1.6 million pictures.
const MAX_FILE_NODES: usize = 1 << 22;
/// Old protocols write arrays as text.
const MAX_FILE_TEXT: usize = 64 << 20;
/// The splits of ARCTIC have some gigabytes each.
const MAX_FILE_BYTES: u64 = 16 << 30;
/// Byte strings of a file that are longer than this stay there.
const MAX_SHORT: usize = 1 << 10;
/// Names and numbers of protocol 0.
const MAX_LINE: usize = 1024;
/// Keys of storages, codes of NumPy types and names of devices: names can be called on the same text again and again, so what
/// a call copies is short.
const MAX_COPIED: usize = 64;
/// What all calls may copy together where it is long, as bytes that an old protocol wrote as text.
const MAX_COPIES: usize = 16 << 20;
/// Module and name of a global: a TorchScript class keeps both.
const MAX_GLOBAL: usize = 256;

impl Pickle {
    /// Reads a pickle.
    pub fn parse(bytes: &[u8]) -> Result<Self, PickleError> {
        if bytes.len() > MAX_BYTES {
            return Err(PickleError {
                offset: 0,
                reason: format!("{} bytes; the limit is {MAX_BYTES}", bytes.len()),
            });
        }
        Ok(Self::parse_first(bytes)?.0)
    }

    /// Reads the pickle that `bytes` begin with, whatever follows, and says how long it is.
    pub fn parse_first(bytes: &[u8]) -> Result<(Self, usize), PickleError> {
        let bytes = &bytes[..bytes.len().min(MAX_BYTES)];
        let mut machine = Machine::new(bytes);
        let (root, end) = machine.run()?;
        let pickle = Self {
            nodes: machine.nodes,
            root,
            storages: machine.storages,
            path: None,
        };
        Ok((pickle, end))
    }

    /// Reads the pickle of a data set: its arrays stay in the file. A pickled npy file is one too.
    ///
    /// # Errors
    /// When the file is damaged, or wants more than data.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let bytes = super::read_whole(path, MAX_FILE_BYTES)
            .map_err(|error| ReadError::Format(error.in_file(path)))?;
        let start = npy::pickle_start(&bytes)
            .map_err(|error| ReadError::Format(error.in_file(path)))?
            .unwrap_or(0);
        let mut machine = Machine::new(&bytes[start..]);
        machine.file_offset = Some(start as u64);
        let (root, _) = machine.run().map_err(|error| {
            ReadError::malformed(
                path,
                Position::Offset((start + error.offset) as u64),
                format!("pickle: {}", error.reason),
            )
        })?;
        let mut pickle = Self {
            nodes: machine.nodes,
            root,
            storages: machine.storages,
            path: Some(path.to_owned()),
        };
        // `np.save` of a dictionary is an array without axes whose only element it is.
        if let Node::Array(array) = pickle.node(root)
            && let Some(Node::List(items)) = array.bytes.map(|items| pickle.node(items))
            && let [only] = items.as_slice()
        {
            pickle.root = *only;
        }
        Ok(pickle)
    }

    /// All objects, in the order in which they were made.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// A NumPy array with its values.
    ///
    /// # Errors
    /// When it is none, or its elements are of a type that [`NpyArray`] cannot hold.
    pub fn array(&self, id: Id) -> Result<NpyArray, FormatError> {
        let wrong = |reason: &str| FormatError::malformed("pickle", 0, reason);
        let Node::Array(view) = self.node(id) else {
            return Err(wrong("not a NumPy array"));
        };
        match view.bytes.map(|bytes| self.node(bytes)) {
            Some(Node::Bytes(bytes)) => {
                npy::from_parts(&view.dtype, view.fortran, &view.shape, bytes)
            }
            _ => Err(wrong("a NumPy array without values")),
        }
    }

    /// The object that the whole pickle stands for.
    pub fn root(&self) -> Id {
        self.root
    }

    /// The object of an `id` of this pickle.
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
            (b"(S'true'\nios\nsystem\n.", "os.system"),
            (b"(cos\nsystem\nS'true'\no.", "os.system"),
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
    #[test]
    fn short_programs_that_copy_much_are_refused() {
        // A million objects of one byte each.
        let mut many = b"\x80\x02".to_vec();
        many.extend(std::iter::repeat_n(b'N', 1 << 20));
        many.push(b'.');
        assert!(refused(&many).contains("objects"));
        // One long text, behind calls that would copy it.
        let mut long = vec![b'X', 0, 0, 1, 0];
        long.extend(std::iter::repeat_n(b'8', 1 << 16));
        let call = |before: &[u8], after: &[u8]| refused(&[before, &long, after].concat());
        assert!(call(b"cnumpy\ndtype\n", b"\x85R.").contains("65536"));
        // Bytes that an old protocol wrote as text are copied, but not again and again.
        let mut again = [b"c_codecs\nencode\nq\x00", &long[..]].concat();
        again.extend(b"X\x06\x00\x00\x00latin1\x86q\x01");
        let once = [&again[..], b"h\x00h\x01R."].concat();
        assert!(Pickle::parse(&once).is_ok());
        again.extend(std::iter::repeat_n(b"h\x00h\x01R", 300).flatten());
        again.push(b'.');
        assert!(refused(&again).contains("copy more"));
        let storage = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\n";
        assert!(call(storage, b"NK\x01tQ.").contains("65536"));
        assert!(call(b"X\x09\x00\x00\x00__torch__", b"\x93.").contains("65545 bytes"));
        // A call with a thousand arguments.
        let mut wide = b"ctorch._utils\n_rebuild_tensor_v2\n(".to_vec();
        wide.extend(std::iter::repeat_n(b'N', 1000));
        wide.extend(b"tR.");
        assert!(refused(&wide).contains("1000 arguments"));
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
