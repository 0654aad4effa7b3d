//! Depth of a recording: an array, or a folder of pictures.

use super::FILE;
use super::arrays::{inside, load, nanoseconds};
use super::manifest::DepthEntry;
use crate::datasets::recording::DepthFrames;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::formats::read_whole;
use crate::video::folder;
use crate::video::image::grey16_from_png;
use ndarray::{Array2, Array3, Axis};
use std::path::{Path, PathBuf};

/// More than a picture has, uncompressed.
const MAX_PICTURE: u64 = 1 << 30;

enum DepthFiles {
    Array(Array3<f32>),
    Pictures(Vec<PathBuf>),
}

struct NeutralDepth {
    files: DepthFiles,
    times: Vec<i64>,
    scale: f32,
}

pub(super) fn depth(root: &Path, entry: &DepthEntry) -> Result<Box<dyn DepthFrames>, ReadError> {
    let path = inside(root, &entry.file)?;
    let scale = entry.unit.metres() as f32;
    let (files, times) = if path.is_dir() {
        let files = folder::list(&path)?;
        let rate = entry
            .rate
            .filter(|rate| *rate > 0.0 && rate.is_finite())
            .ok_or_else(|| {
                ReadError::malformed(
                    &root.join(FILE),
                    Position::File,
                    "a folder of depth pictures needs a `rate`",
                )
            })?;
        let times = (0..files.len())
            .map(|k| nanoseconds(&path, entry.start + k as f64 / rate))
            .collect::<Result<_, _>>()?;
        (DepthFiles::Pictures(files), times)
    } else {
        let (array, times) = load(
            root,
            &entry.file,
            entry.key.as_deref(),
            entry.start,
            entry.rate,
            entry.times.as_deref(),
        )?;
        let array = array
            .to_dim::<f32, ndarray::Ix3>()
            .map_err(|error| error.in_file(&path))?;
        if array.is_empty() {
            return Err(ReadError::malformed(
                &path,
                Position::File,
                format!("depth maps without pixels, of shape {:?}", array.shape()),
            ));
        }
        (DepthFiles::Array(array), times)
    };
    Ok(Box::new(NeutralDepth {
        files,
        times,
        scale,
    }))
}

impl DepthFrames for NeutralDepth {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError> {
        let metres = |value: f32| {
            if value > 0.0 && value.is_finite() {
                value * self.scale
            } else {
                f32::NAN
            }
        };
        match &self.files {
            DepthFiles::Array(array) => Ok(array.index_axis(Axis(0), index).mapv(metres)),
            DepthFiles::Pictures(files) => {
                let path = &files[index];
                let bytes = read_whole(path, MAX_PICTURE)?;
                let values = grey16_from_png(&bytes)
                    .map_err(|reason| ReadError::malformed(path, Position::File, reason))?;
                Ok(values.mapv(|value| metres(f32::from(value))))
            }
        }
    }
}
