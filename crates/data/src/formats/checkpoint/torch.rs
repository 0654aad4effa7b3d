//! Torch archives: a zip with one pickle that describes tensors, and one stored member per storage.

use super::{Checkpoint, CheckpointError, Source, tree};
use crate::formats::FormatError;
use crate::formats::pickle::Pickle;
use crate::formats::zip::{Method, ZipArchive};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

impl Checkpoint {
    pub(super) fn archive(path: &Path, file: File) -> Result<Self, CheckpointError> {
        let refused = |reason: String| CheckpointError::refused(path, reason);
        let in_file = |error: FormatError| error.in_file(path);
        let mut zip = ZipArchive::new(BufReader::new(file)).map_err(in_file)?;
        let roots: Vec<String> = zip
            .entries()
            .iter()
            .filter_map(|e| e.name.strip_suffix("/data.pkl"))
            .filter(|root| !root.contains('/'))
            .map(str::to_owned)
            .collect();
        let [root] = roots.as_slice() else {
            let mut names = zip.entries().iter().map(|e| Path::new(&e.name));
            let arrays = names.all(|name| name.extension().is_some_and(|e| e == "npy"));
            if arrays && !zip.entries().is_empty() {
                return Err(refused("an archive of NumPy arrays (npz)".to_owned()));
            }
            return Err(refused(format!(
                "a zip archive with {} `*/data.pkl`, a torch archive has one",
                roots.len()
            )));
        };
        let root = root.clone();
        if let Some(order) = zip.find(&format!("{root}/byteorder")).cloned()
            && zip.read(&order.name, 16).map_err(in_file)? != b"little"
        {
            return Err(refused("written on a big-endian machine".to_owned()));
        }
        let bytes = zip
            .read(&format!("{root}/data.pkl"), 16 << 20)
            .map_err(in_file)?;
        let pickle = Pickle::parse(&bytes).map_err(|e| refused(e.to_string()))?;
        drop(bytes);
        let contents = tree::contents(&pickle).map_err(refused)?;
        let mut sizes = BTreeMap::new();
        for (name, view) in &contents.entries {
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
        let source = Source::Archive {
            zip: Box::new(zip),
            root,
        };
        Self::of_pickle(path, contents, sizes.values().sum(), source)
    }
}
