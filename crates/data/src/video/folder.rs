//! A folder of pictures as a video: png or jpeg, in natural order of their names (`frame_9` before `frame_10`).

use super::exif;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Image;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The pictures of a folder in order. Hidden files and folders are no pictures; names that differ in more than their numbers
/// are several series, which nobody can put into one order.
///
/// # Errors
/// When the folder cannot be read, holds no picture, or holds several series.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let entries = std::fs::read_dir(folder).map_err(|cause| ReadError::io(folder, cause))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.map_err(|cause| ReadError::io(folder, cause))?.path();
        // `._name.jpg` is what macOS keeps beside `name.jpg`.
        let name = path.file_name().unwrap_or_default().as_encoded_bytes();
        if !name.starts_with(b".") && kind(&path).is_some() && path.is_file() {
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
    one_series(folder, &files)?;
    Ok(files)
}

/// `png` or `jpg`, if it is a picture by its name.
fn kind(path: &Path) -> Option<&'static str> {
    let extension = path.extension()?.to_str()?;
    [("png", "png"), ("jpg", "jpg"), ("jpeg", "jpg")]
        .into_iter()
        .find(|(known, _)| extension.eq_ignore_ascii_case(known))
        .map(|(_, kind)| kind)
}

/// A series is what names have in common when each run of digits (and of the marks between them) is one number. Names of which
/// no two have that in common (`a.png`, `b.png`) are taken as one series, unless they differ in their extension alone.
fn one_series(folder: &Path, files: &[PathBuf]) -> Result<(), ReadError> {
    let mut series: BTreeMap<(String, &str), Vec<&Path>> = BTreeMap::new();
    let mut stems: BTreeMap<String, &Path> = BTreeMap::new();
    let mut twins = None;
    for path in files {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        if let Some(other) = stems.insert(stem.to_string(), path) {
            twins = twins.or(Some((other, path.as_path())));
        }
        let key = (pattern(&stem), kind(path).unwrap_or_default());
        series.entry(key).or_default().push(path);
    }
    let mut first: Vec<&Path> = series.values().map(|paths| paths[0]).collect();
    first.sort_by_key(|path| files.iter().position(|file| file == path));
    let pair = match (twins, series.values().any(|paths| paths.len() > 1)) {
        (Some(twins), _) => twins,
        (None, true) if first.len() > 1 => (first[0], first[1]),
        _ => return Ok(()),
    };
    let name = |path: &Path| path.file_name().unwrap_or_default().display().to_string();
    Err(ReadError::malformed(
        folder,
        Position::File,
        format!(
            "the folder holds more than one series of pictures (`{}`, `{}`); give each one a folder of its own",
            name(pair.0),
            name(pair.1)
        ),
    ))
}

/// A name with `#` for every number: `frame-0001.color` is `frame-#.color`, `1305031102.175` is `#`.
fn pattern(stem: &str) -> String {
    let mut pattern = String::new();
    let mut marks = String::new();
    for c in stem.chars() {
        if c.is_ascii_digit() {
            if !pattern.ends_with('#') {
                // What stands in front of all may be a sign.
                if !pattern.is_empty() {
                    pattern.push_str(&marks);
                }
                pattern.push('#');
            }
            marks.clear();
        } else if "._-, ".contains(c) {
            marks.push(c);
        } else {
            pattern.push_str(&std::mem::take(&mut marks));
            pattern.extend(c.to_lowercase());
        }
    }
    pattern.push_str(&marks);
    pattern
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

/// Decodes one picture, upright as its camera says.
///
/// # Errors
/// When it cannot be read.
pub fn read(path: &Path) -> Result<Image, ReadError> {
    let bytes = std::fs::read(path).map_err(|cause| ReadError::io(path, cause))?;
    let image = Image::from_bytes(&bytes)
        .map_err(|reason| ReadError::malformed(path, Position::File, reason))?;
    Ok(image.upright(exif::orientation(&bytes)))
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

    #[test]
    fn several_series_and_hidden_files_are_told_from_pictures() {
        for (names, taken) in [
            (
                vec![
                    "000000.jpg",
                    "000001.jpg",
                    "._000000.jpg",
                    ".hidden.png",
                    "Thumbs.db",
                ],
                Some(2),
            ),
            (
                vec![
                    "frame-0.color.png",
                    "frame-1.color.png",
                    "frame-0.depth.png",
                    "frame-1.depth.png",
                ],
                None,
            ),
            (vec!["left_1.png", "left_2.png", "right_1.png"], None),
            (vec!["0.jpg", "1.jpg", "cover.jpg"], None),
            (vec!["0.jpg", "0.png"], None),
            (vec!["IMG_1.JPG", "IMG_2.jpg", "img_3.jpeg"], Some(3)),
            (vec!["1305031102.175.png", "1305031103.png"], Some(2)),
            (
                vec!["2024-01-02 10.11.12.jpg", "2024-01-02 10.11.12-1.jpg"],
                Some(2),
            ),
            (vec!["a.png", "b.png"], Some(2)),
        ] {
            let folder = tempfile::tempdir().unwrap();
            for name in &names {
                std::fs::write(folder.path().join(name), b"").unwrap();
            }
            std::fs::create_dir(folder.path().join("thumbs.png")).unwrap();
            match (list(folder.path()), taken) {
                (Ok(found), Some(count)) => assert_eq!(found.len(), count, "{names:?}"),
                (Err(error), None) => {
                    let said = error.to_string();
                    assert!(said.contains("more than one series"), "{said}");
                }
                (found, _) => panic!("{names:?}: {found:?}"),
            }
        }
    }
}
