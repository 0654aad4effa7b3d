//! Aria Digital Twin: the paper's evaluation set (camera, gaze, depth, body).
//!
//! A sequence is a folder with `video.vrs` (gen1 Aria), `depth_images.vrs` (z-depth in millimetres on the grid of the fisheye
//! pictures), `aria_trajectory.csv` (30 Hz, world y-up), `eyegaze.csv` and, where somebody wore markers, `Skeleton_*.json`
//! (51 joints at 120 Hz in the same world). All of them use the glasses' clock.

use super::ReadError;
use super::aria::vrs::image::{Pictures, Pixels};
use super::aria::vrs::{Kind, StreamId, Vrs};
use super::aria::{calibration, gaze, trajectory};
use super::dataset::{Recordings, find};
use super::recording::{
    ColourFrames, CutSettings, DepthFrames, GazeSample, MountedCamera, Recording,
};
use super::track::{Joints, SECOND, Track};
use crate::formats::read_error::Position;
use crate::formats::stays_inside;
use crate::formats::text::{self, read_json};
use crate::video::image::{Image, Turn};
use nalgebra::Point3;
use ndarray::Array2;
use serde::de::{DeserializeSeed, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Body frames come at 120 Hz; half of them are dense enough for 30 Hz.
const BODY_STEP: i64 = SECOND / 60 - SECOND / 1000;
/// Joints of the marker system, fingers included.
const JOINTS: usize = 51;

/// Opens the sequences at or below `root`.
///
/// # Errors
/// When there is none, or one cannot be opened.
pub fn source(root: &Path, settings: CutSettings) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "Aria Digital Twin sequence (a folder with `video.vrs` and `aria_trajectory.csv`)",
        is_sequence,
    )?;
    Recordings::new("adt", folders, settings, |folder, _| open(folder))
}

/// Whether a folder is a sequence.
#[must_use]
pub fn is_sequence(folder: &Path) -> bool {
    folder.join("video.vrs").is_file() && folder.join("aria_trajectory.csv").is_file()
}

/// Opens one sequence.
///
/// # Errors
/// When a file is missing that every sequence has, or one is damaged.
pub fn open(folder: &Path) -> Result<Recording, ReadError> {
    let name = folder.file_name().map_or_else(
        || "sequence".into(),
        |name| name.to_string_lossy().into_owned(),
    );
    let mut recording = Recording::new("adt", &name);
    recording.turn = Turn::Clockwise;

    let video = folder.join("video.vrs");
    let vrs = Arc::new(Vrs::open_streams(&video, |stream| stream == StreamId::RGB)?);
    let pictures = Pictures::new(Arc::clone(&vrs), StreamId::RGB)?;
    let side = pictures.size().map_or(1408, |(width, _)| width);
    let factory = vrs.tags.get("calib_json").ok_or_else(|| {
        ReadError::missing(&video, "there is no factory calibration (`calib_json`)")
    })?;
    let camera = calibration::colour_camera(factory, side).map_err(|reason| {
        ReadError::malformed(&video, Position::File, format!("calib_json: {reason}"))
    })?;
    recording.cameras = vec![(0, camera.into())];
    recording.colour = Some(Box::new(VrsColour { pictures }));

    let depth = folder.join("depth_images.vrs");
    if depth.is_file() {
        recording.depth = depth_of(&depth, StreamId::RGB)?;
        if recording.depth.is_none() {
            recording.lacks(format!(
                "no depth: `depth_images.vrs` has no stream of camera {}",
                StreamId::RGB
            ));
        }
    } else {
        recording.lacks("no depth: `depth_images.vrs` is not there");
    }

    let track = trajectory::read(&folder.join("aria_trajectory.csv"))?;
    recording.device = Some(track.poses);
    recording.up_world = track.up_world;

    let eyes = folder.join("eyegaze.csv");
    if eyes.is_file() {
        let large = gaze::large_frame(&vrs.tags);
        recording.gaze = Some(aria_gaze(&eyes, large)?);
    } else {
        recording.lacks("no gaze: `eyegaze.csv` is not there");
    }
    match skeleton_of(folder, vrs.tags.get("device_serial").map(String::as_str))? {
        Ok(skeleton) => {
            recording.body = Some(read_skeleton(&skeleton)?);
            if recording.up_world.is_none() {
                recording.lacks(trajectory::NO_GRAVITY);
            }
        }
        Err(reason) => recording.lacks(format!("no body: {reason}")),
    }
    Ok(recording)
}

/// A gaze table as samples that are projected when a clip is cut.
pub(super) fn aria_gaze(path: &Path, large_frame: bool) -> Result<Track<GazeSample>, ReadError> {
    let pupils = gaze::pupils_on_device(large_frame);
    let track = gaze::read(path)?;
    let samples = track
        .times()
        .iter()
        .zip(track.values())
        .map(|(time, gaze)| (*time, GazeSample::Aria(*gaze, pupils)))
        .collect();
    Ok(Track::new(samples, SECOND / 4, SECOND / 20))
}

/// Colour pictures in a VRS file, on its own clock.
pub(super) struct VrsColour {
    pub pictures: Pictures,
}

impl ColourFrames for VrsColour {
    fn times(&self) -> &[i64] {
        &self.pictures.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        for &index in indices {
            match self.pictures.read(index)? {
                Pixels::Rgb(image) => each(index, image),
                Pixels::Grey16(_) => {
                    return Err(ReadError::Settings(format!(
                        "stream {} holds depth, not colour",
                        self.pictures.stream()
                    )));
                }
            }
        }
        Ok(())
    }
}

struct VrsDepth {
    pictures: Pictures,
    path: PathBuf,
}

impl DepthFrames for VrsDepth {
    fn times(&self) -> &[i64] {
        &self.pictures.times
    }

    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError> {
        match self.pictures.read(index)? {
            Pixels::Grey16(millimetres) => Ok(millimetres.mapv(|mm| match mm {
                0 => f32::NAN,
                mm => f32::from(mm) / 1000.0,
            })),
            Pixels::Rgb(_) => Err(ReadError::malformed(
                &self.path,
                Position::Frame(index as u64),
                "a depth map of eight bits",
            )),
        }
    }
}

/// The depth maps that belong to a camera: found by the description of the stream, because their numbers do not say it.
fn depth_of(path: &Path, camera: StreamId) -> Result<Option<Box<dyn DepthFrames>>, ReadError> {
    let vrs = Arc::new(Vrs::open(path)?);
    let mut streams: Vec<StreamId> = vrs.of_kind(Kind::Configuration).collect();
    streams.dedup();
    for stream in streams {
        let (layout, record) = vrs.configuration(stream)?;
        let description = vrs.fields(&layout, &record)?.text("description");
        if description.as_deref() == Some(&camera.to_string()) {
            return Ok(Some(Box::new(VrsDepth {
                pictures: Pictures::new(Arc::clone(&vrs), stream)?,
                path: path.to_owned(),
            })));
        }
    }
    Ok(None)
}

#[derive(Deserialize)]
struct Association {
    #[serde(rename = "SkeletonMetadata", default)]
    skeletons: Vec<AssociatedSkeleton>,
}

#[derive(Deserialize)]
struct AssociatedSkeleton {
    #[serde(rename = "AssociatedDeviceSerial")]
    serial: String,
    #[serde(rename = "SkeletonName")]
    name: String,
}

/// The skeleton of the person who wears these glasses, or why there is none.
fn skeleton_of(folder: &Path, serial: Option<&str>) -> Result<Result<PathBuf, String>, ReadError> {
    let path = folder.join("skeleton_aria_association.json");
    if !path.is_file() {
        return Ok(Err(
            "`skeleton_aria_association.json` is not there".to_owned()
        ));
    }
    let association: Association = read_json(&path)?;
    let mine = association
        .skeletons
        .iter()
        .find(|skeleton| serial.is_none_or(|serial| serial == skeleton.serial));
    let Some(mine) = mine else {
        return Ok(Err(
            "`skeleton_aria_association.json` has no skeleton of these glasses".to_owned(),
        ));
    };
    if mine.name == "NONE" {
        return Ok(Err("the wearer had no markers".to_owned()));
    }
    let file = format!("{}.json", mine.name);
    if !stays_inside(Path::new(&file)) || file.contains(['/', '\\']) {
        return Err(ReadError::malformed(
            &path,
            Position::File,
            format!("`{file}` is no name of a file beside it"),
        ));
    }
    let named = folder.join(&file);
    Ok(if named.is_file() {
        Ok(named)
    } else {
        Err(format!("`{file}` is not there"))
    })
}

/// The marker system's joints in our order.
///
/// Its skeleton has one joint between pelvis and chest and none between chest and neck, where SMPL has two and one: `spine2` is
/// its chest (both lie half-way from pelvis to neck), and `spine3` lies 15 % of the way from there to the neck, where SMPL has it.
/// Everything else has a counterpart: collar, shoulder, elbow and wrist are its Shoulder, UArm, FArm and Hand; hip, knee, ankle
/// and foot are its Thigh, Shin, Foot and Toe.
#[must_use]
pub fn body_from_markers(joints: &[Option<Point3<f64>>; JOINTS]) -> Joints {
    const CHEST: usize = 2;
    const NECK: usize = 3;
    const FROM: [usize; 21] = [
        0, 43, 47, 44, 48, CHEST, 45, 49, CHEST, 46, 50, NECK, 5, 24, 4, 6, 25, 7, 26, 8, 27,
    ];
    let mut body = FROM.map(|from| joints[from]);
    body[8] = joints[CHEST]
        .zip(joints[NECK])
        .map(|(chest, neck)| chest + (neck - chest) * 0.15);
    body
}

/// Body joints in the scene over device time, thinned to 60 Hz while the file is read: it can have hundreds of megabytes.
///
/// # Errors
/// When the file is damaged; the line is named.
pub fn read_skeleton(path: &Path) -> Result<Track<Joints>, ReadError> {
    let mut samples = Vec::new();
    let mut deserializer = serde_json::Deserializer::from_reader(text::open(path)?);
    deserializer
        .deserialize_map(SkeletonFile {
            samples: &mut samples,
        })
        .map_err(|error| {
            ReadError::malformed(path, Position::Line(error.line() as u64), error.to_string())
        })?;
    if samples.is_empty() {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "there are no body frames in it",
        ));
    }
    Ok(Track::new(samples, SECOND / 10, SECOND / 50))
}

/// The file's outermost object: only `frames` is read.
struct SkeletonFile<'a> {
    samples: &'a mut Vec<(i64, Joints)>,
}

impl<'de> Visitor<'de> for SkeletonFile<'_> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a skeleton file with `frames`")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            if key == "frames" {
                map.next_value_seed(FrameList {
                    samples: self.samples,
                })?;
            } else {
                map.next_value::<IgnoredAny>()?;
            }
        }
        Ok(())
    }
}

struct FrameList<'a> {
    samples: &'a mut Vec<(i64, Joints)>,
}

impl<'de> DeserializeSeed<'de> for FrameList<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

#[derive(Deserialize)]
struct BodyFrame {
    joints: Vec<[Option<f64>; 3]>,
    timestamp_ns: i64,
}

impl<'de> Visitor<'de> for FrameList<'_> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a list of body frames")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        while let Some(frame) = list.next_element::<BodyFrame>()? {
            let close = self.samples.last().is_some_and(|(last, _)| {
                (0..BODY_STEP).contains(&frame.timestamp_ns.saturating_sub(*last))
            });
            if close {
                continue;
            }
            let joints: Vec<Option<Point3<f64>>> = frame
                .joints
                .iter()
                .map(|[x, y, z]| Some(Point3::new((*x)?, (*y)?, (*z)?)))
                .collect();
            let joints: &[_; JOINTS] = joints
                .as_slice()
                .try_into()
                .map_err(|_| serde::de::Error::invalid_length(joints.len(), &"51 joints"))?;
            self.samples
                .push((frame.timestamp_ns, body_from_markers(joints)));
        }
        Ok(())
    }
}

impl From<calibration::DeviceCamera> for MountedCamera {
    fn from(camera: calibration::DeviceCamera) -> Self {
        MountedCamera {
            camera: camera.camera,
            T_device_camera: camera.T_device_camera,
        }
    }
}
