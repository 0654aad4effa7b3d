//! Torch files that are no archives, as torch wrote them before 1.6 and still does when asked to: five pickles (a magic number,
//! the version, the machine, the objects, the keys of the storages), then every storage with its number of elements.

use super::{Checkpoint, CheckpointError, Source, tree};
use crate::formats::pickle::{Node, Pickle, Scalar};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// By which torch knows its own files.
const MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
const VERSION: i128 = 1001;
/// The pickles of a file: objects, and as much again for the keys.
const MAX_PICKLES: u64 = 32 << 20;
const CUT: &str = "cut off";

impl Checkpoint {
    pub(super) fn legacy(path: &Path, file: File) -> Result<Self, CheckpointError> {
        let refused = |reason: String| CheckpointError::refused(path, reason);
        let length = file.metadata().map_err(CheckpointError::io(path))?.len();
        let mut file = BufReader::new(file);
        let mut bytes = Vec::new();
        (&mut file)
            .take(MAX_PICKLES)
            .read_to_end(&mut bytes)
            .map_err(CheckpointError::io(path))?;
        let mut at = 0;
        let mut next = |what: &str| {
            let (pickle, used) = Pickle::parse_first(&bytes[at..]).map_err(|mut error| {
                error.offset += at;
                if error.is_cut() {
                    return refused(format!("{CUT} in {what}: {error}"));
                }
                refused(error.to_string())
            })?;
            at += used;
            Ok::<_, CheckpointError>(pickle)
        };
        let number = |pickle: &Pickle| match pickle.node(pickle.root()) {
            Node::Int(value) => Some(*value),
            _ => None,
        };
        let magic = next("its first number")?;
        if number(&magic) != Some(MAGIC) {
            return Err(refused(
                "a pickle, but not one that torch wrote: save tensors with `torch.save`".to_owned(),
            ));
        }
        let version = number(&next("its version")?);
        if version != Some(VERSION) {
            return Err(refused(format!(
                "version {version:?} of torch's old format is unknown"
            )));
        }
        let machine = next("what it says of the machine")?;
        let little = machine.get(machine.root(), "little_endian");
        if little.is_some_and(|little| *machine.node(little) != Node::Bool(true)) {
            return Err(refused("written on a big-endian machine".to_owned()));
        }
        let pickle = next("its objects")?;
        let keys = next("the keys of its storages")?;
        let end = at as u64;
        drop(bytes);

        let contents = tree::contents(&pickle).map_err(refused)?;
        let mut scalars: BTreeMap<&str, (Scalar, u64)> = BTreeMap::new();
        for node in pickle.nodes() {
            let Node::Storage(storage) = node else {
                continue;
            };
            let known = (storage.scalar, storage.elements);
            if *scalars.entry(&storage.key).or_insert(known) != known {
                return Err(refused(format!(
                    "storage `{}` is described twice, differently",
                    storage.key
                )));
            }
        }
        let Node::List(keys_in_order) = keys.node(keys.root()) else {
            return Err(refused("the keys of its storages are no list".to_owned()));
        };
        let mut places = BTreeMap::new();
        let mut place = end;
        for key in keys_in_order {
            let key = keys
                .text(*key)
                .ok_or_else(|| refused("a storage whose key is no text".to_owned()))?;
            let &(scalar, elements) = scalars
                .get(key)
                .ok_or_else(|| refused(format!("storage `{key}` belongs to nothing")))?;
            let size = elements * scalar.width() as u64;
            let start = place + 8;
            if start.checked_add(size).is_none_or(|end| end > length) {
                return Err(refused(format!(
                    "{CUT}: storage `{key}` needs {size} bytes from byte {start} on, and the file has {length}"
                )));
            }
            file.seek(SeekFrom::Start(place))
                .map_err(CheckpointError::io(path))?;
            let mut count = [0; 8];
            file.read_exact(&mut count)
                .map_err(CheckpointError::io(path))?;
            if u64::from_le_bytes(count) != elements {
                return Err(refused(format!(
                    "storage `{key}` has {} elements, the objects say {elements}",
                    u64::from_le_bytes(count)
                )));
            }
            if places.insert(key.to_owned(), start).is_some() {
                return Err(refused(format!("two storages have the key `{key}`")));
            }
            place = start + size;
        }
        for (name, view) in &contents.entries {
            if !places.contains_key(&view.storage.key) {
                return Err(refused(format!(
                    "`{name}`: storage `{}` is missing",
                    view.storage.key
                )));
            }
        }
        let source = Source::Legacy { file, places };
        Self::of_pickle(path, contents, place - end, source)
    }
}
