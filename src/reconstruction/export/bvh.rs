//! BVH motion of a skeleton that is known by its joint positions.
//!
//! A BVH skeleton has constant bones and rotations. Bone lengths are the median over time; each joint's rotation is the one that
//! best turns its rest bones into the observed ones (with a single bone, the smallest such rotation: twist is not observable
//! from positions). The root carries the position. Lengths are centimetres and y is up, as BVH readers expect.

use crate::geometry::skeleton::{JOINTS, Joints, Skeleton};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use std::io::Write;

/// Writes every frame, so that the motion stays in time with the video: one with an unknown joint repeats the last that is whole, or,
/// before there is any, the first.
///
/// `up` turns the source's axes into x right, y up, z back: [`from_z_up`] for the world, [`from_camera`] for camera space.
///
/// # Errors
/// When writing fails, or no frame has all joints (as `InvalidData`).
pub fn write_bvh(
    skeleton: &Skeleton,
    frames: &[Joints],
    rate: f64,
    up: &UnitQuaternion<f64>,
    out: &mut impl Write,
) -> std::io::Result<()> {
    let poses: Vec<Vec<Vector3<f64>>> = whole_poses(frames, up);
    let Some(first) = poses.first() else {
        return Err(std::io::Error::new(
            std::io::ErrorKind::InvalidData,
            format!("no frame of the {} has all joints", skeleton.name),
        ));
    };
    let rest = rest_offsets(skeleton, first, &poses);
    writeln!(out, "HIERARCHY")?;
    joint_header(skeleton, &rest, 0, 0, out)?;
    writeln!(
        out,
        "MOTION\nFrames: {}\nFrame Time: {:.8}",
        poses.len(),
        1.0 / rate
    )?;
    for pose in &poses {
        let root = pose[0] * 100.0;
        write!(out, "{:.4} {:.4} {:.4}", root.x, root.y, root.z)?;
        let world = rotations(skeleton, &rest, pose);
        for joint in depth_first(skeleton, 0) {
            if children(skeleton, joint).next().is_none() {
                continue;
            }
            let local = if joint == 0 {
                world[0]
            } else {
                world[skeleton.parents[joint]].inverse() * world[joint]
            };
            let [z, x, y] = zxy(&local).map(f64::to_degrees);
            write!(out, " {z:.4} {x:.4} {y:.4}")?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// World axes (x right, y forward, z up) to BVH axes (x right, y up, z back).
pub fn from_z_up() -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2)
}

/// Camera axes (x right, y down, z forward) to BVH axes (x right, y up, z back).
pub fn from_camera() -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
}

/// One pose per frame: its own where the frame is whole, else the last whole one, or the first. None where no frame is whole.
pub(super) fn whole_poses(frames: &[Joints], up: &UnitQuaternion<f64>) -> Vec<Vec<Vector3<f64>>> {
    let Some(mut last) = frames.iter().find(|frame| is_whole(frame)) else {
        return Vec::new();
    };
    let pose = |joints: &Joints| -> Vec<_> {
        let turned = joints.iter().map(|p| up * Vector3::from(p.map(f64::from)));
        turned.collect()
    };
    frames
        .iter()
        .map(|frame| {
            if is_whole(frame) {
                last = frame;
            }
            pose(last)
        })
        .collect()
}

/// Whether all joints are known.
pub(crate) fn is_whole(joints: &Joints) -> bool {
    joints.iter().flatten().all(|value| value.is_finite())
}

pub(super) fn children(skeleton: &Skeleton, joint: usize) -> impl Iterator<Item = usize> + '_ {
    (0..JOINTS).filter(move |&c| c != joint && skeleton.parents[c] == joint)
}

fn depth_first(skeleton: &Skeleton, joint: usize) -> Vec<usize> {
    let mut order = vec![joint];
    for child in children(skeleton, joint) {
        order.extend(depth_first(skeleton, child));
    }
    order
}

/// Directions of the first pose with median lengths.
pub(super) fn rest_offsets(
    skeleton: &Skeleton,
    first: &[Vector3<f64>],
    poses: &[Vec<Vector3<f64>>],
) -> Vec<Vector3<f64>> {
    (0..JOINTS)
        .map(|joint| {
            let parent = skeleton.parents[joint];
            let mut lengths: Vec<f64> = poses
                .iter()
                .map(|p| (p[joint] - p[parent]).norm())
                .collect();
            lengths.sort_by(f64::total_cmp);
            let direction = (first[joint] - first[parent])
                .try_normalize(1e-9)
                .unwrap_or_else(Vector3::zeros);
            direction * lengths[lengths.len() / 2]
        })
        .collect()
}

/// World rotation of every joint: the rotation of its rest bones that fits the observed ones best.
pub(super) fn rotations(
    skeleton: &Skeleton,
    rest: &[Vector3<f64>],
    pose: &[Vector3<f64>],
) -> Vec<UnitQuaternion<f64>> {
    let mut world = vec![UnitQuaternion::identity(); JOINTS];
    for joint in depth_first(skeleton, 0) {
        let parent = if joint == 0 {
            UnitQuaternion::identity()
        } else {
            world[skeleton.parents[joint]]
        };
        let bones: Vec<(Vector3<f64>, Vector3<f64>)> = children(skeleton, joint)
            .map(|c| (parent * rest[c], pose[c] - pose[joint]))
            .filter(|(a, b)| a.norm() > 1e-9 && b.norm() > 1e-9)
            .collect();
        let turn = match bones.as_slice() {
            [] => UnitQuaternion::identity(),
            [(a, b)] => UnitQuaternion::rotation_between(a, b).unwrap_or_else(|| {
                UnitQuaternion::from_axis_angle(&any_normal(a), std::f64::consts::PI)
            }),
            several => {
                let spread: Matrix3<f64> = several.iter().map(|(a, b)| b * a.transpose()).sum();
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_eps(
                    &spread,
                    1e-12,
                    100,
                    Rotation3::identity(),
                ))
            }
        };
        world[joint] = turn * parent;
    }
    world
}

fn any_normal(v: &Vector3<f64>) -> nalgebra::Unit<Vector3<f64>> {
    let other = if v.x.abs() < 0.9 * v.norm() {
        Vector3::x()
    } else {
        Vector3::y()
    };
    nalgebra::Unit::new_normalize(v.cross(&other))
}

/// Intrinsic Z, X, Y angles: `R = Rz Rx Ry`.
fn zxy(rotation: &UnitQuaternion<f64>) -> [f64; 3] {
    let m = rotation.to_rotation_matrix();
    let x = m[(2, 1)].clamp(-1.0, 1.0).asin();
    if m[(2, 1)].abs() > 1.0 - 1e-9 {
        return [m[(1, 0)].atan2(m[(0, 0)]), x, 0.0];
    }
    [
        (-m[(0, 1)]).atan2(m[(1, 1)]),
        x,
        (-m[(2, 0)]).atan2(m[(2, 2)]),
    ]
}

fn joint_header(
    skeleton: &Skeleton,
    rest: &[Vector3<f64>],
    joint: usize,
    depth: usize,
    out: &mut impl Write,
) -> std::io::Result<()> {
    let pad = "  ".repeat(depth);
    let offset = if joint == 0 {
        Vector3::zeros()
    } else {
        rest[joint] * 100.0
    };
    let leaf = children(skeleton, joint).next().is_none();
    let name = skeleton.joints[joint].replace(' ', "_");
    match (joint, leaf) {
        (0, _) => writeln!(out, "{pad}ROOT {name}")?,
        (_, false) => writeln!(out, "{pad}JOINT {name}")?,
        (_, true) => writeln!(out, "{pad}End Site")?,
    }
    writeln!(
        out,
        "{pad}{{\n{pad}  OFFSET {:.6} {:.6} {:.6}",
        offset.x, offset.y, offset.z
    )?;
    if joint == 0 {
        let channels = "Xposition Yposition Zposition Zrotation Xrotation Yrotation";
        writeln!(out, "{pad}  CHANNELS 6 {channels}")?;
    } else if !leaf {
        writeln!(out, "{pad}  CHANNELS 3 Zrotation Xrotation Yrotation")?;
    }
    for child in children(skeleton, joint) {
        joint_header(skeleton, rest, child, depth + 1, out)?;
    }
    writeln!(out, "{pad}}}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::skeleton::BODY;

    /// Reads what the writer wrote, by the rules of the format: joints in file order with offsets and channels.
    fn forward(text: &str) -> Vec<Vec<Vector3<f64>>> {
        let (header, motion) = text.split_once("MOTION").unwrap();
        let mut joints: Vec<(Option<usize>, Vector3<f64>, bool)> = Vec::new();
        let mut stack: Vec<usize> = Vec::new();
        for line in header.lines().map(str::trim) {
            let words: Vec<&str> = line.split_whitespace().collect();
            match words.first() {
                Some(&"ROOT" | &"JOINT") => {
                    joints.push((stack.last().copied(), Vector3::zeros(), true));
                }
                Some(&"End") => joints.push((stack.last().copied(), Vector3::zeros(), false)),
                Some(&"{") => stack.push(joints.len() - 1),
                Some(&"}") => {
                    stack.pop();
                }
                Some(&"OFFSET") => {
                    let v: Vec<f64> = words[1..].iter().map(|w| w.parse().unwrap()).collect();
                    joints.last_mut().unwrap().1 = Vector3::new(v[0], v[1], v[2]);
                }
                _ => {}
            }
        }
        let mut frames = Vec::new();
        for line in motion.lines().skip(3) {
            let mut n = line.split(' ').map(|w| w.parse::<f64>().unwrap());
            let mut next = || n.next().unwrap();
            let root = Vector3::new(next(), next(), next());
            let mut placed: Vec<(Vector3<f64>, UnitQuaternion<f64>)> = Vec::new();
            for (parent, offset, turns) in &joints {
                let (at, base) = match parent {
                    Some(p) => (placed[*p].0 + placed[*p].1 * offset, placed[*p].1),
                    None => (root, UnitQuaternion::identity()),
                };
                let turn = if *turns {
                    let about = |axis, degrees: f64| {
                        UnitQuaternion::from_axis_angle(&axis, degrees.to_radians())
                    };
                    let z = about(Vector3::z_axis(), next());
                    let x = about(Vector3::x_axis(), next());
                    z * x * about(Vector3::y_axis(), next())
                } else {
                    UnitQuaternion::identity()
                };
                placed.push((at, base * turn));
            }
            frames.push(placed.into_iter().map(|p| p.0 / 100.0).collect());
        }
        frames
    }

    #[test]
    fn a_reader_of_the_file_gets_the_joints_back() {
        // A chain that bends: every bone keeps its length and turns with its own rhythm.
        let frames: Vec<Joints> = (0..20)
            .map(|t| {
                let mut pose = [[0.0_f32; 3]; JOINTS];
                let mut world = [UnitQuaternion::identity(); JOINTS];
                for j in depth_first(&BODY, 0) {
                    let swing = 0.4 * (0.3 * f64::from(t) + j as f64).sin();
                    let axis =
                        nalgebra::Unit::new_normalize(Vector3::new(1.0, j as f64 * 0.3, 0.5));
                    let turn = UnitQuaternion::from_axis_angle(&axis, swing);
                    let parent = BODY.parents[j];
                    if j == 0 {
                        pose[0] = [0.1 * t as f32, 0.0, 0.9];
                        world[0] = turn;
                        continue;
                    }
                    let rest =
                        Vector3::new((j as f64).sin(), (j as f64).cos(), 0.5).normalize() * 0.2;
                    let at = Vector3::from(pose[parent].map(f64::from)) + world[parent] * rest;
                    pose[j] = [at.x as f32, at.y as f32, at.z as f32];
                    world[j] = world[parent] * turn;
                }
                pose
            })
            .collect();
        let mut out = Vec::new();
        write_bvh(&BODY, &frames, 30.0, &from_z_up(), &mut out).unwrap();
        let read = forward(&String::from_utf8(out).unwrap());
        let order = depth_first(&BODY, 0);
        let mut worst = 0.0_f64;
        for (frame, joints) in frames.iter().zip(&read) {
            for (place, &joint) in order.iter().enumerate() {
                let truth = from_z_up() * Vector3::from(frame[joint].map(f64::from));
                worst = worst.max((joints[place] - truth).norm());
            }
        }
        assert!(worst < 2e-3, "{worst} m");
    }

    #[test]
    fn every_frame_has_a_pose_from_the_nearest_whole_one_before_it_or_the_first() {
        let at = |x: f32| [[x, 0.0, 0.0]; JOINTS];
        let mut part = at(9.0);
        part[3][1] = f32::NAN;
        let poses = whole_poses(&[part, at(1.0), part, at(2.0)], &UnitQuaternion::identity());
        let found: Vec<f64> = poses.iter().map(|pose| pose[0].x).collect();
        assert_eq!(found, [1.0, 1.0, 1.0, 2.0]);
    }

    #[test]
    fn a_skeleton_that_is_never_whole_is_refused() {
        let frames = [[[f32::NAN; 3]; JOINTS]];
        let error = write_bvh(&BODY, &frames, 30.0, &from_z_up(), &mut Vec::new()).unwrap_err();
        assert!(error.to_string().contains("no frame"));
    }
}
