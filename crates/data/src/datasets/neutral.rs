//! The neutral recording folder: any data set becomes readable by writing these files. `docs/guide/data.md` is its manual.
//!
//! A folder with `recording.yaml`, which says for every signal which file holds it, in which unit and frame, and when its samples
//! were taken. Arrays are npz (or npy) files; colour is a video or a folder of pictures; depth an array or a folder of 16-bit
//! png pictures. NaN means missing.

mod arrays;
mod depth;
mod lens;
mod manifest;

use arrays::{inside, joints, load, nanoseconds, poses, shape, track};
use depth::depth;
use lens::lens_of;
use manifest::{GazeUnit, JointFrameEntry, Manifest};

use super::ReadError;
use super::dataset::{Recordings, find};
use super::recording::{CutSettings, GazeSample, JointFrame, MountedCamera, Recording};
use super::track::SECOND;
use super::video_frames::Frames;
use crate::formats::is_plain_name;
use crate::formats::read_error::Position;
use crate::formats::text;
use crate::video::image::Turn;
use crate::video::{DecoderChoice, Video, VideoSettings};
use nalgebra::{Isometry3, Unit, Vector3};
use std::path::Path;

/// The name of the file that makes a folder a recording.
pub const FILE: &str = "recording.yaml";
/// What `format` has to say.
pub const FORMAT: &str = "reviv-recording/1";

/// Opens the recordings at or below `root`.
///
/// # Errors
/// When there is none, or one cannot be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "recording folder (one with `recording.yaml`)",
        is_recording,
    )?;
    let name = manifest(&folders[0])?
        .source
        .unwrap_or_else(|| "recordings".to_owned());
    Recordings::new(&name, folders, settings, |folder, settings| {
        open_with(folder, settings.decoder)
    })
}

/// Whether a folder is a neutral recording.
#[must_use]
pub fn is_recording(folder: &Path) -> bool {
    folder.join(FILE).is_file()
}

fn manifest(folder: &Path) -> Result<Manifest, ReadError> {
    let path = folder.join(FILE);
    let text = text::read(&path)?;
    let manifest: Manifest = serde_saphyr::from_str(&text::yaml(&text)).map_err(|error| {
        let place = error
            .location()
            .map_or(Position::File, |at| Position::Line(at.line()));
        ReadError::malformed(&path, place, error.to_string())
    })?;
    if manifest.format != FORMAT {
        return Err(ReadError::unsupported(
            &path,
            format!("format `{}` is not `{FORMAT}`", manifest.format),
        ));
    }
    // Both become names of folders where clips are written.
    for (key, name) in [("source", &manifest.source), ("name", &manifest.name)] {
        if let Some(name) = name
            && !is_plain_name(name)
        {
            let name: String = name.chars().take(60).collect();
            return Err(ReadError::malformed(
                &path,
                Position::File,
                format!("`{key}: {name}` is no name of a folder"),
            ));
        }
    }
    Ok(manifest)
}

/// Opens one recording.
///
/// # Errors
/// When the manifest or a file it names is damaged or does not fit.
pub fn open(root: &Path) -> Result<Recording, ReadError> {
    open_with(root, DecoderChoice::Auto)
}

fn open_with(root: &Path, decoder: DecoderChoice) -> Result<Recording, ReadError> {
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
        let wrong = |reason| ReadError::malformed(&path, Position::File, reason);
        if !entry.turn.is_multiple_of(90) {
            return Err(wrong(format!(
                "`turn` is {} degrees, no multiple of 90",
                entry.turn
            )));
        }
        recording.turn = Turn::from_degrees(entry.turn);
        let video = Video::open_with(
            inside(root, &entry.file)?,
            &VideoSettings {
                folder_fps: entry.rate.unwrap_or(30.0),
                decoder,
            },
        )?;
        let start = nanoseconds(&path, entry.start)?;
        let times = (0..video.info().frames)
            .map(|frame| start + (video.schedule().seconds(frame) * SECOND as f64).round() as i64)
            .collect();
        if let Some(lens) = &entry.lens {
            let camera = lens_of(&path, lens)?;
            let info = video.info();
            if (camera.width, camera.height) != (info.width, info.height) {
                return Err(wrong(format!(
                    "`lens` is for pictures of {} x {} pixels, and those of `{}` have {} x {}",
                    camera.width,
                    camera.height,
                    entry.file.display(),
                    info.width,
                    info.height
                )));
            }
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
            recording.cameras = vec![(0, MountedCamera::without_lens())];
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
        let points = array
            .to_dim::<f64, ndarray::Ix2>()
            .map_err(|error| error.in_file(&root.join(&entry.file)))?;
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
        return Err(ReadError::malformed(
            &path,
            Position::File,
            "both hands must be in the same frame",
        ));
    }
    if let Some(entry) = &manifest.body {
        if entry.frame != JointFrameEntry::World {
            return Err(ReadError::malformed(
                &path,
                Position::File,
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
