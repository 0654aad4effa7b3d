//! Container formats that carry arrays and pictures, read with bounded memory.
//!
//! Read in this order: [`zip`] (archives, also the shell of npz and of released checkpoints), [`npy`] (one array), [`npz`]
//! (named arrays), [`pickle`] (an interpreter that can only describe data), [`checkpoint`] (weights in any of their containers, streamed), [`png`] (pictures), [`place`] (where a file lies: on a disk,
//! or in an object store), [`tar`] (shards). Every reader takes untrusted
//! bytes: a malformed file is a [`FormatError`] that says where and why, a recording that cannot be read is a [`ReadError`], and
//! no length field is believed before it has been compared with the size of the file.

pub mod checkpoint;
pub mod npy;
pub mod npz;
#[cfg(feature = "s3")]
pub mod object;
pub mod pickle;
pub mod place;
pub mod png;
pub mod read_error;
pub mod tar;
pub mod text;
pub mod zip;

pub use read_error::ReadError;

use std::path::{Path, PathBuf};

/// Why a file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The bytes are not what the format prescribes, or more than this reader accepts.
    #[error("{format}: byte {offset}: {reason}")]
    Malformed {
        /// The format in which it was read: `npy`, `zip`, `png`, ...
        format: &'static str,
        /// From the start of the file (or of the uncompressed member, where the format lies inside an archive).
        offset: u64,
        /// What is wrong there.
        reason: String,
    },
    /// The array is fine, but its values do not fit what was asked for.
    #[error("{reason}")]
    Conversion {
        /// Which value does not fit, and into what.
        reason: String,
    },
    /// The archive has no member of this name.
    #[error("no `{name}` in the archive; it holds {present}")]
    Missing {
        /// The member that was asked for.
        name: String,
        /// The names of its first members, joined by commas, or `nothing`.
        present: String,
    },
    /// The operating system refuses to read or write.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// A file was expected.
    #[error("{kind}, and no regular file")]
    NotAFile {
        /// What is there: `a folder` or `a pipe or a device`.
        kind: &'static str,
    },
    /// More bytes than are held in memory.
    #[error("more than {limit} bytes")]
    TooLarge {
        /// The most bytes that the reader takes.
        limit: u64,
    },
    /// Any of the above, with the file it happened in.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What happened in it.
        #[source]
        source: Box<FormatError>,
    },
}

impl FormatError {
    /// A [`FormatError::Malformed`] at byte `offset`.
    pub fn malformed(format: &'static str, offset: u64, reason: impl Into<String>) -> Self {
        Self::Malformed {
            format,
            offset,
            reason: reason.into(),
        }
    }

    /// The same error with its file; an error that has one keeps it.
    #[must_use]
    pub fn in_file(self, path: &Path) -> Self {
        match self {
            Self::File { .. } => self,
            source => Self::File {
                path: path.to_owned(),
                source: Box::new(source),
            },
        }
    }
}

/// All bytes of a file that is held in memory: of a regular file, never of a pipe or of a device, which may have no end.
///
/// # Errors
/// When it cannot be read, is no regular file, or has more than `limit` bytes.
pub fn read_whole(path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
    use std::io::Read;
    let read = || {
        // Before it is opened: that of a pipe would wait for somebody who writes.
        let facts = std::fs::metadata(path)?;
        if !facts.is_file() {
            let kind = if facts.is_dir() {
                "a folder"
            } else {
                "a pipe or a device"
            };
            return Err(FormatError::NotAFile { kind });
        }
        let too_large = || FormatError::TooLarge { limit };
        if facts.len() > limit {
            return Err(too_large());
        }
        let mut bytes = Vec::new();
        // It may grow while it is read, and files of `/proc` say that they are empty.
        std::fs::File::open(path)?
            .take(limit + 1)
            .read_to_end(&mut bytes)?;
        if bytes.len() as u64 > limit {
            return Err(too_large());
        }
        Ok(bytes)
    };
    read().map_err(|error: FormatError| error.in_file(path))
}

/// The SHA-256 of a file, in hexadecimal.
pub fn sha256_of(path: &Path) -> std::io::Result<String> {
    use sha2::{Digest, Sha256};
    use std::fmt::Write as _;
    use std::io::Read as _;
    let mut file = std::fs::File::open(path)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        let count = file.read(&mut buffer)?;
        if count == 0 {
            break;
        }
        hasher.update(&buffer[..count]);
    }
    let text = String::new();
    Ok(hasher.finalize().iter().fold(text, |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    }))
}

/// Whether a path that a file names stays below the folder it is joined to: neither absolute nor with `..`.
pub fn stays_inside(path: &Path) -> bool {
    use std::path::Component;
    let plain = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    !path.as_os_str().is_empty() && path.components().all(plain)
}

/// Whether a text that a file gives can be the name of a file or a folder anywhere: one part, without separators of any system.
pub fn is_plain_name(name: &str) -> bool {
    let odd = |c: char| c.is_control() || matches!(c, '/' | '\\');
    !matches!(name, "" | "." | "..") && name.len() <= 200 && !name.contains(odd)
}

/// Bytes of a block of a tar.
const TAR_BLOCK: u64 = 512;
/// What to say of a tar without its end.
pub const TAR_CUT: &str =
    "it ends without the empty block that ends a tar: it is cut short, or was never finished";

/// Whether a tar of `length` bytes goes on behind its last member, which ends at byte `end`. One that was cut between two members has
/// nothing there, and reads like a whole one with fewer members.
pub fn tar_has_end(length: u64, end: u64) -> bool {
    let padded = end.div_ceil(TAR_BLOCK).saturating_mul(TAR_BLOCK);
    length >= padded.saturating_add(TAR_BLOCK)
}

/// A temporary file in `folder` that will be renamed, with the rights that a file made in place would have: the process's umask
/// applies, where the default of `tempfile` would hide the file from colleagues.
pub fn temporary_in(folder: &Path) -> std::io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder)
}

/// Writes `bytes` to a temporary name beside `path` and renames it, so that a reader never sees half a file.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    use std::io::Write;
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let mut file = temporary_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|e| e.error)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    #[test]
    fn a_written_file_has_the_rights_of_any_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let rights = |name: &str| {
            let path = folder.path().join(name);
            std::fs::metadata(path).unwrap().permissions().mode()
        };
        std::fs::write(folder.path().join("plain"), b"1").unwrap();
        super::write_atomically(&folder.path().join("renamed"), b"1").unwrap();
        assert_eq!(rights("renamed"), rights("plain"));
    }
}
