//! Nymeria: people in motion-capture suits with Project Aria glasses: pictures, gaze, camera and body.
//!
//! A sequence has a folder `recording_head` (the glasses: `data/data.vrs` and the files of Machine Perception Services, all on the
//! glasses' clock) and `body/xdata.npz` (XSens segments at 240 Hz on the studio's timecode, in a world of their own). The timecode
//! of the glasses is a stream of `data.vrs`. [`body`] brings the segments into the glasses' world.

mod body;
mod registration;

use super::ReadError;
use super::adt::{VrsColour, aria_gaze};
use super::aria::vrs::image::Pictures;
use super::aria::vrs::{Kind, StreamId, Vrs};
use super::aria::{calibration, gaze, trajectory};
use super::dataset::{Recordings, find};
use super::recording::{CutSettings, Recording};
use super::track::ClockMap;
use crate::formats::read_error::Position;
use crate::video::image::Turn;
use std::path::Path;
use std::sync::Arc;

/// Opens the sequences at or below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "Nymeria sequence (a folder with `recording_head`)",
        is_sequence,
    )?;
    Recordings::new("nymeria", folders, settings, |folder, _| open(folder))
}

/// Whether a folder is a sequence.
#[must_use]
pub fn is_sequence(folder: &Path) -> bool {
    folder.join("recording_head").is_dir()
}

/// Opens one sequence.
///
/// # Errors
/// When it has neither pictures nor a trajectory, or a file is damaged.
pub fn open(folder: &Path) -> Result<Recording, ReadError> {
    let name = folder.file_name().map_or_else(
        || "sequence".into(),
        |name| name.to_string_lossy().into_owned(),
    );
    let mut recording = Recording::new("nymeria", &name);
    recording.turn = Turn::Clockwise;
    let head = folder.join("recording_head");
    let video = head.join("data/data.vrs");
    let positions = head.join("mps/slam/closed_loop_trajectory.csv");
    if !video.is_file() && !positions.is_file() {
        return Err(ReadError::missing(
            &head,
            "there is neither `data/data.vrs` nor `mps/slam/closed_loop_trajectory.csv`",
        ));
    }
    let mut note = |text: &str| recording.notes.push(text.to_owned());

    let mut side = 1408;
    let mut large_frame = false;
    let mut factory = None;
    let mut timecode = Vec::new();
    if video.is_file() {
        let vrs = Arc::new(Vrs::open_streams(&video, |stream| {
            stream == StreamId::RGB || stream == StreamId::TIMECODE
        })?);
        large_frame = gaze::large_frame(&vrs.tags);
        timecode = vrs.time_map(StreamId::TIMECODE)?;
        factory = vrs.tags.get("calib_json").cloned();
        if vrs.of(StreamId::RGB, Kind::Data).next().is_some() {
            let pictures = Pictures::new(vrs, StreamId::RGB)?;
            side = pictures.size().map_or(1408, |(width, _)| width);
            recording.colour = Some(Box::new(VrsColour { pictures }));
        } else {
            note("`data.vrs` has no stream 214-1: no pictures");
        }
    } else {
        note("there is no `recording_head/data/data.vrs`: no pictures");
    }

    if positions.is_file() {
        let track = trajectory::read(&positions)?;
        let times = track.poses.times();
        recording.span = Some((times[0], times[times.len() - 1]));
        recording.up_world = track.up_world;
        recording.device = Some(track.poses);
    } else {
        note("there is no `mps/slam/closed_loop_trajectory.csv`: no camera and no body");
    }

    let online = head.join("mps/slam/online_calibration.jsonl");
    if online.is_file() {
        recording.cameras = calibration::online(&online, side)?
            .into_iter()
            .map(|(time, camera)| (time, camera.into()))
            .collect();
    } else if let Some(text) = factory {
        let camera = calibration::colour_camera(&text, side).map_err(|reason| {
            ReadError::malformed(&video, Position::File, format!("calib_json: {reason}"))
        })?;
        recording.cameras = vec![(0, camera.into())];
    } else {
        note("there is no `mps/slam/online_calibration.jsonl`: no lens, no camera and no gaze");
    }

    // Fitted to the wearer, where somebody looked at the calibration marks.
    let eyes = ["personalized_eye_gaze.csv", "general_eye_gaze.csv"]
        .iter()
        .map(|name| head.join("mps/eye_gaze").join(name))
        .find(|path| path.is_file());
    match eyes {
        Some(path) => recording.gaze = Some(aria_gaze(&path, large_frame)?),
        None => note("there is no `mps/eye_gaze/general_eye_gaze.csv`: no gaze"),
    }

    let segments = folder.join("body/xdata.npz");
    if !segments.is_file() {
        note("there is no `body/xdata.npz`: no body");
        return Ok(recording);
    }
    let Some(clock) = ClockMap::new(
        timecode
            .into_iter()
            .map(|(device, code)| (code, device))
            .collect(),
    ) else {
        note(
            "there is no timecode (stream 285-2 of `data.vrs`) to place the body in time: no body",
        );
        return Ok(recording);
    };
    if let Some(device) = &recording.device {
        let recorded = match &recording.colour {
            Some(colour) => (colour.times()[0], colour.times()[colour.times().len() - 1]),
            None => (device.times()[0], device.times()[device.times().len() - 1]),
        };
        match body::read(&segments, &clock, device, recorded)? {
            Ok(track) => recording.body = Some(track),
            Err(reason) => recording.notes.push(format!("{reason}: no body")),
        }
    }
    Ok(recording)
}
