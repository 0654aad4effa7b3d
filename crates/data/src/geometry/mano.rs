//! MANO: where the joints of a hand are, given its shape and pose (Romero et al. 2017, "Embodied Hands").
//!
//! 778 vertices hang on 16 joints. Shape coefficients move vertices and with them joints; each joint turns by its own rotation about
//! where its parent put it; a linear term of the rotations corrects the skin. The data sets use two programs, `smplx` and
//! `manopth`, that agree on all of that and differ in three things, which [`Convention`] names: whether the mean pose is added,
//! which vertices are the finger tips, and whether the wrist is moved to the origin first.
//!
//! The numbers of the model are licensed and not part of this product; [`ManoModel::new`] takes them as they are in the user's file.

use super::skeleton::JOINTS;
use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

/// Vertices of the surface.
pub const VERTICES: usize = 778;
/// Joints that turn: the wrist, then three of each finger.
pub const TURNING: usize = 16;
/// Coefficients of the shape.
pub const SHAPE: usize = 10;
/// Values of the pose of a hand without its wrist: an axis times an angle for each of 15 joints.
pub const POSE: usize = 3 * (TURNING - 1);
/// Entries of the 15 rotation matrices.
const CORRECTIONS: usize = 9 * (TURNING - 1);

/// The numbers of one hand, row by row, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct ManoArrays {
    /// `v_template`, `[778, 3]`.
    pub template: Vec<f64>,
    /// `shapedirs`, `[778, 3, 10]`.
    pub shape_directions: Vec<f64>,
    /// `posedirs`, `[778, 3, 135]`.
    pub pose_directions: Vec<f64>,
    /// `J_regressor`, `[16, 778]`.
    pub joint_regressor: Vec<f64>,
    /// `weights`, `[778, 16]`.
    pub weights: Vec<f64>,
    /// `kintree_table[0]`; the first joint has none.
    pub parents: [Option<usize>; TURNING],
    /// `hands_components`, `[45, 45]`, one component a row.
    pub components: Vec<f64>,
    /// `hands_mean`, `[45]`.
    pub mean: Vec<f64>,
}

/// One hand.
#[derive(Debug, Clone, PartialEq)]
pub struct ManoModel {
    arrays: ManoArrays,
    /// Joints of the hand of mean shape, and how shape moves them.
    joints: [Vector3<f64>; TURNING],
    joint_directions: Vec<[Vector3<f64>; SHAPE]>,
}

/// What a program makes of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Convention {
    /// The vertices at the tips of thumb, index, middle, ring and pinky.
    pub tips: [usize; 5],
    /// Whether zero means the mean pose (`flat_hand_mean=False`) or the flat hand.
    pub add_mean: bool,
    /// Whether the wrist goes to the origin before the translation is added (`center_idx=0`).
    pub centre_on_wrist: bool,
}

impl Convention {
    /// `smplx`, mean pose added.
    pub const SMPLX: Self = Convention {
        tips: [744, 320, 443, 554, 671],
        add_mean: true,
        centre_on_wrist: false,
    };

    /// `manopth`, flat hand; one of its tips differs between the hands.
    #[must_use]
    pub fn manopth(right: bool) -> Self {
        Convention {
            tips: [745, 317, if right { 444 } else { 445 }, 556, 673],
            add_mean: false,
            centre_on_wrist: false,
        }
    }
}

/// How the fingers are bent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FingerPose<'a> {
    /// An axis times an angle for each of the 15 joints.
    AxisAngle(&'a [f64; POSE]),
    /// Coefficients of the first components.
    Components(&'a [f64]),
}

/// A hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ManoPose<'a> {
    /// Coefficients of the shape (betas); zeros for the mean hand.
    pub shape: [f64; SHAPE],
    /// Axis times angle; turns about the wrist.
    pub orientation: [f64; 3],
    /// Rotations of the fingers, without the wrist.
    pub fingers: FingerPose<'a>,
    /// Metres.
    pub translation: [f64; 3],
}

/// The hand's frames: rotation and position of each joint, and where it is at rest.
struct Frames {
    rotations: [Matrix3<f64>; TURNING],
    positions: [Vector3<f64>; TURNING],
    rest: [Vector3<f64>; TURNING],
    /// `R - 1` of the 15 joints of the fingers, row by row.
    corrections: [f64; CORRECTIONS],
}

impl ManoModel {
    /// # Errors
    /// A sentence that names the array that does not fit.
    pub fn new(arrays: ManoArrays) -> Result<Self, String> {
        let lists = [
            ("v_template", &arrays.template, VERTICES * 3),
            ("shapedirs", &arrays.shape_directions, VERTICES * 3 * SHAPE),
            (
                "posedirs",
                &arrays.pose_directions,
                VERTICES * 3 * CORRECTIONS,
            ),
            ("J_regressor", &arrays.joint_regressor, TURNING * VERTICES),
            ("weights", &arrays.weights, VERTICES * TURNING),
            ("hands_components", &arrays.components, POSE * POSE),
            ("hands_mean", &arrays.mean, POSE),
        ];
        for (name, values, count) in lists {
            if values.len() != count {
                return Err(format!(
                    "`{name}` has {} values instead of {count}",
                    values.len()
                ));
            }
            if !values.iter().all(|v| v.is_finite()) {
                return Err(format!("`{name}` has a value that is not finite"));
            }
        }
        for (joint, parent) in arrays.parents.iter().enumerate() {
            let fits = match parent {
                None => joint == 0,
                Some(parent) => *parent < joint,
            };
            if !fits {
                return Err(format!(
                    "`kintree_table` gives joint {joint} the parent {parent:?}"
                ));
            }
        }
        let vertex = |k: usize| Vector3::from_row_slice(&arrays.template[3 * k..3 * k + 3]);
        let direction = |k: usize, b: usize| {
            Vector3::from_fn(|axis, _| arrays.shape_directions[(3 * k + axis) * SHAPE + b])
        };
        let regressed = |joint: usize, of: &dyn Fn(usize) -> Vector3<f64>| {
            let row = &arrays.joint_regressor[joint * VERTICES..(joint + 1) * VERTICES];
            row.iter()
                .enumerate()
                .filter(|(_, share)| **share != 0.0)
                .fold(Vector3::zeros(), |sum, (k, share)| sum + of(k) * *share)
        };
        let joints = std::array::from_fn(|joint| regressed(joint, &vertex));
        let joint_directions = (0..TURNING)
            .map(|joint| std::array::from_fn(|b| regressed(joint, &|k| direction(k, b))))
            .collect();
        Ok(ManoModel {
            arrays,
            joints,
            joint_directions,
        })
    }

    /// The left hand as it should have been released: `MANO_LEFT` carries the right hand's shape directions along x. Users of
    /// HOT3D turn their sign, users of other sets do not.
    ///
    /// # Errors
    /// None in practice: the arrays have been checked.
    pub fn with_mirrored_shape(&self) -> Result<Self, String> {
        let mut arrays = self.arrays.clone();
        for vertex in arrays.shape_directions.chunks_exact_mut(3 * SHAPE) {
            for value in &mut vertex[..SHAPE] {
                *value = -*value;
            }
        }
        Self::new(arrays)
    }

    /// Whether this hand's shape directions along x are those of `other`: the mistake that [`ManoModel::with_mirrored_shape`] mends.
    #[must_use]
    pub fn shares_shape_along_x(&self, other: &ManoModel) -> bool {
        let pairs = self
            .arrays
            .shape_directions
            .chunks_exact(3 * SHAPE)
            .zip(other.arrays.shape_directions.chunks_exact(3 * SHAPE));
        let apart: f64 = pairs
            .flat_map(|(a, b)| a[..SHAPE].iter().zip(&b[..SHAPE]))
            .map(|(a, b)| (a - b).abs())
            .sum();
        apart < 1.0
    }

    /// The 21 joints in our order ([`super::skeleton::HAND`]), metres.
    ///
    /// # Errors
    /// When there are more coefficients than components.
    pub fn joints(
        &self,
        pose: &ManoPose<'_>,
        convention: &Convention,
    ) -> Result<[Point3<f64>; JOINTS], String> {
        let frames = self.frames(pose, convention)?;
        let mut joints = [Point3::origin(); JOINTS];
        for (joint, position) in joints.iter_mut().zip(frames.positions) {
            *joint = Point3::from(position);
        }
        for (joint, vertex) in joints[TURNING..].iter_mut().zip(convention.tips) {
            *joint = self.vertex(vertex, pose, &frames);
        }
        let shift = Vector3::from(pose.translation)
            - if convention.centre_on_wrist {
                joints[0].coords
            } else {
                Vector3::zeros()
            };
        for joint in &mut joints {
            *joint += shift;
        }
        Ok(joints)
    }

    /// All vertices, metres.
    ///
    /// # Errors
    /// As [`ManoModel::joints`].
    pub fn vertices(
        &self,
        pose: &ManoPose<'_>,
        convention: &Convention,
    ) -> Result<Vec<Point3<f64>>, String> {
        let frames = self.frames(pose, convention)?;
        let shift = Vector3::from(pose.translation)
            - if convention.centre_on_wrist {
                frames.positions[0]
            } else {
                Vector3::zeros()
            };
        Ok((0..VERTICES)
            .map(|k| self.vertex(k, pose, &frames) + shift)
            .collect())
    }

    fn frames(&self, pose: &ManoPose<'_>, convention: &Convention) -> Result<Frames, String> {
        let mut bent = [0.0; POSE];
        match pose.fingers {
            FingerPose::AxisAngle(values) => bent = *values,
            FingerPose::Components(coefficients) => {
                if coefficients.len() > POSE {
                    return Err(format!(
                        "{} coefficients for {POSE} components",
                        coefficients.len()
                    ));
                }
                let rows = self.arrays.components.chunks_exact(POSE);
                for (coefficient, row) in coefficients.iter().zip(rows) {
                    for (value, component) in bent.iter_mut().zip(row) {
                        *value += coefficient * component;
                    }
                }
            }
        }
        if convention.add_mean {
            for (value, mean) in bent.iter_mut().zip(&self.arrays.mean) {
                *value += mean;
            }
        }
        let turn = |joint: usize| {
            let axis = match joint.checked_sub(1) {
                None => Vector3::from(pose.orientation),
                Some(finger) => Vector3::from_row_slice(&bent[3 * finger..3 * finger + 3]),
            };
            Rotation3::from_scaled_axis(axis).into_inner()
        };
        let turns: [Matrix3<f64>; TURNING] = std::array::from_fn(turn);
        let mut corrections = [0.0; CORRECTIONS];
        for (joint, turn) in turns[1..].iter().enumerate() {
            for entry in 0..9 {
                let (row, column) = (entry / 3, entry % 3);
                corrections[9 * joint + entry] =
                    turn[(row, column)] - f64::from(u8::from(row == column));
            }
        }
        let rest: [Vector3<f64>; TURNING] = std::array::from_fn(|joint| {
            let directions = self.joint_directions[joint].iter().zip(pose.shape);
            directions.fold(self.joints[joint], |sum, (direction, b)| {
                sum + direction * b
            })
        });
        let mut rotations = turns;
        let mut positions = rest;
        for joint in 1..TURNING {
            // Parents come first.
            let parent = self.arrays.parents[joint].unwrap_or(0);
            rotations[joint] = rotations[parent] * turns[joint];
            positions[joint] = positions[parent] + rotations[parent] * (rest[joint] - rest[parent]);
        }
        Ok(Frames {
            rotations,
            positions,
            rest,
            corrections,
        })
    }

    fn vertex(&self, k: usize, pose: &ManoPose<'_>, frames: &Frames) -> Point3<f64> {
        let arrays = &self.arrays;
        let at_rest = Vector3::from_fn(|axis, _| {
            let row = 3 * k + axis;
            let shape = &arrays.shape_directions[row * SHAPE..(row + 1) * SHAPE];
            let corrections = &arrays.pose_directions[row * CORRECTIONS..(row + 1) * CORRECTIONS];
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            arrays.template[row] + dot(shape, &pose.shape) + dot(corrections, &frames.corrections)
        });
        let weights = &arrays.weights[k * TURNING..(k + 1) * TURNING];
        let skinned = (0..TURNING).fold(Vector3::zeros(), |sum, joint| {
            let moved =
                frames.positions[joint] + frames.rotations[joint] * (at_rest - frames.rest[joint]);
            sum + moved * weights[joint]
        });
        // The weights of a vertex need not sum to one exactly: what is missing stays at the origin, as in both programs.
        Point3::from(skinned)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A hand of 778 points on a line, each hanging on one joint.
    fn arrays() -> ManoArrays {
        let parents = [0, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14];
        let mut arrays = ManoArrays {
            template: (0..VERTICES * 3)
                .map(|k| (k as f64 * 0.7).sin() * 0.1)
                .collect(),
            shape_directions: vec![0.001; VERTICES * 3 * SHAPE],
            pose_directions: vec![0.0; VERTICES * 3 * CORRECTIONS],
            joint_regressor: vec![0.0; TURNING * VERTICES],
            weights: vec![0.0; VERTICES * TURNING],
            parents: std::array::from_fn(|joint| (joint > 0).then(|| parents[joint])),
            components: (0..POSE * POSE)
                .map(|k| f64::from(u8::from(k / POSE == k % POSE)))
                .collect(),
            mean: vec![0.1; POSE],
        };
        for joint in 0..TURNING {
            arrays.joint_regressor[joint * VERTICES + 7 * joint] = 1.0;
        }
        for k in 0..VERTICES {
            arrays.weights[k * TURNING + k % TURNING] = 1.0;
        }
        arrays
    }

    fn pose(fingers: FingerPose<'_>) -> ManoPose<'_> {
        ManoPose {
            shape: [0.5; SHAPE],
            orientation: [0.3, -0.2, 0.9],
            fingers,
            translation: [1.0, 2.0, 3.0],
        }
    }

    #[test]
    fn the_orientation_turns_about_the_wrist_and_bones_keep_their_lengths() {
        let model = ManoModel::new(arrays()).unwrap();
        let bent: [f64; POSE] = std::array::from_fn(|k| (k as f64).cos());
        let convention = Convention::manopth(true);
        let mut still = pose(FingerPose::AxisAngle(&[0.0; POSE]));
        still.orientation = [0.0; 3];
        let (still, bent) = (
            model.joints(&still, &convention).unwrap(),
            model
                .joints(&pose(FingerPose::AxisAngle(&bent)), &convention)
                .unwrap(),
        );
        assert!((still[0] - bent[0]).norm() < 1e-12);
        let parents = super::super::skeleton::HAND.parents;
        for joint in 1..TURNING {
            let length = |hand: &[Point3<f64>; JOINTS]| (hand[joint] - hand[parents[joint]]).norm();
            assert!((length(&still) - length(&bent)).abs() < 1e-12);
        }
    }

    #[test]
    fn components_and_angles_say_the_same_and_a_centred_wrist_lies_where_the_translation_says() {
        let model = ManoModel::new(arrays()).unwrap();
        let bent: [f64; POSE] = std::array::from_fn(|k| (k as f64).cos());
        let mut some = [0.0; POSE];
        some[..15].copy_from_slice(&bent[..15]);
        let convention = Convention {
            centre_on_wrist: true,
            ..Convention::SMPLX
        };
        let a = model
            .joints(&pose(FingerPose::AxisAngle(&some)), &convention)
            .unwrap();
        let b = model
            .joints(&pose(FingerPose::Components(&bent[..15])), &convention)
            .unwrap();
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).norm() < 1e-12));
        assert!((a[0] - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
        let tips: Vec<_> = model
            .vertices(&pose(FingerPose::AxisAngle(&some)), &convention)
            .unwrap();
        assert!((tips[744] - a[16]).norm() < 1e-12);
        assert!(
            model
                .joints(&pose(FingerPose::Components(&[0.0; 46])), &convention)
                .is_err()
        );
    }

    #[test]
    fn arrays_that_are_no_hand_are_refused_by_name() {
        let mut wrong = arrays();
        wrong.weights.pop();
        assert!(ManoModel::new(wrong).unwrap_err().contains("`weights`"));
        let mut wrong = arrays();
        wrong.mean[3] = f64::NAN;
        assert!(ManoModel::new(wrong).unwrap_err().contains("`hands_mean`"));
        let mut wrong = arrays();
        wrong.parents[3] = Some(5);
        assert!(ManoModel::new(wrong).unwrap_err().contains("joint 3"));
    }
}
