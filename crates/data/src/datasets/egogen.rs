//! EgoGen in the form in which EgoM2P trains on it: synthetic recordings of a few seconds, each a file per modality with one name.
//!
//! `cam/<name>.npz` holds poses `[T, 4, 4]` at 30 Hz, camera-to-world with OpenGL's axes (x right, y up, z back);
//! `rgb_256_8fps/<name>.mp4` the pictures, of which number k shows pose round(3.75 k), half to even; `depth/<name>.npz` metres
//! `[T, H, W]` at 30 Hz, 0 where nothing is. Four seconds are two clips. Each modality may lack some names.

use super::ReadError;
use super::dataset::Recordings;
use super::egom2p;
use super::recording::{CutSettings, DepthFrames, MountedCamera, Recording};
use super::track::{SECOND, Track};
use super::video_frames::Frames;
use crate::formats::npz::Npz;
use crate::formats::read_error::Position;
use crate::video::{DecoderChoice, Video, VideoSettings};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use ndarray::{Array2, Array3, Axis, Ix3};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Hz of poses and depth.
const RATE: f64 = 30.0;

/// The folder of each modality; EgoM2P keeps the newer poses beside the older pictures.
#[derive(Debug, Clone, Default)]
struct Folders {
    cam: Option<PathBuf>,
    rgb: Option<PathBuf>,
    depth: Option<PathBuf>,
}

impl Folders {
    fn of(root: &Path) -> Self {
        let first = |name: &str| {
            ["", "egogen_new", "egogen"]
                .iter()
                .map(|inside| root.join(inside).join(name))
                .find(|folder| folder.is_dir())
        };
        Folders {
            cam: first("cam"),
            rgb: first("rgb_256_8fps"),
            depth: first("depth"),
        }
    }

    /// The file of a recording in one of the folders.
    fn file(folder: Option<&PathBuf>, name: &str, extensions: &[&str]) -> Option<PathBuf> {
        let folder = folder?;
        extensions
            .iter()
            .map(|extension| folder.join(format!("{name}.{extension}")))
            .find(|path| path.is_file())
    }
}

/// Opens the recordings below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = Folders::of(root);
    let mut names = BTreeSet::new();
    for (folder, extensions) in [
        (&folders.cam, &["npz", "npy"][..]),
        (&folders.rgb, &["mp4"][..]),
    ] {
        let Some(folder) = folder else { continue };
        let fail = |cause| ReadError::io(folder, cause);
        for entry in std::fs::read_dir(folder).map_err(fail)? {
            let path = entry.map_err(fail)?.path();
            let known = path
                .extension()
                .is_some_and(|found| extensions.iter().any(|extension| found == *extension));
            if known && path.is_file() {
                names.extend(
                    path.file_stem()
                        .map(|stem| stem.to_string_lossy().into_owned()),
                );
            }
        }
    }
    if names.is_empty() || (folders.rgb.is_none() && folders.cam.is_none()) {
        return Err(ReadError::absent(
            root,
            "there are no recordings of EgoGen here (`cam/<name>.npz`, `rgb_256_8fps/<name>.mp4`)",
        ));
    }
    let paths = names.into_iter().map(|name| root.join(name)).collect();
    Recordings::new("egogen", paths, settings, move |path, settings| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        open(&folders, &name, settings.decoder)
    })
}

fn open(folders: &Folders, name: &str, decoder: DecoderChoice) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("egogen", name);
    let missing = |folder: &str, extension: &str, what: &str| {
        format!("there is no `{folder}/<name>.{extension}`: no {what}")
    };
    // Blender's world.
    recording.up_world = Some(Vector3::z_axis());
    match Folders::file(folders.rgb.as_ref(), name, &["mp4"]) {
        Some(path) => {
            let video = Video::open_with(path, &VideoSettings::by(decoder))?;
            let times = (0..video.info().frames)
                .map(|frame| {
                    tick((video.schedule().seconds(frame) * RATE).round_ties_even() as usize)
                })
                .collect();
            recording.colour = Some(Box::new(Frames { video, times }));
        }
        None => recording
            .notes
            .push(missing("rgb_256_8fps", "mp4", "pictures")),
    }
    match Folders::file(folders.cam.as_ref(), name, &["npz", "npy"]) {
        Some(path) => {
            let (track, count) = poses(&path)?;
            recording.span = Some((0, tick(count)));
            recording.device = Some(track);
            recording.cameras = vec![(0, MountedCamera::without_lens())];
        }
        None => recording.notes.push(missing("cam", "npz", "camera")),
    }
    match Folders::file(folders.depth.as_ref(), name, &["npz"]) {
        Some(path) => recording.depth = Some(Box::new(DepthFile::open(path)?)),
        // Sets without any depth are usual.
        None if folders.depth.is_none() => {}
        None => recording.notes.push(missing("depth", "npz", "depth")),
    }
    Ok(recording)
}

/// Sample `k` on the clock of a recording, nanoseconds.
fn tick(k: usize) -> i64 {
    (k as f64 / RATE * SECOND as f64).round() as i64
}

/// `T_world_camera` of the poses that are there, and how many rows there are.
fn poses(path: &Path) -> Result<(Track<Isometry3<f64>>, usize), ReadError> {
    let poses = egom2p::array(path)?
        .to_dim::<f64, Ix3>()
        .map_err(|error| error.in_file(path))?;
    let count = poses.shape()[0];
    egom2p::expect(path, poses.shape(), &[count.max(1), 4, 4])?;
    let opencv = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let mut samples = Vec::with_capacity(count);
    for (row, matrix) in poses.outer_iter().enumerate() {
        if let Some(pose) = egom2p::pose(path, row, matrix)? {
            samples.push((tick(row), pose * opencv));
        }
    }
    // Each row is its own sample: a missing one is missing.
    Ok((Track::new(samples, SECOND / 25, SECOND / 100), count))
}

/// Depth maps in an npz file, which is read when the first one is asked for.
struct DepthFile {
    path: PathBuf,
    key: String,
    times: Vec<i64>,
    metres: OnceLock<Array3<f32>>,
}

impl DepthFile {
    fn open(path: PathBuf) -> Result<Self, ReadError> {
        let key = "arr_0".to_owned();
        let shape = Npz::rows(&path, &key, |rows| Ok(rows.shape().to_vec()))?;
        if shape.len() != 3 || shape.contains(&0) {
            return Err(ReadError::malformed(
                &path,
                Position::File,
                format!("depth of shape {shape:?}, which is not frames, rows and columns"),
            ));
        }
        Ok(DepthFile {
            path,
            key,
            times: (0..shape[0]).map(tick).collect(),
            metres: OnceLock::new(),
        })
    }
}

impl DepthFrames for DepthFile {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError> {
        let metres = if let Some(metres) = self.metres.get() {
            metres
        } else {
            let array = Npz::read_some(&self.path, &[&self.key])?;
            let read = array
                .get(&self.key)?
                .to_dim::<f32, Ix3>()
                .map_err(|error| error.in_file(&self.path))?;
            self.metres.get_or_init(|| read)
        };
        if index >= metres.shape()[0] {
            return Err(ReadError::malformed(
                &self.path,
                Position::Frame(index as u64),
                "the file has changed while it was read",
            ));
        }
        Ok(metres.index_axis(Axis(0), index).mapv(|depth| {
            if depth > 0.0 && depth.is_finite() {
                depth
            } else {
                f32::NAN
            }
        }))
    }
}
