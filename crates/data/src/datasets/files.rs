//! Pictures and depth maps that are files of their own and named by a number (`000012.png`).

use super::ReadError;
use super::recording::{ColourFrames, DepthFrames};
use crate::formats::read_error::Position;
use crate::video::folder;
use crate::video::image::{Image, grey16_from_png};
use ndarray::Array2;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use zune_core::bytestream::ZCursor;

/// The files of a folder whose names are a number and one of these extensions, by their number. Other files (`.DS_Store`,
/// `._000012.png`) are left alone.
///
/// # Errors
/// When the folder cannot be listed.
pub(super) fn numbered(
    folder: &Path,
    extensions: &[&str],
) -> Result<Vec<(u32, PathBuf)>, ReadError> {
    let fail = |cause| ReadError::io(folder, cause);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        let extension = path.extension().and_then(|extension| extension.to_str());
        let known = extension.is_some_and(|found| {
            extensions
                .iter()
                .any(|known| found.eq_ignore_ascii_case(known))
        });
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        let number = stem
            .filter(|stem| stem.bytes().all(|byte| byte.is_ascii_digit()))
            .and_then(|stem| stem.parse().ok());
        if let (true, Some(number)) = (known, number) {
            files.push((number, path));
        }
    }
    files.sort();
    files.dedup_by_key(|(number, _)| *number);
    Ok(files)
}

/// Pictures in files.
pub(super) struct PictureFiles {
    pub files: Vec<PathBuf>,
    pub times: Vec<i64>,
}

impl ColourFrames for PictureFiles {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        for &index in indices {
            each(index, folder::read(&self.files[index])?);
        }
        Ok(())
    }
}

/// Depth maps in 16-bit png files, 0 where nothing was measured.
pub(super) struct DepthFiles {
    pub files: Vec<PathBuf>,
    pub times: Vec<i64>,
    pub metres_per_unit: f32,
}

impl DepthFrames for DepthFiles {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError> {
        let path = &self.files[index];
        let bytes = std::fs::read(path).map_err(|cause| ReadError::io(path, cause))?;
        let values = grey16_from_png(&bytes)
            .map_err(|reason| ReadError::malformed(path, Position::File, reason))?;
        Ok(metres(&values, self.metres_per_unit))
    }
}

/// Metres from 16-bit values, NaN where there is 0.
pub(super) fn metres(values: &Array2<u16>, metres_per_unit: f32) -> Array2<f32> {
    values.mapv(|value| match value {
        0 => f32::NAN,
        value => f32::from(value) * metres_per_unit,
    })
}

/// Width and height of a picture, from its header.
///
/// # Errors
/// When it is neither a png nor a jpeg, or cut short.
pub(super) fn picture_size(path: &Path) -> Result<(u32, u32), ReadError> {
    let wrong = |reason: String| ReadError::malformed(path, Position::File, reason);
    let is_png = path
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    if is_png {
        let file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
        let mut decoder = png::Decoder::new(BufReader::new(file));
        let header = decoder
            .read_header_info()
            .map_err(|error| wrong(format!("png: {error}")))?;
        return Ok((header.width, header.height));
    }
    let bytes = std::fs::read(path).map_err(|cause| ReadError::io(path, cause))?;
    let mut decoder = zune_jpeg::JpegDecoder::new(ZCursor::new(bytes));
    decoder
        .decode_headers()
        .map_err(|error| wrong(format!("jpeg: {error}")))?;
    let info = decoder
        .info()
        .ok_or_else(|| wrong("jpeg: no header".to_owned()))?;
    Ok((info.width.into(), info.height.into()))
}

/// Sample `k` of 30 a second, nanoseconds.
pub(super) fn tick(k: i64) -> i64 {
    (k as f64 / 30.0 * 1e9).round() as i64
}
