//! Files of experiments: small texts, found beside each other.

use super::yaml;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// The nearest `name` beside a file: in its folder, or in the folder above it.
pub fn beside(path: &Path, name: &str) -> Option<PathBuf> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    };
    let near = folder.join(name);
    if near.exists() {
        return Some(near);
    }
    let above = std::fs::canonicalize(&folder).ok()?.parent()?.join(name);
    if !above.exists() {
        return None;
    }
    // Keep what people read short.
    let short = folder.parent().map(|parent| parent.join(name));
    match short {
        Some(short) if short.exists() && !folder.ends_with(".") => Some(short),
        _ => Some(above),
    }
}

/// A name for a file that is the same however it is written.
pub fn canonical(path: &Path) -> PathBuf {
    std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}

/// Reads a small text file: bounded, never from a pipe or a device.
///
/// # Errors
/// When it is missing, no regular file, too large or not UTF-8.
pub fn read(path: &Path) -> std::io::Result<String> {
    let bytes = read_bytes(path)?;
    yaml::decode(&bytes, 0)
        .map(std::borrow::Cow::into_owned)
        .map_err(|diagnostic| std::io::Error::other(diagnostic.message))
}

/// Reads at most one byte more than an experiment may have.
///
/// # Errors
/// When it is missing or no regular file.
pub fn read_bytes(path: &Path) -> std::io::Result<Vec<u8>> {
    let facts = std::fs::metadata(path)?;
    if facts.is_dir() {
        return Err(std::io::Error::other("it is a folder"));
    }
    if !facts.is_file() {
        return Err(std::io::Error::other("it is no regular file"));
    }
    let mut bytes = Vec::new();
    std::fs::File::open(path)?
        .take(yaml::MAX_BYTES as u64 + 1)
        .read_to_end(&mut bytes)?;
    Ok(bytes)
}
