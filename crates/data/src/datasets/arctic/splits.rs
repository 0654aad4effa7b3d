//! ARCTIC's processed splits: pickles of gigabytes, of which only the places of some arrays are remembered.

use super::{HeadCamera, flat, inverse, lens};
use crate::datasets::files::tick;
use crate::datasets::track::Joints;
use crate::formats::ReadError;
use crate::formats::pickle::{Id, Pickle, StoredArray};
use crate::formats::read_error::Position;
use nalgebra::Point3;
use ndarray::{Ix3, Ix4};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Joints by time in nanoseconds.
type Timed = Vec<(i64, Joints)>;

/// What the splits say, by `<subject>/<sequence>`.
#[derive(Debug, Default)]
pub(super) struct Splits {
    sequences: BTreeMap<String, Split>,
    notes: Vec<String>,
}

/// One sequence: where its arrays are.
#[derive(Debug)]
pub(super) struct Split {
    path: PathBuf,
    /// Left and right, `[N, views, 21, 3]`, in the camera of the view; view 0 is the head camera, undistorted.
    joints: [Option<StoredArray>; 2],
    /// `[N, 4, 4]`.
    world2ego: Option<StoredArray>,
    /// `[N, 3, 3]` and `[N, 8]`, or without their first axis.
    intrinsics: Option<StoredArray>,
    distortion: Option<StoredArray>,
}

impl Splits {
    /// Looks through every split; a sequence that is in several counts once.
    pub fn index(folder: &Path) -> Result<Self, ReadError> {
        let mut splits = Splits::default();
        if !folder.is_dir() {
            return Ok(splits);
        }
        let fail = |cause| ReadError::io(folder, cause);
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(fail)? {
            let path = entry.map_err(fail)?.path();
            if path.extension().is_some_and(|extension| extension == "npy") {
                files.push(path);
            }
        }
        files.sort();
        for path in files {
            // A damaged split is said where a sequence may lack it; what the others hold is still there.
            if let Err(error) = splits.add(&path) {
                splits
                    .notes
                    .push(format!("a split cannot be read: {error}"));
            }
        }
        Ok(splits)
    }

    fn add(&mut self, path: &Path) -> Result<(), ReadError> {
        let pickle = Pickle::open(path)?;
        let sequences = pickle.get(pickle.root(), "data_dict").ok_or_else(|| {
            ReadError::malformed(path, Position::File, "there is no `data_dict` in it")
        })?;
        for (name, data) in pickle.pairs(sequences) {
            if let Some(name) = pickle.text(*name)
                && !self.sequences.contains_key(name)
            {
                self.sequences
                    .insert(name.to_owned(), Split::of(&pickle, *data, path));
            }
        }
        Ok(())
    }

    pub fn get(&self, name: &str) -> Option<&Split> {
        self.sequences.get(name)
    }

    pub fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }
}

impl Split {
    fn of(pickle: &Pickle, data: Id, path: &Path) -> Self {
        let array = |group: &str, key: &str| {
            let group = pickle.get(data, group)?;
            pickle.numbers(pickle.get(group, key)?).ok()
        };
        Split {
            path: path.to_owned(),
            joints: [
                array("cam_coord", "joints.left"),
                array("cam_coord", "joints.right"),
            ],
            world2ego: array("params", "world2ego"),
            intrinsics: array("params", "K_ego"),
            distortion: array("params", "dist"),
        }
    }

    fn wrong(&self, reason: impl Into<String>) -> ReadError {
        ReadError::malformed(&self.path, Position::File, reason)
    }

    pub(super) fn head_camera(&self) -> Result<HeadCamera, ReadError> {
        let poses = self
            .world2ego
            .as_ref()
            .ok_or_else(|| self.wrong("a sequence without `world2ego`"))?
            .read()?
            .to_dim::<f64, Ix3>()
            .map_err(|error| self.wrong(format!("`world2ego`: {error}")))?;
        if poses.shape()[1..] != [4, 4] {
            return Err(self.wrong(format!("`world2ego` of shape {:?}", poses.shape())));
        }
        let poses = poses
            .outer_iter()
            .enumerate()
            .map(|(row, m)| {
                let matrix = std::array::from_fn(|k| m[[k / 4, k % 4]]);
                inverse(&self.path, row, &matrix)
            })
            .collect::<Result<_, _>>()?;
        // The same lens in every row: the first is as good as any.
        let first = |array: &Option<StoredArray>, count: usize, key: &str| {
            let Some(array) = array else {
                return Ok(None);
            };
            let values = flat(&array.read()?, &self.path, key)?;
            Ok::<_, ReadError>(values.get(..count).map(<[f64]>::to_vec))
        };
        let intrinsics = first(&self.intrinsics, 9, "K_ego")?;
        let distortion = first(&self.distortion, 8, "dist")?;
        Ok(HeadCamera {
            poses,
            lens: intrinsics.and_then(|k| lens(&k, &distortion.unwrap_or_else(|| vec![0.0; 8]))),
        })
    }

    /// Joints in the head camera; the order of `smplx` is ours. Whether a hand is in the picture does not matter.
    pub(super) fn hands(&self) -> Result<[Option<Timed>; 2], ReadError> {
        let read = |side: usize| {
            let Some(array) = &self.joints[side] else {
                return Ok(None);
            };
            let joints = array
                .read()?
                .to_dim::<f64, Ix4>()
                .map_err(|error| self.wrong(format!("joints: {error}")))?;
            if joints.shape()[1] == 0 || joints.shape()[2..] != [21, 3] {
                return Err(self.wrong(format!("joints of shape {:?}", joints.shape())));
            }
            let rows = joints.outer_iter().enumerate().map(|(row, views)| {
                let hand = std::array::from_fn(|joint| {
                    let p: [f64; 3] = std::array::from_fn(|k| views[[0, joint, k]]);
                    p.iter().all(|v| v.is_finite()).then(|| Point3::from(p))
                });
                (tick(row as i64), hand)
            });
            Ok(Some(rows.collect()))
        };
        Ok([read(0)?, read(1)?])
    }
}
