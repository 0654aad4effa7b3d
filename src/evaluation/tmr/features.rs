//! 22 joints with y up to the 263 numbers per frame step of `HumanML3D`, as the code that made TMR's training data computes them.
//!
//! Known errors of that code that all weights were trained with, and that are therefore reproduced: the heading of every frame
//! mixes left minus right hips with right minus left shoulders (the facing of the first frame has them right); the rotation of
//! frame 0 is the identity by force, so row 0 holds a jump; the yaw step is half the angle; smoothing counts frames, not seconds;
//! the threshold of contacts is per step, whatever the rate.

use super::skeleton::{AXES, CHAINS, JOINTS, LENGTHS, PARENTS, Pose};
use crate::evaluation::outcome::MetricError;

/// Numbers of a row.
pub const FEATURES: usize = 263;

/// Squared metres below which a foot that moves in one step is in contact.
const CONTACT: f64 = 0.002;
/// Left ankle, left foot, right ankle, right foot.
const FEET: [usize; 4] = [7, 10, 8, 11];
/// Frames of the Gaussian that smooths the heading, and where it is cut off.
const SIGMA: f64 = 20.0;
const RADIUS: i64 = 80;
/// Bones shorter than this (metres) have no direction.
const SHORTEST: f64 = 1e-6;

type Vector = [f64; 3];
/// `w, x, y, z`.
pub type Quaternion = [f64; 4];

/// The features of a motion, with the steps to them.
#[derive(Debug, Clone)]
pub struct Features {
    /// Bones of the reference lengths, the root scaled by the ratio of the legs.
    pub retargeted: Vec<Pose>,
    /// Turns the first frame to +z.
    pub facing: Quaternion,
    /// On the floor, starting at x = z = 0, turned.
    pub global: Vec<Pose>,
    /// Of every frame: turns the smoothed heading to +z; the identity in frame 0.
    pub root_rotation: Vec<Quaternion>,
    /// Per joint, relative along the chains; the root's is `root_rotation`.
    pub local_rotations: Vec<[Quaternion; JOINTS]>,
    /// One per frame step.
    pub rows: Vec<[f64; FEATURES]>,
}

/// The features of a motion of at least two frames.
///
/// # Errors
/// When there are fewer, a value is not finite, or a bone has no length.
pub fn features(joints: &[Pose]) -> Result<Features, MetricError> {
    if joints.len() < 2 {
        return Err(MetricError::TooShort {
            found: joints.len(),
            needed: 2,
        });
    }
    check(joints)?;
    let retargeted = retarget(joints);
    let facing = facing(&retargeted[0]);
    let global = placed(&retargeted, facing);
    let root_rotation = headings(&global);
    let local_rotations: Vec<_> = global
        .iter()
        .zip(&root_rotation)
        .map(|(pose, root)| local(pose, *root))
        .collect();
    let rows = (0..joints.len() - 1)
        .map(|t| row(&global, &root_rotation, &local_rotations[t], t))
        .collect();
    Ok(Features {
        retargeted,
        facing,
        global,
        root_rotation,
        local_rotations,
        rows,
    })
}

fn check(joints: &[Pose]) -> Result<(), MetricError> {
    for (frame, pose) in joints.iter().enumerate() {
        for (joint, place) in pose.iter().enumerate() {
            if place.iter().any(|value| !value.is_finite()) {
                return Err(MetricError::NotFinite {
                    field: "joints",
                    position: vec![frame, joint],
                });
            }
            if joint > 0 && norm(sub(*place, pose[PARENTS[joint]])) < SHORTEST {
                return Err(MetricError::NoBone { frame, joint });
            }
        }
    }
    Ok(())
}

fn retarget(joints: &[Pose]) -> Vec<Pose> {
    let first = &joints[0];
    let leg = |a: usize, b: usize| norm(sub(first[b], first[a]));
    let scale = (LENGTHS[5] + LENGTHS[8]) / (leg(2, 5) + leg(5, 8));
    joints
        .iter()
        .map(|pose| {
            let mut placed = [[0.0; 3]; JOINTS];
            placed[0] = pose[0].map(|value| value * scale);
            for joint in 1..JOINTS {
                let parent = PARENTS[joint];
                let along = unit(sub(pose[joint], pose[parent]));
                placed[joint] =
                    std::array::from_fn(|k| placed[parent][k] + LENGTHS[joint] * along[k]);
            }
            placed
        })
        .collect()
}

/// The rotation about the vertical that turns a pose to +z.
fn facing(pose: &Pose) -> Quaternion {
    let across = unit(add(sub(pose[2], pose[1]), sub(pose[17], pose[16])));
    between(unit(cross([0.0, 1.0, 0.0], across)), [0.0, 0.0, 1.0])
}

/// On the floor, the first root at x = z = 0, everything turned by `facing`.
fn placed(retargeted: &[Pose], facing: Quaternion) -> Vec<Pose> {
    let heights = retargeted.iter().flatten().map(|joint| joint[1]);
    let floor = heights.fold(f64::INFINITY, f64::min);
    let root = retargeted[0][0];
    let start = [root[0], floor, root[2]];
    retargeted
        .iter()
        .map(|pose| pose.map(|joint| rotate(facing, sub(joint, start))))
        .collect()
}

/// Left minus right hip plus right minus left shoulder: the original's error (see above). Shoulders win.
fn heading(pose: &Pose) -> Vector {
    let across = unit(add(sub(pose[1], pose[2]), sub(pose[17], pose[16])));
    cross([0.0, 1.0, 0.0], across)
}

fn headings(global: &[Pose]) -> Vec<Quaternion> {
    let raw: Vec<Vector> = global.iter().map(heading).collect();
    let kernel: Vec<f64> = (-RADIUS..=RADIUS)
        .map(|i| (-0.5 * (i as f64 / SIGMA).powi(2)).exp())
        .collect();
    let total: f64 = kernel.iter().sum();
    let last = raw.len() as i64 - 1;
    (0..raw.len() as i64)
        .map(|t| {
            if t == 0 {
                return [1.0, 0.0, 0.0, 0.0];
            }
            let mut sum = [0.0; 3];
            for (offset, weight) in (-RADIUS..=RADIUS).zip(&kernel) {
                let at = (t + offset).clamp(0, last) as usize;
                for (sum, value) in sum.iter_mut().zip(raw[at]) {
                    *sum += value * weight / total;
                }
            }
            between(unit(sum), [0.0, 0.0, 1.0])
        })
        .collect()
}

fn local(pose: &Pose, root: Quaternion) -> [Quaternion; JOINTS] {
    let mut rotations = [[1.0, 0.0, 0.0, 0.0]; JOINTS];
    rotations[0] = root;
    for chain in CHAINS {
        let mut along = root;
        for pair in chain.windows(2) {
            let (parent, joint) = (pair[0], pair[1]);
            let whole = between(AXES[joint], unit(sub(pose[joint], pose[parent])));
            rotations[joint] = product(conjugate(along), whole);
            along = product(along, rotations[joint]);
        }
    }
    rotations
}

fn row(
    global: &[Pose],
    root_rotation: &[Quaternion],
    local: &[Quaternion; JOINTS],
    t: usize,
) -> [f64; FEATURES] {
    let (now, next) = (&global[t], &global[t + 1]);
    let (turn, next_turn) = (root_rotation[t], root_rotation[t + 1]);
    let mut row = [0.0; FEATURES];
    // Half the angle of the step: the y part of a quaternion, not of a rotation.
    row[0] = product(next_turn, conjugate(turn))[2]
        .clamp(-1.0, 1.0)
        .asin();
    let velocity = rotate(next_turn, sub(next[0], now[0]));
    (row[1], row[2]) = (velocity[0], velocity[2]);
    row[3] = now[0][1];
    for joint in 1..JOINTS {
        // Heights stay absolute.
        let [x, y, z] = now[joint];
        let place = rotate(turn, [x - now[0][0], y, z - now[0][2]]);
        row[4 + 3 * (joint - 1)..][..3].copy_from_slice(&place);
        let columns = first_columns(local[joint]);
        row[67 + 6 * (joint - 1)..][..6].copy_from_slice(&columns);
    }
    for joint in 0..JOINTS {
        let velocity = rotate(turn, sub(next[joint], now[joint]));
        row[193 + 3 * joint..][..3].copy_from_slice(&velocity);
    }
    for (column, foot) in FEET.into_iter().enumerate() {
        let moved = sub(next[foot], now[foot]);
        row[259 + column] = f64::from(u8::from(dot(moved, moved) < CONTACT));
    }
    row
}

fn add(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|k| a[k] + b[k])
}

fn sub(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|k| a[k] - b[k])
}

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Vector, b: Vector) -> Vector {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn norm(a: Vector) -> f64 {
    dot(a, a).sqrt()
}

/// Zero stays zero.
fn unit(a: Vector) -> Vector {
    let length = norm(a);
    if length > 0.0 {
        a.map(|value| value / length)
    } else {
        a
    }
}

/// The shortest rotation from `a` to `b`; half a turn about an axis across `a` where they are opposite.
fn between(a: Vector, b: Vector) -> Quaternion {
    let axis = cross(a, b);
    let w = norm(a) * norm(b) + dot(a, b);
    let length = (w * w + dot(axis, axis)).sqrt();
    if length < 1e-12 {
        let upright = a[0] == 0.0 && a[2] == 0.0;
        return if upright {
            [0.0, 1.0, 0.0, 0.0]
        } else {
            [0.0, 0.0, 1.0, 0.0]
        };
    }
    [w, axis[0], axis[1], axis[2]].map(|value| value / length)
}

fn product(p: Quaternion, q: Quaternion) -> Quaternion {
    [
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    ]
}

fn conjugate(q: Quaternion) -> Quaternion {
    [q[0], -q[1], -q[2], -q[3]]
}

fn rotate(q: Quaternion, v: Vector) -> Vector {
    let turned = product(product(q, [0.0, v[0], v[1], v[2]]), conjugate(q));
    [turned[1], turned[2], turned[3]]
}

/// `r00 r10 r20 r01 r11 r21` of the rotation matrix.
fn first_columns([w, x, y, z]: Quaternion) -> [f64; 6] {
    let s = 2.0 / (w * w + x * x + y * y + z * z);
    [
        1.0 - s * (y * y + z * z),
        s * (x * y + z * w),
        s * (x * z - y * w),
        s * (x * y - z * w),
        1.0 - s * (x * x + z * z),
        s * (y * z + x * w),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A figure that stands on its reference bones and sways.
    pub(super) fn standing(frames: usize) -> Vec<Pose> {
        (0..frames)
            .map(|t| {
                let mut pose = [[0.0, 0.9, 0.0]; JOINTS];
                for joint in 1..JOINTS {
                    let parent = pose[PARENTS[joint]];
                    let sway = 0.1 * (t as f64 * 0.3 + joint as f64).sin();
                    let along = unit(add(AXES[joint], [sway, 0.0, sway]));
                    pose[joint] = std::array::from_fn(|k| parent[k] + LENGTHS[joint] * along[k]);
                }
                pose
            })
            .collect()
    }

    fn largest_difference(a: &Features, b: &Features) -> f64 {
        let pairs = a.rows.iter().flatten().zip(b.rows.iter().flatten());
        pairs.fold(0.0, |worst, (x, y)| worst.max((x - y).abs()))
    }

    #[test]
    fn place_yaw_height_and_size_of_a_person_change_nothing() {
        let motion = standing(9);
        let yaw = [0.9_f64.cos(), 0.0, 0.9_f64.sin(), 0.0];
        let moved: Vec<Pose> = motion
            .iter()
            .map(|pose| {
                pose.map(|joint| add(rotate(yaw, joint).map(|v| v * 0.8), [3.0, 0.5, -2.0]))
            })
            .collect();
        let (a, b) = (features(&motion).unwrap(), features(&moved).unwrap());
        assert!(largest_difference(&a, &b) < 1e-9);
        // A mirror is no rotation.
        let mirrored: Vec<Pose> = motion
            .iter()
            .map(|pose| pose.map(|[x, y, z]| [-x, y, z]))
            .collect();
        assert!(largest_difference(&a, &features(&mirrored).unwrap()) > 0.01);
    }

    #[test]
    fn two_and_three_frames_work_and_one_does_not() {
        assert_eq!(features(&standing(2)).unwrap().rows.len(), 1);
        let three = features(&standing(3)).unwrap();
        assert!(three.rows.iter().flatten().all(|value| value.is_finite()));
        assert!(features(&standing(1)).is_err());
        assert!(features(&[]).is_err());
    }

    #[test]
    fn a_bone_without_length_and_a_missing_joint_are_refused_by_name() {
        let mut motion = standing(4);
        motion[2][3] = motion[2][0];
        let error = features(&motion).unwrap_err().to_string();
        assert!(
            error.contains("joint 3") && error.contains("frame 2"),
            "{error}"
        );
        motion[2][3] = [f64::NAN; 3];
        assert!(features(&motion).is_err());
    }

    #[test]
    fn a_clip_that_faces_backwards_is_turned_round() {
        let yaw = [0.0, 0.0, 1.0, 0.0];
        let motion = standing(5);
        let back: Vec<Pose> = motion
            .iter()
            .map(|pose| pose.map(|joint| rotate(yaw, joint)))
            .collect();
        let (a, b) = (features(&motion).unwrap(), features(&back).unwrap());
        assert!(largest_difference(&a, &b) < 1e-9);
    }
}
