//! NumPy's npz: a zip archive of npy members, read as a map of named arrays.

use super::npy::{self, NpyArray};
use super::zip::{EntryReader, ZipArchive, ZipWriter, missing};
use super::{FormatError, write_atomically};
use std::collections::BTreeMap;
use std::io::{Cursor, Read, Seek};
use std::path::Path;

/// Named arrays, in the order of their names.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Npz {
    /// By name: the member without `.npy`.
    pub arrays: BTreeMap<String, NpyArray>,
}

impl Npz {
    /// The array called `name`.
    pub fn get(&self, name: &str) -> Result<&NpyArray, FormatError> {
        self.arrays
            .get(name)
            .ok_or_else(|| missing(name, self.arrays.keys().map(String::as_str)))
    }

    /// Adds an array (replacing one of the same name) and returns the map, for chains of calls.
    #[must_use]
    pub fn with(mut self, name: &str, array: impl Into<NpyArray>) -> Self {
        self.arrays.insert(name.to_owned(), array.into());
        self
    }

    /// Reads all arrays of the file at `path`. Members that do not end in `.npy` are left alone.
    ///
    /// # Errors
    /// Also when the arrays would take more than 256 MB and more than a hundred times the size of the file.
    pub fn read(path: &Path) -> Result<Self, FormatError> {
        ZipArchive::open(path)
            .and_then(|zip| Self::collect(zip, |_| true))
            .map_err(|e| e.in_file(path))
    }

    /// Reads only these arrays; each must be there.
    pub fn read_some(path: &Path, names: &[&str]) -> Result<Self, FormatError> {
        let read = || {
            let zip = ZipArchive::open(path)?;
            for name in names {
                if zip.find(&format!("{name}.npy")).is_none() {
                    let present = zip
                        .entries()
                        .iter()
                        .map(|e| e.name.trim_end_matches(".npy"));
                    return Err(missing(name, present));
                }
            }
            Self::collect(zip, |name| names.contains(&name))
        };
        read().map_err(|e: FormatError| e.in_file(path))
    }

    /// Reads the array `name` row by row, in memory that does not depend on how many there are.
    pub fn rows<T>(
        path: &Path,
        name: &str,
        read: impl FnOnce(&mut npy::Rows<EntryReader<'_>>) -> Result<T, FormatError>,
    ) -> Result<T, FormatError> {
        let rows = || {
            let mut zip = ZipArchive::open(path)?;
            let member = format!("{name}.npy");
            let Some(entry) = zip.find(&member) else {
                let entries = zip.entries().iter();
                let present = entries.map(|e| e.name.trim_end_matches(".npy"));
                return Err(missing(name, present));
            };
            let size = entry.size;
            read(&mut npy::Rows::new(zip.reader(&member)?, size)?)
        };
        rows().map_err(|e| match e {
            FormatError::Malformed {
                format: "npy",
                offset,
                reason,
            } => FormatError::malformed("npy", offset, format!("array `{name}`: {reason}"))
                .in_file(path),
            other => other.in_file(path),
        })
    }

    /// Reads all arrays from the bytes of an npz file.
    pub fn parse(bytes: &[u8]) -> Result<Self, FormatError> {
        Self::collect(ZipArchive::new(Cursor::new(bytes))?, |_| true)
    }

    fn collect<R: Read + Seek>(
        mut zip: ZipArchive<R>,
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Self, FormatError> {
        let mut budget = zip.length().saturating_mul(100).max(256 << 20);
        let members: Vec<String> = zip.entries().iter().map(|e| e.name.clone()).collect();
        let mut arrays = BTreeMap::new();
        for member in members {
            let Some(name) = member.strip_suffix(".npy").filter(|name| wanted(name)) else {
                continue;
            };
            let bytes = zip.read(&member, budget)?;
            budget -= bytes.len() as u64;
            let array = npy::parse(&bytes).map_err(|e| match e {
                FormatError::Malformed {
                    format,
                    offset,
                    reason,
                } => FormatError::malformed(format, offset, format!("array `{name}`: {reason}")),
                other => other,
            })?;
            arrays.insert(name.to_owned(), array);
        }
        Ok(Self { arrays })
    }

    /// The bytes of an npz file: stored, in the order of names, without times.
    pub fn to_bytes(&self) -> Result<Vec<u8>, FormatError> {
        let mut writer = ZipWriter::new(Vec::new());
        for (name, array) in &self.arrays {
            writer.add(&format!("{name}.npy"), &npy::to_bytes(array))?;
        }
        writer.finish()
    }

    /// Writes the arrays to `path` (to a temporary name first, then renamed).
    pub fn write(&self, path: &Path) -> Result<(), FormatError> {
        self.to_bytes()
            .and_then(|bytes| write_atomically(path, &bytes))
            .map_err(|e| e.in_file(path))
    }
}

impl<T: npy::Element, D: ndarray::Dimension> From<ndarray::Array<T, D>> for NpyArray {
    fn from(array: ndarray::Array<T, D>) -> Self {
        Self::from(&array)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sample() -> Npz {
        Npz::default()
            .with("pose", ndarray::arr2(&[[1.0f64, 2.0], [3.0, 4.0]]))
            .with("valid", ndarray::arr1(&[true, false]))
    }

    #[test]
    fn named_arrays_survive_the_round_trip_and_bytes_are_stable() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npz");
        sample().write(&path).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), sample().to_bytes().unwrap());
        assert_eq!(Npz::read(&path).unwrap(), sample());
        let some = Npz::read_some(&path, &["valid"]).unwrap();
        assert_eq!(some.arrays.len(), 1);
        let error = Npz::read_some(&path, &["gaze"]).unwrap_err().to_string();
        assert!(
            error.contains("a.npz") && error.contains("pose, valid"),
            "{error}"
        );
    }

    #[test]
    fn rows_are_those_of_the_whole_array() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npz");
        sample().write(&path).unwrap();
        let all = |rows: &mut npy::Rows<EntryReader<'_>>| {
            let shape = rows.shape().to_vec();
            let mut found = Vec::new();
            while let Some(row) = rows.next_row()? {
                found.push(row.to_vec());
            }
            Ok((shape, found))
        };
        let (shape, found) = Npz::rows(&path, "pose", all).unwrap();
        assert_eq!(
            (shape, found),
            (vec![2, 2], vec![vec![1.0, 2.0], vec![3.0, 4.0]])
        );
        let (_, found) = Npz::rows(&path, "valid", all).unwrap();
        assert_eq!(found, [[1.0], [0.0]]);
        let error = Npz::rows(&path, "gaze", all).unwrap_err().to_string();
        assert!(error.contains("pose, valid"), "{error}");
        // A flipped bit of a value is noticed at the end.
        let mut bytes = std::fs::read(&path).unwrap();
        let at = bytes
            .windows(8)
            .position(|w| w == 3.0f64.to_le_bytes())
            .unwrap();
        bytes[at + 2] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        let error = Npz::rows(&path, "pose", all).unwrap_err().to_string();
        assert!(error.contains("checksum"), "{error}");
    }

    proptest! {
        #[test]
        fn no_damage_makes_the_reader_panic(at in 0usize..700, value in any::<u8>(), cut in 0usize..2000) {
            let mut bytes = sample().to_bytes().unwrap();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(cut);
            let _ = Npz::parse(&bytes);
        }
    }
}
