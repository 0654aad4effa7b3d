//! Depth on disk for other programs: one npz, or a picture per frame. Frames are written as they come, so memory does not grow
//! with the length of the video.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use ndarray::Array2;

use super::{DepthLabelKind, LabelError};
use crate::formats::FormatError;
use crate::formats::npy::{self, NpyArray, NpyData};
use crate::formats::png::{self, Picture};
use crate::formats::zip::ZipWriter;

/// What the depth of a video is written as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DepthFormat {
    /// `depth.npz` with the array `depth`, `[frames, height, width]` f32.
    Npz,
    /// `000000.png`, 16-bit grey: millimetres of metric depth (0 is unknown, 65.535 m the farthest); relative depth between the
    /// extremes of the video.
    Png,
    /// `000000.exr`, one f32 channel `Z`.
    Exr,
}

impl std::str::FromStr for DepthFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "npz" => Ok(Self::Npz),
            "png" => Ok(Self::Png),
            "exr" => Ok(Self::Exr),
            _ => Err(format!("`{text}` is not one of npz, png, exr")),
        }
    }
}

/// The files of one video.
#[derive(Debug)]
pub struct DepthFiles {
    folder: PathBuf,
    format: DepthFormat,
    /// Height and width.
    size: [usize; 2],
    /// Values that wait for the number of frames or for their extremes, where the format needs those.
    waiting: Option<BufWriter<File>>,
    frames: usize,
    range: [f32; 2],
}

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Written {
    /// How many frames.
    pub frames: usize,
    /// The smallest and the largest value.
    pub range: [f32; 2],
}

impl DepthFiles {
    /// Starts to write into `folder`, which exists.
    ///
    /// # Errors
    /// When a temporary file cannot be made there.
    pub fn create(
        folder: &Path,
        format: DepthFormat,
        kind: DepthLabelKind,
        size: [usize; 2],
    ) -> Result<Self, LabelError> {
        let waits = match format {
            DepthFormat::Npz => true,
            DepthFormat::Png => kind == DepthLabelKind::Relative,
            DepthFormat::Exr => false,
        };
        let mut waiting = None;
        if waits {
            let file = tempfile::tempfile_in(folder).map_err(|error| failed(folder, &error))?;
            waiting = Some(BufWriter::with_capacity(1 << 20, file));
        }
        let mut files = Self {
            folder: folder.to_owned(),
            format,
            size,
            waiting,
            frames: 0,
            range: [f32::INFINITY, f32::NEG_INFINITY],
        };
        if format == DepthFormat::Npz {
            // The length of a header does not depend on the number of frames: it is written again at the end.
            let header = files.header();
            files.wait(&header)?;
        }
        Ok(files)
    }

    fn header(&self) -> Vec<u8> {
        npy::to_bytes(&NpyArray {
            shape: vec![self.frames, self.size[0], self.size[1]],
            data: NpyData::from_vec(Vec::<f32>::new()),
        })
    }

    fn wait(&mut self, bytes: &[u8]) -> Result<(), LabelError> {
        let folder = &self.folder;
        let Some(out) = &mut self.waiting else {
            return Ok(());
        };
        out.write_all(bytes).map_err(|error| failed(folder, &error))
    }

    /// Adds the next frame, `[height * width]`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn push(&mut self, values: &[f32]) -> Result<(), LabelError> {
        for value in values.iter().filter(|value| value.is_finite()) {
            self.range = [self.range[0].min(*value), self.range[1].max(*value)];
        }
        if self.waiting.is_some() {
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            self.wait(&bytes)?;
        } else if self.format == DepthFormat::Exr {
            let path = self.path(self.frames, "exr");
            write_exr(&path, values, self.size).map_err(|error| failed(&path, &error))?;
        } else {
            let millimetres = values
                .iter()
                .map(|metres| (metres * 1000.0).round().clamp(0.0, 65_535.0) as u16);
            self.grey(self.frames, millimetres.collect())?;
        }
        self.frames += 1;
        Ok(())
    }

    fn path(&self, frame: usize, extension: &str) -> PathBuf {
        self.folder.join(format!("{frame:06}.{extension}"))
    }

    fn grey(&self, frame: usize, values: Vec<u16>) -> Result<(), LabelError> {
        let path = self.path(frame, "png");
        let picture = Array2::from_shape_vec((self.size[0], self.size[1]), values)
            .map_err(|error| failed(&path, &error))?;
        png::write(&path, &Picture::Grey16(picture)).map_err(|error| failed(&path, &error))
    }

    /// Writes what waited.
    ///
    /// # Errors
    /// When it cannot be written, or an npz would exceed 4 GB.
    pub fn finish(mut self) -> Result<Written, LabelError> {
        let written = Written {
            frames: self.frames,
            range: self.range,
        };
        let Some(waiting) = self.waiting.take() else {
            return Ok(written);
        };
        let folder = self.folder.clone();
        let io = |error: std::io::Error| failed(&folder, &error);
        let mut file = waiting
            .into_inner()
            .map_err(|error| io(error.into_error()))?;
        file.seek(SeekFrom::Start(0)).map_err(io)?;
        if self.format == DepthFormat::Npz {
            file.write_all(&self.header()).map_err(io)?;
            let path = self.folder.join("depth.npz");
            archive(&folder, &path, &mut file).map_err(|error| failed(&path, &error))?;
            return Ok(written);
        }
        let [low, high] = self.range;
        let scale = if high > low {
            65_535.0 / (high - low)
        } else {
            0.0
        };
        let mut reader = BufReader::with_capacity(1 << 20, file);
        let mut bytes = vec![0; 4 * self.size[0] * self.size[1]];
        for frame in 0..self.frames {
            reader.read_exact(&mut bytes).map_err(io)?;
            let (chunks, _) = bytes.as_chunks::<4>();
            let level = |bytes: &[u8; 4]| {
                let value = f32::from_le_bytes(*bytes);
                ((value - low) * scale).round().clamp(0.0, 65_535.0) as u16
            };
            self.grey(frame, chunks.iter().map(level).collect())?;
        }
        Ok(written)
    }

    /// What a value of the files means, for people.
    #[must_use]
    pub fn unit(format: DepthFormat, kind: DepthLabelKind) -> &'static str {
        match (format, kind) {
            (DepthFormat::Png, DepthLabelKind::Metric) => "millimetres of z-depth, 0 is unknown",
            (DepthFormat::Png, DepthLabelKind::Relative) => {
                "inverse depth, 0 to 65535 between the extremes of the video"
            }
            (_, DepthLabelKind::Metric) => "metres of z-depth",
            (_, DepthLabelKind::Relative) => "inverse depth up to scale and shift, near is large",
        }
    }
}

fn archive(folder: &Path, path: &Path, file: &mut File) -> Result<(), FormatError> {
    let temporary = crate::formats::temporary_in(folder)?;
    let mut zip = ZipWriter::new(BufWriter::with_capacity(1 << 20, temporary));
    zip.add_file("depth.npy", file)?;
    let temporary = zip
        .finish()?
        .into_inner()
        .map_err(std::io::IntoInnerError::into_error)?;
    temporary.persist(path).map_err(|error| error.error)?;
    Ok(())
}

fn write_exr(path: &Path, values: &[f32], size: [usize; 2]) -> exr::error::UnitResult {
    use exr::prelude::{
        AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes,
        WritableImage,
    };
    let channel = AnyChannel::new("Z", FlatSamples::F32(values.to_vec()));
    let layer = Layer::new(
        (size[1], size[0]),
        LayerAttributes::named("depth"),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort([channel].into_iter().collect()),
    );
    Image::from_layer(layer)
        .write()
        .non_parallel()
        .to_file(path)
}

fn failed(path: &Path, error: &impl std::fmt::Display) -> LabelError {
    LabelError::Files(format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::npz::Npz;
    use ndarray::Array3;

    fn write(folder: &Path, format: DepthFormat, kind: DepthLabelKind) -> Written {
        let mut files = DepthFiles::create(folder, format, kind, [2, 3]).unwrap();
        for frame in 0..3 {
            let values: Vec<f32> = (0..6).map(|i| (frame * 6 + i) as f32 * 0.25).collect();
            files.push(&values).unwrap();
        }
        files.finish().unwrap()
    }

    #[test]
    fn every_format_holds_every_frame() {
        let folder = tempfile::tempdir().unwrap();
        let (relative, metric) = (DepthLabelKind::Relative, DepthLabelKind::Metric);
        let written = write(folder.path(), DepthFormat::Npz, relative);
        assert_eq!((written.frames, written.range), (3, [0.0, 4.25]));
        let npz = Npz::read(&folder.path().join("depth.npz")).unwrap();
        let depth: Array3<f32> = npz.get("depth").unwrap().to_dim().unwrap();
        assert_eq!(depth.dim(), (3, 2, 3));
        assert_eq!(depth[[2, 1, 2]], 4.25);

        write(folder.path(), DepthFormat::Png, metric);
        let grey = |frame: &str| match png::read(&folder.path().join(frame)).unwrap() {
            Picture::Grey16(values) => values,
            other => panic!("{other:?}"),
        };
        assert_eq!(grey("000001.png")[[0, 1]], 1750);
        write(folder.path(), DepthFormat::Png, relative);
        assert_eq!(grey("000000.png")[[0, 0]], 0);
        assert_eq!(grey("000002.png")[[1, 2]], 65_535);

        write(folder.path(), DepthFormat::Exr, metric);
        let image = exr::prelude::read_first_flat_layer_from_file(folder.path().join("000002.exr"))
            .unwrap();
        let channel = &image.layer_data.channel_data.list[0];
        let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
        assert_eq!(values[5], 4.25);
        let left = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(left, 7, "no temporary file stays");
    }
}
