//! One predicted clip as the arrays of an npz, and back; arrays of other systems are checked and made ours.

use crate::clip::{CameraTrack, Clip, Depth, GazeTrack, JointTrack, Rgb, Signal};
use crate::formats::npy::{Element, NpyArray};
use crate::formats::npz::Npz;
use crate::geometry::{rigid, rotation};
use nalgebra::{Isometry3, Matrix3, Translation3, Vector3};
use ndarray::{Array1, Array2, Array3, ArrayD, Dimension, Ix1, Ix2, Ix3, Ix4};

pub(super) fn to_npz(clip: &Clip) -> Npz {
    let mut npz = Npz::default();
    if let Some(camera) = &clip.camera {
        let rows = camera
            .T_world_camera
            .iter()
            .flat_map(rigid::to_row_major)
            .collect();
        let poses = Array3::from_shape_vec((camera.T_world_camera.len(), 4, 4), rows)
            .expect("16 numbers per pose");
        npz = npz
            .with("camera", poses)
            .with("camera_valid", Array1::from(camera.valid.clone()));
    }
    if let Some(gaze) = &clip.gaze {
        npz = npz
            .with("gaze", &gaze.points)
            .with("gaze_valid", &gaze.valid);
    }
    for (name, track) in [
        ("body", &clip.body),
        ("left_hand", &clip.left_hand),
        ("right_hand", &clip.right_hand),
    ] {
        if let Some(track) = track {
            npz = npz
                .with(name, &track.joints)
                .with(&format!("{name}_valid"), &track.valid);
        }
    }
    if let Some(depth) = &clip.depth {
        npz = npz.with("depth", &depth.metres);
    }
    if let Some(rgb) = &clip.rgb {
        npz = npz.with("rgb", &rgb.frames);
    }
    for (name, signal) in &clip.declared {
        npz = npz.with(&format!("declared.{name}"), &signal.values);
        if let Some(valid) = &signal.valid {
            npz = npz.with(&format!("declared.{name}_valid"), valid);
        }
    }
    npz
}

/// Names that other systems use for ours.
const ALIASES: [(&str, &str); 3] = [
    ("camera", "cam"),
    ("left_hand", "lhand"),
    ("right_hand", "rhand"),
];

fn find<'a>(npz: &'a Npz, name: &str) -> Option<&'a NpyArray> {
    let alias = ALIASES.iter().find(|(ours, _)| *ours == name);
    npz.arrays
        .get(name)
        .or_else(|| alias.and_then(|(_, theirs)| npz.arrays.get(*theirs)))
}

fn typed<T: Element, D: Dimension>(
    name: &str,
    array: &NpyArray,
) -> Result<ndarray::Array<T, D>, String> {
    array.to_dim().map_err(|e| format!("array `{name}`: {e}"))
}

pub(super) fn from_npz(
    npz: &Npz,
    id: &str,
    source: &str,
    rate: impl Fn(&str, f64) -> f64,
) -> Result<Clip, String> {
    let mut clip = Clip::empty(id, source);
    if let Some(array) = find(npz, "camera") {
        let T_world_camera = camera_poses(array)?;
        let valid = match npz.arrays.get("camera_valid") {
            Some(valid) => typed::<bool, Ix1>("camera_valid", valid)?.to_vec(),
            None => vec![true; T_world_camera.len()],
        };
        expect_shape("camera_valid", &[valid.len()], &[T_world_camera.len()])?;
        clip.camera = Some(CameraTrack {
            rate: rate("camera", 30.0),
            T_world_camera,
            valid,
            up_world: None,
            intrinsics: None,
        });
    }
    if let Some(array) = npz.arrays.get("gaze") {
        let points = typed::<f32, Ix2>("gaze", array)?;
        expect_shape("gaze", &[points.ncols()], &[2])?;
        let valid = match npz.arrays.get("gaze_valid") {
            Some(valid) => typed::<bool, Ix1>("gaze_valid", valid)?,
            None => Array1::from_elem(points.nrows(), true),
        };
        expect_shape("gaze_valid", &[valid.len()], &[points.nrows()])?;
        clip.gaze = Some(GazeTrack {
            rate: rate("gaze", 30.0),
            points,
            valid,
        });
    }
    for (name, slot) in [
        ("body", &mut clip.body),
        ("left_hand", &mut clip.left_hand),
        ("right_hand", &mut clip.right_hand),
    ] {
        if let Some(array) = find(npz, name) {
            *slot = Some(joints(npz, name, array, rate(name, 30.0))?);
        }
    }
    if let Some(array) = npz.arrays.get("depth") {
        clip.depth = Some(Depth {
            rate: rate("depth", 8.0),
            metres: typed::<f32, Ix3>("depth", array)?,
        });
    }
    if let Some(array) = npz.arrays.get("rgb") {
        clip.rgb = Some(Rgb {
            rate: rate("rgb", 8.0),
            frames: typed::<u8, Ix4>("rgb", array)?,
        });
    }
    for (name, array) in &npz.arrays {
        let Some(modality) = name
            .strip_prefix("declared.")
            .filter(|n| !n.ends_with("_valid"))
        else {
            continue;
        };
        let values: ArrayD<f32> = array.to().map_err(|e| format!("array `{name}`: {e}"))?;
        let valid = match npz.arrays.get(&format!("{name}_valid")) {
            Some(valid) => Some(
                valid
                    .to()
                    .map_err(|e| format!("array `{name}_valid`: {e}"))?,
            ),
            None => None,
        };
        clip.declared
            .insert(modality.to_owned(), Signal { values, valid });
    }
    Ok(clip)
}

fn joints(npz: &Npz, name: &str, array: &NpyArray, rate: f64) -> Result<JointTrack, String> {
    let joints = typed::<f32, Ix3>(name, array)?;
    let (frames, count, axes) = joints.dim();
    expect_shape(name, &[axes], &[3])?;
    let valid_name = format!("{name}_valid");
    let valid = match npz.arrays.get(&valid_name) {
        Some(array) if array.shape.len() == 1 => {
            let frames_valid = typed::<bool, Ix1>(&valid_name, array)?;
            expect_shape(&valid_name, &[frames_valid.len()], &[frames])?;
            Array2::from_shape_fn((frames, count), |(t, _)| frames_valid[t])
        }
        Some(array) => typed::<bool, Ix2>(&valid_name, array)?,
        None => Array2::from_elem((frames, count), true),
    };
    expect_shape(&valid_name, valid.shape(), &[frames, count])?;
    Ok(JointTrack {
        rate,
        joints,
        valid,
    })
}

fn expect_shape(name: &str, found: &[usize], expected: &[usize]) -> Result<(), String> {
    if found == expected {
        Ok(())
    } else {
        Err(format!(
            "array `{name}`: {found:?} where {expected:?} is needed"
        ))
    }
}

/// Stands for a pose that is not finite: scoring leaves it alone where nothing is scored, and refuses it where something is.
fn no_pose() -> Isometry3<f64> {
    Isometry3::translation(f64::NAN, f64::NAN, f64::NAN)
}

/// Poses out of `[T, 4, 4]` matrices (a block that is no rotation is refused) or `[T, 9]` vectors (made orthonormal). A pose
/// with a value that is not finite becomes [`no_pose`].
fn camera_poses(array: &NpyArray) -> Result<Vec<Isometry3<f64>>, String> {
    let name = "camera";
    if array.shape.len() == 2 {
        let rows = typed::<f64, Ix2>(name, array)?;
        expect_shape(name, &[rows.ncols()], &[9])?;
        return rows
            .outer_iter()
            .enumerate()
            .map(|(i, row)| {
                if !row.iter().all(|value| value.is_finite()) {
                    return Ok(no_pose());
                }
                let six = [row[0], row[1], row[2], row[3], row[4], row[5]];
                let turn = rotation::from_6d(&six).ok_or_else(|| {
                    format!("array `{name}`: the rotation of pose {i} has no direction")
                })?;
                let place = Translation3::from(Vector3::new(row[6], row[7], row[8]));
                Ok(Isometry3::from_parts(place, turn))
            })
            .collect();
    }
    let matrices = typed::<f64, Ix3>(name, array)?;
    expect_shape(name, &[matrices.dim().1, matrices.dim().2], &[4, 4])?;
    matrices
        .outer_iter()
        .enumerate()
        .map(|(i, matrix)| {
            if !matrix.iter().all(|value| value.is_finite()) {
                return Ok(no_pose());
            }
            let mut flat = [0.0; 16];
            flat.iter_mut()
                .zip(matrix)
                .for_each(|(slot, &value)| *slot = value);
            let turn = Matrix3::from_fn(|r, c| flat[4 * r + c]);
            if (turn.transpose() * turn - Matrix3::identity()).amax() > 1e-4 {
                return Err(format!(
                    "array `{name}`: pose {i}: its rotation part is not a rotation (1e-4)"
                ));
            }
            rigid::from_row_major(&flat).map_err(|e| format!("array `{name}`: pose {i}: {e}"))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_that_is_not_finite_has_no_place_and_the_others_stay() {
        let mut matrices = Array3::<f64>::zeros((3, 4, 4));
        for mut matrix in matrices.outer_iter_mut() {
            matrix.diag_mut().fill(1.0);
        }
        matrices[(1, 0, 0)] = f64::NAN;
        let nine = Array2::from_shape_fn((3, 9), |(i, c)| match (i, c) {
            (1, 7) => f64::INFINITY,
            (_, 0 | 4) => 1.0,
            _ => 0.0,
        });
        for npz in [
            Npz::default().with("camera", matrices),
            Npz::default().with("cam", nine),
        ] {
            let clip = from_npz(&npz, "a", "", |_, rate| rate).unwrap();
            let poses = clip.camera.unwrap().T_world_camera;
            assert_eq!(poses[0], Isometry3::identity());
            assert!(poses[1].translation.vector.iter().all(|v| v.is_nan()));
            assert_eq!(poses[2], Isometry3::identity());
        }
    }
}
