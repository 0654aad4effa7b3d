//! The ancestors' layout (4M, EgoM2P, and the authors' release): one folder per modality with identical names below it.
//!
//! Arrays: `root/<modality>/<data set>/<name>.{mp4,npy,npz}`, each file one clip of two seconds: `rgb` 16 frames at 8 per second,
//! `cam` `[60, 4, 4]` camera-to-world in OpenCV axes, `gaze` `[60, 2]` in pixels of the original picture, `lhand` and `rhand`
//! `[60, 21, 3]` in the camera. Tokens: the same with npz (or npy) files of integers of any width and shape
//! ([`read_tokens`]). Relative depth videos carry no metres and are left out; 512-pathway ones, which do, are read.

use super::recording::{CutSettings, GazeSample, JointFrame, MountedCamera, Recording};
use super::track::{Joints, SECOND, Track};
use super::video_frames::Frames;
use super::{ClipSource, Outcome, ReadError};
use crate::clip::{DEPTH, Depth};
use crate::formats::npy::{self, NpyArray};
use crate::formats::npz::Npz;
use crate::formats::read_error::Position;
use crate::geometry::rigid::{self, PoseError, Rigid};
use crate::modality::ClipFormat;
use crate::video::{Video, VideoSettings};
use nalgebra::Point3;
use ndarray::{Array3, ArrayView2, Axis};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Folder names per modality, ours first; the numbers of the 512 pathway come last.
const FOLDERS: [(&str, &[&str]); 6] = [
    ("rgb", &["rgb", "rgb_video", "rgb_512", "rgb_video_512"]),
    ("depth", &["depth_512"]),
    ("camera", &["cam", "camera"]),
    ("gaze", &["gaze"]),
    ("left_hand", &["lhand", "left_hand"]),
    ("right_hand", &["rhand", "right_hand"]),
];
/// Metres at the top of the value range of 512-pathway depth videos.
const DEPTH_RANGE: f32 = 15.0;

/// Pixels that gaze refers to.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(deny_unknown_fields)]
pub struct GazeSpace {
    /// The picture in whose pixels gaze is written.
    pub width: u32,
    /// Height of that picture, pixels.
    pub height: u32,
    /// Side of the centre square that clips show.
    pub crop: u32,
}

impl GazeSpace {
    /// HoloAssist's clips show the middle 480 pixels of 896 x 504; Aria's the whole square.
    #[must_use]
    pub fn of(dataset: &str) -> Self {
        if dataset.to_ascii_lowercase().contains("holo") {
            GazeSpace {
                width: 896,
                height: 504,
                crop: 480,
            }
        } else {
            GazeSpace {
                width: 1408,
                height: 1408,
                crop: 1408,
            }
        }
    }

    /// The picture whose centre square is the crop: what projects a pixel to a fraction of the clip's frame.
    fn pixel(self, [u, v]: [f64; 2]) -> ([f64; 2], [f64; 2]) {
        let crop = f64::from(self.crop);
        let left = (f64::from(self.width) - crop) / 2.0;
        let top = (f64::from(self.height) - crop) / 2.0;
        ([u - left, v - top], [crop; 2])
    }
}

/// Clips of one data set in the ancestors' array layout.
#[derive(Debug)]
pub struct Arrays {
    dataset: String,
    settings: CutSettings,
    gaze: GazeSpace,
    /// Per clip name the file of each modality.
    clips: Vec<(String, BTreeMap<&'static str, PathBuf>)>,
}

impl Arrays {
    /// Finds the clips of `dataset` below `root`; without a name, of the only data set there is.
    ///
    /// # Errors
    /// When there is none, or several and none is named.
    pub fn open(
        root: &Path,
        dataset: Option<&str>,
        gaze: Option<GazeSpace>,
        settings: CutSettings,
    ) -> Result<Self, ReadError> {
        settings.check()?;
        let mut datasets = BTreeSet::new();
        for (_, names) in FOLDERS {
            for name in names {
                if let Ok(entries) = std::fs::read_dir(root.join(name)) {
                    datasets.extend(
                        entries
                            .flatten()
                            .filter(|entry| entry.path().is_dir())
                            .map(|entry| entry.file_name().to_string_lossy().into_owned()),
                    );
                }
            }
        }
        let dataset = match dataset {
            Some(name) => name.to_owned(),
            None if datasets.len() == 1 => datasets.into_iter().next().unwrap_or_default(),
            None => {
                let names: Vec<String> = datasets.into_iter().collect();
                return Err(if names.is_empty() {
                    ReadError::absent(root, "there is no `<modality>/<data set>/` here")
                } else {
                    let names = names.join(", ");
                    ReadError::missing(root, format!("name one of the data sets here: {names}"))
                });
            }
        };
        let mut clips: BTreeMap<String, BTreeMap<&'static str, PathBuf>> = BTreeMap::new();
        for (modality, names) in FOLDERS {
            for name in names {
                let folder = root.join(name).join(&dataset);
                let Ok(entries) = std::fs::read_dir(&folder) else {
                    continue;
                };
                let mut paths = entries
                    .map(|entry| entry.map(|entry| entry.path()))
                    .collect::<Result<Vec<_>, _>>()
                    .map_err(|cause| ReadError::io(&folder, cause))?;
                // `x.npy` goes before `x.npz`, in whatever order the folder lists them.
                paths.sort();
                for path in paths {
                    let known = path
                        .extension()
                        .and_then(|extension| extension.to_str())
                        .is_some_and(|extension| matches!(extension, "npy" | "npz" | "mp4"));
                    if let (true, Some(stem)) = (known, path.file_stem()) {
                        clips
                            .entry(stem.to_string_lossy().into_owned())
                            .or_default()
                            .entry(modality)
                            .or_insert(path);
                    }
                }
            }
        }
        if clips.is_empty() {
            return Err(ReadError::absent(
                root,
                format!("data set `{dataset}` has no clips here"),
            ));
        }
        Ok(Arrays {
            gaze: gaze.unwrap_or_else(|| GazeSpace::of(&dataset)),
            dataset,
            settings: CutSettings {
                pad_short: true,
                ..settings
            },
            clips: clips.into_iter().collect(),
        })
    }

    fn recording(
        &self,
        name: &str,
        files: &BTreeMap<&'static str, PathBuf>,
    ) -> Result<Recording, ReadError> {
        let mut recording = Recording::new(&self.dataset, name);
        recording.span = Some((0, 2 * SECOND));
        if let Some(path) = files.get("rgb") {
            let video = Video::open_with(path, &VideoSettings::by(self.settings.decoder))?;
            let times = (0..video.info().frames)
                .map(|frame| (video.schedule().seconds(frame) * SECOND as f64).round() as i64)
                .collect();
            recording.colour = Some(Box::new(Frames { video, times }));
        }
        if let Some(path) = files.get("camera") {
            let poses = dimensions::<ndarray::Ix3>(path)?;
            expect(path, poses.shape(), &[60, 4, 4])?;
            let mut samples = Vec::new();
            for (k, m) in poses.outer_iter().enumerate() {
                if let Some(pose) = pose(path, k, m)? {
                    samples.push((tick(k), pose));
                }
            }
            recording.device = Some(Track::new(samples, SECOND / 10, SECOND / 60));
            recording.cameras = vec![(0, MountedCamera::without_lens())];
        }
        if let Some(path) = files.get("gaze") {
            let points = dimensions::<ndarray::Ix2>(path)?;
            expect(path, points.shape(), &[60, 2])?;
            let samples = points
                .outer_iter()
                .enumerate()
                .filter(|(_, row)| row.iter().all(|v| v.is_finite()))
                .map(|(k, row)| {
                    let (pixel, size) = self.gaze.pixel([row[0], row[1]]);
                    (tick(k), GazeSample::Pixel { pixel, size })
                })
                .collect();
            // Each row is its own sample: a missing one is missing.
            recording.gaze = Some(Track::new(samples, SECOND / 25, SECOND / 100));
        }
        for (side, modality) in ["left_hand", "right_hand"].into_iter().enumerate() {
            if let Some(path) = files.get(modality) {
                recording.hands[side] = Some(hand(path)?);
                recording.hands_frame = JointFrame::Camera;
            }
        }
        recording.check(&self.settings)?;
        Ok(recording)
    }
}

impl ClipSource for Arrays {
    fn name(&self) -> &str {
        &self.dataset
    }

    fn len(&self) -> usize {
        self.clips.len()
    }

    fn modalities(&self) -> Vec<String> {
        FOLDERS
            .iter()
            .filter(|(modality, _)| {
                self.clips
                    .iter()
                    .any(|(_, files)| files.contains_key(modality))
            })
            .map(|(modality, _)| (*modality).to_owned())
            .collect()
    }

    fn format(&self) -> Option<ClipFormat> {
        Some(self.settings.format())
    }

    /// Every file is a recording of its own.
    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        let names = self.clips.iter().map(|(name, _)| name.clone());
        names.zip((0..).map(|index| index..index + 1)).collect()
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        let (name, files) = self.clips.get(index).ok_or_else(|| ReadError::OutOfRange {
            source_name: self.dataset.clone(),
            index,
            len: self.clips.len(),
        })?;
        let outcome = self.recording(name, files)?.clip(0, &self.settings)?;
        let Outcome::Clip(mut clip) = outcome else {
            return Ok(outcome);
        };
        clip.id = format!("{}/{name}", self.dataset);
        if let Some(path) = files.get("depth") {
            clip.set(DEPTH, metric_depth(path, &self.settings)?);
        }
        Ok(Outcome::Clip(clip))
    }
}

/// A 512-pathway depth video: grey from 0 to 255 for 0 to 15 m; 0 means nothing was measured.
fn metric_depth(path: &Path, settings: &CutSettings) -> Result<Depth, ReadError> {
    let video = Video::open_with(path, &VideoSettings::by(settings.decoder))?;
    let frames = (settings.fps * 2.0).round() as usize;
    // Written at 8 frames a second whatever its real rate: what counts is that the frames span two seconds.
    let native = video.info().frames as f64 / 2.0;
    let chosen: Vec<usize> = (0..frames)
        .map(|k| {
            ((k as f64 * native / settings.fps).round_ties_even() as usize)
                .min(video.info().frames - 1)
        })
        .collect();
    let side = settings.side as usize;
    let mut metres = Array3::from_elem((frames, side, side), f32::NAN);
    for frame in video.chosen(chosen.clone())? {
        let frame = frame?;
        let square = frame.image.square(settings.side);
        for (k, _) in chosen
            .iter()
            .enumerate()
            .filter(|(_, index)| **index == frame.index)
        {
            for (slot, pixel) in metres
                .index_axis_mut(Axis(0), k)
                .iter_mut()
                .zip(square.data.chunks_exact(3))
            {
                let mean = pixel.iter().map(|v| f32::from(*v)).sum::<f32>() / 3.0;
                *slot = if mean < 0.5 {
                    f32::NAN
                } else {
                    mean / 255.0 * DEPTH_RANGE
                };
            }
        }
    }
    Ok(Depth {
        rate: settings.fps,
        metres,
    })
}

fn tick(k: usize) -> i64 {
    (k as f64 / 30.0 * SECOND as f64).round() as i64
}

/// A row of poses; `None` where it is missing: not finite, or never filled.
pub(super) fn pose(
    path: &Path,
    row: usize,
    m: ArrayView2<f64>,
) -> Result<Option<Rigid>, ReadError> {
    if m.iter().all(|v| *v == 0.0) {
        return Ok(None);
    }
    let values = std::array::from_fn(|k| m[[k / 4, k % 4]]);
    match rigid::from_row_major(&values) {
        Ok(pose) => Ok(Some(pose)),
        Err(PoseError::NotFinite) => Ok(None),
        Err(error) => Err(ReadError::malformed(
            path,
            Position::Frame(row as u64),
            error.to_string(),
        )),
    }
}

fn hand(path: &Path) -> Result<Track<Joints>, ReadError> {
    let values = dimensions::<ndarray::Ix3>(path)?;
    // A fourth value is validity.
    let depth = values.shape()[2];
    expect(
        path,
        values.shape(),
        &[60, 21, if depth == 4 { 4 } else { 3 }],
    )?;
    let samples = values
        .outer_iter()
        .enumerate()
        .map(|(k, row)| {
            let joints = std::array::from_fn(|joint| {
                let valid = depth == 3 || row[[joint, 3]] > 0.5;
                let p = Point3::new(row[[joint, 0]], row[[joint, 1]], row[[joint, 2]]);
                (valid && p.iter().all(|v| v.is_finite())).then_some(p)
            });
            (tick(k), joints)
        })
        .collect();
    Ok(Track::new(samples, SECOND / 10, SECOND / 60))
}

pub(super) fn array(path: &Path) -> Result<NpyArray, ReadError> {
    if path.extension().is_some_and(|extension| extension == "npy") {
        return Ok(npy::read(path)?);
    }
    let npz = Npz::read(path)?;
    let mut arrays = npz.arrays;
    if arrays.len() == 1
        && let Some((_, only)) = arrays.pop_first()
    {
        return Ok(only);
    }
    arrays
        .remove("arr_0")
        .ok_or_else(|| ReadError::missing(path, "there are several arrays, and none is `arr_0`"))
}

/// The array of a file with so many axes.
fn dimensions<D: ndarray::Dimension>(path: &Path) -> Result<ndarray::Array<f64, D>, ReadError> {
    let array = array(path)?.to_dim::<f64, D>();
    Ok(array.map_err(|error| error.in_file(path))?)
}

pub(super) fn expect(path: &Path, found: &[usize], wanted: &[usize]) -> Result<(), ReadError> {
    if found == wanted {
        return Ok(());
    }
    Err(ReadError::malformed(
        path,
        Position::File,
        format!("an array of shape {found:?} instead of {wanted:?}"),
    ))
}

/// Tokens of one clip in the ancestors' files: integers of any width, flat or as a grid, in an npz (`arr_0`) or npy file. They
/// come back with the shape of `grid`.
///
/// # Errors
/// When the file is damaged, holds something else, or its number of tokens is not that of the grid.
pub fn read_tokens(path: &Path, grid: &[usize]) -> Result<Vec<u32>, ReadError> {
    let tokens = array(path)?;
    let wanted: usize = grid.iter().product();
    if tokens.len() != wanted || (tokens.shape.len() > 1 && tokens.shape != grid) {
        return Err(ReadError::malformed(
            path,
            Position::File,
            format!("tokens of shape {:?} instead of {grid:?}", tokens.shape),
        ));
    }
    let ids = tokens.to::<u32>().map_err(|error| error.in_file(path))?;
    Ok(ids.into_raw_vec_and_offset().0)
}
