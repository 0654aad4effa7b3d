//! The tracks of the built-in modalities, and of every modality that brings none.
//!
//! The camera is chained by the rigid motion that fits the overlap, rotations by slerp; the body follows its window's camera
//! (it lives in the gravity frame of the window's first camera, so only heading and position change); hands stay in the camera
//! of their sample, gaze in its image. A value that is unknown on one side of a boundary is taken from the other.

use super::export::bvh::{from_camera, from_z_up, is_whole, write_bvh};
use super::export::camera::{write_colmap, write_tum};
use super::export::files::Files;
use super::export::write_gaze;
use super::folder_error::FolderError;
use super::predictions::ScaleStatus;
use super::track::{Description, Gap, Placement, Timeline, Track, TrackEntry, blend};
use super::windows::Window;
use crate::clip::clock::{CLIP_SECONDS, SIGNAL_RATE};
use crate::clip::tracks::pose_matrices;
use crate::clip::{BODY, CAMERA, Clip, GAZE, JointTrack, Key, LEFT_HAND, RIGHT_HAND, Signal};
use crate::geometry::rigid::{Rigid, interpolate};
use crate::geometry::skeleton::{self, JOINTS, Joints, Skeleton};
use crate::view::{Drawing, Part};
use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use ndarray::{Array1, Array2, Array3};

/// The unit of points in the image.
const SQUARE: &str = "share of the image: x right, y down";
const WORLD: &str = "world: z up, origin and heading of the first camera";

fn learned() -> ScaleStatus {
    ScaleStatus::Metric {
        by: "learning from metric data".into(),
    }
}

/// The path of the camera, `T_world_camera`; the world has z up.
#[derive(Debug, Default)]
pub struct CameraPath {
    /// One per motion sample at 30 Hz, metres.
    pub poses: Vec<Rigid>,
}
inventory::submit! { TrackEntry { modality: "camera", make: |_| Box::new(CameraPath::default()) } }

impl CameraPath {
    /// The motion that takes the window's own camera world to ours: the mean over the overlap.
    fn place(&self, place: &Placement<'_>, local: &[Rigid]) -> Rigid {
        let shared: Vec<_> = place.window.shared(&self.poses, local).collect();
        let Some((first, own)) = shared.first() else {
            return place.T_world_first * local[0].inverse();
        };
        let mut sum = Quaternion::new(0.0, 0.0, 0.0, 0.0);
        for (a, b) in &shared {
            let q = (a.rotation * b.rotation.inverse()).into_inner();
            // q and -q are the same rotation.
            sum += if q.coords.dot(&sum.coords) < 0.0 {
                -q
            } else {
                q
            };
        }
        let rotation = UnitQuaternion::try_new(sum, 1e-9)
            .unwrap_or_else(|| first.rotation * own.rotation.inverse());
        let offset = shared
            .iter()
            .map(|(a, b)| a.translation.vector - rotation * b.translation.vector)
            .sum::<Vector3<f64>>()
            / shared.len() as f64;
        Rigid::from_parts(offset.into(), rotation)
    }
}

impl Track for CameraPath {
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap> {
        let Some(camera) = clip
            .get(CAMERA)
            .filter(|camera| !camera.T_world_camera.is_empty())
        else {
            return Vec::new();
        };
        let placed = self.place(place, &camera.T_world_camera);
        let poses: Vec<Rigid> = camera
            .T_world_camera
            .iter()
            .map(|pose| placed * pose)
            .collect();
        place.T_world_first = poses[0];
        let shared = || place.window.shared(&self.poses, &poses);
        let metres = shared().map(|(a, b)| (a.translation.vector - b.translation.vector).norm());
        let degrees = shared().map(|(a, b)| a.rotation.angle_to(&b.rotation).to_degrees());
        let gaps = vec![
            Gap::new("camera_m", metres.collect()),
            Gap::new("camera_deg", degrees.collect()),
        ];
        place.window.append(&mut self.poses, &poses, interpolate);
        gaps
    }

    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError> {
        let facts = files.facts("T_world_camera", "m", WORLD, learned(), None);
        files.array("camera.npz", pose_matrices(&self.poses), facts);
        files.file("camera.tum", |out| write_tum(SIGNAL_RATE, &self.poses, out))?;
        let samples = files.samples_of_frames(self.poses.len());
        let at_frames: Vec<Rigid> = samples.map(|sample| self.poses[sample]).collect();
        let intrinsics = files.intrinsics;
        files.folder(
            "colmap",
            ["cameras.txt", "images.txt", "points3D.txt"],
            |folder| write_colmap(folder, &at_frames, &intrinsics),
        )
    }

    fn parts(&self, _: &Timeline<'_>) -> Vec<Part> {
        let rows = |(t, k): (usize, usize)| {
            let pose = &self.poses[t];
            let (p, q) = (pose.translation.vector, pose.rotation.coords);
            [p.x, p.y, p.z, q.x, q.y, q.z, q.w][k] as f32
        };
        let values = Array2::from_shape_fn((self.poses.len(), 7), rows);
        vec![Part::new("camera", "camera", Drawing::Camera, values)]
    }
}

/// Where the wearer looks, upright square image, `[0, 1]^2`; NaN where invalid.
#[derive(Debug, Default)]
pub struct GazePath {
    /// One per motion sample at 30 Hz.
    pub points: Vec<[f32; 2]>,
}
inventory::submit! { TrackEntry { modality: "gaze", make: |_| Box::new(GazePath::default()) } }

impl Track for GazePath {
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap> {
        let Some(gaze) = clip.get(GAZE) else {
            return Vec::new();
        };
        let rows = gaze.points.rows().into_iter().zip(&gaze.valid);
        let points: Vec<[f32; 2]> = rows
            .map(|(p, &valid)| if valid { [p[0], p[1]] } else { [f32::NAN; 2] })
            .collect();
        let mix = |a: &[f32; 2], b: &[f32; 2], t| blend(*a, *b, t);
        place.window.append(&mut self.points, &points, mix);
        Vec::new()
    }

    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError> {
        let facts = files.facts(
            "gaze",
            SQUARE,
            "upright square image",
            ScaleStatus::None,
            None,
        );
        let count = self.points.len();
        let values = Array2::from_shape_fn((count, 2), |(t, k)| self.points[t][k]);
        files.array("gaze.npz", values, facts);
        files.file("gaze.csv", |out| write_gaze(SIGNAL_RATE, &self.points, out))
    }

    fn parts(&self, _: &Timeline<'_>) -> Vec<Part> {
        let at = |(t, k): (usize, usize)| self.points[t][k];
        let values = Array2::from_shape_fn((self.points.len(), 2), at);
        vec![Part::new("gaze", "gaze", Drawing::ImagePoint, values)]
    }
}

/// The body in the world, or a hand in the camera of the same sample.
#[derive(Debug)]
pub struct JointPath {
    part: &'static JointPart,
    /// One per motion sample at 30 Hz: all joints in metres, NaN where unknown.
    pub poses: Vec<Joints>,
}

/// What distinguishes the body from a hand.
#[derive(Debug)]
struct JointPart {
    key: Key<'static, JointTrack>,
    skeleton: &'static Skeleton,
    /// Whether it moves with the camera of its sample instead of standing in the world.
    in_camera: bool,
    gap: &'static str,
    /// The file of its arrays, which both hands share.
    file: &'static str,
    layer: &'static str,
    /// Metres of a bone on the page.
    radius: f32,
    axes: fn() -> UnitQuaternion<f64>,
}

static BODY_PART: JointPart = JointPart {
    key: BODY,
    skeleton: &skeleton::BODY,
    in_camera: false,
    gap: "body_m",
    file: "body.npz",
    layer: "body",
    radius: 0.035,
    axes: from_z_up,
};

const fn hand(key: Key<'static, JointTrack>) -> JointPart {
    JointPart {
        key,
        skeleton: &skeleton::HAND,
        in_camera: true,
        gap: "hands_m",
        file: "hands.npz",
        layer: "hands",
        radius: 0.008,
        axes: from_camera,
    }
}

static LEFT_PART: JointPart = hand(LEFT_HAND);
static RIGHT_PART: JointPart = hand(RIGHT_HAND);
inventory::submit! { TrackEntry { modality: "left_hand", make: |_| JointPath::boxed(&LEFT_PART) } }
inventory::submit! { TrackEntry { modality: "right_hand", make: |_| JointPath::boxed(&RIGHT_PART) } }
inventory::submit! { TrackEntry { modality: "body", make: |_| JointPath::boxed(&BODY_PART) } }

impl JointPath {
    fn boxed(part: &'static JointPart) -> Box<dyn Track> {
        Box::new(Self {
            part,
            poses: Vec::new(),
        })
    }
}

impl Track for JointPath {
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap> {
        let Some(track) = clip.get(self.part.key) else {
            return Vec::new();
        };
        let to_world = gravity_to_world(&place.T_world_first);
        let joint = |t: usize, j: usize| {
            if !track.valid[[t, j]] {
                return [f32::NAN; 3];
            }
            let p: [f32; 3] = std::array::from_fn(|k| track.joints[[t, j, k]]);
            if self.part.in_camera {
                return p;
            }
            let moved = to_world * Point3::from(p.map(f64::from));
            [moved.x as f32, moved.y as f32, moved.z as f32]
        };
        let pose = |t| std::array::from_fn(|j| joint(t, j));
        let poses: Vec<Joints> = (0..track.joints.shape()[0]).map(pose).collect();
        let distance = |(a, b): (&[f32; 3], &[f32; 3])| {
            f64::from((Vector3::from(*a) - Vector3::from(*b)).norm())
        };
        let shared = place.window.shared(&self.poses, &poses);
        let distances = shared.flat_map(|(a, b)| a.iter().zip(b).map(distance));
        let gap = Gap::new(self.part.gap, distances.filter(|d| d.is_finite()).collect());
        place.window.append(&mut self.poses, &poses, blend_joints);
        vec![gap]
    }

    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError> {
        let (part, poses) = (self.part, &self.poses);
        let name = part.key.name();
        let frame = if part.in_camera {
            "camera of the same sample, OpenCV axes"
        } else {
            WORLD
        };
        let values = Array3::from_shape_fn((poses.len(), JOINTS, 3), |(t, j, k)| poses[t][j][k]);
        let valid = Array2::from_shape_fn((poses.len(), JOINTS), |(t, j)| {
            poses[t][j].iter().all(|v| v.is_finite())
        });
        files.array_with_validity(part.file, name, values, valid, "m", frame, learned());
        // A skeleton that is never seen whole has no motion to write.
        if !poses.iter().any(is_whole) {
            return Ok(());
        }
        files.file(&format!("{name}.bvh"), |out| {
            write_bvh(part.skeleton, poses, SIGNAL_RATE, &(part.axes)(), out)
        })
    }

    fn follows_camera(&self) -> bool {
        !self.part.in_camera
    }

    fn parts(&self, timeline: &Timeline<'_>) -> Vec<Part> {
        let at = |(t, i): (usize, usize)| {
            let (p, k) = (self.poses[t][i / 3], i % 3);
            match timeline.cameras.get(t) {
                Some(pose) if self.part.in_camera => {
                    (pose * Point3::from(p.map(f64::from)))[k] as f32
                }
                _ => p[k],
            }
        };
        let values = Array2::from_shape_fn((self.poses.len(), 3 * JOINTS), at);
        let bones = self.part.skeleton.bones();
        let drawing = Drawing::Joints {
            bones: bones.map(|(a, b)| (a, b, self.part.radius)).collect(),
            in_image: self.part.in_camera,
        };
        vec![Part::new(
            self.part.key.name(),
            self.part.layer,
            drawing,
            values,
        )]
    }
}

/// Joint by joint.
pub(super) fn blend_joints(a: &Joints, b: &Joints, t: f64) -> Joints {
    std::array::from_fn(|j| blend(a[j], b[j], t))
}

/// The gravity frame of a camera (origin at its centre, x along the horizontal part of its right axis, z up) in the world.
pub fn gravity_to_world(T_world_camera: &Rigid) -> Rigid {
    let right = T_world_camera.rotation * Vector3::x();
    let yaw = right.y.atan2(right.x);
    Rigid::from_parts(
        T_world_camera.translation,
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
    )
}

/// Channels over time, blended linearly: a modality that brings no track of its own.
#[derive(Debug)]
pub struct SignalTrack {
    /// What the modality says of itself.
    pub description: Description,
    /// Samples per second.
    pub rate: f64,
    /// One row per sample; NaN where unknown.
    pub rows: Vec<Vec<f32>>,
}

impl SignalTrack {
    /// Nothing yet.
    pub fn new(description: Description) -> Self {
        Self {
            description,
            rate: SIGNAL_RATE,
            rows: Vec::new(),
        }
    }
}

impl Track for SignalTrack {
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap> {
        let Some(signal) = clip.held(&self.description.modality).and_then(|held| {
            // A value of another type than `Signal` is its arrays.
            let arrays = held.to_arrays();
            <Signal as crate::clip::Value>::from_arrays(&arrays).ok()
        }) else {
            return Vec::new();
        };
        let samples = signal.values.shape().first().copied().unwrap_or(0);
        if samples == 0 {
            return Vec::new();
        }
        let width = signal.values.len() / samples;
        let valid: Option<Vec<bool>> = signal.valid.map(|valid| valid.into_iter().collect());
        let values: Vec<f32> = signal.values.into_iter().collect();
        let known = |i: usize| valid.as_ref().is_none_or(|v| v[i * v.len() / values.len()]);
        let value = |i: usize| if known(i) { values[i] } else { f32::NAN };
        let row = |t: usize| (t * width..(t + 1) * width).map(value).collect();
        let rows: Vec<Vec<f32>> = (0..samples).map(row).collect();
        self.rate = self
            .description
            .rate
            .unwrap_or(samples as f64 / CLIP_SECONDS);
        let window: Window = place.window.at_rate(self.rate);
        let mix = |a: &Vec<f32>, b: &Vec<f32>, t| {
            let one = |(a, b): (&f32, &f32)| blend([*a], [*b], t)[0];
            a.iter().zip(b).map(one).collect::<Vec<f32>>()
        };
        window.append(&mut self.rows, &rows, mix);
        Vec::new()
    }

    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError> {
        let about = &self.description;
        let width = self.rows.first().map_or(0, Vec::len);
        let at = |(t, c): (usize, usize)| self.rows[t].get(c).copied().unwrap_or(f32::NAN);
        let values = Array2::from_shape_fn((self.rows.len(), width), at);
        let valid: Array1<bool> = values
            .rows()
            .into_iter()
            .map(|row| row.iter().all(|v| v.is_finite()))
            .collect();
        let file = format!("{}.npz", plain(&about.modality));
        files.rate = self.rate;
        let (unit, frame) = (about.units.join(" "), about.frame.as_str());
        let scale = about.scale.clone().unwrap_or(ScaleStatus::None);
        files.array_with_validity(&file, &about.modality, values, valid, &unit, frame, scale);
        files.rate = SIGNAL_RATE;
        Ok(())
    }

    fn parts(&self, timeline: &Timeline<'_>) -> Vec<Part> {
        let about = &self.description;
        let width = self.rows.first().map_or(0, Vec::len);
        let at = |(sample, c): (usize, usize)| {
            let row = (sample as f64 / SIGNAL_RATE * self.rate).round() as usize;
            self.rows
                .get(row)
                .and_then(|row| row.get(c))
                .copied()
                .unwrap_or(f32::NAN)
        };
        let values = Array2::from_shape_fn((timeline.samples, width), at);
        let drawing = Drawing::Plot {
            channels: about.channels.clone(),
            units: about.units.clone(),
        };
        vec![Part::new(&about.modality, &about.modality, drawing, values)]
    }
}

/// A name that stays in its folder: modalities may come from the folder of a model.
fn plain(name: &str) -> String {
    let keep = |c: char| {
        if c.is_alphanumeric() || "_-".contains(c) {
            c
        } else {
            '_'
        }
    };
    name.chars().map(keep).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::Intrinsics;
    use crate::reconstruction::windows::windows;
    use ndarray::ArrayD;

    #[test]
    fn a_signal_of_another_rate_is_blended_and_its_file_stays_in_the_folder() {
        let name = "../pulse";
        let mut track = SignalTrack::new(Description {
            modality: name.to_owned(),
            rate: Some(50.0),
            ..Description::default()
        });
        for window in windows(3.5, 0.5).unwrap() {
            let mut clip = Clip::empty("a", "test");
            let mut valid = ArrayD::from_elem(vec![100], true);
            valid[[99]] = false;
            let signal = Signal {
                values: ArrayD::from_elem(vec![100, 1], window.index as f32),
                valid: Some(valid),
            };
            clip.set(Key::new(name), signal);
            let mut place = Placement {
                window: &window,
                T_world_first: Rigid::identity(),
            };
            track.push(&clip, &mut place);
        }
        let values: Vec<f32> = track.rows.iter().map(|row| row[0]).collect();
        assert_eq!(values.len(), 175);
        assert!(values[..174].windows(2).all(|p| p[1] >= p[0]));
        // Unknown on one side of the boundary, and at the very end.
        assert_eq!((values[99], values[174].is_nan()), (1.0, true));
        let folder = tempfile::tempdir().unwrap();
        let inside = folder.path().join("in");
        std::fs::create_dir(&inside).unwrap();
        let intrinsics = Intrinsics {
            fx: 1.0,
            fy: 1.0,
            cx: 0.0,
            cy: 0.0,
            width: 1,
            height: 1,
        };
        let mut files = Files::new(&inside, intrinsics, (0, 8.0));
        track.write(&mut files).unwrap();
        let (facts, names) = files.finish().unwrap();
        assert_eq!(names, ["___pulse.npz"]);
        assert_eq!(
            (facts[0].rate, facts[0].shape.as_slice()),
            (Some(50.0), [175, 1].as_slice())
        );
        assert!(inside.join("___pulse.npz").is_file());
    }
}
