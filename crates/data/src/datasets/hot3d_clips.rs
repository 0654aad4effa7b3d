//! HOT3D-Clips: five seconds of Aria glasses or of a Quest 3 in one webdataset tar, `clip-000017.tar`, read in place.
//!
//! A frame `000012` has members `.image_<stream>.jpg`, `.cameras.json` (lens and world pose of every camera, of the picture as stored),
//! `.info.json` (device, capture times) and `.hands.json`; `__hand_shapes.json__` has the wearer's hands for UmeTrack and for MANO. The
//! head camera is 214-1 of Aria and 1201-1 of Quest, whose pictures are stored turned. Aria's world is z-up, Quest's y-up. Clips of
//! the test have no hands.

mod tar;

use super::aria::calibration::unit_quaternion;
use super::dataset::Recordings;
use super::files::tick;
use super::mano::{self, Mano};
use super::recording::{CutSettings, MountedCamera, Recording};
use super::track::{Joints, SECOND, Track};
use super::umetrack::{ANGLES, HandProfile};
use super::{ReadError, kind::HandModel};
use crate::formats::read_error::Position;
use crate::geometry::camera::{Camera, Fisheye624, Lens};
use crate::geometry::mano::{Convention, FingerPose, ManoPose, SHAPE};
use crate::video::image::Turn;
use nalgebra::{Isometry3, Matrix4, Vector3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tar::{SHAPES, Tar, TarPictures};

const ARIA: &str = "214-1";
const QUEST: &str = "1201-1";
/// Frames are 33 ms apart, and each is its own sample: a missing one is missing.
const MAX_GAP: i64 = SECOND / 25;
const HOLD: i64 = SECOND / 100;
/// Nanoseconds between a frame and the tick that it counts for.
const JITTER: u64 = 1_000_000;

/// Opens the clips at or below `root`, which may be a single tar.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(
    root: &Path,
    settings: CutSettings,
    mano: Option<&Path>,
    hands: HandModel,
) -> Result<Recordings, ReadError> {
    let mut tars = Vec::new();
    if root.is_file() {
        if is_clip(root) {
            tars.push(root.to_owned());
        }
    } else {
        below(root, 2, &mut tars)?;
    }
    if tars.is_empty() {
        return Err(ReadError::absent(
            root,
            "there are no clips of HOT3D here (`clip-000017.tar`)",
        ));
    }
    let mano = mano
        .map(|folder| Mano::open(folder)?.with_left_fix())
        .transpose()?;
    let base = root.to_owned();
    Recordings::new("hot3d_clips", tars, settings, move |tar, _| {
        open(tar, &name_of(&base, tar), mano.as_ref(), hands)
    })
}

/// Whether a file is named like a clip.
#[must_use]
pub fn is_clip(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "tar")
        && path
            .file_stem()
            .and_then(|stem| stem.to_str())
            .is_some_and(|stem| stem.starts_with("clip-"))
}

fn below(folder: &Path, depth: usize, tars: &mut Vec<PathBuf>) -> Result<(), ReadError> {
    let fail = |cause| ReadError::io(folder, cause);
    let mut inside = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        inside.push(entry.map_err(fail)?.path());
    }
    inside.sort();
    for path in inside {
        if path.is_dir() {
            if depth > 0 {
                below(&path, depth - 1, tars)?;
            }
        } else if is_clip(&path) {
            tars.push(path);
        }
    }
    Ok(())
}

/// `train_aria/clip-000017`.
fn name_of(root: &Path, tar: &Path) -> String {
    let inside = tar
        .strip_prefix(root)
        .ok()
        .filter(|path| path.iter().count() > 0);
    let path = inside.map_or_else(
        || tar.file_name().unwrap_or_default().into(),
        Path::to_owned,
    );
    path.with_extension("").to_string_lossy().into_owned()
}

#[derive(Deserialize)]
struct FrameCamera {
    calibration: Calibration,
    #[serde(rename = "T_world_from_camera")]
    pose: Option<Pose>,
}

#[derive(Deserialize)]
struct Calibration {
    image_width: u32,
    image_height: u32,
    projection_model_type: String,
    projection_params: Vec<f64>,
}

#[derive(Deserialize)]
struct Pose {
    translation_xyz: [f64; 3],
    quaternion_wxyz: [f64; 4],
}

impl Pose {
    fn rigid(&self) -> Option<Isometry3<f64>> {
        let [w, x, y, z] = self.quaternion_wxyz;
        let translation = Vector3::from(self.translation_xyz);
        let finite = translation.iter().all(|v| v.is_finite());
        let rotation = unit_quaternion(w, x, y, z).filter(|_| finite)?;
        Some(Isometry3::from_parts(translation.into(), rotation))
    }
}

#[derive(Deserialize, Default)]
struct Info {
    device: Option<String>,
    #[serde(default)]
    image_timestamps_ns: BTreeMap<String, i64>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Hands {
    left: Option<Hand>,
    right: Option<Hand>,
}

#[derive(Deserialize)]
struct Hand {
    umetrack_pose: Option<UmetrackPose>,
    mano_pose: Option<ManoParameters>,
}

#[derive(Deserialize)]
struct UmetrackPose {
    joint_angles: Vec<f64>,
    #[serde(rename = "T_world_from_wrist")]
    wrist: Option<Pose>,
    /// As the documentation of the set has it, row by row.
    wrist_xform: Option<[[f64; 4]; 4]>,
}

impl UmetrackPose {
    fn wrist(&self) -> Option<Matrix4<f64>> {
        match (&self.wrist, &self.wrist_xform) {
            (Some(pose), _) => Some(pose.rigid()?.to_homogeneous()),
            (None, Some(rows)) => Some(Matrix4::from_fn(|row, column| rows[row][column])),
            (None, None) => None,
        }
    }
}

#[derive(Deserialize)]
struct ManoParameters {
    thetas: Vec<f64>,
    /// Orientation, then translation.
    wrist_xform: [f64; 6],
}

#[derive(Deserialize)]
struct Shapes {
    mano: Option<Vec<f64>>,
    umetrack: Option<serde_json::Value>,
}

fn open(
    path: &Path,
    name: &str,
    mano: Option<&Mano>,
    model: HandModel,
) -> Result<Recording, ReadError> {
    let tar = Tar::index(path)?;
    let mut recording = Recording::new("hot3d_clips", name);
    recording.turn = Turn::Clockwise;
    let has = |stream: &str| tar.frames.values().any(|f| f.pictures.contains_key(stream));
    let mut device = None;
    let mut infos = BTreeMap::new();
    for (number, frame) in &tar.frames {
        let info: Info = match frame.info {
            Some(member) => tar.json(member, &format!("{number:06}.info.json"))?,
            None => Info::default(),
        };
        device = device.or(info.device.clone());
        infos.insert(*number, info);
    }
    let quest = match device.as_deref() {
        Some(device) => !device.eq_ignore_ascii_case("aria"),
        None => !has(ARIA),
    };
    let stream = if quest { QUEST } else { ARIA };
    recording.up_world = Some(if quest {
        Vector3::y_axis()
    } else {
        Vector3::z_axis()
    });
    // A frame without a capture time has none that would fit the others' clock, unless none has one.
    let first = infos
        .values()
        .filter_map(|info| info.image_timestamps_ns.get(stream).copied())
        .min();
    let time = |number: u32| match first {
        Some(first) => {
            let time = infos[&number].image_timestamps_ns.get(stream)?;
            Some(on_grid(first, *time))
        }
        None => Some(tick(number.into())),
    };

    let mut pictures = Vec::new();
    let mut poses = Vec::new();
    for (number, frame) in &tar.frames {
        let Some(time) = time(*number) else { continue };
        if let Some(member) = frame.pictures.get(stream) {
            // Pictures are chosen by when they were taken.
            let taken = infos[number].image_timestamps_ns.get(stream).copied();
            pictures.push((taken.unwrap_or(time), *member));
        }
        let Some(member) = frame.cameras else {
            continue;
        };
        let cameras: BTreeMap<String, FrameCamera> =
            tar.json(member, &format!("{number:06}.cameras.json"))?;
        let Some(camera) = cameras.get(stream) else {
            continue;
        };
        if let Some(pose) = camera.pose.as_ref().and_then(Pose::rigid) {
            poses.push((time, pose));
        }
        let mounted = mounted(&camera.calibration).map_err(|reason| {
            ReadError::malformed(
                &tar.path,
                Position::Offset(member.offset),
                format!("`{number:06}.cameras.json`: camera {stream}: {reason}"),
            )
        })?;
        let same = recording
            .cameras
            .last()
            .is_some_and(|(_, known)| *known == mounted);
        if !same {
            recording.cameras.push((time, mounted));
        }
    }
    if poses.is_empty() {
        recording
            .notes
            .push("its frames have no pose of the camera: no camera and no hands".to_owned());
    } else {
        recording.device = Some(Track::new(poses, MAX_GAP, HOLD));
    }
    hands(&tar, &time, mano, model, &mut recording)?;
    pictures.sort_by_key(|(time, _)| *time);
    pictures.dedup_by_key(|(time, _)| *time);
    let times: Vec<i64> = pictures.iter().map(|(time, _)| *time).collect();
    if let (Some(first), Some(last)) = (times.first(), times.last()) {
        recording.span = Some((*first, last.saturating_add(SECOND / 30)));
        recording.colour = Some(Box::new(TarPictures {
            path: tar.path,
            members: pictures.into_iter().map(|(_, member)| member).collect(),
            times,
        }));
    } else {
        let times = tar.frames.keys().filter_map(|number| time(*number));
        let (first, last) = (times.clone().min(), times.max());
        recording.span = first.zip(last.map(|last| last.saturating_add(SECOND / 30)));
        recording.notes.push(format!(
            "its frames have no `image_{stream}.jpg`: no pictures"
        ));
    }
    Ok(recording)
}

/// Frames are taken 30 times a second, and their times have a jitter of some microseconds, by which nothing moves: a frame counts at
/// its tick. One that is far from every tick keeps its own time.
fn on_grid(first: i64, time: i64) -> i64 {
    let nearest = ((time.saturating_sub(first)) as f64 * 30.0 / SECOND as f64).round() as i64;
    let ticked = first.saturating_add(tick(nearest));
    if ticked.abs_diff(time) < JITTER {
        ticked
    } else {
        time
    }
}

fn mounted(calibration: &Calibration) -> Result<MountedCamera, String> {
    if !calibration.projection_model_type.ends_with("FISHEYE624") {
        let kind = calibration.projection_model_type.escape_default();
        return Err(format!("projection `{kind}` is not FISHEYE624"));
    }
    let lens = Fisheye624::from_parameters(&calibration.projection_params)
        .ok_or("parameters that are no lens")?;
    if calibration.image_width == 0 || calibration.image_height == 0 {
        return Err("pictures without pixels".to_owned());
    }
    Ok(MountedCamera {
        camera: Camera {
            lens: Lens::Fisheye624(lens),
            width: calibration.image_width,
            height: calibration.image_height,
            valid_radius: None,
        },
        // Poses are of this camera itself.
        T_device_camera: Isometry3::identity(),
    })
}

fn hands(
    tar: &Tar,
    time: &dyn Fn(u32) -> Option<i64>,
    mano: Option<&Mano>,
    model: HandModel,
    recording: &mut Recording,
) -> Result<(), ReadError> {
    let Some(shapes) = tar.shapes else {
        recording.notes.push(
            "there are no hands: no `__hand_shapes.json__` (clips of the test have none)"
                .to_owned(),
        );
        return Ok(());
    };
    let place = Position::Offset(shapes.offset);
    let shapes: Shapes = tar.json(shapes, SHAPES)?;
    let profile = shapes
        .umetrack
        .as_ref()
        .map(HandProfile::from_json)
        .transpose()
        .map_err(|reason| {
            ReadError::malformed(&tar.path, place, format!("`{SHAPES}`: umetrack: {reason}"))
        })?;
    let betas: Option<[f64; SHAPE]> = shapes
        .mano
        .and_then(|betas| betas.get(..SHAPE)?.try_into().ok());
    let use_mano = match model {
        HandModel::Auto => profile.is_none(),
        HandModel::Umetrack => false,
        HandModel::Mano => true,
    };
    if use_mano && mano.is_none() {
        recording.notes.push(mano::absent("as asked for they are"));
        return Ok(());
    }
    let mut samples: [Vec<(i64, Joints)>; 2] = Default::default();
    for (number, frame) in &tar.frames {
        let (Some(member), Some(time)) = (frame.hands, time(*number)) else {
            continue;
        };
        let name = format!("{number:06}.hands.json");
        let hands: Hands = tar.json(member, &name)?;
        for (side, hand) in [hands.left, hands.right].into_iter().enumerate() {
            let Some(hand) = hand else { continue };
            let joints = if use_mano {
                mano.zip(betas)
                    .and_then(|(mano, betas)| by_mano(mano, side, betas, &hand.mano_pose?))
            } else {
                let pose = hand.umetrack_pose;
                profile
                    .as_ref()
                    .zip(pose)
                    .and_then(|(profile, pose)| by_umetrack(profile, side, &pose))
            };
            if let Some(joints) = joints {
                samples[side].push((time, joints));
            }
        }
    }
    if let (true, Some(mano)) = (use_mano, mano) {
        recording
            .notes
            .extend((0..2).filter_map(|side| mano.note(side)));
    }
    if samples.iter().all(Vec::is_empty) {
        recording
            .notes
            .push("there are no hands: no pose in its `hands.json`".to_owned());
    }
    recording.hands =
        samples.map(|samples| (!samples.is_empty()).then(|| Track::new(samples, MAX_GAP, HOLD)));
    Ok(())
}

fn by_umetrack(profile: &HandProfile, side: usize, pose: &UmetrackPose) -> Option<Joints> {
    let angles: &[f64; ANGLES] = pose.joint_angles.get(..ANGLES)?.try_into().ok()?;
    let wrist = pose.wrist()?;
    let finite = angles.iter().chain(wrist.iter()).all(|v| v.is_finite());
    finite.then(|| profile.joints(&wrist, angles, side == 1))
}

fn by_mano(
    mano: &Mano,
    side: usize,
    betas: [f64; SHAPE],
    parameters: &ManoParameters,
) -> Option<Joints> {
    let [a, b, c, x, y, z] = parameters.wrist_xform;
    let pose = ManoPose {
        shape: betas,
        orientation: [a, b, c],
        fingers: FingerPose::Components(&parameters.thetas),
        translation: [x, y, z],
    };
    Some(mano::joints(mano.hand(side)?, &pose, &Convention::SMPLX))
}
