//! Recordings of Project Aria glasses with the files of Machine Perception Services, with or without pictures: trajectory, gaze
//! (general or personalised), hand tracking. Times are device times.

use super::ReadError;
use super::adt::{VrsColour, aria_gaze};
use super::aria::vrs::image::Pictures;
use super::aria::vrs::{Kind, StreamId, Vrs};
use super::aria::{calibration, gaze, hand_tracking, trajectory};
use super::dataset::{Recordings, find};
use super::recording::{CutSettings, Recording};
use super::track::{Joints, SECOND, Track};
use crate::formats::read_error::Position;
use crate::video::image::Turn;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The names under which the services have written each file, the preferred one first.
const TRAJECTORIES: [&str; 3] = [
    "slam/closed_loop_trajectory.csv",
    "trajectory/closed_loop_trajectory.csv",
    "closed_loop_trajectory.csv",
];
const CALIBRATIONS: [&str; 3] = [
    "slam/online_calibration.jsonl",
    "trajectory/online_calibration.jsonl",
    "online_calibration.jsonl",
];
const GAZES: [&str; 5] = [
    "eye_gaze/personalized_eye_gaze.csv",
    "eye_gaze/general_eye_gaze.csv",
    "eye_gaze/generalized_eye_gaze.csv",
    "general_eye_gaze.csv",
    "generalized_eye_gaze.csv",
];
const HANDS: [&str; 3] = [
    "hand_tracking/hand_tracking_results.csv",
    "hand_tracking/hand_tracking_results_v1.csv",
    "hand_tracking_results.csv",
];

/// Opens the recordings at or below `root`.
///
/// # Errors
/// When there is none, or one cannot be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "Aria recording (a folder with `closed_loop_trajectory.csv` in it or in `mps/slam`)",
        is_recording,
    )?;
    Recordings::new("aria", folders, settings, |folder, _| open(folder))
}

/// Whether a folder has a trajectory of the services.
#[must_use]
pub fn is_recording(folder: &Path) -> bool {
    first(folder, &TRAJECTORIES).is_some()
}

fn first(folder: &Path, names: &[&str]) -> Option<PathBuf> {
    names
        .iter()
        .flat_map(|name| [folder.join("mps").join(name), folder.join(name)])
        .find(|path| path.is_file())
}

/// What to say where a file of the services is not there under any of its names.
fn absent(what: &str, names: &[&str]) -> String {
    format!(
        "no {what}: `{}` is not there, in `mps` or beside it",
        names[0]
    )
}

/// The recording itself: `video.vrs`, `recording.vrs`, or the only VRS file in the folder.
fn container(folder: &Path) -> Result<Option<PathBuf>, ReadError> {
    let fail = |cause| ReadError::io(folder, cause);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        if path.extension().is_some_and(|extension| extension == "vrs") {
            files.push(path);
        }
    }
    files.sort();
    let named = files
        .iter()
        .find(|path| path.ends_with("video.vrs") || path.ends_with("recording.vrs"))
        .cloned();
    Ok(named.or(if files.len() == 1 { files.pop() } else { None }))
}

/// Opens one recording.
///
/// # Errors
/// When it has no trajectory, or a file is damaged.
pub fn open(folder: &Path) -> Result<Recording, ReadError> {
    let name = folder.file_name().map_or_else(
        || "recording".into(),
        |name| name.to_string_lossy().into_owned(),
    );
    let mut recording = Recording::new("aria", &name);
    recording.turn = Turn::Clockwise;
    let path = first(folder, &TRAJECTORIES)
        .ok_or_else(|| ReadError::missing(folder, "there is no closed_loop_trajectory.csv"))?;
    let track = trajectory::read(&path)?;
    let (start, end) = (
        track.poses.times()[0],
        track.poses.times()[track.poses.times().len() - 1],
    );
    recording.span = Some((start, end));
    recording.up_world = track.up_world;

    let mut side = 1408;
    let mut large_frame = false;
    let mut factory = None;
    if let Some(video) = container(folder)? {
        let vrs = Arc::new(Vrs::open_streams(&video, |stream| stream == StreamId::RGB)?);
        large_frame = gaze::large_frame(&vrs.tags);
        factory = vrs
            .tags
            .get("calib_json")
            .cloned()
            .map(|text| (video, text));
        if vrs.of(StreamId::RGB, Kind::Data).next().is_none() {
            recording.lacks("no rgb: the VRS file has no pictures of camera-rgb");
        }
        // Recordings are also published without their image streams.
        if vrs.of(StreamId::RGB, Kind::Data).next().is_some() {
            let pictures = Pictures::new(vrs, StreamId::RGB)?;
            side = pictures.size().map_or(1408, |(width, _)| width);
            recording.colour = Some(Box::new(VrsColour { pictures }));
        }
    } else {
        recording
            .lacks("no rgb: there is no VRS file, or several and none is called `recording.vrs`");
    }
    if let Some(path) = first(folder, &CALIBRATIONS) {
        recording.cameras = calibration::online(&path, side)?
            .into_iter()
            .map(|(time, camera)| (time, camera.into()))
            .collect();
    } else if let Some((video, text)) = factory {
        let camera = calibration::colour_camera(&text, side).map_err(|reason| {
            ReadError::malformed(&video, Position::File, format!("calib_json: {reason}"))
        })?;
        recording.cameras = vec![(0, camera.into())];
    } else {
        recording.lacks(absent(
            "camera, gaze, hands in the camera and body",
            &CALIBRATIONS,
        ));
    }
    if recording.up_world.is_none() {
        recording.lacks(
            "the trajectory does not say where gravity points (columns `gravity_x_world`, ...)",
        );
    }
    if let Some(path) = first(folder, &GAZES) {
        recording.gaze = Some(aria_gaze(&path, large_frame)?);
    } else {
        recording.lacks(absent("gaze", &GAZES));
    }
    if first(folder, &HANDS).is_none() {
        recording.lacks(absent("left_hand and right_hand", &HANDS));
    }
    if let Some(path) = first(folder, &HANDS) {
        let hands = hand_tracking::read(&path)?;
        recording.hands = hands.map(|hand| {
            // From the device into the world, where every other source has its hands; rows without a pose are left out.
            let samples: Vec<(i64, Joints)> = hand
                .times()
                .iter()
                .zip(hand.values())
                .filter_map(|(time, joints)| {
                    let T_world_device = track.poses.at(*time)?;
                    Some((*time, joints.map(|joint| Some(T_world_device * joint?))))
                })
                .collect();
            (!samples.is_empty()).then(|| Track::new(samples, SECOND / 4, SECOND / 20))
        });
    }
    recording.device = Some(track.poses);
    Ok(recording)
}
