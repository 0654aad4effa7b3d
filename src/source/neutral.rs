//! The neutral recording folder: any data set becomes readable by writing these files. `docs/guide/data.md` is its manual.
//!
//! A folder with `recording.yaml`, which says for every signal which file holds it, in which unit and frame, and when its samples
//! were taken. Arrays are npz (or npy) files; colour is a video or a folder of pictures; depth an array or a folder of 16-bit
//! png pictures. NaN means missing.

use super::SourceError;
use super::dataset::{Recordings, find};
use super::error::Place;
use super::image::{Turn, grey16_from_png};
use super::open::Frames;
use super::recording::{
    CutSettings, DepthFrames, GazeSample, JointFrame, MountedCamera, Recording,
};
use super::track::{Joints, SECOND, Track};
use super::video::{Video, VideoSettings, folder};
use crate::formats::npy::{self, NpyArray};
use crate::formats::npz::Npz;
use crate::geometry::camera::{Camera, Fisheye624, KannalaBrandt, Lens, Pinhole};
use crate::geometry::skeleton::{BODY_FROM_SMPL22, HAND_FROM_COMMON};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};
use ndarray::{Array2, Array3, Axis};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The name of the file that makes a folder a recording.
pub const FILE: &str = "recording.yaml";
/// What `format` has to say.
pub const FORMAT: &str = "reviv-recording/1";

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    /// The data set; becomes the source of the clips.
    #[serde(default)]
    source: Option<String>,
    #[serde(default)]
    name: Option<String>,
    #[serde(default)]
    colour: Option<ColourEntry>,
    #[serde(default)]
    depth: Option<DepthEntry>,
    #[serde(default)]
    camera: Option<CameraEntry>,
    #[serde(default)]
    gaze: Option<GazeEntry>,
    #[serde(default)]
    left_hand: Option<JointEntry>,
    #[serde(default)]
    right_hand: Option<JointEntry>,
    #[serde(default)]
    body: Option<JointEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ColourEntry {
    /// A video, or a folder of png or jpg pictures.
    file: PathBuf,
    /// Seconds of the first frame on the recording's clock.
    #[serde(default)]
    start: f64,
    /// Frames per second; needed for a folder, else the video says it.
    #[serde(default)]
    rate: Option<f64>,
    /// Degrees clockwise that make the pictures upright.
    #[serde(default)]
    turn: u32,
    #[serde(default)]
    lens: Option<LensEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, tag = "model", rename_all = "snake_case")]
enum LensEntry {
    /// `fx fy cx cy` in pixels of the stored pictures.
    Pinhole {
        parameters: [f64; 4],
        size: [u32; 2],
    },
    /// `fx fy cx cy k0..k3`
    KannalaBrandt {
        parameters: [f64; 8],
        size: [u32; 2],
    },
    /// `f cx cy k0..k5 p0 p1 s0..s3`
    Fisheye624 {
        parameters: [f64; 15],
        size: [u32; 2],
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct DepthEntry {
    /// An array `[T, H, W]`, or a folder of 16-bit png pictures.
    file: PathBuf,
    #[serde(default)]
    key: Option<String>,
    unit: LengthUnit,
    #[serde(default)]
    start: f64,
    #[serde(default)]
    rate: Option<f64>,
    #[serde(default)]
    times: Option<String>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
enum LengthUnit {
    #[serde(rename = "m")]
    Metres,
    #[serde(rename = "mm")]
    Millimetres,
}

impl LengthUnit {
    fn metres(self) -> f64 {
        match self {
            LengthUnit::Metres => 1.0,
            LengthUnit::Millimetres => 1e-3,
        }
    }
}

/// Which array, and when its rows were taken: `rate` with `start`, or `times` (seconds, an array of the same file).
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraEntry {
    file: PathBuf,
    #[serde(default)]
    key: Option<String>,
    #[serde(default)]
    start: f64,
    #[serde(default)]
    rate: Option<f64>,
    #[serde(default)]
    times: Option<String>,
    direction: Direction,
    axes: Axes,
    /// Against gravity, in the world.
    #[serde(default)]
    up: Option<[f64; 3]>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Direction {
    CameraToWorld,
    WorldToCamera,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Axes {
    /// x right, y down, z forward.
    Opencv,
    /// x right, y up, z backward.
    Opengl,
    /// x forward, y left, z up.
    Psi,
}

impl Axes {
    /// Columns: the axes of OpenCV in these.
    fn opencv_in(self) -> Matrix3<f64> {
        match self {
            Axes::Opencv => Matrix3::identity(),
            Axes::Opengl => Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)),
            Axes::Psi => Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct GazeEntry {
    file: PathBuf,
    #[serde(default)]
    key: Option<String>,
    #[serde(default)]
    start: f64,
    #[serde(default)]
    rate: Option<f64>,
    #[serde(default)]
    times: Option<String>,
    /// `pixel` of the upright picture of `size`, or `fraction` of its width and height.
    unit: GazeUnit,
    /// Width and height of the upright picture.
    size: [u32; 2],
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum GazeUnit {
    Pixel,
    Fraction,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct JointEntry {
    file: PathBuf,
    #[serde(default)]
    key: Option<String>,
    #[serde(default)]
    start: f64,
    #[serde(default)]
    rate: Option<f64>,
    #[serde(default)]
    times: Option<String>,
    unit: LengthUnit,
    frame: JointFrameEntry,
    order: JointOrder,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum JointFrameEntry {
    World,
    /// Hands only: the upright camera of the same moment.
    Camera,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum JointOrder {
    /// Ours, 21 joints.
    Reviv,
    /// Hands: wrist, thumb, index, middle, ring, pinky from knuckle to tip.
    Common,
    /// Body: the 22 joints of SMPL.
    Smpl22,
    /// Hands: the 26 joints of HoloLens 2.
    Hololens,
}

impl JointOrder {
    /// For each of our joints the one in this order.
    fn map(self) -> ([usize; 21], usize) {
        /// Wrist, thumb, index, middle, ring, pinky among HoloLens's joints.
        const COMMON_FROM_HOLOLENS: [usize; 21] = [
            1, 2, 3, 4, 5, 7, 8, 9, 10, 12, 13, 14, 15, 17, 18, 19, 20, 22, 23, 24, 25,
        ];
        match self {
            JointOrder::Reviv => (std::array::from_fn(|k| k), 21),
            JointOrder::Common => (HAND_FROM_COMMON, 21),
            JointOrder::Smpl22 => (BODY_FROM_SMPL22, 22),
            JointOrder::Hololens => (HAND_FROM_COMMON.map(|k| COMMON_FROM_HOLOLENS[k]), 26),
        }
    }
}

/// Opens the recordings at or below `root`.
///
/// # Errors
/// When there is none, or one cannot be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, SourceError> {
    let folders = find(
        root,
        "recording folder (one with `recording.yaml`)",
        is_recording,
    )?;
    let name = manifest(&folders[0])?
        .source
        .unwrap_or_else(|| "recordings".to_owned());
    Recordings::new(&name, folders, settings, |folder, _| open(folder))
}

/// Whether a folder is a neutral recording.
#[must_use]
pub fn is_recording(folder: &Path) -> bool {
    folder.join(FILE).is_file()
}

fn manifest(folder: &Path) -> Result<Manifest, SourceError> {
    let path = folder.join(FILE);
    let text = std::fs::read_to_string(&path).map_err(|cause| SourceError::io(&path, cause))?;
    let manifest: Manifest = serde_saphyr::from_str(&text).map_err(|error| {
        let place = error
            .location()
            .map_or(Place::File, |at| Place::Line(at.line()));
        SourceError::malformed(&path, place, error.to_string())
    })?;
    if manifest.format != FORMAT {
        return Err(SourceError::unsupported(
            &path,
            format!("format `{}` is not `{FORMAT}`", manifest.format),
        ));
    }
    Ok(manifest)
}

/// Opens one recording.
///
/// # Errors
/// When the manifest or a file it names is damaged or does not fit.
pub fn open(root: &Path) -> Result<Recording, SourceError> {
    let manifest = manifest(root)?;
    let path = root.join(FILE);
    let name = manifest.name.unwrap_or_else(|| {
        root.file_name().map_or_else(
            || "recording".into(),
            |name| name.to_string_lossy().into_owned(),
        )
    });
    let mut recording = Recording::new(manifest.source.as_deref().unwrap_or("recordings"), &name);
    let mut span: Option<(i64, i64)> = None;

    if let Some(entry) = &manifest.colour {
        recording.turn = Turn::from_degrees(entry.turn);
        let video = Video::open_with(
            root.join(&entry.file),
            &VideoSettings {
                folder_fps: entry.rate.unwrap_or(30.0),
                ..VideoSettings::default()
            },
        )?;
        let start = nanoseconds(&path, entry.start)?;
        let times = (0..video.info().frames)
            .map(|frame| start + (video.schedule().seconds(frame) * SECOND as f64).round() as i64)
            .collect();
        let camera = match &entry.lens {
            Some(lens) => lens_of(&path, lens)?,
            // Without a lens only the size is known; nothing is projected through it.
            None => unknown_lens(video.info().width, video.info().height),
        };
        if entry.lens.is_some() {
            recording.cameras = vec![(
                0,
                MountedCamera {
                    camera,
                    T_device_camera: Isometry3::identity(),
                },
            )];
        }
        recording.colour = Some(Box::new(Frames { video, times }));
    }
    if let Some(entry) = &manifest.depth {
        recording.depth = Some(depth(root, entry)?);
    }
    if let Some(entry) = &manifest.camera {
        let (array, times) = load(
            root,
            &entry.file,
            entry.key.as_deref(),
            entry.start,
            entry.rate,
            entry.times.as_deref(),
        )?;
        let poses = poses(&root.join(&entry.file), &array, entry)?;
        recording.up_world = entry
            .up
            .and_then(|[x, y, z]| Unit::try_new(Vector3::new(x, y, z), 1e-6));
        // Poses are of the upright camera; the recording turns its stored camera itself.
        let back = super::recording::upright(recording.turn).inverse();
        let samples = times
            .iter()
            .zip(poses)
            .filter_map(|(time, pose)| Some((*time, pose? * back)))
            .collect();
        recording.device = Some(track(samples, &times));
        span = Some((times[0], times[times.len() - 1]));
        if recording.cameras.is_empty() {
            recording.cameras = vec![(
                0,
                MountedCamera {
                    camera: unknown_lens(1, 1),
                    T_device_camera: Isometry3::identity(),
                },
            )];
        }
    }
    if let Some(entry) = &manifest.gaze {
        let (array, times) = load(
            root,
            &entry.file,
            entry.key.as_deref(),
            entry.start,
            entry.rate,
            entry.times.as_deref(),
        )?;
        let points = array.to_dim::<f64, ndarray::Ix2>()?;
        shape(&root.join(&entry.file), points.shape(), &[times.len(), 2])?;
        let size = entry.size.map(f64::from);
        let samples = times
            .iter()
            .zip(points.rows())
            .filter_map(|(time, point)| {
                let pixel = match entry.unit {
                    GazeUnit::Pixel => [point[0], point[1]],
                    GazeUnit::Fraction => [point[0] * size[0], point[1] * size[1]],
                };
                let sample = GazeSample::Pixel { pixel, size };
                pixel
                    .iter()
                    .all(|v| v.is_finite())
                    .then_some((*time, sample))
            })
            .collect();
        recording.gaze = Some(track(samples, &times));
        span = span.or(Some((times[0], times[times.len() - 1])));
    }
    for (side, entry) in [&manifest.left_hand, &manifest.right_hand]
        .into_iter()
        .enumerate()
    {
        let Some(entry) = entry else { continue };
        let (joints, times) = joints(root, entry)?;
        recording.hands[side] = Some(joints);
        recording.hands_frame = match entry.frame {
            JointFrameEntry::World => JointFrame::World,
            JointFrameEntry::Camera => JointFrame::Camera,
        };
        span = span.or(Some((times[0], times[times.len() - 1])));
    }
    if let (Some(left), Some(right)) = (&manifest.left_hand, &manifest.right_hand)
        && left.frame != right.frame
    {
        return Err(SourceError::malformed(
            &path,
            Place::File,
            "both hands must be in the same frame",
        ));
    }
    if let Some(entry) = &manifest.body {
        if entry.frame != JointFrameEntry::World {
            return Err(SourceError::malformed(
                &path,
                Place::File,
                "the body must be in the world",
            ));
        }
        let (joints, times) = joints(root, entry)?;
        recording.body = Some(joints);
        span = span.or(Some((times[0], times[times.len() - 1])));
    }
    // The last sample stands for its own period.
    recording.span = span.map(|(first, last)| (first, last.saturating_add(SECOND / 30)));
    Ok(recording)
}

fn nanoseconds(path: &Path, seconds: f64) -> Result<i64, SourceError> {
    // A century on either side.
    if seconds.abs() < 3.2e9 {
        Ok((seconds * SECOND as f64).round() as i64)
    } else {
        Err(SourceError::malformed(
            path,
            Place::File,
            format!("a time of {seconds} seconds"),
        ))
    }
}

fn array(path: &Path, key: Option<&str>) -> Result<NpyArray, SourceError> {
    if path.extension().is_some_and(|extension| extension == "npy") {
        return Ok(npy::read(path)?);
    }
    let key = key.unwrap_or("arr_0");
    let mut npz = Npz::read_some(path, &[key])?;
    npz.arrays
        .remove(key)
        .ok_or_else(|| SourceError::missing(path, format!("there is no array `{key}`")))
}

/// An array and the times of its rows.
fn load(
    root: &Path,
    file: &Path,
    key: Option<&str>,
    start: f64,
    rate: Option<f64>,
    times: Option<&str>,
) -> Result<(NpyArray, Vec<i64>), SourceError> {
    let path = root.join(file);
    let values = array(&path, key)?;
    let count = values.shape.first().copied().unwrap_or(0);
    if count == 0 {
        return Err(SourceError::malformed(
            &path,
            Place::File,
            "the array has no rows",
        ));
    }
    let times: Vec<i64> = match (times, rate) {
        (Some(times), _) => array(&path, Some(times))?
            .to::<f64>()?
            .iter()
            .map(|seconds| nanoseconds(&path, *seconds))
            .collect::<Result<_, _>>()?,
        (None, Some(rate)) if rate > 0.0 && rate.is_finite() => (0..count)
            .map(|k| nanoseconds(&path, start + k as f64 / rate))
            .collect::<Result<_, _>>()?,
        _ => {
            return Err(SourceError::malformed(
                &root.join(FILE),
                Place::File,
                format!(
                    "`{}` needs a `rate` or the name of an array of `times`",
                    file.display()
                ),
            ));
        }
    };
    if times.len() != count || !times.is_sorted() {
        return Err(SourceError::malformed(
            &path,
            Place::File,
            format!(
                "{} times for {count} rows, or they do not ascend",
                times.len()
            ),
        ));
    }
    Ok((values, times))
}

fn shape(path: &Path, found: &[usize], wanted: &[usize]) -> Result<(), SourceError> {
    if found == wanted {
        return Ok(());
    }
    Err(SourceError::malformed(
        path,
        Place::File,
        format!("an array of shape {found:?} instead of {wanted:?}"),
    ))
}

/// Gaps and holds that fit the spacing of the samples.
fn track<T: super::track::Blend>(samples: Vec<(i64, T)>, times: &[i64]) -> Track<T> {
    let period = (times[times.len() - 1] - times[0]) / (times.len() as i64 - 1).max(1);
    Track::new(samples, period * 5 / 2 + 1, period * 3 / 5 + 1)
}

fn poses(
    path: &Path,
    array: &NpyArray,
    entry: &CameraEntry,
) -> Result<Vec<Option<Isometry3<f64>>>, SourceError> {
    let matrices = array.to_dim::<f64, ndarray::Ix3>()?;
    let rows = matrices.shape()[1];
    shape(
        path,
        &matrices.shape()[1..],
        &[if rows == 3 { 3 } else { 4 }, 4],
    )?;
    matrices
        .outer_iter()
        .enumerate()
        .map(|(index, m)| {
            if m.iter().any(|v| !v.is_finite()) {
                return Ok(None);
            }
            let rotation = Matrix3::from_fn(|r, c| m[[r, c]]);
            if (rotation * rotation.transpose() - Matrix3::identity()).norm() > 1e-2
                || rotation.determinant() < 0.0
            {
                return Err(SourceError::malformed(
                    path,
                    Place::Frame(index as u64),
                    "the pose is no rotation",
                ));
            }
            let pose = Isometry3::from_parts(
                Vector3::new(m[[0, 3]], m[[1, 3]], m[[2, 3]]).into(),
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation)),
            );
            let pose = match entry.direction {
                Direction::CameraToWorld => pose,
                Direction::WorldToCamera => pose.inverse(),
            };
            let axes = Rotation3::from_matrix_unchecked(entry.axes.opencv_in());
            Ok(Some(pose * UnitQuaternion::from_rotation_matrix(&axes)))
        })
        .collect()
}

fn joints(root: &Path, entry: &JointEntry) -> Result<(Track<Joints>, Vec<i64>), SourceError> {
    let (array, times) = load(
        root,
        &entry.file,
        entry.key.as_deref(),
        entry.start,
        entry.rate,
        entry.times.as_deref(),
    )?;
    let values = array.to_dim::<f64, ndarray::Ix3>()?;
    let (map, count) = entry.order.map();
    shape(
        &root.join(&entry.file),
        values.shape(),
        &[times.len(), count, 3],
    )?;
    let scale = entry.unit.metres();
    let samples = times
        .iter()
        .zip(values.outer_iter())
        .map(|(time, row)| {
            let joints = map.map(|joint| {
                let p = Point3::new(row[[joint, 0]], row[[joint, 1]], row[[joint, 2]]) * scale;
                p.iter().all(|v| v.is_finite()).then_some(p)
            });
            (*time, joints)
        })
        .collect();
    Ok((track(samples, &times), times))
}

fn lens_of(path: &Path, entry: &LensEntry) -> Result<Camera, SourceError> {
    let wrong =
        || SourceError::malformed(path, Place::File, "`lens` has parameters that are no lens");
    let (lens, [width, height]) = match entry {
        LensEntry::Pinhole {
            parameters: [fx, fy, cx, cy],
            size,
        } => (
            Lens::Pinhole(Pinhole {
                fx: *fx,
                fy: *fy,
                cx: *cx,
                cy: *cy,
            }),
            *size,
        ),
        LensEntry::KannalaBrandt {
            parameters: [fx, fy, cx, cy, radial @ ..],
            size,
        } => (
            Lens::KannalaBrandt(KannalaBrandt {
                fx: *fx,
                fy: *fy,
                cx: *cx,
                cy: *cy,
                radial: *radial,
            }),
            *size,
        ),
        LensEntry::Fisheye624 { parameters, size } => (
            Lens::Fisheye624(Fisheye624::from_parameters(parameters).ok_or_else(wrong)?),
            *size,
        ),
    };
    let parameters_ok = match &lens {
        Lens::Pinhole(Pinhole { fx, fy, .. })
        | Lens::KannalaBrandt(KannalaBrandt { fx, fy, .. }) => *fx > 0.0 && *fy > 0.0,
        Lens::Fisheye624(_) => true,
    };
    if !parameters_ok || width == 0 || height == 0 {
        return Err(wrong());
    }
    Ok(Camera {
        lens,
        width,
        height,
        valid_radius: None,
    })
}

/// A stand-in where only poses matter: its lens is a fisheye, so that no pinhole intrinsics come out of it.
fn unknown_lens(width: u32, height: u32) -> Camera {
    Camera {
        lens: Lens::KannalaBrandt(KannalaBrandt {
            fx: 1.0,
            fy: 1.0,
            cx: 0.0,
            cy: 0.0,
            radial: [0.0; 4],
        }),
        width,
        height,
        valid_radius: None,
    }
}

enum DepthFiles {
    Array(Array3<f32>),
    Pictures(Vec<PathBuf>),
}

struct NeutralDepth {
    files: DepthFiles,
    times: Vec<i64>,
    scale: f32,
}

fn depth(root: &Path, entry: &DepthEntry) -> Result<Box<dyn DepthFrames>, SourceError> {
    let path = root.join(&entry.file);
    let scale = entry.unit.metres() as f32;
    let (files, times) = if path.is_dir() {
        let files = folder::list(&path)?;
        let rate = entry
            .rate
            .filter(|rate| *rate > 0.0 && rate.is_finite())
            .ok_or_else(|| {
                SourceError::malformed(
                    &root.join(FILE),
                    Place::File,
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
        (
            DepthFiles::Array(array.to_dim::<f32, ndarray::Ix3>()?),
            times,
        )
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

    fn read(&self, index: usize) -> Result<Array2<f32>, SourceError> {
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
                let bytes = std::fs::read(path).map_err(|cause| SourceError::io(path, cause))?;
                let values = grey16_from_png(&bytes)
                    .map_err(|reason| SourceError::malformed(path, Place::File, reason))?;
                Ok(values.mapv(|value| metres(f32::from(value))))
            }
        }
    }
}
