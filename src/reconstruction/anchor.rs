//! Metric depth of another model, to which relative depth is fitted (Supp. D).
//!
//! Maps of the whole video or of the model's frames, in time order: an npz with one array `[T, H, W]` (or one named `depth`), or
//! a folder of OpenEXR files (their `Z` or first channel, as ViPE writes them) or of 16-bit PNG in millimetres. Of each, the
//! centre square is taken, as of the video. What is zero, negative or not finite is unknown.

use super::folder::thin;
use crate::formats::FormatError;
use crate::formats::npz::Npz;
use crate::labelling::{DepthLabelKind, DepthLabeller, LabelError, LabelOptions};
use crate::video::image::{Image, grey16_from_png};
use ndarray::{Array2, Array3, ArrayView2, Axis, s};
use std::path::{Path, PathBuf};

/// Maps are this wide or high at most.
const LARGEST: usize = 8192;

/// Why an anchor cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AnchorError {
    /// A file or a folder of maps cannot be read.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// The npz archive of maps cannot be read.
    #[error(transparent)]
    Npz(#[from] FormatError),
    /// What was read holds no depth maps of one size.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// There are fewer maps than frames, or no frames.
    #[error("{}: {found} depth maps for {expected} frames of the model's video", path.display())]
    Frames {
        /// The file or folder of maps.
        path: PathBuf,
        /// Frames of the video at the model's rate.
        expected: usize,
        /// Maps that were found.
        found: usize,
    },
}

fn malformed(path: &Path, reason: impl std::fmt::Display) -> AnchorError {
    AnchorError::Malformed {
        path: path.to_owned(),
        reason: reason.to_string(),
    }
}

/// `[T, S, S]` metres for `frames` frames on the grid that the fits use; NaN where unknown. More maps than frames are thinned
/// evenly, as when the other model has seen the whole video.
///
/// # Errors
/// When the files cannot be read, are empty or of different sizes, or are fewer than the frames.
pub fn read(path: &Path, frames: usize) -> Result<Array3<f32>, AnchorError> {
    let mut maps = if path.is_dir() {
        folder(path, frames)?
    } else {
        npz(path, frames)?
    };
    maps.mapv_inplace(|metres| {
        if metres.is_finite() && metres > 0.0 {
            metres
        } else {
            f32::NAN
        }
    });
    Ok(maps)
}

/// As [`read`], of a video that a metric network labels: one map per frame that comes.
///
/// # Errors
/// What the frames refuse; when there is none, or the network is relative.
pub fn labelled<E: From<LabelError>>(
    labeller: &DepthLabeller,
    frames: impl IntoIterator<Item = Result<Image, E>>,
) -> Result<Vec<Array2<f32>>, E> {
    if labeller.kind() == DepthLabelKind::Relative {
        let reason = "a relative depth network has no metres to anchor the scale with; import metric weights";
        return Err(LabelError::Settings(reason.to_owned()).into());
    }
    let size = std::cell::Cell::new([0, 0]);
    let frames = frames.into_iter().map(|frame| {
        frame.inspect(|frame| size.set([frame.height as usize, frame.width as usize]))
    });
    let mut squares = Vec::new();
    labeller.label(frames, &LabelOptions::default(), &mut |_, metres| {
        let [height, width] = size.get();
        let metres = metres
            .into_iter()
            .map(|metres| if metres > 0.0 { metres } else { f32::NAN });
        let map = Array2::from_shape_vec((height, width), metres.collect())
            .map_err(|error| LabelError::Frames(error.to_string()))?;
        squares.push(square(map.view()));
        Ok(())
    })?;
    Ok(squares)
}

/// Of `found` maps those nearest in time to `frames` frames that span the same time.
fn chosen(path: &Path, found: usize, frames: usize) -> Result<Vec<usize>, AnchorError> {
    if found < frames || frames == 0 {
        return Err(AnchorError::Frames {
            path: path.to_owned(),
            expected: frames,
            found,
        });
    }
    let nearest =
        |frame: usize| ((frame * found) as f64 / frames as f64).round_ties_even() as usize;
    Ok((0..frames)
        .map(|frame| nearest(frame).min(found - 1))
        .collect())
}

/// The centre square of a map, on the grid that the fits use.
fn square(map: ArrayView2<'_, f32>) -> Array2<f32> {
    let (height, width) = map.dim();
    let side = height.min(width);
    let (top, left) = ((height - side) / 2, (width - side) / 2);
    thin(map.slice(s![top..top + side, left..left + side]))
}

/// Maps of one size, one after the other.
#[derive(Debug, Default)]
struct Maps {
    /// Height and width of the first, before it was cut.
    size: Option<(usize, usize)>,
    squares: Vec<Array2<f32>>,
}

impl Maps {
    fn push(&mut self, path: &Path, map: ArrayView2<'_, f32>) -> Result<(), AnchorError> {
        let (height, width) = map.dim();
        if map.is_empty() {
            return Err(malformed(path, format_args!("{width} x {height} pixels")));
        }
        let first = *self.size.get_or_insert(map.dim());
        if first != map.dim() {
            return Err(malformed(
                path,
                format_args!(
                    "{width} x {height} pixels, the first has {} x {}",
                    first.1, first.0
                ),
            ));
        }
        self.squares.push(square(map));
        Ok(())
    }

    fn finish(self, path: &Path) -> Result<Array3<f32>, AnchorError> {
        let views: Vec<_> = self.squares.iter().map(|square| square.view()).collect();
        ndarray::stack(Axis(0), &views).map_err(|error| malformed(path, error))
    }
}

fn npz(path: &Path, frames: usize) -> Result<Array3<f32>, AnchorError> {
    let file = Npz::read(path)?;
    let names: Vec<&String> = file.arrays.keys().collect();
    let name = match names.as_slice() {
        [only] => (*only).clone(),
        _ => "depth".to_owned(),
    };
    let array: Array3<f32> = file.get(&name)?.to_dim()?;
    let mut maps = Maps::default();
    for index in chosen(path, array.len_of(Axis(0)), frames)? {
        maps.push(path, array.index_axis(Axis(0), index))?;
    }
    maps.finish(path)
}

fn folder(path: &Path, frames: usize) -> Result<Array3<f32>, AnchorError> {
    let entries = std::fs::read_dir(path).map_err(|error| AnchorError::Io {
        path: path.to_owned(),
        error,
    })?;
    let known = |file: &Path| matches!(extension(file).as_str(), "exr" | "png");
    let mut files: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|file| known(file))
        .collect();
    files.sort();
    if files.is_empty() {
        return Err(malformed(path, "no .exr and no .png in this folder"));
    }
    let mut maps = Maps::default();
    for index in chosen(path, files.len(), frames)? {
        maps.push(&files[index], map(&files[index])?.view())?;
    }
    maps.finish(path)
}

fn extension(file: &Path) -> String {
    file.extension()
        .map_or_else(String::new, |e| e.to_string_lossy().to_lowercase())
}

fn map(file: &Path) -> Result<Array2<f32>, AnchorError> {
    if extension(file) == "exr" {
        return exr(file);
    }
    let bytes = std::fs::read(file).map_err(|error| AnchorError::Io {
        path: file.to_owned(),
        error,
    })?;
    let millimetres = grey16_from_png(&bytes).map_err(|reason| malformed(file, reason))?;
    Ok(millimetres.mapv(|value| f32::from(value) / 1000.0))
}

fn exr(file: &Path) -> Result<Array2<f32>, AnchorError> {
    use ::exr::prelude::{ReadChannels, ReadLayers, read};
    let meta = ::exr::meta::MetaData::read_from_file(file, false)
        .map_err(|error| malformed(file, error))?;
    for header in &meta.headers {
        let size = header.layer_size;
        if size.width() > LARGEST || size.height() > LARGEST {
            return Err(malformed(
                file,
                format_args!("{} x {} pixels", size.width(), size.height()),
            ));
        }
    }
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_file(file)
        .map_err(|error| malformed(file, error))?;
    let layer = image.layer_data;
    let channels = &layer.channel_data.list;
    let channel = channels
        .iter()
        .find(|channel| channel.name.eq_case_insensitive("z"))
        .or(channels.first())
        .ok_or_else(|| malformed(file, "no channel"))?;
    let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
    Array2::from_shape_vec((layer.size.height(), layer.size.width()), values)
        .map_err(|error| malformed(file, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sequence_of_pictures_is_metres_and_zero_is_unknown() {
        let folder = tempfile::tempdir().unwrap();
        for (index, value) in [1500_u16, 0].into_iter().enumerate() {
            let file =
                std::fs::File::create(folder.path().join(format!("{index:03}.png"))).unwrap();
            let mut encoder = png::Encoder::new(file, 4, 2);
            encoder.set_color(png::ColorType::Grayscale);
            encoder.set_depth(png::BitDepth::Sixteen);
            let mut writer = encoder.write_header().unwrap();
            // The sides are cut off.
            let row = [9000, value, value + 250 * u16::from(value > 0), 9000];
            let data: Vec<u8> = row
                .iter()
                .chain(&row)
                .flat_map(|v| v.to_be_bytes())
                .collect();
            writer.write_image_data(&data).unwrap();
        }
        let maps = read(folder.path(), 2).unwrap();
        assert_eq!(maps.dim(), (2, 2, 2));
        assert_eq!(maps[[0, 1, 0]], 1.5);
        assert_eq!(maps[[0, 1, 1]], 1.75);
        assert!(maps[[1, 0, 0]].is_nan());
        assert!(matches!(
            read(folder.path(), 3),
            Err(AnchorError::Frames { found: 2, .. })
        ));
    }

    #[test]
    fn of_more_maps_than_frames_the_nearest_in_time_are_taken() {
        let of = |found, frames| chosen(Path::new("a"), found, frames).unwrap();
        assert_eq!(of(60, 16)[..4], [0, 4, 8, 11]);
        assert_eq!(of(3, 3), [0, 1, 2]);
        assert_eq!(of(5, 4), [0, 1, 2, 4]);
    }

    #[test]
    fn half_floats_of_open_exr_are_read() {
        use ::exr::prelude::{AnyChannel, AnyChannels, Image, Layer, WritableImage, f16};
        let folder = tempfile::tempdir().unwrap();
        let values = vec![f16::from_f32(0.5), f16::from_f32(2.25), f16::ZERO, f16::ONE];
        let channel = AnyChannel::new("Z", ::exr::prelude::FlatSamples::F16(values));
        let layer = Layer::new(
            (2, 2),
            ::exr::prelude::LayerAttributes::named("depth"),
            ::exr::prelude::Encoding::SMALL_LOSSLESS,
            AnyChannels::sort([channel].into_iter().collect()),
        );
        let path = folder.path().join("000.exr");
        Image::from_layer(layer).write().to_file(&path).unwrap();
        let maps = read(folder.path(), 1).unwrap();
        assert_eq!(maps[[0, 0, 1]], 2.25);
        assert!(maps[[0, 1, 0]].is_nan());
        std::fs::write(&path, b"not an exr").unwrap();
        assert!(matches!(
            read(folder.path(), 1),
            Err(AnchorError::Malformed { .. })
        ));
    }
}
