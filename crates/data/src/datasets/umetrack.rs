//! UmeTrack hands: joint angles and a wrist pose become 21 landmarks by the forward kinematics of a user's hand profile.
//!
//! The profile describes a left hand at rest; a right hand is its mirror image. Positions in files are millimetres.

use super::ReadError;
use super::aria::calibration::unit_quaternion;
use super::aria::hand_tracking::from_landmarks;
use super::track::{Joints, SECOND, Track};
use crate::formats::read_error::Position;
use crate::formats::text::{Lines, json_line, read_json};
use nalgebra::{Matrix4, Point3, Rotation3, Unit, Vector3, Vector4};
use serde::Deserialize;
use std::path::Path;

const FINGERS: usize = 5;
/// Wrist twice, then three moving frames of each finger.
const FRAMES: usize = 2 + 3 * FINGERS;
/// Joint angles that the kinematics use.
pub const ANGLES: usize = 4 * FINGERS;

/// The shape of a user's hand.
#[derive(Debug, Clone, PartialEq)]
pub struct HandProfile {
    /// Metres, in the frame of the wrist.
    rest: [Vector3<f64>; ANGLES],
    axes: [Unit<Vector3<f64>>; ANGLES],
    landmarks: Vec<Landmark>,
}

#[derive(Debug, Clone, PartialEq)]
struct Landmark {
    rest: Vector4<f64>,
    bones: [(usize, f64); 3],
}

#[derive(Deserialize)]
struct ProfileFile {
    hand_model: HandModel,
}

#[derive(Deserialize)]
struct HandModel {
    joint_rest_positions: Vec<[f64; 3]>,
    joint_rotation_axes: Vec<[f64; 3]>,
    landmark_rest_positions: Vec<[f64; 3]>,
    landmark_rest_bone_indices: Vec<[f64; 3]>,
    landmark_rest_bone_weights: Vec<[f64; 3]>,
}

impl HandProfile {
    /// Reads `umetrack_hand_user_profile.json`.
    ///
    /// # Errors
    /// When the file is damaged or holds another model.
    pub fn read(path: &Path) -> Result<Self, ReadError> {
        let file: ProfileFile = read_json(path)?;
        Self::from_model(&file.hand_model).map_err(|reason| {
            ReadError::malformed(path, Position::File, format!("hand_model: {reason}"))
        })
    }

    /// From the hand model itself, as HOT3D-Clips has it.
    ///
    /// # Errors
    /// A sentence about the part that is no hand.
    pub fn from_json(model: &serde_json::Value) -> Result<Self, String> {
        let model = HandModel::deserialize(model).map_err(|error| error.to_string())?;
        Self::from_model(&model)
    }

    fn from_model(model: &HandModel) -> Result<Self, String> {
        if model.joint_rest_positions.len() < ANGLES || model.joint_rotation_axes.len() < ANGLES {
            return Err(format!(
                "{} joints instead of {ANGLES}",
                model.joint_rest_positions.len()
            ));
        }
        let count = model.landmark_rest_positions.len();
        if count != 21
            || model.landmark_rest_bone_indices.len() != count
            || model.landmark_rest_bone_weights.len() != count
        {
            return Err(format!("{count} landmarks instead of 21"));
        }
        let mut axes = [Vector3::x_axis(); ANGLES];
        for (axis, [x, y, z]) in axes.iter_mut().zip(&model.joint_rotation_axes) {
            *axis =
                Unit::try_new(Vector3::new(*x, *y, *z), 1e-6).ok_or("a joint without an axis")?;
        }
        let mut landmarks = Vec::with_capacity(count);
        for k in 0..count {
            let [x, y, z] = model.landmark_rest_positions[k];
            let mut bones = [(0, 0.0); 3];
            for (slot, (index, weight)) in bones.iter_mut().zip(
                model.landmark_rest_bone_indices[k]
                    .iter()
                    .zip(&model.landmark_rest_bone_weights[k]),
            ) {
                if !(0.0..FRAMES as f64).contains(index) {
                    return Err(format!("landmark {k} hangs on bone {index}"));
                }
                *slot = (*index as usize, *weight);
            }
            landmarks.push(Landmark {
                rest: Vector4::new(x / 1000.0, y / 1000.0, z / 1000.0, 1.0),
                bones,
            });
        }
        Ok(HandProfile {
            rest: std::array::from_fn(|k| Vector3::from(model.joint_rest_positions[k]) / 1000.0),
            axes,
            landmarks,
        })
    }

    /// A hand in our joint order, in the frame of `T_world_wrist`'s world.
    #[must_use]
    pub fn joints(
        &self,
        T_world_wrist: &Matrix4<f64>,
        angles: &[f64; ANGLES],
        right: bool,
    ) -> Joints {
        let mut wrist = *T_world_wrist;
        if right {
            for row in 0..3 {
                wrist[(row, 0)] = -wrist[(row, 0)];
            }
        }
        let mut frames = vec![wrist; 2];
        for finger in 0..FINGERS {
            let mut frame = wrist;
            for link in 0..4 {
                let joint = 4 * finger + link;
                let rotation = Rotation3::from_axis_angle(&self.axes[joint], angles[joint]);
                let mut about = rotation.to_homogeneous();
                let shift = self.rest[joint] - rotation * self.rest[joint];
                about.fixed_view_mut::<3, 1>(0, 3).copy_from(&shift);
                frame *= about;
                if link > 0 {
                    frames.push(frame);
                }
            }
        }
        let mut points = [Point3::origin(); 21];
        for (point, landmark) in points.iter_mut().zip(&self.landmarks) {
            let mut sum = Vector4::zeros();
            for (bone, weight) in landmark.bones {
                sum += frames[bone] * landmark.rest * weight;
            }
            *point = Point3::from(sum.xyz());
        }
        // There is no landmark at the thumb's base; the first joint at rest, moved with the wrist, stands for it.
        let base = wrist * self.rest[0].push(1.0);
        from_landmarks(&points, Some(Point3::from(base.xyz())))
    }
}

#[derive(Deserialize)]
struct Line {
    timestamp_ns: i64,
    hand_poses: HandPoses,
}

#[derive(Deserialize)]
struct HandPoses {
    #[serde(rename = "0")]
    left: Option<HandPose>,
    #[serde(rename = "1")]
    right: Option<HandPose>,
}

#[derive(Deserialize)]
struct HandPose {
    wrist_xform: Wrist,
    joint_angles: Vec<f64>,
}

#[derive(Deserialize)]
struct Wrist {
    t_xyz: [f64; 3],
    q_wxyz: [f64; 4],
}

/// Left and right hand in the world, from `umetrack_hand_pose_trajectory.jsonl`.
///
/// # Errors
/// When a line is damaged; it is named.
pub fn read(path: &Path, profile: &HandProfile) -> Result<[Track<Joints>; 2], ReadError> {
    let mut samples = [Vec::new(), Vec::new()];
    for line in Lines::open(path)? {
        let (number, text) = line?;
        let Some(text) = json_line(&text) else {
            continue;
        };
        let fail = |reason: String| ReadError::malformed(path, Position::Line(number), reason);
        let line: Line = serde_json::from_str(text).map_err(|error| fail(error.to_string()))?;
        let poses = [line.hand_poses.left, line.hand_poses.right];
        for (side, pose) in poses.into_iter().enumerate() {
            let Some(pose) = pose else { continue };
            let angles: &[f64; ANGLES] = pose
                .joint_angles
                .get(..ANGLES)
                .and_then(|angles| angles.try_into().ok())
                .ok_or_else(|| fail(format!("{} joint angles", pose.joint_angles.len())))?;
            let [w, x, y, z] = pose.wrist_xform.q_wxyz;
            let rotation = unit_quaternion(w, x, y, z)
                .ok_or_else(|| fail("a wrist rotation of no unit length".to_owned()))?;
            let T_world_wrist = nalgebra::Isometry3::from_parts(
                Vector3::from(pose.wrist_xform.t_xyz).into(),
                rotation,
            )
            .to_homogeneous();
            samples[side].push((
                line.timestamp_ns,
                profile.joints(&T_world_wrist, angles, side == 1),
            ));
        }
    }
    Ok(samples.map(|samples| Track::new(samples, SECOND / 10, SECOND / 50)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn profile() -> HandProfile {
        let model = HandModel {
            joint_rest_positions: (0..22).map(|k| [f64::from(k), 10.0, 0.0]).collect(),
            joint_rotation_axes: vec![[0.0, 0.0, 1.0]; 22],
            landmark_rest_positions: (0..21).map(|k| [f64::from(k), 50.0, 5.0]).collect(),
            landmark_rest_bone_indices: vec![[4.0, 0.0, 0.0]; 21],
            landmark_rest_bone_weights: vec![[1.0, 0.0, 0.0]; 21],
        };
        HandProfile::from_model(&model).unwrap()
    }

    #[test]
    fn a_hand_at_rest_stands_where_its_profile_says_and_a_right_hand_mirrors_it() {
        let wrist = Matrix4::identity();
        let left = profile().joints(&wrist, &[0.0; ANGLES], false);
        let right = profile().joints(&wrist, &[0.0; ANGLES], true);
        // The wrist is landmark 5.
        assert!((left[0].unwrap() - Point3::new(0.005, 0.05, 0.005)).norm() < 1e-12);
        for (l, r) in left.iter().zip(&right) {
            let (l, r) = (l.unwrap(), r.unwrap());
            assert!((l.x + r.x).abs() < 1e-12 && (l.y - r.y).abs() < 1e-12);
        }
    }

    #[test]
    fn bending_one_joint_keeps_the_distance_to_its_axis() {
        let mut angles = [0.0; ANGLES];
        angles[1] = 0.7;
        let hand = profile().joints(&Matrix4::identity(), &angles, false);
        let pivot = Point3::new(0.001, 0.01, 0.0);
        let before = Point3::new(0.005, 0.05, 0.005);
        let after = hand[0].unwrap();
        assert!(((after - pivot).norm() - (before - pivot).norm()).abs() < 1e-12);
        assert!((after - before).norm() > 0.02);
    }
}
