//! Windows become one reconstruction: each is moved to where the overlap says it belongs, and the seam is blended.
//!
//! The camera is chained by the rigid motion that fits the overlap, rotations by slerp; the body follows its window's camera
//! (it lives in the gravity frame of the window's first camera, so only heading and position change); hands stay in the camera
//! of their sample, gaze in its image. A value that is unknown on one side of a seam is taken from the other.

use super::windows::Window;
use crate::clip::{Clip, JointTrack};
use crate::geometry::rigid::{Rigid, interpolate};
use crate::geometry::skeleton::JOINTS;
use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// One pose of 21 joints, metres; NaN where unknown.
pub type Joints = [[f32; 3]; JOINTS];

/// Everything low-dimensional about the wearer over the whole video, at 30 Hz. A signal that was never predicted is empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracks {
    /// `T_world_camera`; the world has z up.
    pub camera: Vec<Rigid>,
    /// Upright square image, `[0, 1]^2`; NaN where invalid.
    pub gaze: Vec<[f32; 2]>,
    /// In the camera of the same sample.
    pub left_hand: Vec<Joints>,
    /// In the camera of the same sample.
    pub right_hand: Vec<Joints>,
    /// In the world.
    pub body: Vec<Joints>,
}

/// How well two neighbouring windows agree where they overlap, before blending.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct WindowBoundary {
    /// The later window.
    pub window: usize,
    /// Seconds from the start of the video.
    pub at_seconds: f64,
    /// Mean distance of camera positions after the rigid fit, metres.
    pub camera_m: Option<f64>,
    /// Mean angle between camera rotations after the rigid fit, degrees.
    pub camera_deg: Option<f64>,
    /// Mean distance of body joints, metres.
    pub body_m: Option<f64>,
    /// Mean distance of hand joints, metres.
    pub hands_m: Option<f64>,
}

/// Takes windows in order and builds [`Tracks`].
#[derive(Debug, Clone)]
pub struct Stitcher {
    /// Pose of the first camera in the world.
    first: Rigid,
    tracks: Tracks,
    seams: Vec<WindowBoundary>,
}

impl Stitcher {
    /// `first` is the world pose of the video's first camera: [`crate::geometry::rigid::level_camera`] where nothing better is known.
    pub fn new(first: Rigid) -> Self {
        Self {
            first,
            tracks: Tracks::default(),
            seams: Vec::new(),
        }
    }

    /// Adds the decoded clip of a window. Windows must come in order.
    pub fn push(&mut self, window: &Window, clip: &Clip) {
        let mut seam = WindowBoundary {
            window: window.index,
            at_seconds: window.start_seconds(),
            ..WindowBoundary::default()
        };
        let mut first_camera = self.first;
        if let Some(camera) = clip.camera() {
            let local = &camera.T_world_camera;
            let placed = self.place_camera(window, local);
            let poses: Vec<Rigid> = local.iter().map(|pose| placed * pose).collect();
            first_camera = poses[0];
            let shared = window
                .overlap
                .min(self.tracks.camera.len().saturating_sub(window.start));
            if shared > 0 {
                let old = &self.tracks.camera[window.start..window.start + shared];
                let pairs = old.iter().zip(&poses);
                seam.camera_m = mean(
                    pairs
                        .clone()
                        .map(|(a, b)| (a.translation.vector - b.translation.vector).norm()),
                );
                seam.camera_deg =
                    mean(pairs.map(|(a, b)| a.rotation.angle_to(&b.rotation).to_degrees()));
            }
            append(&mut self.tracks.camera, window, &poses, |a, b, t| {
                interpolate(a, b, t)
            });
        }
        if let Some(gaze) = clip.gaze() {
            let points: Vec<[f32; 2]> = gaze
                .points
                .rows()
                .into_iter()
                .zip(&gaze.valid)
                .map(|(p, &valid)| if valid { [p[0], p[1]] } else { [f32::NAN; 2] })
                .collect();
            append(&mut self.tracks.gaze, window, &points, |a, b, t| {
                blend(*a, *b, t)
            });
        }
        let mut hands = Vec::new();
        for (track, held) in [
            (clip.left_hand(), &mut self.tracks.left_hand),
            (clip.right_hand(), &mut self.tracks.right_hand),
        ] {
            if let Some(track) = track {
                let joints = joints_of(track);
                hands.extend(seam_distance(held, window, &joints));
                append(held, window, &joints, blend_joints);
            }
        }
        seam.hands_m = mean(hands.into_iter());
        if let Some(track) = clip.body() {
            let to_world = gravity_to_world(&first_camera);
            let joints: Vec<Joints> = joints_of(track)
                .iter()
                .map(|pose| {
                    pose.map(|p| {
                        let moved = to_world * Point3::from(p.map(f64::from));
                        [moved.x as f32, moved.y as f32, moved.z as f32]
                    })
                })
                .collect();
            seam.body_m = seam_distance(&self.tracks.body, window, &joints);
            append(&mut self.tracks.body, window, &joints, blend_joints);
        }
        if window.overlap > 0 {
            self.seams.push(seam);
        }
    }

    /// What has been built, and how the seams were.
    pub fn finish(self) -> (Tracks, Vec<WindowBoundary>) {
        (self.tracks, self.seams)
    }

    /// The motion that takes the window's own camera world to ours: the mean over the overlap.
    fn place_camera(&self, window: &Window, local: &[Rigid]) -> Rigid {
        let held = &self.tracks.camera;
        let shared = window
            .overlap
            .min(held.len().saturating_sub(window.start))
            .min(local.len());
        if shared == 0 {
            return self.first * local[0].inverse();
        }
        let old = &held[window.start..window.start + shared];
        let mut sum = Quaternion::new(0.0, 0.0, 0.0, 0.0);
        for (a, b) in old.iter().zip(local) {
            let q = (a.rotation * b.rotation.inverse()).into_inner();
            // q and -q are the same rotation.
            sum += if q.coords.dot(&sum.coords) < 0.0 {
                -q
            } else {
                q
            };
        }
        let rotation = UnitQuaternion::try_new(sum, 1e-9)
            .unwrap_or_else(|| old[0].rotation * local[0].rotation.inverse());
        let offset = old
            .iter()
            .zip(local)
            .map(|(a, b)| a.translation.vector - rotation * b.translation.vector)
            .sum::<Vector3<f64>>()
            / shared as f64;
        Rigid::from_parts(offset.into(), rotation)
    }
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

/// Share of the new window at sample `i` of an overlap: rises from just above 0 to just below 1.
pub(super) fn ramp(i: usize, overlap: usize) -> f64 {
    (i + 1) as f64 / (overlap + 1) as f64
}

fn append<T: Clone>(held: &mut Vec<T>, window: &Window, new: &[T], mix: impl Fn(&T, &T, f64) -> T) {
    for (i, value) in new.iter().take(window.inside).enumerate() {
        let at = window.start + i;
        if at < held.len() {
            held[at] = mix(&held[at], value, ramp(i, window.overlap));
        } else {
            held.push(value.clone());
        }
    }
}

fn blend<const N: usize>(a: [f32; N], b: [f32; N], t: f64) -> [f32; N] {
    match (
        a.iter().all(|v| v.is_finite()),
        b.iter().all(|v| v.is_finite()),
    ) {
        (true, true) => {
            std::array::from_fn(|k| (f64::from(a[k]) * (1.0 - t) + f64::from(b[k]) * t) as f32)
        }
        (true, false) => a,
        _ => b,
    }
}

fn blend_joints(a: &Joints, b: &Joints, t: f64) -> Joints {
    std::array::from_fn(|j| blend(a[j], b[j], t))
}

fn joints_of(track: &JointTrack) -> Vec<Joints> {
    (0..track.joints.shape()[0])
        .map(|t| {
            std::array::from_fn(|j| {
                std::array::from_fn(|k| {
                    if track.valid[[t, j]] {
                        track.joints[[t, j, k]]
                    } else {
                        f32::NAN
                    }
                })
            })
        })
        .collect()
}

fn seam_distance(held: &[Joints], window: &Window, new: &[Joints]) -> Option<f64> {
    let shared = window
        .overlap
        .min(held.len().saturating_sub(window.start))
        .min(new.len());
    let old = &held[held.len().min(window.start)..][..shared];
    mean(old.iter().zip(new).flat_map(|(a, b)| {
        (0..JOINTS).filter_map(move |j| {
            let d = Vector3::from(a[j]) - Vector3::from(b[j]);
            let d = f64::from(d.norm());
            d.is_finite().then_some(d)
        })
    }))
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0_usize), |(sum, n), v| (sum + v, n + 1));
    (n > 0).then(|| sum / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{BODY, CAMERA, CameraTrack, LEFT_HAND};
    use crate::geometry::rigid::level_camera;
    use crate::reconstruction::windows::windows;
    use ndarray::{Array2, Array3};

    /// A walk that turns and climbs, as poses in a z-up world.
    fn walk(sample: usize) -> Rigid {
        let t = sample as f64 / 30.0;
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.4 * t);
        let nod = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.2 * (2.0 * t).sin());
        let at = Vector3::new(t.sin(), 0.8 * t, 0.05 * (3.0 * t).cos() - 0.05);
        Rigid::from_parts(at.into(), yaw * level_camera().rotation * nod)
    }

    fn clip_at(start: usize) -> Clip {
        let first = walk(start);
        let mut clip = Clip::empty("test", "test");
        let poses: Vec<Rigid> = (start..start + 60)
            .map(|s| first.inv_mul(&walk(s)))
            .collect();
        clip.set(
            CAMERA,
            CameraTrack {
                rate: 30.0,
                valid: vec![true; 60],
                T_world_camera: poses,
                up_world: None,
                intrinsics: None,
            },
        );
        // A body whose joints hang below the walking camera.
        let from_world = gravity_to_world(&first).inverse();
        clip.set(
            BODY,
            JointTrack {
                rate: 30.0,
                joints: Array3::from_shape_fn((60, JOINTS, 3), |(t, j, k)| {
                    let world = walk(start + t).translation.vector
                        - Vector3::new(0.0, 0.0, 0.07 * j as f64);
                    (from_world * Point3::from(world))[k] as f32
                }),
                valid: Array2::from_elem((60, JOINTS), true),
            },
        );
        clip
    }

    #[test]
    fn windows_of_one_walk_give_the_walk_back() {
        let mut stitcher = Stitcher::new(walk(0));
        let list = windows(7.3, 0.5).unwrap();
        for window in &list {
            stitcher.push(window, &clip_at(window.start));
        }
        let (tracks, seams) = stitcher.finish();
        assert_eq!(tracks.camera.len(), 219);
        assert_eq!(tracks.body.len(), 219);
        assert_eq!(seams.len(), list.len() - 1);
        for (sample, pose) in tracks.camera.iter().enumerate() {
            let truth = walk(sample);
            assert!((pose.translation.vector - truth.translation.vector).norm() < 1e-9);
            assert!(pose.rotation.angle_to(&truth.rotation) < 1e-7);
            let head = Vector3::from(tracks.body[sample][0].map(f64::from));
            assert!((head - truth.translation.vector).norm() < 1e-5);
        }
        assert!(
            seams
                .iter()
                .all(|s| s.camera_m.unwrap() < 1e-9 && s.body_m.unwrap() < 1e-5)
        );
    }

    #[test]
    fn a_seam_is_smooth_and_reported() {
        let mut stitcher = Stitcher::new(level_camera());
        let list = windows(3.5, 0.5).unwrap();
        for (k, window) in list.iter().enumerate() {
            let mut clip = Clip::empty("test", "test");
            let joints = Array3::from_elem((60, JOINTS, 3), k as f32);
            clip.set(
                LEFT_HAND,
                JointTrack {
                    rate: 30.0,
                    joints,
                    valid: Array2::from_elem((60, JOINTS), true),
                },
            );
            stitcher.push(window, &clip);
        }
        let (tracks, seams) = stitcher.finish();
        let x: Vec<f32> = tracks.left_hand.iter().map(|p| p[0][0]).collect();
        assert!(x.windows(2).all(|p| p[1] >= p[0] && p[1] - p[0] < 0.08));
        assert!((seams[0].hands_m.unwrap() - 3_f64.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn what_one_window_does_not_know_comes_from_the_other() {
        let a = [[1.0; 3]; JOINTS];
        let b = [[f32::NAN; 3]; JOINTS];
        assert_eq!(blend_joints(&a, &b, 0.9), a);
        assert_eq!(blend_joints(&b, &a, 0.1), a);
    }
}
