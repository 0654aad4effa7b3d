//! The user's MANO models: `MANO_LEFT` and `MANO_RIGHT`, as pickled by their authors (`.pkl`, with chumpy's and SciPy's
//! objects inside) or as plain arrays (`.npz`). The kinematics are in [`crate::geometry::mano`].
//!
//! The models are licensed to the user by their authors (<https://mano.is.tue.mpg.de>) and not part of this product.

use super::ReadError;
use super::track::Joints;
use crate::formats::npy::NpyArray;
use crate::formats::npz::Npz;
use crate::formats::pickle::{Id, Node, Pickle};
use crate::formats::read_error::Position;
use crate::geometry::mano::{
    Convention, ManoArrays, ManoModel, ManoPose, POSE, SHAPE, TURNING, VERTICES,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What to supply where a data set needs the models and has none.
pub const SUPPLY: &str = "put MANO_LEFT.pkl and MANO_RIGHT.pkl of https://mano.is.tue.mpg.de into a folder and name it: `mano: FOLDER` in \
    data.yaml, REVIV_DATA_MANO=FOLDER, or --mano FOLDER";
/// Where the models lie in the folders that are handed around.
const BELOW: [&str; 4] = ["", "models", "mano", "mano_v1_2/models"];

/// Both hands, as far as they are there.
#[derive(Debug, Clone)]
pub struct Mano {
    folder: PathBuf,
    /// Left and right.
    hands: [Option<Arc<ManoModel>>; 2],
}

impl Mano {
    /// Reads the models in `folder`.
    ///
    /// # Errors
    /// When there is none, or one is damaged.
    pub fn open(folder: &Path) -> Result<Self, ReadError> {
        let mut hands = [None, None];
        for (hand, name) in hands.iter_mut().zip(["MANO_LEFT", "MANO_RIGHT"]) {
            let found = BELOW.iter().find_map(|below| {
                ["pkl", "npz"]
                    .iter()
                    .map(|kind| folder.join(below).join(format!("{name}.{kind}")))
                    .find(|path| path.is_file())
            });
            if let Some(path) = found {
                *hand = Some(Arc::new(read(&path)?));
            }
        }
        if hands.iter().all(Option::is_none) {
            return Err(ReadError::missing(
                folder,
                "there is no MANO_LEFT.pkl and no MANO_RIGHT.pkl here (nor an .npz of them)",
            ));
        }
        Ok(Mano {
            folder: folder.to_owned(),
            hands,
        })
    }

    /// The same with the left hand's shape mended, where it is the released one.
    ///
    /// # Errors
    /// None in practice.
    pub fn with_left_fix(mut self) -> Result<Self, ReadError> {
        let [left, right] = &mut self.hands;
        if let Some(left) = left
            && right
                .as_ref()
                .is_none_or(|right| left.shares_shape_along_x(right))
        {
            *left = Arc::new(left.with_mirrored_shape().map_err(ReadError::Settings)?);
        }
        Ok(self)
    }

    /// Left (0) or right (1).
    #[must_use]
    pub fn hand(&self, side: usize) -> Option<&ManoModel> {
        self.hands.get(side)?.as_deref()
    }

    /// Why a hand is absent although its parameters are there.
    #[must_use]
    pub fn note(&self, side: usize) -> Option<String> {
        let name = ["LEFT", "RIGHT"].get(side)?;
        self.hand(side).is_none().then(|| {
            format!(
                "the {} hand is left out: there is no MANO_{name}.pkl in `{}`",
                name.to_lowercase(),
                self.folder.display()
            )
        })
    }
}

/// The sentence for a recording whose hands need the models.
#[must_use]
pub fn absent(what: &str) -> String {
    format!("both hands are left out: {what} MANO parameters, and no MANO model is given; {SUPPLY}")
}

/// The joints of a hand in the frame of its parameters; nothing where a number is missing.
#[must_use]
pub fn joints(model: &ManoModel, pose: &ManoPose<'_>, convention: &Convention) -> Joints {
    let numbers = pose
        .shape
        .iter()
        .chain(&pose.orientation)
        .chain(&pose.translation);
    let finite = numbers.into_iter().all(|v| v.is_finite());
    match model.joints(pose, convention) {
        Ok(joints) if finite => joints.map(|joint| {
            let known = joint.coords.iter().all(|v| v.is_finite());
            known.then_some(joint)
        }),
        _ => [None; 21],
    }
}

/// Reads one model.
///
/// # Errors
/// When the file is damaged, or something else.
pub fn read(path: &Path) -> Result<ManoModel, ReadError> {
    let arrays = if path.extension().is_some_and(|kind| kind == "npz") {
        from_npz(path)?
    } else {
        from_pickle(path)?
    };
    ManoModel::new(arrays).map_err(|reason| ReadError::malformed(path, Position::File, reason))
}

fn from_npz(path: &Path) -> Result<ManoArrays, ReadError> {
    let npz = Npz::read(path)?;
    let get = |name: &str| -> Result<&NpyArray, ReadError> {
        npz.get(name)
            .map_err(|error| ReadError::Format(error.in_file(path)))
    };
    let values = |name: &str| values(path, name, get(name)?);
    Ok(ManoArrays {
        template: values("v_template")?,
        shape_directions: shape_directions(path, get("shapedirs")?)?,
        pose_directions: values("posedirs")?,
        joint_regressor: values("J_regressor")?,
        weights: values("weights")?,
        parents: parents(path, &values("kintree_table")?)?,
        components: values("hands_components")?,
        mean: values("hands_mean")?,
    })
}

fn values(path: &Path, name: &str, array: &NpyArray) -> Result<Vec<f64>, ReadError> {
    Ok(array
        .to::<f64>()
        .map_err(|error| ReadError::malformed(path, Position::File, format!("`{name}`: {error}")))?
        .into_raw_vec_and_offset()
        .0)
}

/// The first ten of the directions there are: other programs keep all twenty.
fn shape_directions(path: &Path, array: &NpyArray) -> Result<Vec<f64>, ReadError> {
    let all = values(path, "shapedirs", array)?;
    match array.shape.as_slice() {
        [VERTICES, 3, count] if *count >= SHAPE => Ok(all
            .chunks_exact(*count)
            .flat_map(|row| row[..SHAPE].to_vec())
            .collect()),
        shape => Err(ReadError::malformed(
            path,
            Position::File,
            format!("`shapedirs` has shape {shape:?} instead of [778, 3, 10]"),
        )),
    }
}

/// The first row of the table; the root's parent is no joint.
fn parents(path: &Path, table: &[f64]) -> Result<[Option<usize>; TURNING], ReadError> {
    if table.len() < TURNING {
        return Err(ReadError::malformed(
            path,
            Position::File,
            format!("`kintree_table` has {} values", table.len()),
        ));
    }
    Ok(std::array::from_fn(|joint| {
        let parent = table[joint];
        (0.0..TURNING as f64)
            .contains(&parent)
            .then_some(parent as usize)
    }))
}

fn from_pickle(path: &Path) -> Result<ManoArrays, ReadError> {
    let pickle = Pickle::open(path)?;
    let root = pickle.root();
    let wrong = |name: &str, reason: String| {
        ReadError::malformed(path, Position::File, format!("`{name}`: {reason}"))
    };
    let get = |name: &str| {
        pickle.get(root, name).ok_or_else(|| {
            ReadError::missing(
                path,
                format!("there is no `{name}` in it: not a MANO model"),
            )
        })
    };
    let array = |name: &str, id: Id| -> Result<NpyArray, ReadError> {
        pickle
            .numbers(id)
            .map_err(|reason| wrong(name, reason))?
            .read()
    };
    let values = |name: &str| values(path, name, &array(name, get(name)?)?);

    let shapedirs = get("shapedirs")?;
    let shape_array = match class(&pickle, shapedirs) {
        // `a.ravel()[idxs].reshape(preferred_shape)`
        Some("chumpy.reordering.Select") => {
            let part = |name: &str| {
                pickle
                    .get(shapedirs, name)
                    .ok_or_else(|| wrong("shapedirs", format!("a selection without `{name}`")))
            };
            let all = self::values(path, "shapedirs", &array("shapedirs", part("a")?)?)?;
            let indices = self::values(path, "shapedirs", &array("shapedirs", part("idxs")?)?)?;
            let chosen: Option<Vec<f64>> = indices
                .iter()
                .map(|index| (*index >= 0.0).then(|| all.get(*index as usize).copied())?)
                .collect();
            let chosen = chosen
                .ok_or_else(|| wrong("shapedirs", "a selection beyond its array".to_owned()))?;
            let columns = chosen.len() / (VERTICES * 3);
            NpyArray::from(
                &ndarray::Array3::from_shape_vec((VERTICES, 3, columns), chosen)
                    .map_err(|error| wrong("shapedirs", error.to_string()))?,
            )
        }
        _ => array("shapedirs", shapedirs)?,
    };
    let regressor = get("J_regressor")?;
    let joint_regressor = match class(&pickle, regressor) {
        Some(kind @ ("scipy.sparse.csc_matrix" | "scipy.sparse.csr_matrix")) => {
            let part = |names: &[&str]| {
                let id = names.iter().find_map(|name| pickle.get(regressor, name));
                let id = id.ok_or_else(|| {
                    wrong("J_regressor", format!("a matrix without `{}`", names[0]))
                })?;
                self::values(path, "J_regressor", &array("J_regressor", id)?)
            };
            let sparse = Sparse {
                shape: part(&["_shape", "shape"])?,
                data: part(&["data"])?,
                indices: part(&["indices"])?,
                starts: part(&["indptr"])?,
            };
            sparse
                .dense(kind.ends_with("csc_matrix"))
                .map_err(|reason| wrong("J_regressor", reason))?
        }
        _ => values("J_regressor")?,
    };
    Ok(ManoArrays {
        template: values("v_template")?,
        shape_directions: shape_directions(path, &shape_array)?,
        pose_directions: values("posedirs")?,
        joint_regressor,
        weights: values("weights")?,
        parents: parents(path, &values("kintree_table")?)?,
        components: values("hands_components")?,
        mean: values("hands_mean")?,
    })
}

fn class(pickle: &Pickle, id: Id) -> Option<&str> {
    match pickle.node(id) {
        Node::Object { class, .. } => Some(class),
        _ => None,
    }
}

/// A matrix in compressed columns or rows.
struct Sparse {
    shape: Vec<f64>,
    data: Vec<f64>,
    indices: Vec<f64>,
    starts: Vec<f64>,
}

impl Sparse {
    /// `[16, 778]`, row by row.
    fn dense(&self, columns: bool) -> Result<Vec<f64>, String> {
        if self.shape != [TURNING as f64, VERTICES as f64] {
            return Err(format!("a matrix of shape {:?}", self.shape));
        }
        let outer = if columns { VERTICES } else { TURNING };
        if self.starts.len() != outer + 1 || self.indices.len() != self.data.len() {
            return Err("a matrix whose parts do not fit each other".to_owned());
        }
        let mut dense = vec![0.0; TURNING * VERTICES];
        for (major, pair) in self.starts.windows(2).enumerate() {
            let range = pair[0] as usize..pair[1] as usize;
            let (Some(indices), Some(data)) =
                (self.indices.get(range.clone()), self.data.get(range))
            else {
                return Err("a matrix whose columns lie beyond its values".to_owned());
            };
            for (index, value) in indices.iter().zip(data) {
                let minor = *index as usize;
                let (row, column) = if columns {
                    (minor, major)
                } else {
                    (major, minor)
                };
                if *index < 0.0 || row >= TURNING || column >= VERTICES {
                    return Err(format!("an entry in row {row}, column {column}"));
                }
                // Entries of the same place add up.
                dense[row * VERTICES + column] += value;
            }
        }
        Ok(dense)
    }
}

/// Exactly as many numbers as a row of parameters has.
#[must_use]
pub fn finger_pose(values: &[f64]) -> Option<&[f64; POSE]> {
    values.try_into().ok()
}
