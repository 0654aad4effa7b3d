//! TACO: tools and objects in two hands, seen by a head camera with depth.
//!
//! A sequence `<triplet>/<sequence>` (`(brush, brush, box)/20230926_012`) has a folder below each of `Egocentric_RGB_Videos` (`color.mp4`),
//! `Egocentric_Depth_Videos` (`egocentric_depth.avi`, 16 bits, a quarter of a millimetre), `Egocentric_Camera_Parameters` (intrinsics,
//! world-to-camera poses) and `Hand_Poses` (MANO parameters as torch tensors in pickles). Everything is frame by frame at 30 Hz; a sequence
//! whose counts differ is left out, as the official code does. The world is z-up.
//!
//! Hands come from the user's MANO models, or without them from `hand_joints.npz` beside the pickles (`left`, `right` `[N, 21, 3]`,
//! metres, world, the order of `manopth`), which docs/guide/data.md tells how to write.

use super::ReadError;
use super::dataset::Recordings;
use super::egom2p;
use super::files::{metres, tick};
use super::mano::{self, Mano};
use super::recording::{CutSettings, DepthFrames, MountedCamera, Recording};
use super::track::{Joints, SECOND, Track};
use super::video_frames::Frames;
use crate::formats::npz::Npz;
use crate::formats::pickle::{Id, Pickle};
use crate::formats::read_error::Position;
use crate::geometry::camera::{Camera, Lens, Pinhole};
use crate::geometry::mano::{Convention, FingerPose, ManoModel, ManoPose, SHAPE};
use crate::geometry::skeleton::HAND_FROM_COMMON;
use crate::video::Video;
use crate::video::grey16::Grey16Video;
use nalgebra::{Isometry3, Point3, Vector3};
use ndarray::{Array2, Ix3};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const COLOUR: &str = "Egocentric_RGB_Videos";
const DEPTH: &str = "Egocentric_Depth_Videos";
const CAMERA: &str = "Egocentric_Camera_Parameters";
const HANDS: &str = "Hand_Poses";
/// The sequences of the first release that have egocentric data.
const LIST: &str = "v1_egocentric_data_available_sequences.txt";
const METRES_PER_UNIT: f32 = 1.0 / 4000.0;
/// Frames are 33 ms apart, and each is its own sample: a missing one is missing.
const MAX_GAP: i64 = SECOND / 25;
const HOLD: i64 = SECOND / 100;

/// Opens the sequences below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(
    root: &Path,
    settings: CutSettings,
    mano: Option<&Path>,
) -> Result<Recordings, ReadError> {
    let names = sequences(root)?;
    if names.is_empty() {
        return Err(ReadError::absent(
            root,
            format!(
                "there are no sequences of TACO here (`{COLOUR}/<triplet>/<sequence>/color.mp4`)"
            ),
        ));
    }
    let mano = mano.map(Mano::open).transpose()?;
    let base = root.to_owned();
    let paths = names.iter().map(PathBuf::from).collect();
    Recordings::new("taco", paths, settings, move |name, _| {
        open(&base, name, mano.as_ref())
    })
}

/// `<triplet>/<sequence>` of everything that has pictures or a camera, without what the list of the release leaves out.
fn sequences(root: &Path) -> Result<Vec<String>, ReadError> {
    let mut names = BTreeSet::new();
    for kind in [COLOUR, CAMERA] {
        for triplet in folders(&root.join(kind))? {
            for sequence in folders(&root.join(kind).join(&triplet))? {
                names.insert(format!("{triplet}/{sequence}"));
            }
        }
    }
    let list = root.join(LIST);
    if list.is_file() {
        let text = std::fs::read_to_string(&list).map_err(|cause| ReadError::io(&list, cause))?;
        let listed = |name: &&String| {
            name.split_once('/').is_some_and(|(triplet, sequence)| {
                text.lines()
                    .any(|line| line.contains(triplet) && line.contains(sequence))
            })
        };
        let kept: Vec<String> = names.iter().filter(listed).cloned().collect();
        // A list that names nothing that is here is that of another part.
        if !kept.is_empty() {
            return Ok(kept);
        }
    }
    Ok(names.into_iter().collect())
}

/// The folders in a folder; none where it is not there.
fn folders(folder: &Path) -> Result<Vec<String>, ReadError> {
    let fail = |cause| ReadError::io(folder, cause);
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        let entry = entry.map_err(fail)?;
        if entry.path().is_dir() {
            names.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    names.sort();
    Ok(names)
}

fn open(root: &Path, name: &Path, mano: Option<&Mano>) -> Result<Recording, ReadError> {
    let mut recording = Recording::new("taco", &name.to_string_lossy());
    recording.up_world = Some(Vector3::z_axis());
    let camera = root.join(CAMERA).join(name);
    let extrinsics = camera.join("egocentric_frame_extrinsic.npy");
    let (poses, count) = poses(&extrinsics)?;
    recording.device = Some(Track::new(poses, MAX_GAP, HOLD));
    recording.cameras = vec![(0, MountedCamera::without_lens())];
    recording.span = Some((0, tick(count as i64)));

    let video = root.join(COLOUR).join(name).join("color.mp4");
    if video.is_file() {
        let video_file = Video::open(&video)?;
        let info = video_file.info().clone();
        if info.frames != count {
            return Err(ReadError::malformed(
                &video,
                Position::File,
                format!(
                    "{} pictures for {count} poses in `{}`: left out, as the official code does",
                    info.frames,
                    extrinsics.display()
                ),
            ));
        }
        let intrinsics = camera.join("egocentric_intrinsic.txt");
        if intrinsics.is_file() {
            recording.cameras = vec![(
                0,
                MountedCamera {
                    camera: lens(&intrinsics, info.width, info.height)?,
                    T_device_camera: Isometry3::identity(),
                },
            )];
        } else {
            recording
                .notes
                .push("there is no `egocentric_intrinsic.txt`: the lens is not known".to_owned());
        }
        recording.colour = Some(Box::new(Frames {
            video: video_file,
            times: (0..count as i64).map(tick).collect(),
        }));
        depth(&root.join(DEPTH).join(name), count, &mut recording);
    } else {
        recording.notes.push(format!(
            "there is no `color.mp4` below `{COLOUR}`: no pictures"
        ));
    }
    hands(&root.join(HANDS).join(name), count, mano, &mut recording)?;
    Ok(recording)
}

/// `T_world_camera` by time in nanoseconds.
type Poses = Vec<(i64, Isometry3<f64>)>;

/// `T_world_camera` where it is finite, and how many rows there are.
fn poses(path: &Path) -> Result<(Poses, usize), ReadError> {
    if !path.is_file() {
        return Err(ReadError::missing(path, "the camera's poses are not there"));
    }
    let array = egom2p::array(path)?
        .to_dim::<f64, Ix3>()
        .map_err(|error| error.in_file(path))?;
    let count = array.shape()[0];
    egom2p::expect(path, array.shape(), &[count.max(1), 4, 4])?;
    let mut samples = Vec::with_capacity(count);
    for (row, matrix) in array.outer_iter().enumerate() {
        if let Some(T_camera_world) = egom2p::pose(path, row, matrix)? {
            samples.push((tick(row as i64), T_camera_world.inverse()));
        }
    }
    Ok((samples, count))
}

/// A 3x3 matrix in a text file, for pictures of this size.
fn lens(path: &Path, width: u32, height: u32) -> Result<Camera, ReadError> {
    let text = std::fs::read_to_string(path).map_err(|cause| ReadError::io(path, cause))?;
    let mut values = Vec::new();
    for (number, line) in text.lines().enumerate() {
        for word in line
            .split([' ', '\t', ',', ';'])
            .filter(|word| !word.is_empty())
        {
            let value: f64 = word.parse().map_err(|_| {
                let word = word.escape_default();
                let line = Position::Line(number as u64 + 1);
                ReadError::malformed(path, line, format!("`{word}` is not a number"))
            })?;
            values.push(value);
        }
    }
    let wrong = || {
        let reason = "not the nine numbers of a pinhole camera";
        ReadError::malformed(path, Position::File, reason)
    };
    let &[fx, _, cx, _, fy, cy, _, _, last] = values.as_slice() else {
        return Err(wrong());
    };
    let fine = values.iter().all(|v| v.is_finite()) && fx > 0.0 && fy > 0.0 && last == 1.0;
    if !fine {
        return Err(wrong());
    }
    Ok(Camera {
        lens: Lens::Pinhole(Pinhole { fx, fy, cx, cy }),
        width,
        height,
        valid_radius: None,
    })
}

/// Depth frame by frame, where the file is there, can be read and has as many frames.
fn depth(folder: &Path, count: usize, recording: &mut Recording) {
    let path = folder.join("egocentric_depth.avi");
    if !path.is_file() {
        recording.notes.push(format!(
            "there is no `egocentric_depth.avi` below `{DEPTH}`: no depth"
        ));
        return;
    }
    match Grey16Video::open(&path) {
        Ok(video) if video.frames == count => {
            recording.depth = Some(Box::new(DepthVideo {
                video,
                times: (0..count as i64).map(tick).collect(),
            }));
        }
        Ok(video) => recording.notes.push(format!(
            "depth is left out: `{}` has {} frames for {count} poses",
            path.display(),
            video.frames
        )),
        Err(error) => recording.notes.push(format!("depth is left out: {error}")),
    }
}

struct DepthVideo {
    video: Grey16Video,
    times: Vec<i64>,
}

impl DepthFrames for DepthVideo {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError> {
        let mut read = None;
        self.read_several(&[index], &mut |metres| read = Some(metres))?;
        read.ok_or_else(|| ReadError::Settings(format!("depth frame {index} was not read")))
    }

    fn read_several(
        &self,
        indices: &[usize],
        each: &mut dyn FnMut(Array2<f32>),
    ) -> Result<(), ReadError> {
        self.video.read(indices, &mut |_, values| {
            each(metres(&values, METRES_PER_UNIT));
        })
    }
}

fn hands(
    folder: &Path,
    count: usize,
    mano: Option<&Mano>,
    recording: &mut Recording,
) -> Result<(), ReadError> {
    let sides = ["left", "right"];
    let parameters = |side: usize| {
        let name = format!("{}_hand", sides[side]);
        let file = folder.join(format!("{name}.pkl"));
        let several = folder.join(&name);
        let shape = folder.join(format!("{name}_shape.pkl"));
        let poses = [file, several].into_iter().find(|path| path.exists())?;
        shape.is_file().then_some((poses, shape))
    };
    let side_file = folder.join("hand_joints.npz");
    if let Some(mano) = mano
        && (0..2).any(|side| parameters(side).is_some())
    {
        for (side, name) in sides.into_iter().enumerate() {
            let Some((poses, shape)) = parameters(side) else {
                recording
                    .notes
                    .push(format!("there is no `{name}_hand.pkl`"));
                continue;
            };
            let Some(model) = mano.hand(side) else {
                recording.notes.extend(mano.note(side));
                continue;
            };
            let joints = from_mano(&poses, &shape, count, model, side)?;
            recording.hands[side] = Some(Track::new(joints, MAX_GAP, HOLD));
        }
    } else if side_file.is_file() {
        for (side, name) in sides.into_iter().enumerate() {
            let joints = exported(&side_file, name, count)?;
            recording.hands[side] = Some(Track::new(joints, MAX_GAP, HOLD));
        }
    } else if (0..2).any(|side| parameters(side).is_some()) {
        recording.notes.push(format!(
            "{}; or write `hand_joints.npz` as docs/guide/data.md says",
            mano::absent("they are")
        ));
    } else {
        recording
            .notes
            .push(format!("there are no hands below `{HANDS}`"));
    }
    Ok(())
}

fn differs(path: &Path, found: usize, count: usize) -> ReadError {
    ReadError::malformed(
        path,
        Position::File,
        format!(
            "{found} hands for {count} poses of the camera: left out, as the official code does"
        ),
    )
}

/// Joints of the side file.
fn exported(path: &Path, name: &str, count: usize) -> Result<Vec<(i64, Joints)>, ReadError> {
    let npz = Npz::read_some(path, &[name])?;
    let array = npz
        .get(name)
        .map_err(|error| error.in_file(path))?
        .to_dim::<f64, Ix3>()
        .map_err(|error| error.in_file(path))?;
    if array.shape()[0] != count {
        return Err(differs(path, array.shape()[0], count));
    }
    egom2p::expect(path, array.shape(), &[count, 21, 3])?;
    Ok(array
        .outer_iter()
        .enumerate()
        .map(|(row, hand)| {
            let joints = HAND_FROM_COMMON.map(|joint| {
                let p = Point3::new(hand[[joint, 0]], hand[[joint, 1]], hand[[joint, 2]]);
                p.coords.iter().all(|v| v.is_finite()).then_some(p)
            });
            (tick(row as i64), joints)
        })
        .collect())
}

/// A hand's parameters at one moment: orientation and fingers, then the wrist in the world.
struct Parameters {
    pose: Vec<f64>,
    wrist: Vec<f64>,
}

fn from_mano(
    poses: &Path,
    shape: &Path,
    count: usize,
    model: &ManoModel,
    side: usize,
) -> Result<Vec<(i64, Joints)>, ReadError> {
    let pickle = Pickle::open(shape)?;
    let betas = values(&pickle, pickle.root(), "hand_shape", shape, SHAPE)?;
    let rows = parameters(poses, count)?;
    let convention = Convention {
        centre_on_wrist: true,
        ..Convention::manopth(side == 1)
    };
    Ok(rows
        .into_iter()
        .map(|(row, parameters)| {
            let joints = match mano::finger_pose(&parameters.pose[3..]) {
                Some(fingers) => mano::joints(
                    model,
                    &ManoPose {
                        shape: std::array::from_fn(|k| betas[k]),
                        orientation: std::array::from_fn(|k| parameters.pose[k]),
                        fingers: FingerPose::AxisAngle(fingers),
                        translation: std::array::from_fn(|k| parameters.wrist[k]),
                    },
                    &convention,
                ),
                None => [None; 21],
            };
            (tick(row as i64), joints)
        })
        .collect())
}

/// The rows of a pickled dictionary, or of a folder of pickles, by their keys or names in the order of text.
fn parameters(path: &Path, count: usize) -> Result<Vec<(usize, Parameters)>, ReadError> {
    let of = |pickle: &Pickle, id: Id, path: &Path| {
        Ok::<_, ReadError>(Parameters {
            pose: values(pickle, id, "hand_pose", path, 48)?,
            wrist: values(pickle, id, "hand_trans", path, 3)?,
        })
    };
    let mut rows: Vec<(String, Parameters)> = Vec::new();
    if path.is_dir() {
        for entry in std::fs::read_dir(path).map_err(|cause| ReadError::io(path, cause))? {
            let file = entry.map_err(|cause| ReadError::io(path, cause))?.path();
            if file.extension().is_some_and(|extension| extension == "pkl") {
                let pickle = Pickle::open(&file)?;
                let name = file.file_stem().unwrap_or_default().to_string_lossy();
                rows.push((name.into_owned(), of(&pickle, pickle.root(), &file)?));
            }
        }
    } else {
        let pickle = Pickle::open(path)?;
        for (key, value) in pickle.pairs(pickle.root()) {
            let key = pickle.text(*key).ok_or_else(|| {
                ReadError::malformed(path, Position::File, "a frame whose name is not text")
            })?;
            rows.push((key.to_owned(), of(&pickle, *value, path)?));
        }
    }
    rows.sort_by(|a, b| a.0.cmp(&b.0));
    if rows.len() == count {
        return Ok(rows
            .into_iter()
            .enumerate()
            .map(|(row, (_, parameters))| (row, parameters))
            .collect());
    }
    // Some are missing in between: those that are there say by their number which frame they are of, counted from 1.
    let found = rows.len();
    let numbered: Option<Vec<(usize, Parameters)>> = rows
        .into_iter()
        .map(|(name, parameters)| {
            let digits = name.trim_start_matches(|c: char| !c.is_ascii_digit());
            let number: usize = digits.parse().ok()?;
            (1..=count)
                .contains(&number)
                .then(|| (number - 1, parameters))
        })
        .collect();
    match numbered {
        Some(rows) if rows.last().is_some_and(|(row, _)| row + 1 == count) => Ok(rows),
        _ => Err(differs(path, found, count)),
    }
}

/// `count` numbers under a key, whatever their shape: a shape is `(10)` in some files and `(1, 10)` in others.
fn values(
    pickle: &Pickle,
    id: Id,
    key: &str,
    path: &Path,
    count: usize,
) -> Result<Vec<f64>, ReadError> {
    let wrong =
        |reason: String| ReadError::malformed(path, Position::File, format!("`{key}`: {reason}"));
    let found = pickle
        .get(id, key)
        .ok_or_else(|| wrong("it is not there".to_owned()))?;
    let array = pickle.numbers(found).map_err(&wrong)?.read()?;
    if array.len() != count {
        return Err(wrong(format!("{} numbers instead of {count}", array.len())));
    }
    let values = array
        .to::<f64>()
        .map_err(|error| wrong(error.to_string()))?;
    Ok(values.into_raw_vec_and_offset().0)
}
