//! ARCTIC: two hands with articulated objects, seen by a head camera among eight others.
//!
//! Below the content of `arctic_data/data`: `images/<subject>/<sequence>/0/%05d.jpg` (view 0 is the head camera, 2800x2000) or
//! `cropped_images/` (the same scaled by 0.3), `raw_seqs/<subject>/<sequence>.{egocam.dist,mano}.npy`, `meta/misc.json`, and the
//! processed `splits/*.npy`. Picture `n` belongs to row `n - ioi_offset` of the labels; pictures before and after them are left out.
//!
//! The camera comes from `raw_seqs`, else from the splits. Hands come from the MANO parameters in `raw_seqs` where the user's models are
//! given, else from the splits, whose joints need no model. The lens is wide: `undistort` makes pinhole pictures of it. Which way is up
//! is not documented.

mod splits;

use super::ReadError;
use super::dataset::Recordings;
use super::files::{PictureFiles, numbered, picture_size, tick};
use super::mano::{self, Mano};
use super::recording::{CutSettings, JointFrame, MountedCamera, Recording};
use super::track::{Joints, SECOND, Track};
use crate::formats::npy::NpyArray;
use crate::formats::pickle::{Id, Pickle};
use crate::formats::read_error::Position;
use crate::geometry::camera::{Camera, Lens, Rational};
use crate::geometry::mano::{Convention, FingerPose, ManoModel, ManoPose, SHAPE};
use crate::geometry::rigid::{self, PoseError};
use nalgebra::Isometry3;
use ndarray::{Ix2, Ix3};
use splits::{Split, Splits};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Frames are 33 ms apart, and each is its own sample: a missing one is missing.
const MAX_GAP: i64 = SECOND / 25;
const HOLD: i64 = SECOND / 100;
/// The size of the head camera's pictures where `misc.json` does not say it.
const SIZE: (u32, u32) = (2800, 2000);

/// What `meta/misc.json` says of a subject.
#[derive(Debug, Clone, serde::Deserialize)]
struct Subject {
    ioi_offset: i64,
    /// Of each view, the head camera first.
    #[serde(default)]
    image_size: Vec<[u32; 2]>,
}

/// The whole data set: what its recordings share.
struct Arctic {
    root: PathBuf,
    subjects: BTreeMap<String, Subject>,
    mano: Option<Mano>,
    splits: Splits,
}

/// Opens the sequences below `root`.
///
/// # Errors
/// When there is none, or not one can be opened.
pub fn source(
    root: &Path,
    settings: CutSettings,
    mano: Option<&Path>,
) -> Result<Recordings, ReadError> {
    let absent = || {
        ReadError::absent(
            root,
            "there are no sequences of ARCTIC here (`cropped_images/<subject>/<sequence>/0`, `raw_seqs`, `meta/misc.json`)",
        )
    };
    let root = ["", "data", "arctic_data/data", "unpack/arctic_data/data"]
        .iter()
        .map(|inside| root.join(inside))
        .find(|root| root.join("meta/misc.json").is_file())
        .ok_or_else(absent)?;
    let names = sequences(&root)?;
    if names.is_empty() {
        return Err(absent());
    }
    let path = root.join("meta/misc.json");
    let text = std::fs::read(&path).map_err(|cause| ReadError::io(&path, cause))?;
    let subjects = serde_json::from_slice(&text).map_err(|error| {
        let line = Position::Line(error.line() as u64);
        ReadError::malformed(&path, line, error.to_string())
    })?;
    let mano = mano.map(Mano::open).transpose()?;
    // The splits have gigabytes: they are looked through only where they are needed.
    let raw = |name: &String, kind: &str| root.join("raw_seqs").join(format!("{name}.{kind}.npy"));
    let enough = mano.is_some()
        && names
            .iter()
            .all(|name| raw(name, "egocam.dist").is_file() && raw(name, "mano").is_file());
    let splits = if enough {
        Splits::default()
    } else {
        Splits::index(&root.join("splits"))?
    };
    let set = Arctic {
        root,
        subjects,
        mano,
        splits,
    };
    let paths = names.iter().map(PathBuf::from).collect();
    Recordings::new("arctic", paths, settings, move |name, _| {
        set.open(&name.to_string_lossy())
    })
}

/// `<subject>/<sequence>` of everything that has pictures or raw labels.
fn sequences(root: &Path) -> Result<Vec<String>, ReadError> {
    let mut names = BTreeSet::new();
    let list = |folder: &Path| -> Result<Vec<PathBuf>, ReadError> {
        if !folder.is_dir() {
            return Ok(Vec::new());
        }
        let fail = |cause| ReadError::io(folder, cause);
        let entries = std::fs::read_dir(folder).map_err(fail)?;
        entries
            .map(|entry| entry.map(|entry| entry.path()).map_err(fail))
            .collect()
    };
    let name = |path: &Path| {
        path.file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    for kind in ["cropped_images", "images", "raw_seqs"] {
        for subject in list(&root.join(kind))?.iter().filter(|path| path.is_dir()) {
            for inside in list(subject)? {
                let sequence = name(&inside);
                match sequence.strip_suffix(".egocam.dist.npy") {
                    Some(sequence) => names.insert(format!("{}/{sequence}", name(subject))),
                    None if inside.join("0").is_dir() => {
                        names.insert(format!("{}/{sequence}", name(subject)))
                    }
                    None => false,
                };
            }
        }
    }
    Ok(names.into_iter().collect())
}

impl Arctic {
    fn open(&self, name: &str) -> Result<Recording, ReadError> {
        let mut recording = Recording::new("arctic", name);
        let subject = name.split('/').next().unwrap_or(name);
        let facts = self.subjects.get(subject).ok_or_else(|| {
            ReadError::missing(
                &self.root.join("meta/misc.json"),
                format!("it says nothing of subject `{subject}`"),
            )
        })?;
        let raw = |kind: &str| {
            self.root
                .join("raw_seqs")
                .join(format!("{name}.{kind}.npy"))
        };
        let split = self.splits.get(name);
        let (egocam, parameters) = (raw("egocam.dist"), raw("mano"));
        let head = if egocam.is_file() {
            head_camera(&egocam)?
        } else if let Some(split) = split {
            split.head_camera()?
        } else {
            return Err(ReadError::missing(
                &egocam,
                "there is no camera: neither this file nor the sequence in `splits/*.npy`",
            ));
        };
        let rows = head.poses.len();
        let samples = head.poses.iter().enumerate();
        let samples = samples.filter_map(|(row, pose)| Some((tick(row as i64), (*pose)?)));
        recording.device = Some(Track::new(samples.collect(), MAX_GAP, HOLD));
        recording.span = Some((0, tick(rows as i64)));
        recording.cameras = vec![(0, MountedCamera::without_lens())];
        self.colour(name, facts, &head, rows, &mut recording)?;
        self.hands(&parameters, split, rows, &mut recording)?;
        Ok(recording)
    }

    fn colour(
        &self,
        name: &str,
        facts: &Subject,
        head: &HeadCamera,
        rows: usize,
        recording: &mut Recording,
    ) -> Result<(), ReadError> {
        let folder = ["images", "cropped_images"]
            .iter()
            .map(|kind| self.root.join(kind).join(name).join("0"))
            .find(|folder| folder.is_dir());
        let labelled: Vec<(i64, PathBuf)> = match &folder {
            Some(folder) => numbered(folder, &["jpg", "jpeg", "png"])?
                .into_iter()
                .map(|(number, path)| (i64::from(number) - facts.ioi_offset, path))
                .filter(|(row, _)| (0..rows as i64).contains(row))
                .collect(),
            None => Vec::new(),
        };
        let Some((_, first)) = labelled.first() else {
            recording.notes.push(
                "there are no pictures with labels below `cropped_images` or `images`".to_owned(),
            );
            return Ok(());
        };
        let (width, height) = picture_size(first)?;
        let size = facts.image_size.first().map_or(SIZE, |[w, h]| (*w, *h));
        if let Some(lens) = head.lens
            && size.0 > 0
            && size.1 > 0
        {
            let camera = Camera {
                lens: Lens::Rational(lens),
                width: size.0,
                height: size.1,
                valid_radius: None,
            };
            recording.cameras = vec![(
                0,
                MountedCamera {
                    camera: camera.resized_to(width, height),
                    T_device_camera: Isometry3::identity(),
                },
            )];
        } else {
            recording
                .notes
                .push("the lens of the head camera is not known".to_owned());
        }
        if labelled.len() < rows {
            recording
                .notes
                .push("there are fewer pictures than rows of labels".to_owned());
        }
        let (rows, files): (Vec<i64>, Vec<PathBuf>) = labelled.into_iter().unzip();
        recording.colour = Some(Box::new(PictureFiles {
            files,
            times: rows.into_iter().map(tick).collect(),
        }));
        Ok(())
    }

    fn hands(
        &self,
        parameters: &Path,
        split: Option<&Split>,
        rows: usize,
        recording: &mut Recording,
    ) -> Result<(), ReadError> {
        if let (Some(mano), true) = (&self.mano, parameters.is_file()) {
            let pickle = Pickle::open(parameters)?;
            for (side, key) in ["left", "right"].into_iter().enumerate() {
                let Some(hand) = pickle.get(pickle.root(), key) else {
                    recording.notes.push(format!(
                        "there is no {key} hand in `{}`",
                        parameters.display()
                    ));
                    continue;
                };
                match mano.hand(side) {
                    Some(model) => {
                        let joints = from_mano(&pickle, hand, key, parameters, model)?;
                        recording.notes.extend(fewer(key, joints.len(), rows));
                        recording.hands[side] = Some(Track::new(joints, MAX_GAP, HOLD));
                    }
                    None => recording.notes.extend(mano.note(side)),
                }
            }
        } else if let Some(split) = split {
            recording.hands_frame = JointFrame::Camera;
            for (side, joints) in split.hands()?.into_iter().enumerate() {
                let key = ["left", "right"][side];
                match &joints {
                    Some(joints) => recording.notes.extend(fewer(key, joints.len(), rows)),
                    None => recording.notes.push(format!(
                        "there is no {key} hand of the sequence in `splits`"
                    )),
                }
                recording.hands[side] = joints.map(|joints| Track::new(joints, MAX_GAP, HOLD));
            }
        } else if parameters.is_file() {
            recording.notes.push(format!(
                "{}; or supply `splits/*.npy`, whose joints need no model",
                mano::absent("in `raw_seqs` they are")
            ));
        } else {
            recording.notes.push(
                "there are no hands: neither in `raw_seqs` nor in `splits` (the labels of the test are hidden)"
                    .to_owned(),
            );
        }
        recording.notes.extend(self.splits.notes());
        Ok(())
    }
}

/// What to say of a hand with fewer rows than the camera.
fn fewer(hand: &str, found: usize, rows: usize) -> Option<String> {
    (found < rows).then(|| format!("the {hand} hand has fewer rows than the camera"))
}

/// The head camera of a sequence.
struct HeadCamera {
    /// `T_world_camera`, nothing where it is not finite.
    poses: Vec<Option<Isometry3<f64>>>,
    /// For pictures of full size.
    lens: Option<Rational>,
}

/// Numbers below a key of a pickle, with the file and the key in every error.
fn array(pickle: &Pickle, id: Id, key: &str, path: &Path) -> Result<NpyArray, ReadError> {
    let wrong =
        |reason: String| ReadError::malformed(path, Position::File, format!("`{key}`: {reason}"));
    let found = pickle
        .get(id, key)
        .ok_or_else(|| wrong("it is not there".to_owned()))?;
    pickle.numbers(found).map_err(wrong)?.read()
}

fn head_camera(path: &Path) -> Result<HeadCamera, ReadError> {
    let pickle = Pickle::open(path)?;
    let root = pickle.root();
    let get = |key: &str| array(&pickle, root, key, path);
    let (rotations, positions) = (get("R_k_cam_np")?, get("T_k_cam_np")?);
    let rotations = dimensions::<Ix3>(&rotations, path, "R_k_cam_np")?;
    let count = rotations.shape()[0];
    if rotations.shape() != [count, 3, 3] || positions.len() != 3 * count {
        return Err(ReadError::malformed(
            path,
            Position::File,
            format!(
                "rotations of shape {:?} and positions of shape {:?}",
                rotations.shape(),
                positions.shape
            ),
        ));
    }
    let positions = flat(&positions, path, "T_k_cam_np")?;
    let mut poses = Vec::with_capacity(count);
    for (row, rotation) in rotations.outer_iter().enumerate() {
        let matrix = std::array::from_fn(|k| match (k / 4, k % 4) {
            (3, column) => f64::from(u8::from(column == 3)),
            (i, 3) => positions[3 * row + i],
            (i, j) => rotation[[i, j]],
        });
        poses.push(inverse(path, row, &matrix)?);
    }
    let intrinsics = flat(&get("intrinsics")?, path, "intrinsics")?;
    let distortion = match pickle.get(root, "dist8") {
        Some(_) => flat(&get("dist8")?, path, "dist8")?,
        None => vec![0.0; 8],
    };
    Ok(HeadCamera {
        poses,
        lens: lens(&intrinsics, &distortion),
    })
}

/// `T_world_camera` of a world-to-camera matrix, row by row.
fn inverse(
    path: &Path,
    row: usize,
    matrix: &[f64; 16],
) -> Result<Option<Isometry3<f64>>, ReadError> {
    match rigid::from_row_major(matrix) {
        Ok(T_camera_world) => Ok(Some(T_camera_world.inverse())),
        Err(PoseError::NotFinite) => Ok(None),
        Err(error) => Err(ReadError::malformed(
            path,
            Position::Frame(row as u64),
            error.to_string(),
        )),
    }
}

/// A 3x3 matrix and eight distortion terms; nothing where they are no lens.
fn lens(intrinsics: &[f64], distortion: &[f64]) -> Option<Rational> {
    let &[fx, _, cx, _, fy, cy, ..] = intrinsics else {
        return None;
    };
    let distortion: [f64; 8] = distortion.get(..8)?.try_into().ok()?;
    let finite = [fx, fy, cx, cy]
        .iter()
        .chain(&distortion)
        .all(|v| v.is_finite());
    (finite && fx > 0.0 && fy > 0.0).then_some(Rational {
        fx,
        fy,
        cx,
        cy,
        distortion,
    })
}

fn flat(array: &NpyArray, path: &Path, key: &str) -> Result<Vec<f64>, ReadError> {
    let values = array
        .to::<f64>()
        .map_err(|error| ReadError::malformed(path, Position::File, format!("`{key}`: {error}")))?;
    Ok(values.into_raw_vec_and_offset().0)
}

fn dimensions<D: ndarray::Dimension>(
    array: &NpyArray,
    path: &Path,
    key: &str,
) -> Result<ndarray::Array<f64, D>, ReadError> {
    array
        .to_dim::<f64, D>()
        .map_err(|error| ReadError::malformed(path, Position::File, format!("`{key}`: {error}")))
}

/// World joints by `smplx`, mean pose added, the left hand's shape as released.
fn from_mano(
    pickle: &Pickle,
    hand: Id,
    side: &str,
    path: &Path,
    model: &ManoModel,
) -> Result<Vec<(i64, Joints)>, ReadError> {
    let get = |key: &str| array(pickle, hand, key, path);
    let orientations = dimensions::<Ix2>(&get("rot")?, path, "rot")?;
    let poses = dimensions::<Ix2>(&get("pose")?, path, "pose")?;
    let translations = dimensions::<Ix2>(&get("trans")?, path, "trans")?;
    let shape = flat(&get("shape")?, path, "shape")?;
    let count = orientations.nrows();
    let fits = orientations.shape() == [count, 3]
        && poses.shape() == [count, 45]
        && translations.shape() == [count, 3]
        && shape.len() >= SHAPE;
    if !fits {
        return Err(ReadError::malformed(
            path,
            Position::File,
            format!(
                "the {side} hand has `rot` {:?}, `pose` {:?}, `trans` {:?} and `shape` [{}]",
                orientations.shape(),
                poses.shape(),
                translations.shape(),
                shape.len()
            ),
        ));
    }
    Ok((0..count)
        .map(|row| {
            let fingers = std::array::from_fn(|k| poses[[row, k]]);
            let pose = ManoPose {
                shape: std::array::from_fn(|k| shape[k]),
                orientation: std::array::from_fn(|k| orientations[[row, k]]),
                fingers: FingerPose::AxisAngle(&fingers),
                translation: std::array::from_fn(|k| translations[[row, k]]),
            };
            let joints = mano::joints(model, &pose, &Convention::SMPLX);
            (tick(row as i64), joints)
        })
        .collect())
}
