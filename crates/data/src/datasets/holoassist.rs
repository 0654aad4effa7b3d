//! HoloAssist: sessions of a HoloLens 2, with pictures, camera, gaze and both hands.
//!
//! A session is a folder with `Export_py/`, in which tables without header (tab-separated) have one row per moment of a shared 30 Hz
//! clock: column 0 counts its seconds, column 1 is the capture tick (100 ns) of the stream's own sample. Streams belong together row by
//! row, and 60 rows are a clip: the clock of a recording here is column 0. The picture of a row is the video frame nearest to the tick
//! of the row in `Video/Pose_sync.txt`. Poses have the axes of Platform for Situated Intelligence: x forward, y left, z up, and
//! z is up in the world too.

mod rows;
mod tables;

use super::ReadError;
use super::csv::Lines;
use super::dataset::{Recordings, find};
use super::recording::{
    ColourFrames, CutSettings, GazeSample, JointFrame, MountedCamera, Recording,
};
use super::track::{SECOND, Track, nearest};
use crate::geometry::camera::{Camera, Lens, Pinhole};
use crate::video::image::Image;
use crate::video::{DecoderChoice, Video, VideoSettings};
use nalgebra::{Isometry3, Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use tables::{Intrinsics, PoseRow};

/// Metres along the ray of the point whose pixel is the gaze, as in the official code.
const GAZE_DISTANCE: f64 = 0.5;
/// Rows are 33 ms apart, and each is its own sample: a missing one is missing.
const MAX_GAP: i64 = SECOND / 25;
const HOLD: i64 = SECOND / 100;
/// Ticks of 100 ns in a second.
const TICKS: f64 = 1e7;
/// A row this far before the first picture or after the last, in ticks, still shows it: the streams do not start together.
const PICTURE_APART: i64 = 2_500_000;

/// A video that goes on for longer than this after the last row, in ticks, has lost rows.
const MISSING_CLOCK: i64 = 10_000_000;

/// Opens the sessions at or below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "HoloAssist session (a folder with `Export_py`)",
        is_session,
    )?;
    let (splits, absent) = official(root, &folders)?;
    let recordings = Recordings::new("holoassist", folders, settings, |folder, settings| {
        open_with(folder, settings.decoder)
    })?
    .with_splits(splits);
    Ok(if absent > 0 {
        recordings.with_note("sessions of `data_split/` that are not on disk", absent)
    } else {
        recordings
    })
}

/// The split of each session by the lists in `data_split/`, and how many that are listed are not here.
fn official(
    root: &Path,
    folders: &[PathBuf],
) -> Result<(BTreeMap<String, &'static str>, usize), ReadError> {
    let here: BTreeSet<String> = folders
        .iter()
        .filter_map(|folder| folder.file_name())
        .map(|name| name.to_string_lossy().into_owned())
        .collect();
    let (mut splits, mut absent) = (BTreeMap::new(), 0);
    for (file, split) in [("train", "train"), ("val", "validation"), ("test", "test")] {
        let path = root.join(format!("data_split/{file}-v1_2.txt"));
        if !path.is_file() {
            continue;
        }
        for line in Lines::open(&path)? {
            let name = line?.1.trim().to_owned();
            if here.contains(&name) {
                splits.insert(name, split);
            } else if !name.is_empty() {
                absent += 1;
            }
        }
    }
    Ok((splits, absent))
}

/// Whether a folder is a session.
#[must_use]
pub fn is_session(folder: &Path) -> bool {
    folder.join("Export_py").is_dir()
}

/// Opens one session.
///
/// # Errors
/// When it has no clock, or a file is damaged.
pub fn open(folder: &Path) -> Result<Recording, ReadError> {
    open_with(folder, DecoderChoice::Auto)
}

fn open_with(folder: &Path, decoder: DecoderChoice) -> Result<Recording, ReadError> {
    let name = folder.file_name().map_or_else(
        || "session".into(),
        |name| name.to_string_lossy().into_owned(),
    );
    let mut recording = Recording::new("holoassist", &name);
    let export = folder.join("Export_py");
    let clock = export.join("Video/Pose_sync.txt");
    if !clock.is_file() {
        return Err(ReadError::missing(
            folder,
            "there is no `Export_py/Video/Pose_sync.txt`, which holds the clock and the camera",
        ));
    }
    let poses = tables::poses(&clock)?;
    let times: Vec<i64> = poses.iter().map(|row| row.time).collect();
    let last = times[times.len() - 1];
    recording.span = Some((times[0], last.saturating_add(SECOND / 30)));
    recording.up_world = Some(Vector3::z_axis());

    let mut size = None;
    if let Some(path) = video_of(&export) {
        let video = Video::open_with(&path, &VideoSettings::by(decoder))?;
        size = Some((video.info().width, video.info().height));
        match start_of(&export)? {
            Some(start) => {
                // A clock that was cut short is whole to its reader, and so is what follows it: only the video goes on.
                let shown = start.saturating_add((video.info().seconds() * TICKS) as i64);
                let clock = poses[poses.len() - 1].tick;
                if shown.saturating_sub(clock) > MISSING_CLOCK {
                    recording.notes.push(
                        "the video goes on for more than a second after the last row of `Video/Pose_sync.txt`".to_owned(),
                    );
                }
                recording.colour = rows_as_frames(video, start, &poses).map(boxed);
                if recording.colour.is_none() {
                    recording.notes.push(
                        "no row of `Video/Pose_sync.txt` is at a time of the video: no pictures"
                            .to_owned(),
                    );
                }
            }
            None => recording.notes.push(
                "there is no `Video/VideoMp4Timing.txt`, which says when the video begins: no pictures".to_owned(),
            ),
        }
    } else {
        recording.notes.push(
            "there is neither `Video_pitchshift.mp4` nor `Video_compress.mp4`: no pictures"
                .to_owned(),
        );
    }

    let intrinsics = export.join("Video/Intrinsics.txt");
    let lens = if intrinsics.is_file() {
        Some(tables::intrinsics(&intrinsics)?)
    } else {
        recording
            .notes
            .push("there is no `Video/Intrinsics.txt`: no lens and no gaze".to_owned());
        None
    };
    recording.cameras = vec![(times[0], mounted(lens, size))];

    let samples = poses
        .iter()
        .filter_map(|row| Some((row.time, row.T_world_camera?)))
        .collect();
    recording.device = Some(Track::new(samples, MAX_GAP, HOLD));

    for (side, file) in ["Left_sync.txt", "Right_sync.txt"].into_iter().enumerate() {
        let path = export.join("Hands").join(file);
        if !path.is_file() {
            let note = format!("there is no `Hands/{file}`: that hand is not known");
            recording.notes.push(note);
            continue;
        }
        let hand = tables::hand(&path)?;
        recording
            .notes
            .extend(ends_early(&format!("Hands/{file}"), hand.last, last));
        if hand.flags_unused {
            recording.notes.push(format!(
                "`Hands/{file}` flags no joint as valid in any row: its flags are not used"
            ));
        }
        recording.hands[side] = Some(Track::new(hand.samples, MAX_GAP, HOLD));
    }
    recording.hands_frame = JointFrame::World;

    if let Some(lens) = lens {
        recording.gaze = gaze(&export, &lens, &poses, &mut recording.notes)?;
    }
    Ok(recording)
}

/// What to say of a table whose last row is more than a second before the clock's.
fn ends_early(file: &str, last: i64, clock: i64) -> Option<String> {
    (clock.saturating_sub(last) > SECOND)
        .then(|| format!("`{file}` ends more than a second before `Video/Pose_sync.txt`"))
}

fn boxed(frames: RowFrames) -> Box<dyn ColourFrames> {
    Box::new(frames)
}

/// The full pictures, or the small ones that are downloaded on their own.
fn video_of(export: &Path) -> Option<PathBuf> {
    ["Video_pitchshift.mp4", "Video_compress.mp4"]
        .iter()
        .flat_map(|name| [export.join(name), export.join("Video").join(name)])
        .find(|path| path.is_file())
}

fn start_of(export: &Path) -> Result<Option<i64>, ReadError> {
    let path = export.join("Video/VideoMp4Timing.txt");
    path.is_file().then(|| tables::timing(&path)).transpose()
}

/// The camera of the stored pictures. The small video is the full one resized, with a factor per axis.
fn mounted(intrinsics: Option<Intrinsics>, video: Option<(u32, u32)>) -> MountedCamera {
    let Some(Intrinsics {
        lens,
        width,
        height,
    }) = intrinsics
    else {
        return MountedCamera::without_lens();
    };
    let (w, h) = video.unwrap_or((width, height));
    let (x, y) = (
        f64::from(w) / f64::from(width),
        f64::from(h) / f64::from(height),
    );
    MountedCamera {
        camera: Camera {
            lens: Lens::Pinhole(Pinhole {
                fx: lens.fx * x,
                fy: lens.fy * y,
                cx: lens.cx * x,
                cy: lens.cy * y,
            }),
            width: w,
            height: h,
            valid_radius: None,
        },
        T_device_camera: Isometry3::identity(),
    }
}

/// The gaze of each row as a pixel of the full picture: from the rays, or from pixels that somebody computed before.
fn gaze(
    export: &Path,
    intrinsics: &Intrinsics,
    poses: &[PoseRow],
    notes: &mut Vec<String>,
) -> Result<Option<Track<GazeSample>>, ReadError> {
    let size = [f64::from(intrinsics.width), f64::from(intrinsics.height)];
    let rays = export.join("Eyes/Eyes_sync.txt");
    let pixels = export.join("Eyes/Eyes_proj.txt");
    let samples: Vec<(i64, GazeSample)> = if rays.is_file() {
        let rays = tables::rays(&rays)?;
        rays.iter()
            .filter_map(|(time, origin, direction)| {
                let T_world_camera = pose_at(poses, *time)?;
                let point: Point3<f64> = origin + direction * GAZE_DISTANCE;
                let point = T_world_camera.inverse_transform_point(&point);
                let pixel = intrinsics.pixel(&point)?;
                Some((*time, GazeSample::Pixel { pixel, size }))
            })
            .collect()
    } else if pixels.is_file() {
        tables::pixels(&pixels)?
            .into_iter()
            .map(|(time, pixel)| (time, GazeSample::Pixel { pixel, size }))
            .collect()
    } else {
        notes.push("there is no `Eyes/Eyes_sync.txt`: no gaze".to_owned());
        return Ok(None);
    };
    Ok(Some(Track::new(samples, MAX_GAP, HOLD)))
}

/// The pose of the row of this moment.
fn pose_at(poses: &[PoseRow], time: i64) -> Option<Isometry3<f64>> {
    let at = poses.partition_point(|row| row.time < time);
    let near = [at.checked_sub(1), Some(at)]
        .into_iter()
        .flatten()
        .filter_map(|index| poses.get(index))
        .min_by_key(|row| (row.time - time).abs())?;
    if (near.time - time).abs() > HOLD {
        return None;
    }
    near.T_world_camera
}

/// Pictures by row: several rows may show the same one, and some are shown by none.
struct RowFrames {
    video: Video,
    times: Vec<i64>,
    /// The video frame of each row.
    frames: Vec<usize>,
}

/// The video frame nearest to each row; `None` where the video and the rows never meet.
fn rows_as_frames(video: Video, start: i64, poses: &[PoseRow]) -> Option<RowFrames> {
    // Ticks from the start of the video: whole, as the export counts them.
    let shown: Vec<i64> = (0..video.info().frames)
        .map(|frame| (video.schedule().seconds(frame) * TICKS + 1e-3).floor() as i64)
        .collect();
    let (mut times, mut frames) = (Vec::new(), Vec::new());
    for row in poses {
        let tick = row.tick.saturating_sub(start);
        let Some(frame) = nearest(&shown, tick) else {
            continue;
        };
        if (shown[frame] - tick).abs() <= PICTURE_APART {
            times.push(row.time);
            frames.push(frame);
        }
    }
    (!times.is_empty()).then_some(RowFrames {
        video,
        times,
        frames,
    })
}

impl ColourFrames for RowFrames {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        let wanted: Vec<usize> = indices.iter().map(|index| self.frames[*index]).collect();
        let mut left = indices.iter().zip(&wanted).peekable();
        for frame in self.video.chosen(wanted.clone())? {
            let frame = frame?;
            while let Some((index, _)) = left.next_if(|(_, wanted)| **wanted == frame.index) {
                each(*index, frame.image.clone());
            }
        }
        Ok(())
    }

    fn decoder(&self) -> Option<String> {
        Some(self.video.info().read_by())
    }
}
