//! H2O: two hands and objects at a table, seen by a helmet camera (`cam4`) with depth.
//!
//! `subjectN/<kind>/<clip>/cam4/` holds pictures, 16-bit depth in millimetres along the axis, and one small text file per frame:
//! `cam_pose` (4x4 camera-to-world, row by row), `hand_pose` (for the left and then the right hand a flag and 21 joints in the camera,
//! metres, wrist first, thumb to pinky) and `hand_pose_MANO`. Frames are numbered and 1/30 s apart. Which way is up is not
//! documented: the world is that of a calibration board.

use super::ReadError;
use super::dataset::{Recordings, find};
use super::files::{DepthFiles, PictureFiles, numbered, picture_size, tick};
use super::mano::{self, Mano};
use super::recording::{CutSettings, JointFrame, MountedCamera, Recording};
use super::track::{Joints, SECOND, Track};
use crate::formats::read_error::Position;
use crate::geometry::camera::{Camera, Lens, Pinhole};
use crate::geometry::mano::{Convention, FingerPose, ManoPose};
use crate::geometry::rigid::{self, PoseError};
use crate::geometry::skeleton::HAND_FROM_COMMON;
use nalgebra::{Isometry3, Point3};
use std::path::Path;

/// Frames are 33 ms apart, and each is its own sample: a missing one is missing.
const MAX_GAP: i64 = SECOND / 25;
const HOLD: i64 = SECOND / 100;
/// A flag and 21 joints.
const HAND: usize = 1 + 21 * 3;
/// A flag, translation, orientation and pose, shape.
const HAND_MANO: usize = 1 + 3 + 48 + 10;

/// Opens the recordings at or below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(
    root: &Path,
    settings: CutSettings,
    mano: Option<&Path>,
) -> Result<Recordings, ReadError> {
    let folders = find(
        root,
        "recording of H2O (a folder `cam4` with `cam_pose`)",
        is_recording,
    )?;
    let mano = mano.map(Mano::open).transpose()?;
    Recordings::new("h2o", folders, settings, move |folder, _| {
        open(folder, mano.as_ref())
    })
}

/// Whether a folder is the helmet camera of a recording.
#[must_use]
pub fn is_recording(folder: &Path) -> bool {
    folder.file_name().is_some_and(|name| name == "cam4") && folder.join("cam_pose").is_dir()
}

/// `subject3/k2/0`, as far as the folder's path tells.
fn name_of(folder: &Path) -> String {
    let whole = std::fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
    let mut parts: Vec<String> = whole
        .iter()
        .rev()
        .skip(1)
        .take(3)
        .map(|part| part.to_string_lossy().into_owned())
        .collect();
    parts.reverse();
    parts.join("/")
}

fn open(folder: &Path, mano: Option<&Mano>) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("h2o", &name_of(folder));
    let poses = numbered(&folder.join("cam_pose"), &["txt"])?;
    let (Some((first, _)), Some((last, _))) = (poses.first(), poses.last()) else {
        return Err(ReadError::missing(
            &folder.join("cam_pose"),
            "there are no poses in it",
        ));
    };
    recording.span = Some((tick((*first).into()), tick(i64::from(*last) + 1)));
    let mut samples = Vec::with_capacity(poses.len());
    for (number, path) in &poses {
        if let Some(pose) = pose(path)? {
            samples.push((tick((*number).into()), pose));
        }
    }
    recording.device = Some(Track::new(samples, MAX_GAP, HOLD));
    recording.cameras = vec![(0, MountedCamera::without_lens())];

    let pictures = ["rgb", "rgb256"]
        .iter()
        .map(|name| folder.join(name))
        .find(|pictures| pictures.is_dir());
    match pictures {
        Some(pictures) => colour(&pictures, folder, poses.len(), &mut recording)?,
        None => recording
            .notes
            .push("there is no `rgb` and no `rgb256`: no pictures".to_owned()),
    }
    let depth = folder.join("depth");
    if depth.is_dir() {
        let (numbers, files): (Vec<u32>, Vec<_>) = numbered(&depth, &["png"])?.into_iter().unzip();
        if files.is_empty() {
            recording
                .notes
                .push("there are no pictures of depth in `depth`: no depth".to_owned());
        } else if recording.colour.is_none() {
            recording
                .notes
                .push("depth is left out: it has no pictures to go with".to_owned());
        } else {
            recording.depth = Some(Box::new(DepthFiles {
                times: numbers.into_iter().map(|k| tick(k.into())).collect(),
                files,
                metres_per_unit: 1e-3,
            }));
        }
    } else {
        recording
            .notes
            .push("there is no `depth`: no depth".to_owned());
    }
    hands(folder, mano, poses.len(), &mut recording)?;
    Ok(recording)
}

fn colour(
    pictures: &Path,
    folder: &Path,
    poses: usize,
    recording: &mut Recording,
) -> Result<(), ReadError> {
    let (numbers, files): (Vec<u32>, Vec<_>) = numbered(pictures, &["png", "jpg", "jpeg"])?
        .into_iter()
        .unzip();
    let Some(first) = files.first() else {
        recording
            .notes
            .push("its folder of pictures is empty".to_owned());
        return Ok(());
    };
    if files.len() < poses {
        recording
            .notes
            .push("there are fewer pictures than poses in `cam_pose`".to_owned());
    }
    let intrinsics = folder.join("cam_intrinsics.txt");
    if intrinsics.is_file() {
        let (width, height) = picture_size(first)?;
        let camera = lens(&intrinsics)?.resized_to(width, height);
        recording.cameras = vec![(
            0,
            MountedCamera {
                camera,
                T_device_camera: Isometry3::identity(),
            },
        )];
    } else {
        recording
            .notes
            .push("there is no `cam_intrinsics.txt`: the lens is not known".to_owned());
    }
    recording.colour = Some(Box::new(PictureFiles {
        times: numbers.into_iter().map(|k| tick(k.into())).collect(),
        files,
    }));
    Ok(())
}

/// The numbers in the first line of a file.
fn numbers(path: &Path, count: usize) -> Result<Vec<f64>, ReadError> {
    let wrong = |reason: String| ReadError::malformed(path, Position::Line(1), reason);
    let bytes = std::fs::read(path).map_err(|cause| ReadError::io(path, cause))?;
    let text = std::str::from_utf8(&bytes).map_err(|_| wrong("not text (UTF-8)".to_owned()))?;
    let line = text.lines().next().unwrap_or("");
    let mut numbers = Vec::with_capacity(count);
    for word in line.split_ascii_whitespace() {
        let number: f64 = word
            .parse()
            .map_err(|_| wrong(format!("`{}` is not a number", word.escape_default())))?;
        numbers.push(number);
    }
    if numbers.len() != count {
        return Err(wrong(format!(
            "{} numbers instead of {count}",
            numbers.len()
        )));
    }
    Ok(numbers)
}

/// `T_world_camera`; nothing where it is not finite.
fn pose(path: &Path) -> Result<Option<Isometry3<f64>>, ReadError> {
    let numbers = numbers(path, 16)?;
    match rigid::from_row_major(&std::array::from_fn(|k| numbers[k])) {
        Ok(pose) => Ok(Some(pose)),
        Err(PoseError::NotFinite) => Ok(None),
        Err(error) => Err(ReadError::malformed(
            path,
            Position::Line(1),
            error.to_string(),
        )),
    }
}

fn lens(path: &Path) -> Result<Camera, ReadError> {
    let numbers = numbers(path, 6)?;
    let wrong = || ReadError::malformed(path, Position::Line(1), "numbers that are no lens");
    let side = |value: f64| ((1.0..=65536.0).contains(&value)).then_some(value.round() as u32);
    let &[fx, fy, cx, cy, width, height] = numbers.as_slice() else {
        return Err(wrong());
    };
    let (Some(width), Some(height)) = (side(width), side(height)) else {
        return Err(wrong());
    };
    if !(numbers.iter().all(|v| v.is_finite()) && fx > 0.0 && fy > 0.0) {
        return Err(wrong());
    }
    Ok(Camera {
        lens: Lens::Pinhole(Pinhole { fx, fy, cx, cy }),
        width,
        height,
        valid_radius: None,
    })
}

/// Joints of both hands in the camera: as they are written, else from their MANO parameters.
fn hands(
    folder: &Path,
    mano: Option<&Mano>,
    poses: usize,
    recording: &mut Recording,
) -> Result<(), ReadError> {
    let mut samples: [Vec<(i64, Joints)>; 2] = Default::default();
    let mut files = None;
    let (joints, parameters) = (folder.join("hand_pose"), folder.join("hand_pose_MANO"));
    if joints.is_dir() {
        let found = numbered(&joints, &["txt"])?;
        files = Some(("hand_pose", found.len()));
        for (number, path) in found {
            let numbers = numbers(&path, 2 * HAND)?;
            for (samples, hand) in samples.iter_mut().zip(numbers.chunks_exact(HAND)) {
                samples.push((tick(number.into()), written(hand)));
            }
        }
    } else if let (true, Some(mano)) = (parameters.is_dir(), mano) {
        let found = numbered(&parameters, &["txt"])?;
        files = Some(("hand_pose_MANO", found.len()));
        for (number, path) in found {
            let numbers = numbers(&path, 2 * HAND_MANO)?;
            for (side, hand) in numbers.chunks_exact(HAND_MANO).enumerate() {
                samples[side].push((tick(number.into()), from_mano(hand, mano, side)));
            }
        }
        for side in [0, 1] {
            recording.notes.extend(mano.note(side));
            if mano.hand(side).is_none() {
                samples[side].clear();
            }
        }
    } else if parameters.is_dir() {
        recording
            .notes
            .push(mano::absent("without `hand_pose` they are"));
    } else {
        recording.notes.push(
            "there is no `hand_pose`: no hands (subject 4 has none, it is the test)".to_owned(),
        );
    }
    match files {
        Some((name, 0)) => recording
            .notes
            .push(format!("there are no files in `{name}`: no hands")),
        Some((name, count)) if count < poses => recording.notes.push(format!(
            "there are fewer files in `{name}` than poses in `cam_pose`"
        )),
        _ => {}
    }
    recording.hands_frame = JointFrame::Camera;
    recording.hands =
        samples.map(|samples| (!samples.is_empty()).then(|| Track::new(samples, MAX_GAP, HOLD)));
    Ok(())
}

/// A flag and 21 joints in the common order.
fn written(hand: &[f64]) -> Joints {
    HAND_FROM_COMMON.map(|joint| {
        let p = &hand[1 + 3 * joint..4 + 3 * joint];
        let there = hand[0] != 0.0 && p.iter().all(|v| v.is_finite());
        there.then(|| Point3::new(p[0], p[1], p[2]))
    })
}

fn from_mano(hand: &[f64], mano: &Mano, side: usize) -> Joints {
    let (Some(model), Some(fingers)) = (mano.hand(side), mano::finger_pose(&hand[7..52])) else {
        return [None; 21];
    };
    if hand[0] == 0.0 {
        return [None; 21];
    }
    let pose = ManoPose {
        shape: std::array::from_fn(|k| hand[52 + k]),
        orientation: std::array::from_fn(|k| hand[4 + k]),
        fingers: FingerPose::AxisAngle(fingers),
        translation: std::array::from_fn(|k| hand[1 + k]),
    };
    mano::joints(model, &pose, &Convention::manopth(side == 1))
}
