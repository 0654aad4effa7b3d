//! A folder of pictures as a video: png or jpeg, in natural order of their names (`frame_9` before `frame_10`).

use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Image;
use std::path::{Path, PathBuf};

/// The pictures of a folder in order.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let entries = std::fs::read_dir(folder).map_err(|cause| ReadError::io(folder, cause))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.map_err(|cause| ReadError::io(folder, cause))?.path();
        let is_picture = path
            .extension()
            .and_then(|ext| ext.to_str())
            .is_some_and(|ext| {
                ["png", "jpg", "jpeg"]
                    .iter()
                    .any(|known| ext.eq_ignore_ascii_case(known))
            });
        if is_picture {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(ReadError::missing(
            folder,
            "there are no png or jpg pictures in this folder",
        ));
    }
    // By name first: `f1` and `f01` are the same number, and the folder lists them in any order.
    files.sort();
    files.sort_by_cached_key(|path| natural_key(path));
    Ok(files)
}

/// Runs of digits compare as numbers, everything else as bytes.
fn natural_key(path: &Path) -> Vec<(Vec<u8>, u128)> {
    let name = path
        .file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let mut key = Vec::new();
    let mut text = Vec::new();
    let mut number: Option<u128> = None;
    for byte in name.bytes() {
        if byte.is_ascii_digit() {
            let digit = u128::from(byte - b'0');
            number = Some(number.unwrap_or(0).saturating_mul(10).saturating_add(digit));
        } else {
            if let Some(value) = number.take() {
                key.push((std::mem::take(&mut text), value));
            }
            text.push(byte);
        }
    }
    key.push((text, number.unwrap_or(0)));
    key
}

/// Decodes one picture.
pub fn read(path: &Path) -> Result<Image, ReadError> {
    let bytes = std::fs::read(path).map_err(|cause| ReadError::io(path, cause))?;
    Image::from_bytes(&bytes).map_err(|reason| ReadError::malformed(path, Position::File, reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_count() {
        let mut names = ["f10.png", "f9.png", "f1.png", "a.png", "f9b.png"].map(PathBuf::from);
        names.sort_by_cached_key(|path| natural_key(path));
        assert_eq!(
            names.map(|path| path.display().to_string()),
            ["a.png", "f1.png", "f9.png", "f9b.png", "f10.png"]
        );
    }
}
