//! glTF 2.0 (binary) with the wearer's skeletons and the camera, animated: opens in Blender, three.js, Windows and macOS viewers.
//!
//! A skeleton is a skin whose joints turn as in [`super::bvh`] and move as observed, so that every joint is exactly where it was
//! reconstructed; bones are small octahedra. Metres, y up, x right, as glTF has it; a frame with an unknown joint repeats the
//! last whole one, or the first.

use super::bvh::{children, from_camera, from_z_up, rest_offsets, rotations, whole_poses};
use crate::clip::Intrinsics;
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::{JOINTS, Joints, Skeleton};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::{Value, json};
use std::io::Write;

/// A skeleton over time, in the world (z up), metres.
#[derive(Debug)]
pub struct Wearer<'a> {
    /// Name of the node: `body`, `left_hand`.
    pub name: &'a str,
    /// Which joints are linked by bones.
    pub skeleton: &'a Skeleton,
    /// Joints in the world, metres, z up, one set per sample.
    pub poses: &'a [Joints],
    /// Red, green, blue, `[0, 1]`.
    pub colour: [f32; 3],
}

/// The camera over time, `T_world_camera` in the world (z up), and its projection.
#[derive(Debug)]
pub struct Camera<'a> {
    /// `T_world_camera` per sample.
    pub poses: &'a [Rigid],
    /// Of the square picture.
    pub intrinsics: &'a Intrinsics,
}

const FLOAT: u32 = 5126;
const BYTE: u32 = 5121;
const SHORT: u32 = 5123;

/// Writes skeletons and camera at `rate` samples a second; a skeleton that is never whole is left out.
///
/// # Errors
/// When writing fails, or the file would exceed 4 GB (as `InvalidData`).
pub fn write_glb(
    rate: f64,
    wearers: &[Wearer<'_>],
    camera: Option<&Camera<'_>>,
    out: &mut impl Write,
) -> std::io::Result<()> {
    let mut file = Glb::new(rate);
    for wearer in wearers {
        file.wearer(wearer);
    }
    if let Some(camera) = camera.filter(|camera| !camera.poses.is_empty()) {
        file.camera(camera);
    }
    file.write(out)
}

/// A file that is being put together.
#[derive(Debug, Default)]
struct Glb {
    rate: f64,
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    nodes: Vec<Value>,
    roots: Vec<usize>,
    skins: Vec<Value>,
    meshes: Vec<Value>,
    materials: Vec<Value>,
    cameras: Vec<Value>,
    samplers: Vec<Value>,
    channels: Vec<Value>,
}

impl Glb {
    fn new(rate: f64) -> Self {
        Self {
            rate,
            ..Self::default()
        }
    }

    /// An accessor over these bytes.
    fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        // Components lie at multiples of their size.
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let (offset, length) = (self.bytes.len(), bytes.len());
        self.bytes.extend_from_slice(bytes);
        let view = json!({"buffer": 0, "byteOffset": offset, "byteLength": length});
        self.views.push(view);
        let view = self.views.len() - 1;
        let accessor =
            json!({"bufferView": view, "componentType": component, "type": kind, "count": count});
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats(&mut self, values: &[f32], kind: &str, width: usize) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.accessor(&bytes, FLOAT, kind, values.len() / width)
    }

    /// The least and the most of each component, which times and positions must say.
    fn bounds(&mut self, accessor: usize, values: &[f32], width: usize) {
        let fold = |k: usize, pick: fn(f32, f32) -> f32| {
            let own = values.iter().skip(k).step_by(width).copied();
            own.reduce(pick).unwrap_or(0.0)
        };
        let of = |pick| (0..width).map(|k| fold(k, pick)).collect::<Vec<f32>>();
        self.accessors[accessor]["min"] = json!(of(f32::min));
        self.accessors[accessor]["max"] = json!(of(f32::max));
    }

    /// The times of so many samples.
    fn times(&mut self, count: usize) -> usize {
        let times: Vec<f32> = (0..count).map(|k| (k as f64 / self.rate) as f32).collect();
        let accessor = self.floats(&times, "SCALAR", 1);
        self.bounds(accessor, &times, 1);
        accessor
    }

    /// Animates `path` of a node.
    fn animate(&mut self, node: usize, path: &str, times: usize, values: &[f32]) {
        let (kind, width) = match path {
            "rotation" => ("VEC4", 4),
            _ => ("VEC3", 3),
        };
        let output = self.floats(values, kind, width);
        self.samplers
            .push(json!({"input": times, "output": output, "interpolation": "LINEAR"}));
        let sampler = self.samplers.len() - 1;
        self.channels
            .push(json!({"sampler": sampler, "target": {"node": node, "path": path}}));
    }

    fn wearer(&mut self, wearer: &Wearer<'_>) {
        let skeleton = wearer.skeleton;
        let poses = whole_poses(wearer.poses, &from_z_up());
        let Some(first) = poses.first() else {
            return;
        };
        let offsets = rest_offsets(skeleton, first, &poses);
        let start = self.nodes.len();
        for (joint, name) in skeleton.joints.iter().enumerate() {
            let mut node = json!({"name": format!("{}_{name}", wearer.name)});
            let below: Vec<usize> = children(skeleton, joint).map(|c| start + c).collect();
            if !below.is_empty() {
                node["children"] = json!(below);
            }
            let rest = if joint == 0 { first[0] } else { offsets[joint] };
            node["translation"] = json!(rest.as_slice());
            self.nodes.push(node);
        }
        self.motion(skeleton, &offsets, &poses, start);
        let rest = rest_positions(skeleton, first[0], &offsets);
        let skin = self.skin(&rest, start);
        let mesh = self.bones(wearer, &rest);
        self.nodes
            .push(json!({"name": wearer.name, "mesh": mesh, "skin": skin}));
        self.roots.extend([start, self.nodes.len() - 1]);
    }

    fn motion(
        &mut self,
        skeleton: &Skeleton,
        offsets: &[Vector3<f64>],
        poses: &[Vec<Vector3<f64>>],
        start: usize,
    ) {
        let times = self.times(poses.len());
        let mut turns = vec![Vec::new(); JOINTS];
        let mut moves = vec![Vec::new(); JOINTS];
        let mut before = [UnitQuaternion::identity(); JOINTS];
        for pose in poses {
            let world = rotations(skeleton, offsets, pose);
            for joint in 0..JOINTS {
                let parent = skeleton.parents[joint];
                let (mut turn, at) = if joint == 0 {
                    (world[0], pose[0])
                } else {
                    let back = world[parent].inverse();
                    (back * world[joint], back * (pose[joint] - pose[parent]))
                };
                // The shorter way between samples.
                if turn.coords.dot(&before[joint].coords) < 0.0 {
                    turn = UnitQuaternion::new_unchecked(-turn.into_inner());
                }
                before[joint] = turn;
                turns[joint].extend(turn.coords.iter().map(|v| *v as f32));
                moves[joint].extend(at.iter().map(|v| *v as f32));
            }
        }
        for joint in 0..JOINTS {
            self.animate(start + joint, "translation", times, &moves[joint]);
            // A tip does not turn.
            if children(skeleton, joint).next().is_some() {
                self.animate(start + joint, "rotation", times, &turns[joint]);
            }
        }
    }

    fn skin(&mut self, rest: &[Vector3<f64>], start: usize) -> usize {
        let inverse = rest.iter().flat_map(|p| {
            let [x, y, z] = [-p.x as f32, -p.y as f32, -p.z as f32];
            [
                1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, y, z, 1.0,
            ]
        });
        let inverse: Vec<f32> = inverse.collect();
        let accessor = self.floats(&inverse, "MAT4", 16);
        let joints: Vec<usize> = (start..start + JOINTS).collect();
        self.skins
            .push(json!({"joints": joints, "skeleton": start, "inverseBindMatrices": accessor}));
        self.skins.len() - 1
    }

    /// An octahedron per bone, which moves with the joint nearer to the root.
    fn bones(&mut self, wearer: &Wearer<'_>, rest: &[Vector3<f64>]) -> usize {
        let (mut places, mut joints, mut indices) = (Vec::new(), Vec::new(), Vec::new());
        for (from, to) in wearer.skeleton.bones() {
            let along = rest[to] - rest[from];
            let length = along.norm();
            if length < 1e-6 {
                continue;
            }
            let axis = along / length;
            let other = if axis.x.abs() < 0.9 {
                Vector3::x()
            } else {
                Vector3::y()
            };
            let u = axis.cross(&other).normalize() * (0.08 * length);
            let v = axis.cross(&u);
            let waist = rest[from] + along * 0.15;
            let first = (places.len() / 3) as u16;
            let corners = [
                rest[from],
                waist + u,
                waist + v,
                waist - u,
                waist - v,
                rest[to],
            ];
            places.extend(
                corners
                    .iter()
                    .flat_map(|p| [p.x as f32, p.y as f32, p.z as f32]),
            );
            joints.extend([from as u8, 0, 0, 0].repeat(6));
            for (a, b) in [(1, 2), (2, 3), (3, 4), (4, 1)] {
                indices.extend([0, b, a, 5, a, b].map(|k: u16| first + k));
            }
        }
        let position = self.floats(&places, "VEC3", 3);
        self.bounds(position, &places, 3);
        let count = places.len() / 3;
        let joints = self.accessor(&joints, BYTE, "VEC4", count);
        let weights = self.floats(&[1.0, 0.0, 0.0, 0.0].repeat(count), "VEC4", 4);
        let bytes: Vec<u8> = indices.iter().flat_map(|k| k.to_le_bytes()).collect();
        let indices = self.accessor(&bytes, SHORT, "SCALAR", indices.len());
        let [r, g, b] = wearer.colour;
        self.materials.push(json!({
            "name": wearer.name,
            "pbrMetallicRoughness": {"baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7},
        }));
        let primitive = json!({
            "attributes": {"POSITION": position, "JOINTS_0": joints, "WEIGHTS_0": weights},
            "indices": indices,
            "material": self.materials.len() - 1,
        });
        self.meshes
            .push(json!({"name": wearer.name, "primitives": [primitive]}));
        self.meshes.len() - 1
    }

    fn camera(&mut self, camera: &Camera<'_>) {
        let intrinsics = camera.intrinsics;
        let height = f64::from(intrinsics.height);
        let angle = 2.0 * (height / 2.0 / intrinsics.fy).atan();
        self.cameras.push(json!({
            "type": "perspective",
            "perspective": {"yfov": angle, "aspectRatio": f64::from(intrinsics.width) / height, "znear": 0.05},
        }));
        // glTF's camera looks along -z with y up; ours along z with y down.
        let up = from_z_up();
        let (mut turns, mut moves) = (Vec::new(), Vec::new());
        let mut before = UnitQuaternion::identity();
        for pose in camera.poses {
            let mut turn = up * pose.rotation * from_camera();
            if turn.coords.dot(&before.coords) < 0.0 {
                turn = UnitQuaternion::new_unchecked(-turn.into_inner());
            }
            before = turn;
            turns.extend(turn.coords.iter().map(|v| *v as f32));
            let at = up * pose.translation.vector;
            moves.extend(at.iter().map(|v| *v as f32));
        }
        let times = self.times(camera.poses.len());
        self.nodes
            .push(json!({"name": "camera", "camera": self.cameras.len() - 1}));
        let node = self.nodes.len() - 1;
        self.roots.push(node);
        self.animate(node, "translation", times, &moves);
        self.animate(node, "rotation", times, &turns);
    }

    fn write(self, out: &mut impl Write) -> std::io::Result<()> {
        let mut root = json!({
            "asset": {"version": "2.0", "generator": "reviv"},
            "scene": 0,
            "scenes": [{"nodes": self.roots}],
        });
        let parts = [
            ("nodes", self.nodes),
            ("meshes", self.meshes),
            ("skins", self.skins),
            ("materials", self.materials),
            ("cameras", self.cameras),
            ("accessors", self.accessors),
            ("bufferViews", self.views),
        ];
        // An empty list is not allowed.
        for (name, list) in parts {
            if !list.is_empty() {
                root[name] = Value::Array(list);
            }
        }
        if !self.channels.is_empty() {
            root["animations"] = json!([{"name": "reconstruction", "samplers": self.samplers, "channels": self.channels}]);
            root["buffers"] = json!([{"byteLength": self.bytes.len()}]);
        }
        let mut text = root.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bytes = self.bytes;
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        let chunk = if bytes.is_empty() { 0 } else { 8 + bytes.len() };
        let total = u32::try_from(12 + 8 + text.len() + chunk).map_err(|_| {
            std::io::Error::new(std::io::ErrorKind::InvalidData, "more than 4 GB of motion")
        })?;
        let number = |value: usize| (value as u32).to_le_bytes();
        out.write_all(b"glTF")?;
        out.write_all(&2_u32.to_le_bytes())?;
        out.write_all(&total.to_le_bytes())?;
        out.write_all(&number(text.len()))?;
        out.write_all(b"JSON")?;
        out.write_all(&text)?;
        if chunk > 0 {
            out.write_all(&number(bytes.len()))?;
            out.write_all(b"BIN\0")?;
            out.write_all(&bytes)?;
        }
        Ok(())
    }
}

/// Where joints are at rest: bones of median length in the directions of the first pose.
fn rest_positions(
    skeleton: &Skeleton,
    root: Vector3<f64>,
    offsets: &[Vector3<f64>],
) -> Vec<Vector3<f64>> {
    fn place(
        skeleton: &Skeleton,
        offsets: &[Vector3<f64>],
        joint: usize,
        at: Vector3<f64>,
        rest: &mut [Vector3<f64>],
    ) {
        rest[joint] = at;
        for child in children(skeleton, joint) {
            place(skeleton, offsets, child, at + offsets[child], rest);
        }
    }
    let mut rest = vec![root; JOINTS];
    place(skeleton, offsets, 0, root, &mut rest);
    rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::skeleton::BODY;

    /// What a reader needs of the file: the JSON and the bytes behind it.
    fn parsed(file: &[u8]) -> (Value, &[u8]) {
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], number(8)), (&b"glTF"[..], file.len()));
        let text = number(12);
        let json = serde_json::from_slice(&file[20..20 + text]).unwrap();
        (json, &file[28 + text..])
    }

    fn values(json: &Value, bytes: &[u8], accessor: &Value) -> Vec<f32> {
        let accessor = &json["accessors"][accessor.as_u64().unwrap() as usize];
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let at = |key: &str| view[key].as_u64().unwrap() as usize;
        let own = &bytes[at("byteOffset")..at("byteOffset") + at("byteLength")];
        let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        own.chunks_exact(4).map(number).collect()
    }

    #[test]
    fn every_joint_is_where_it_was_at_every_sample() {
        let pose = |t: usize| -> Joints {
            std::array::from_fn(|j| {
                let (t, j) = (t as f32, j as f32);
                [
                    (0.3 * t + j).sin(),
                    0.1 * j,
                    1.0 + 0.2 * (0.7 * j - t).cos(),
                ]
            })
        };
        let poses: Vec<Joints> = (0..4).map(pose).collect();
        let wearer = Wearer {
            name: "body",
            skeleton: &BODY,
            poses: &poses,
            colour: [0.5; 3],
        };
        let mut file = Vec::new();
        write_glb(30.0, &[wearer], None, &mut file).unwrap();
        let (json, bytes) = parsed(&file);
        let animation = &json["animations"][0];
        let track = |node: usize, path: &str| -> Option<Vec<f32>> {
            let channel = animation["channels"]
                .as_array()
                .unwrap()
                .iter()
                .find(|c| c["target"]["node"] == node && c["target"]["path"] == path)?;
            let sampler = &animation["samplers"][channel["sampler"].as_u64().unwrap() as usize];
            Some(values(&json, bytes, &sampler["output"]))
        };
        for (t, pose) in poses.iter().enumerate() {
            // Forward through the tree: parents come before children in the order of `depth_first`.
            let mut world = vec![Rigid::identity(); JOINTS];
            let mut open = vec![0];
            while let Some(joint) = open.pop() {
                let at = &track(joint, "translation").unwrap()[3 * t..3 * t + 3];
                let turn = track(joint, "rotation").map_or_else(UnitQuaternion::identity, |r| {
                    let q = &r[4 * t..4 * t + 4];
                    let [x, y, z, w] = [q[0], q[1], q[2], q[3]].map(f64::from);
                    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z))
                });
                let move_by = Vector3::new(at[0], at[1], at[2]).map(f64::from);
                let local = Rigid::from_parts(move_by.into(), turn);
                world[joint] = if joint == 0 {
                    local
                } else {
                    world[BODY.parents[joint]] * local
                };
                let truth = from_z_up() * Vector3::from(pose[joint].map(f64::from));
                assert!((world[joint].translation.vector - truth).norm() < 1e-5);
                open.extend(children(&BODY, joint));
            }
        }
    }

    #[test]
    fn what_is_never_whole_is_left_out_and_nothing_is_still_a_file() {
        let unknown = [[[f32::NAN; 3]; JOINTS]];
        let wearer = Wearer {
            name: "body",
            skeleton: &BODY,
            poses: &unknown,
            colour: [0.5; 3],
        };
        let mut file = Vec::new();
        write_glb(30.0, &[wearer], None, &mut file).unwrap();
        let number = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
        assert_eq!(file.len(), 20 + number);
    }
}
