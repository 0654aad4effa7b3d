//! Ego-Exo4D: takes seen from Project Aria glasses, with pictures, gaze and camera.
//!
//! `takes.json` names the takes, most of which are usually not downloaded. The pictures of a take are an mp4 that is already upright
//! (`frame_aligned_videos/aria01_214-1.mp4`, or its small copy in `downscaled/448/`); each of its frames is a row of the capture's
//! `captures/<capture>/timesync.csv`, which holds the glasses' time of capture. Trajectory, calibration and gaze are files of
//! Machine Perception Services on the same clock. The recording without images (`aria01_noimagestreams.vrs`) has the factory
//! calibration and says which frame the glasses have.

mod takes;
mod timesync;

use super::ReadError;
use super::adt::aria_gaze;
use super::aria::vrs::Vrs;
use super::aria::{calibration, gaze, trajectory};
use super::dataset::Recordings;
use super::recording::{ColourFrames, CutSettings, MountedCamera, Recording, upright};
use super::video_frames::Frames;
use crate::formats::read_error::Position;
use crate::geometry::camera::Camera;
use crate::video::image::{Image, Turn};
use crate::video::{DecoderChoice, Video, VideoSettings};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use takes::Take;

/// Side of the colour pictures, of which there are smaller copies.
const SIDE: u32 = 1408;

/// Opens the takes that `root/takes.json` names and that are on disk.
///
/// # Errors
/// When there is no `takes.json`, it is damaged, or not one take can be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let list = root.join("takes.json");
    if !list.is_file() {
        return Err(ReadError::absent(
            root,
            "there is no Ego-Exo4D here (a folder with `takes.json`)",
        ));
    }
    let listed = takes::read(&list)?;
    let count = listed.len();
    let takes: BTreeMap<PathBuf, Take> = listed
        .into_iter()
        .map(|take| (root.join(take.folder()), take))
        .filter(|(folder, _)| folder.is_dir())
        .collect();
    if takes.is_empty() {
        return Err(ReadError::missing(
            &list,
            format!("not one of its {count} takes is on disk"),
        ));
    }
    let absent = count - takes.len();
    let folders = takes.keys().cloned().collect();
    let captures = root.join("captures");
    let recordings = Recordings::new("ego_exo4d", folders, settings, move |folder, settings| {
        let take = takes
            .get(folder)
            .ok_or_else(|| ReadError::missing(folder, "the take is not in `takes.json`"))?;
        open(folder, take, &captures, settings.decoder)
    })?;
    Ok(if absent > 0 {
        recordings.with_note("takes of `takes.json` that are not on disk", absent)
    } else {
        recordings
    })
}

/// Opens one take.
fn open(
    folder: &Path,
    take: &Take,
    captures: &Path,
    decoder: DecoderChoice,
) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("ego_exo4d", take.name());
    if take.is_dropped() {
        return Err(ReadError::missing(
            folder,
            "`takes.json` says that this take is dropped",
        ));
    }
    let eyes = take.ego_camera(folder);
    let video = take.video(folder, &eyes);
    let positions = folder.join("trajectory/closed_loop_trajectory.csv");
    if video.is_none() && !positions.is_file() {
        return Err(ReadError::missing(
            folder,
            format!("there is neither `frame_aligned_videos/{eyes}_214-1.mp4` nor a trajectory"),
        ));
    }
    let mut side = SIDE;
    let sync = captures.join(take.capture()).join("timesync.csv");
    let without = |what: &str| format!("{what}: no pictures");
    match (&video, take.rows()) {
        (None, _) => recording.notes.push(without(
            "there is no `frame_aligned_videos/<camera>_214-1.mp4`",
        )),
        (Some(_), None) => recording.notes.push(without(
            "`takes.json` does not say which rows of `timesync.csv` the take is",
        )),
        (Some(_), _) if !sync.is_file() => recording.notes.push(without(
            "there is no `captures/<capture>/timesync.csv`, which says when frames were captured",
        )),
        (Some(path), Some(rows)) => {
            let video = Video::open_with(path, &VideoSettings::by(decoder))?;
            side = video.info().width;
            if side != video.info().height {
                let reason = format!("{side} x {} pixels, not a square", video.info().height);
                return Err(ReadError::unsupported(path, reason));
            }
            let times = timesync::read(&sync, &eyes, &rows)?;
            let frames = timesync::frames(video.info().frames, &rows, &times);
            if frames.times.is_empty() {
                let reason = format!("no row of this take says when `{eyes}_214-1` was captured");
                return Err(ReadError::missing(&sync, reason));
            }
            recording.notes.extend(frames.note.map(str::to_owned));
            if times.len() < timesync::rows_of(&rows) {
                recording.notes.push(
                    "`timesync.csv` ends before the take does: what was captured after it has no pictures"
                        .to_owned(),
                );
            }
            recording.colour = Some(Box::new(TimedFrames {
                frames: Frames {
                    video,
                    times: frames.times,
                },
                indices: frames.indices,
            }));
        }
    }

    if positions.is_file() {
        let track = trajectory::read(&positions)?;
        let times = track.poses.times();
        recording.span = Some((times[0], times[times.len() - 1]));
        recording.up_world = track.up_world;
        recording.device = Some(track.poses);
    } else {
        recording
            .notes
            .push("there is no `trajectory/closed_loop_trajectory.csv`: no camera".to_owned());
    }

    let container = take.container(folder, &eyes);
    let tags = match &container {
        // The index of its streams is not needed.
        Some(path) => Vrs::open_streams(path, |_| false)?.tags,
        None => BTreeMap::new(),
    };
    let online = folder.join("trajectory/online_calibration.jsonl");
    if online.is_file() {
        recording.cameras = calibration::online(&online, SIDE)?
            .into_iter()
            .map(|(time, camera)| (time, upright_camera(camera, side)))
            .collect();
    } else if let (Some(path), Some(text)) = (&container, tags.get("calib_json")) {
        let camera = calibration::colour_camera(text, SIDE).map_err(|reason| {
            ReadError::malformed(path, Position::File, format!("calib_json: {reason}"))
        })?;
        recording.cameras = vec![(0, upright_camera(camera, side))];
    } else {
        recording.notes.push(
            "there is neither `trajectory/online_calibration.jsonl` nor a `_noimagestreams.vrs`: no lens, no camera and no gaze"
                .to_owned(),
        );
    }

    // Fitted to the wearer, where somebody looked at the calibration marks.
    let eye_gaze = ["personalized_eye_gaze.csv", "general_eye_gaze.csv"]
        .iter()
        .map(|name| folder.join("eye_gaze").join(name))
        .find(|path| path.is_file());
    match eye_gaze {
        Some(path) => recording.gaze = Some(aria_gaze(&path, gaze::large_frame(&tags))?),
        None => recording
            .notes
            .push("there is no `eye_gaze/general_eye_gaze.csv`: no gaze".to_owned()),
    }
    Ok(recording)
}

/// The calibration is of the stored picture; the video is upright, and may be smaller.
fn upright_camera(stored: calibration::DeviceCamera, side: u32) -> MountedCamera {
    let camera: Camera = stored.camera.turned_clockwise();
    MountedCamera {
        camera: camera.resized(f64::from(side) / f64::from(SIDE)),
        T_device_camera: stored.T_device_camera * upright(Turn::Clockwise),
    }
}

/// The frames of a video whose time of capture is known.
struct TimedFrames {
    frames: Frames,
    /// Of the frames in the video.
    indices: Vec<usize>,
}

impl ColourFrames for TimedFrames {
    fn times(&self) -> &[i64] {
        &self.frames.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        let stored: Vec<usize> = indices.iter().map(|index| self.indices[*index]).collect();
        self.frames.read(&stored, &mut |frame, image| {
            // Ascending and distinct, as was asked for.
            if let Ok(at) = stored.binary_search(&frame) {
                each(indices[at], image);
            }
        })
    }
}

/// A moment that no recording reaches, to keep sums of hostile numbers in range.
const LATEST: i64 = i64::MAX / 4;
