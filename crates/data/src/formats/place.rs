//! Where shards lie: in folders of this machine, or, with the feature `s3`, below `s3://bucket/prefix` of an object store.
//!
//! An address is a path in both cases; what it means is decided here and nowhere else. An object store has no folders: they are there
//! while something is below them. What is written to it is there whole or not at all, as a file that is renamed.

use super::ReadError;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::path::{Path, PathBuf};

#[cfg(feature = "s3")]
use super::object;

/// What an address of an object store begins with.
const SCHEME: &str = "s3://";
/// Read ahead of what is asked for where a reader jumps: some headers of a tar, or one and the beginning of a member.
pub const JUMPS: u64 = 1 << 18;
/// Read ahead where a reader goes through to the end.
pub const THROUGH: u64 = 1 << 23;

/// Bytes that are read from any place on.
pub trait Bytes: Read + Seek + Send {}

impl<T: Read + Seek + Send> Bytes for T {}

/// Whether a path is an address of an object store.
#[must_use]
pub fn is_remote(path: &Path) -> bool {
    path.to_str().is_some_and(|text| text.starts_with(SCHEME))
}

/// Whether something may lie there: a local folder that exists, or an address that this build can read. Asks no network.
#[must_use]
pub fn may_be_folder(path: &Path) -> bool {
    if is_remote(path) {
        cfg!(feature = "s3")
    } else {
        path.is_dir()
    }
}

/// What a build without the feature says of an address.
#[cfg(not(feature = "s3"))]
fn unsupported<T>() -> Result<T> {
    let reason =
        "this `reviv` was built without the feature `s3`, which reads and writes `s3://` addresses";
    Err(Error::new(ErrorKind::Unsupported, reason))
}

/// Does one thing with a local path, another with an address.
macro_rules! either {
    ($path:expr, $local:expr, $remote:expr) => {
        if is_remote($path) {
            #[cfg(feature = "s3")]
            {
                $remote
            }
            #[cfg(not(feature = "s3"))]
            {
                unsupported()
            }
        } else {
            $local
        }
    };
}

/// Opens a file, with its length; `ahead` bytes are fetched at a time where every request takes its time.
///
/// # Errors
/// When it is not there, or cannot be read.
#[cfg_attr(not(feature = "s3"), allow(unused_variables))]
pub fn open(path: &Path, ahead: u64) -> Result<(Box<dyn Bytes>, u64)> {
    either!(
        path,
        {
            let file = File::open(path)?;
            let length = file.metadata()?.len();
            Ok((Box::new(file) as Box<dyn Bytes>, length))
        },
        {
            let object = object::Object::open(path, ahead)?;
            let length = object.length();
            Ok((Box::new(object) as Box<dyn Bytes>, length))
        }
    )
}

/// All bytes of a file.
///
/// # Errors
/// When it is not there, or cannot be read.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    either!(path, std::fs::read(path), object::read(path))
}

/// `length` bytes from `offset` on; fewer where the file ends before.
///
/// # Errors
/// When it is not there, or cannot be read.
pub fn read_range(path: &Path, offset: u64, length: u64) -> Result<Vec<u8>> {
    either!(
        path,
        {
            let mut file = File::open(path)?;
            file.seek(SeekFrom::Start(offset))?;
            let mut bytes = Vec::with_capacity(length as usize);
            file.take(length).read_to_end(&mut bytes)?;
            Ok(bytes)
        },
        object::read_range(path, offset, length)
    )
}

/// Writes a file, whole or not at all.
///
/// # Errors
/// When the place refuses.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    either!(
        path,
        super::write_atomically(path, bytes).map_err(|error| match error {
            super::FormatError::Io(error) => error,
            error => Error::other(error),
        }),
        object::write(path, bytes)
    )
}

/// Gives a local file its place: it is renamed, or sent there and removed.
///
/// # Errors
/// When the place refuses; the file is still where it was then.
pub fn publish(file: &Path, path: &Path) -> Result<()> {
    either!(path, std::fs::rename(file, path), {
        object::send(file, path)?;
        std::fs::remove_file(file)
    })
}

/// Makes a folder, and those above it, where there are folders.
///
/// # Errors
/// When the disk refuses.
pub fn make_folder(path: &Path) -> Result<()> {
    either!(path, std::fs::create_dir_all(path), object::check(path))
}

/// What lies in a folder, in the order of its names: the path, and whether it is a folder.
///
/// # Errors
/// When it is not there, or cannot be listed.
pub fn entries(folder: &Path) -> Result<Vec<(PathBuf, bool)>> {
    either!(
        folder,
        {
            let mut entries = Vec::new();
            for entry in std::fs::read_dir(folder)? {
                let path = entry?.path();
                let is_folder = path.is_dir();
                entries.push((path, is_folder));
            }
            entries.sort();
            Ok(entries)
        },
        object::entries(folder)
    )
}

/// Whether nothing lies below a folder, which need not be there.
///
/// # Errors
/// When it cannot be listed.
pub fn is_empty(folder: &Path) -> Result<bool> {
    match entries(folder) {
        Ok(entries) => Ok(entries.is_empty()),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(true),
        Err(error) => Err(error),
    }
}

/// Whether a file is there.
///
/// # Errors
/// When an object store does not answer.
pub fn is_file(path: &Path) -> Result<bool> {
    either!(path, Ok(path.is_file()), object::is_file(path))
}

/// Whether a folder is there; in an object store, whether anything is below it.
///
/// # Errors
/// When an object store does not answer.
pub fn is_folder(path: &Path) -> Result<bool> {
    either!(path, Ok(path.is_dir()), {
        Ok(!object::entries(path)?.is_empty())
    })
}

/// What is known of every object below an address without reading one: its name below it, its size, and what tells whether it has changed.
/// Of object stores alone.
///
/// # Errors
/// When it is no such address, or the store does not answer.
pub fn listing(folder: &Path) -> Result<Vec<(String, u64, String)>> {
    either!(
        folder,
        Err(Error::new(
            ErrorKind::Unsupported,
            "no address of an object store"
        )),
        object::listing(folder)
    )
}

/// Copies everything below an address into a local folder.
///
/// # Errors
/// When it cannot be read, or the disk refuses.
pub fn fetch(folder: &Path, to: &Path) -> Result<()> {
    std::fs::create_dir_all(to)?;
    for (path, is_folder) in entries(folder)? {
        let target = to.join(path.file_name().unwrap_or_default());
        if is_folder {
            fetch(&path, &target)?;
        } else {
            std::fs::write(&target, read(&path)?)?;
        }
    }
    Ok(())
}

/// Copies everything below a local folder to an address, or into another folder.
///
/// # Errors
/// When it cannot be read, or the place refuses.
pub fn store(folder: &Path, to: &Path) -> Result<()> {
    make_folder(to)?;
    for (path, is_folder) in entries(folder)? {
        let target = to.join(path.file_name().unwrap_or_default());
        if is_folder {
            store(&path, &target)?;
        } else {
            write(&target, &std::fs::read(&path)?)?;
        }
    }
    Ok(())
}

/// Reads a JSON file from a disk or an object store.
///
/// # Errors
/// When it cannot be read, or does not hold such a value; the error names the line.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> std::result::Result<T, ReadError> {
    if !is_remote(path) {
        return super::text::read_json(path);
    }
    let bytes = read(path).map_err(|cause| ReadError::io(path, cause))?;
    serde_json::from_slice(&bytes).map_err(|error| super::text::json_error(path, &error))
}

/// Writes a JSON file to a disk or an object store, whole or not at all.
///
/// # Errors
/// When the place refuses.
pub fn write_json(path: &Path, value: &impl Serialize) -> std::result::Result<(), ReadError> {
    let bytes =
        serde_json::to_vec_pretty(value).map_err(|error| ReadError::Settings(error.to_string()))?;
    write(path, &bytes).map_err(|cause| ReadError::io(path, cause))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_told_from_paths() {
        for remote in ["s3://bucket", "s3://bucket/a/b"] {
            assert!(is_remote(Path::new(remote)), "{remote}");
            assert!(is_remote(&Path::new(remote).join("clips.json")), "{remote}");
        }
        for local in [
            "s3",
            "s3:/bucket",
            "/s3://bucket",
            "./s3://bucket",
            "data/s3",
        ] {
            assert!(!is_remote(Path::new(local)), "{local}");
        }
    }

    #[cfg(not(feature = "s3"))]
    #[test]
    fn a_build_without_object_stores_says_so() {
        let address = Path::new("s3://bucket/clips");
        for error in [
            read(address).unwrap_err(),
            write(address, b"1").unwrap_err(),
            entries(address).unwrap_err(),
            open(address, JUMPS).map(|(_, length)| length).unwrap_err(),
        ] {
            assert!(error.to_string().contains("feature `s3`"), "{error}");
        }
        assert!(!may_be_folder(address));
    }
}
