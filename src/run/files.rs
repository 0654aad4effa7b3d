//! Files that are whole or not there: everything is written under a temporary name, fsynced and renamed.

use super::error::{AtPath, RunError};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Puts `bytes` at `path`, replacing what was there in one step.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), RunError> {
    let parent = path.parent().unwrap_or(Path::new("."));
    let mut file = temporary(parent)?;
    file.write_all(bytes).at("writing", path)?;
    file.as_file().sync_all().at("writing", path)?;
    file.persist(path)
        .map_err(|error| RunError::io("writing", path, error.error))?;
    sync_directory(parent)
}

/// [`write()`] of pretty-printed JSON with a final newline.
pub fn write_json<T: serde::Serialize>(path: &Path, value: &T) -> Result<(), RunError> {
    let mut text = serde_json::to_vec_pretty(value).map_err(|error| RunError::Malformed {
        path: path.into(),
        reason: error.to_string(),
    })?;
    text.push(b'\n');
    write(path, &text)
}

/// Reads a JSON file of the record. Files above `MAX_RECORD` bytes are refused: no file of ours is that large.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, RunError> {
    let size = fs::metadata(path).at("reading", path)?.len();
    let malformed = |reason: String| RunError::Malformed {
        path: path.into(),
        reason,
    };
    if size > MAX_RECORD {
        return Err(malformed(format!("{size} bytes are too many")));
    }
    let bytes = fs::read(path).at("reading", path)?;
    serde_json::from_slice(&bytes).map_err(|error| malformed(error.to_string()))
}

/// 256 MiB.
const MAX_RECORD: u64 = 256 << 20;

/// Makes the finished directory `from` appear at `to` in one step, with all its bytes on the device first.
pub fn publish_directory(from: &Path, to: &Path) -> Result<(), RunError> {
    for file in files_below(from)? {
        let path = from.join(&file);
        File::open(&path)
            .and_then(|f| f.sync_all())
            .at("writing", &path)?;
    }
    sync_directory(from)?;
    fs::rename(from, to).at("writing", to)?;
    sync_directory(to.parent().unwrap_or(Path::new(".")))
}

/// The files below `root`, relative and sorted; links and special files are refused.
pub fn files_below(root: &Path) -> Result<Vec<PathBuf>, RunError> {
    let mut found = Vec::new();
    let mut open = vec![PathBuf::new()];
    while let Some(relative) = open.pop() {
        let here = root.join(&relative);
        for entry in fs::read_dir(&here).at("reading", &here)? {
            let entry = entry.at("reading", &here)?;
            let path = relative.join(entry.file_name());
            let kind = entry.file_type().at("reading", &here)?;
            if kind.is_dir() {
                open.push(path);
            } else if kind.is_file() {
                found.push(path);
            } else {
                return Err(RunError::Malformed {
                    path: root.join(path),
                    reason: "neither a file nor a directory".into(),
                });
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Creates `path` and what is above it.
pub fn create_directory(path: &Path) -> Result<(), RunError> {
    fs::create_dir_all(path).at("creating", path)
}

/// Removes a file or a tree; what is not there is no error.
pub fn remove(path: &Path) -> Result<(), RunError> {
    let result = match fs::symlink_metadata(path) {
        Ok(meta) if meta.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match result {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).at("removing", path)
        }
        _ => Ok(()),
    }
}

/// Copies a tree of plain files.
pub fn copy_tree(from: &Path, to: &Path) -> Result<(), RunError> {
    create_directory(to)?;
    for file in files_below(from)? {
        let target = to.join(&file);
        if let Some(parent) = target.parent() {
            create_directory(parent)?;
        }
        fs::copy(from.join(&file), &target).at("writing", &target)?;
    }
    Ok(())
}

/// The bytes a tree takes.
pub fn size_below(root: &Path) -> Result<u64, RunError> {
    let mut total = 0;
    for file in files_below(root)? {
        let path = root.join(file);
        total += fs::metadata(&path).at("reading", &path)?.len();
    }
    Ok(total)
}

/// blake3 of a file's bytes, and how many there are.
pub fn hash(path: &Path) -> Result<(blake3::Hash, u64), RunError> {
    let mut hasher = blake3::Hasher::new();
    let file = File::open(path).at("reading", path)?;
    hasher.update_reader(file).at("reading", path)?;
    Ok((hasher.finalize(), hasher.count()))
}

/// Appends one line in a single write, so that lines of several processes do not mix.
pub fn append_line(path: &Path, line: &str) -> Result<(), RunError> {
    let mut file = File::options()
        .create(true)
        .append(true)
        .open(path)
        .at("writing", path)?;
    file.write_all(format!("{line}\n").as_bytes())
        .at("writing", path)
}

fn temporary(parent: &Path) -> Result<tempfile::NamedTempFile, RunError> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".writing-");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // The process's umask applies; the default of `tempfile` would hide the record from colleagues.
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(parent).at("writing", parent)
}

fn sync_directory(path: &Path) -> Result<(), RunError> {
    let path = if path.as_os_str().is_empty() {
        Path::new(".")
    } else {
        path
    };
    // Directories cannot be opened on every platform; the rename itself is atomic everywhere.
    match File::open(path) {
        Ok(directory) if cfg!(unix) => directory.sync_all().at("writing", path),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_file_replaces_the_old_one_and_leaves_nothing_beside_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.json");
        write(&path, b"one").unwrap();
        write(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(
            files_below(dir.path()).unwrap(),
            [PathBuf::from("run.json")]
        );
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_device_is_named_as_such() {
        let error = append_line(Path::new("/dev/full"), "x").unwrap_err();
        assert_eq!(error.code(), "E0502");
    }

    #[test]
    fn a_damaged_record_is_malformed_and_not_a_panic() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.json");
        for bytes in [&b""[..], b"{", b"\xff\xfe", b"[1,2]"] {
            write(&path, bytes).unwrap();
            let result = read_json::<std::collections::BTreeMap<String, u32>>(&path);
            assert_eq!(result.unwrap_err().code(), "E0804");
        }
    }
}
