//! HOT3D in its recording form, from Aria glasses and from Quest 3 headsets: camera and both hands, gaze with Aria.
//!
//! All tables use the studio's timecode; Aria's own files (gaze, calibration) use the glasses' clock. The map between the two is
//! a stream of `recording.vrs`; without that file it is found by the rows that the headset trajectory shares with the SLAM
//! trajectory. The world is z-up with Aria and y-up with Quest.

use super::ReadError;
use super::adt::{VrsColour, aria_gaze};
use super::aria::calibration::{self, unit_quaternion};
use super::aria::gaze;
use super::aria::trajectory::{self, Trajectory};
use super::aria::vrs::image::Pictures;
use super::aria::vrs::{StreamId, Vrs};
use super::csv::Table;
use super::dataset::{Recordings, find};
use super::recording::{ColourFrames, CutSettings, MountedCamera, Recording};
use super::track::{ClockMap, SECOND, Track, nearest};
use super::umetrack::{self, HandProfile};
use crate::formats::is_plain_name;
use crate::formats::read_error::Position;
use crate::formats::text::read_json;
use crate::geometry::camera::{Camera, Fisheye624, Lens};
use crate::video::image::{Image, Turn};
use nalgebra::{Isometry3, Translation3, Vector3};
use serde::Deserialize;
use std::path::Path;
use std::sync::Arc;

/// Two rows with positions this near are the same row of the same trajectory (metres).
const SAME_ROW: f64 = 1e-8;

/// Opens the Aria recordings at or below `root`.
///
/// # Errors
/// When there is none, or one cannot be opened.
pub fn aria(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(root, "HOT3D recording of Aria glasses", |folder| {
        headset(folder).as_deref() == Some("Aria")
    })?;
    Recordings::new("hot3d_aria", folders, settings, |folder, _| open(folder))
}

/// Opens the Quest recordings at or below `root`.
///
/// # Errors
/// As [`aria`].
pub fn quest(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(root, "HOT3D recording of a Quest 3", |folder| {
        headset(folder).as_deref() == Some("Quest3")
    })?;
    Recordings::new("hot3d_quest", folders, settings, |folder, _| open(folder))
}

#[derive(Deserialize)]
struct Metadata {
    headset: Option<String>,
    recording_name: Option<String>,
}

fn metadata(folder: &Path) -> Result<Metadata, ReadError> {
    read_json(&folder.join("metadata.json"))
}

/// `Aria` or `Quest3`, for a folder that is a recording.
#[must_use]
pub fn headset(folder: &Path) -> Option<String> {
    if !folder.join("headset_trajectory.csv").is_file() {
        return None;
    }
    metadata(folder).ok()?.headset
}

/// Opens one recording.
///
/// # Errors
/// When a file is missing that every recording has, or one is damaged.
pub fn open(folder: &Path) -> Result<Recording, ReadError> {
    let metadata = metadata(folder)?;
    let name = metadata.recording_name.filter(|name| is_plain_name(name));
    let name = name.unwrap_or_else(|| {
        folder.file_name().map_or_else(
            || "recording".into(),
            |name| name.to_string_lossy().into_owned(),
        )
    });
    match metadata.headset.as_deref() {
        Some("Aria") => open_aria(folder, &name),
        Some("Quest3") => open_quest(folder, &name),
        other => Err(ReadError::unsupported(
            &folder.join("metadata.json"),
            format!("headset {other:?} is neither `Aria` nor `Quest3`"),
        )),
    }
}

fn open_aria(folder: &Path, name: &str) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("hot3d_aria", name);
    recording.turn = Turn::Clockwise;
    let headset = headset_trajectory(&folder.join("headset_trajectory.csv"))?;
    let slam_path = folder.join("mps/slam/closed_loop_trajectory.csv");
    let slam = slam_path
        .is_file()
        .then(|| trajectory::read(&slam_path))
        .transpose()?;
    recording.up_world = slam
        .as_ref()
        .and_then(|slam| slam.up_world)
        .or(Some(Vector3::z_axis()));

    let video = folder.join("recording.vrs");
    let mut clock = None;
    let mut large_frame = false;
    let mut side = 1408;
    if video.is_file() {
        let vrs = Arc::new(Vrs::open_streams(&video, |stream| {
            stream == StreamId::RGB || stream == StreamId::TIMECODE
        })?);
        clock = ClockMap::new(vrs.time_map(StreamId::TIMECODE)?);
        large_frame = gaze::large_frame(&vrs.tags);
        let pictures = Pictures::new(vrs, StreamId::RGB)?;
        side = pictures.size().map_or(1408, |(width, _)| width);
        let map = clock.as_ref().ok_or_else(|| {
            ReadError::missing(
                &video,
                "there is no timecode stream 285-2 to place the pictures in time",
            )
        })?;
        let times = pictures.times.iter().map(|time| map.map(*time)).collect();
        recording.colour = Some(Box::new(Reclocked {
            inner: VrsColour { pictures },
            times,
        }));
    } else {
        recording.span = frame_span(folder, "214-1")?;
        recording.lacks("no rgb: `recording.vrs` is not there");
    }
    if slam.is_none() {
        recording.lacks("`mps/slam/closed_loop_trajectory.csv` is not there: up is taken to be z");
    }
    if clock.is_none() {
        clock = slam.as_ref().and_then(|slam| match_clocks(slam, &headset));
    }
    take_hands(folder, "214-1", &mut recording)?;
    recording.device = Some(headset);
    if let Some(clock) = clock {
        let calibration = folder.join("mps/slam/online_calibration.jsonl");
        if !calibration.is_file() {
            recording.lacks("no gaze, and nothing in the camera: `mps/slam/online_calibration.jsonl` is not there");
        }
        if calibration.is_file() {
            recording.cameras = calibration::online(&calibration, side)?
                .into_iter()
                .map(|(time, camera)| (clock.map(time), camera.into()))
                .collect();
        }
        if let Some(eyes) = ["personalized_eye_gaze.csv", "general_eye_gaze.csv"]
            .iter()
            .map(|name| folder.join("mps/eye_gaze").join(name))
            .find(|path| path.is_file())
        {
            recording.gaze =
                Some(aria_gaze(&eyes, large_frame)?.on_clock(|time| Some(clock.map(time))));
        } else {
            recording.lacks("no gaze: `mps/eye_gaze/general_eye_gaze.csv` is not there");
        }
    } else {
        recording.lacks(
            "no gaze, and no calibration over time: without `recording.vrs` or rows that `headset_trajectory.csv` shares with `mps/slam/closed_loop_trajectory.csv`, the glasses' clock is not known",
        );
    }
    Ok(recording)
}

fn open_quest(folder: &Path, name: &str) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("hot3d_quest", name);
    recording.turn = Turn::Clockwise;
    recording.up_world = Some(Vector3::y_axis());
    recording.device = Some(headset_trajectory(&folder.join("headset_trajectory.csv"))?);
    recording.cameras = vec![(
        0,
        quest_camera(&folder.join("camera_models.json"), "1201-1")?,
    )];
    let video = folder.join("recording.vrs");
    if video.is_file() {
        let vrs = Arc::new(Vrs::open_streams(&video, |stream| {
            stream == StreamId::SLAM_LEFT
        })?);
        recording.colour = Some(Box::new(VrsColour {
            pictures: Pictures::new(vrs, StreamId::SLAM_LEFT)?,
        }));
    } else {
        recording.span = frame_span(folder, "1201-1")?;
        recording.lacks("no rgb: `recording.vrs` is not there");
    }
    take_hands(folder, "1201-1", &mut recording)?;
    Ok(recording)
}

/// The hands, without the samples of frames whose ground truth did not pass the data set's quality check.
fn take_hands(folder: &Path, stream: &str, recording: &mut Recording) -> Result<(), ReadError> {
    /// Between two frames at 30 Hz.
    const SAME_FRAME: i64 = SECOND / 60;
    let poses = folder.join("umetrack_hand_pose_trajectory.jsonl");
    let profile = folder.join("umetrack_hand_user_profile.json");
    for file in [&poses, &profile] {
        // Test participants come without ground truth.
        if !file.is_file() {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            recording.lacks(format!(
                "no left_hand and right_hand: `{name}` is not there"
            ));
            return Ok(());
        }
    }
    let profile = HandProfile::read(&profile)?;
    let mut hands = umetrack::read(&poses, &profile)?;
    let mask = folder.join("masks/mask_qa_pass.csv");
    if mask.is_file() {
        let frames = mask_of(&mask, stream)?;
        let times: Vec<i64> = frames.iter().map(|(time, _)| *time).collect();
        let failed = |time: i64| {
            nearest(&times, time)
                .is_some_and(|at| !frames[at].1 && (times[at] - time).abs() <= SAME_FRAME)
        };
        let count: usize = hands
            .iter()
            .map(|hand| hand.times().iter().filter(|time| failed(**time)).count())
            .sum();
        if count > 0 {
            hands = hands.map(|hand| {
                let samples = hand.times().iter().zip(hand.values());
                let samples = samples.map(|(time, joints)| {
                    (*time, if failed(*time) { [None; 21] } else { *joints })
                });
                Track::new(samples.collect(), SECOND / 10, SECOND / 50)
            });
            recording.lacks(
                "hands of frames that failed the quality check (`masks/mask_qa_pass.csv`) are invalid",
            );
        }
    }
    recording.hands = hands.map(Some);
    Ok(())
}

/// Times of the frames of a stream (of all streams where the mask has no row of it), ascending, and whether each has the mark.
fn mask_of(path: &Path, stream: &str) -> Result<Vec<(i64, bool)>, ReadError> {
    let mut table = Table::open(path)?;
    let time = table.column("timestamp[ns]")?;
    let (id, mark) = (table.column("stream_id")?, table.column("mask")?);
    let mut rows: Vec<(bool, i64, bool)> = Vec::new();
    while let Some(row) = table.next_row() {
        let row = row?;
        let passed = match row.text(mark) {
            "True" | "true" | "TRUE" | "1" | "1.0" => true,
            "False" | "false" | "FALSE" | "0" | "0.0" => false,
            other => {
                let other: String = other.chars().take(40).collect();
                return Err(row.error(format!("`{other}` is neither `True` nor `False`")));
            }
        };
        rows.push((row.text(id) == stream, row.integer(time)?, passed));
    }
    let own = rows.iter().any(|(own, ..)| *own);
    let mut frames: Vec<(i64, bool)> = rows
        .into_iter()
        .filter(|(is_own, ..)| *is_own || !own)
        .map(|(_, time, passed)| (time, passed))
        .collect();
    frames.sort_unstable();
    Ok(frames)
}

/// `T_world_device`; in this table quaternions start with w.
fn headset_trajectory(path: &Path) -> Result<Track<Isometry3<f64>>, ReadError> {
    let mut table = Table::open(path)?;
    let time = table.column("timestamp[ns]")?;
    let position = table.columns("t_wo_{}[m]", ["x", "y", "z"])?;
    let rotation = table.columns("q_wo_{}", ["w", "x", "y", "z"])?;
    let mut samples = Vec::new();
    while let Some(row) = table.next_row() {
        let row = row?;
        let [x, y, z] = row.numbers(position)?;
        let [qw, qx, qy, qz] = row.numbers(rotation)?;
        let Some(rotation) = unit_quaternion(qw, qx, qy, qz).filter(|_| (x + y + z).is_finite())
        else {
            continue;
        };
        samples.push((
            row.integer(time)?,
            Isometry3::from_parts(Translation3::new(x, y, z), rotation),
        ));
    }
    if samples.is_empty() {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "there is no pose in it",
        ));
    }
    Ok(Track::new(samples, SECOND / 10, SECOND / 50))
}

/// First and last frame of a camera, by the rows of its masks.
fn frame_span(folder: &Path, stream: &str) -> Result<Option<(i64, i64)>, ReadError> {
    let masks = folder.join("masks");
    let Some(path) = ["mask_good_exposure.csv", "mask_hand_pose_available.csv"]
        .iter()
        .map(|name| masks.join(name))
        .find(|path| path.is_file())
    else {
        return Ok(None);
    };
    let mut table = Table::open(&path)?;
    let (time, id) = (table.column("timestamp[ns]")?, table.column("stream_id")?);
    let mut span: Option<(i64, i64)> = None;
    while let Some(row) = table.next_row() {
        let row = row?;
        if row.text(id) == stream {
            let time = row.integer(time)?;
            span = Some(span.map_or((time, time), |(first, last)| {
                (first.min(time), last.max(time))
            }));
        }
    }
    Ok(span)
}

/// Headset rows are SLAM rows with another time: those with the same position give the map from device time to timecode.
fn match_clocks(slam: &Trajectory, headset: &Track<Isometry3<f64>>) -> Option<ClockMap> {
    let mut pairs = Vec::new();
    let mut next = 0;
    for (time, pose) in headset.times().iter().zip(headset.values()) {
        let position = pose.translation.vector;
        let found = slam.first_rows[next..]
            .iter()
            .position(|(_, row)| (row - position).norm() < SAME_ROW);
        if let Some(ahead) = found {
            next += ahead;
            pairs.push((slam.first_rows[next].0, *time));
        }
    }
    // The first of several headset rows on one SLAM row is the nearest.
    pairs.dedup_by_key(|pair| pair.0);
    ClockMap::new(pairs)
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct QuestCamera {
    #[serde(rename = "stream_id")]
    stream: String,
    image_width: u32,
    image_height: u32,
    projection_model_type: String,
    projection_params: Vec<f64>,
    #[serde(rename = "T_Device_Camera")]
    pose: QuestPose,
}

#[derive(Deserialize)]
struct QuestPose {
    quaternion_wxyz: [f64; 4],
    translation_xyz: [f64; 3],
}

fn quest_camera(path: &Path, stream: &str) -> Result<MountedCamera, ReadError> {
    let cameras: Vec<QuestCamera> = read_json(path)?;
    let camera = cameras
        .iter()
        .find(|camera| camera.stream == stream)
        .ok_or_else(|| ReadError::missing(path, format!("there is no camera `{stream}`")))?;
    let wrong = |reason: &str| {
        ReadError::malformed(path, Position::File, format!("camera {stream}: {reason}"))
    };
    if !camera.projection_model_type.ends_with("FISHEYE624") {
        return Err(wrong("its projection is not FISHEYE624"));
    }
    let lens = Fisheye624::from_parameters(&camera.projection_params)
        .ok_or_else(|| wrong("parameters that are no lens"))?;
    let [w, x, y, z] = camera.pose.quaternion_wxyz;
    let [tx, ty, tz] = camera.pose.translation_xyz;
    let rotation =
        unit_quaternion(w, x, y, z).ok_or_else(|| wrong("a pose that is no rotation"))?;
    Ok(MountedCamera {
        camera: Camera {
            lens: Lens::Fisheye624(lens),
            width: camera.image_width,
            height: camera.image_height,
            valid_radius: None,
        },
        T_device_camera: Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation),
    })
}

/// Pictures on another clock.
struct Reclocked {
    inner: VrsColour,
    times: Vec<i64>,
}

impl ColourFrames for Reclocked {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        self.inner.read(indices, each)
    }
}
