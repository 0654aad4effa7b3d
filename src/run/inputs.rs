//! The identity of what lies outside: a file by its bytes, a directory (a data set) by the names and sizes of its files, for
//! data sets are too large to read them whole each time.

use super::error::{AtPath, RunError};
use super::files;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A fingerprint, and how many bytes stand behind it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fingerprint {
    pub hash: blake3::Hash,
    pub bytes: u64,
}

/// Fingerprints, each taken once.
#[derive(Debug, Default)]
pub struct Fingerprints(BTreeMap<PathBuf, Fingerprint>);

impl Fingerprints {
    /// The fingerprint of a file or a directory.
    pub fn of(&mut self, path: &Path) -> Result<Fingerprint, RunError> {
        if let Some(known) = self.0.get(path) {
            return Ok(*known);
        }
        let taken = fingerprint(path)?;
        self.0.insert(path.to_path_buf(), taken);
        Ok(taken)
    }

    /// One that was taken before.
    pub fn known(&self, path: &Path) -> Option<Fingerprint> {
        self.0.get(path).copied()
    }
}

/// Looks at a file or a directory now.
pub fn fingerprint(path: &Path) -> Result<Fingerprint, RunError> {
    if std::fs::metadata(path).at("reading", path)?.is_dir() {
        return listing(path);
    }
    let (hash, bytes) = files::hash(path)?;
    Ok(Fingerprint { hash, bytes })
}

fn listing(root: &Path) -> Result<Fingerprint, RunError> {
    let mut list: Vec<(String, u64)> = Vec::new();
    let mut open = vec![PathBuf::new()];
    while let Some(relative) = open.pop() {
        let here = root.join(&relative);
        for entry in std::fs::read_dir(&here).at("reading", &here)? {
            let entry = entry.at("reading", &here)?;
            let path = relative.join(entry.file_name());
            if entry.file_type().at("reading", &here)?.is_dir() {
                open.push(path);
            } else {
                // A link counts as the file it leads to; links to directories are not followed: they may be circles.
                let bytes = std::fs::metadata(entry.path()).map_or(0, |meta| meta.len());
                list.push((path.to_string_lossy().replace('\\', "/"), bytes));
            }
        }
    }
    list.sort();
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"reviv listing 1");
    for (name, bytes) in &list {
        hasher.update(&(name.len() as u64).to_le_bytes());
        hasher.update(name.as_bytes());
        hasher.update(&bytes.to_le_bytes());
    }
    Ok(Fingerprint {
        hash: hasher.finalize(),
        bytes: list.iter().map(|(_, bytes)| bytes).sum(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_that_gains_a_file_has_another_fingerprint() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a"), b"1").unwrap();
        let before = fingerprint(dir.path()).unwrap();
        assert_eq!(before, fingerprint(dir.path()).unwrap());
        std::fs::create_dir(dir.path().join("more")).unwrap();
        std::fs::write(dir.path().join("more/b"), b"1").unwrap();
        let after = fingerprint(dir.path()).unwrap();
        assert_eq!((before.bytes, after.bytes), (1, 2));
        assert_ne!(before.hash, after.hash);
    }

    #[test]
    fn a_file_is_its_bytes_wherever_it_lies() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a"), b"1").unwrap();
        std::fs::write(dir.path().join("b"), b"1").unwrap();
        let of = |name| fingerprint(&dir.path().join(name)).unwrap();
        assert_eq!(of("a"), of("b"));
        assert!(fingerprint(&dir.path().join("c")).is_err());
    }
}
