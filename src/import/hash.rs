//! SHA-256 of the files of an import, computed beside the conversion.

use super::ImportError;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};

/// What identifies a file's content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fingerprint {
    pub sha256: String,
    pub bytes: u64,
}

type Hashed = (PathBuf, Result<Fingerprint, ImportError>);

/// Hashes of files, made on a thread in the order of the files.
pub(super) struct Hashes {
    made: Receiver<Hashed>,
    known: BTreeMap<PathBuf, Fingerprint>,
}

impl Hashes {
    /// Starts to hash `files`.
    pub fn start(files: Vec<PathBuf>) -> Self {
        let (sender, made) = sync_channel(files.len());
        // The thread ends at the next file once nobody listens.
        std::thread::spawn(move || {
            for path in files {
                let fingerprint = file(&path);
                if sender.send((path, fingerprint)).is_err() {
                    return;
                }
            }
        });
        Self {
            made,
            known: BTreeMap::new(),
        }
    }

    /// The hash of one of the files; waits for it.
    pub fn get(&mut self, path: &Path) -> Result<Fingerprint, ImportError> {
        loop {
            if let Some(fingerprint) = self.known.get(path) {
                return Ok(fingerprint.clone());
            }
            let Ok((made, fingerprint)) = self.made.recv() else {
                return Err(ImportError::refused(path, "could not be hashed"));
            };
            self.known.insert(made, fingerprint?);
        }
    }
}

/// Reads a file to its end.
fn file(path: &Path) -> Result<Fingerprint, ImportError> {
    let mut file = File::open(path).map_err(ImportError::io(path))?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    let mut bytes = 0;
    loop {
        let got = file.read(&mut buffer).map_err(ImportError::io(path))?;
        if got == 0 {
            return Ok(Fingerprint {
                sha256: hex(&hasher.finalize()),
                bytes,
            });
        }
        hasher.update(&buffer[..got]);
        bytes += got as u64;
    }
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// A file that is hashed while it is written.
pub(super) struct HashedFile {
    out: BufWriter<File>,
    hasher: Sha256,
}

impl HashedFile {
    pub fn create(path: &Path) -> std::io::Result<Self> {
        Ok(Self {
            out: BufWriter::with_capacity(1 << 20, File::create(path)?),
            hasher: Sha256::new(),
        })
    }

    pub fn put(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.hasher.update(bytes);
        self.out.write_all(bytes)
    }

    /// Brings the file to the disk; its SHA-256.
    pub fn finish(self) -> std::io::Result<String> {
        let file = self
            .out
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)?;
        file.sync_all()?;
        Ok(hex(&self.hasher.finalize()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_hashed_in_any_order_of_asking() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("abc"), b"abc").unwrap();
        std::fs::write(path("empty"), b"").unwrap();
        let mut hashes = Hashes::start(vec![path("abc"), path("empty"), path("missing")]);
        let empty = hashes.get(&path("empty")).unwrap();
        assert!(empty.sha256.starts_with("e3b0c442") && empty.bytes == 0);
        let abc = hashes.get(&path("abc")).unwrap();
        assert!(abc.sha256.starts_with("ba7816bf") && abc.bytes == 3);
        assert!(hashes.get(&path("missing")).is_err());
        assert!(hashes.get(&path("never asked for")).is_err());

        let mut file = HashedFile::create(&path("written")).unwrap();
        file.put(b"a").unwrap();
        file.put(b"bc").unwrap();
        assert_eq!(file.finish().unwrap(), abc.sha256);
    }
}
