//! Windows become one reconstruction: each is moved to where the overlap says it belongs, and the boundary is blended. How, is for
//! each modality to say ([`super::tracks`]).

use super::track::{Description, Placement, Track, TrackEntry};
use super::tracks::{CameraPath, GazePath, JointPath, SignalTrack};
use super::windows::Window;
use crate::clip::{CAMERA, Clip, DEPTH, RGB};
use crate::geometry::rigid::Rigid;
use crate::modality::{self, BUILT_IN, ClipFormat};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::collections::BTreeMap;

pub use super::tracks::gravity_to_world;
pub use crate::geometry::skeleton::Joints;

/// Everything low-dimensional about the wearer over the whole video, by modality. A modality that was never predicted is absent.
#[derive(Debug, Default)]
pub struct Tracks {
    held: Vec<(String, Box<dyn Track>)>,
}

impl Tracks {
    /// The track of a modality, if it is a `T`.
    #[must_use]
    pub fn get<T: Track>(&self, modality: &str) -> Option<&T> {
        let (_, track) = self.held.iter().find(|(name, _)| name == modality)?;
        let any: &dyn Any = &**track;
        any.downcast_ref()
    }

    /// Every track: the built-in modalities in their order, then the others by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &dyn Track)> {
        self.held
            .iter()
            .map(|(name, track)| (name.as_str(), &**track))
    }

    /// `T_world_camera` at 30 Hz; the world has z up. Empty where it was not predicted, as all that follow.
    #[must_use]
    pub fn camera(&self) -> &[Rigid] {
        self.get(CAMERA.name())
            .map_or(&[], |track: &CameraPath| &track.poses)
    }

    /// Upright square image, `[0, 1]^2`, at 30 Hz; NaN where invalid.
    #[must_use]
    pub fn gaze(&self) -> &[[f32; 2]] {
        self.get("gaze")
            .map_or(&[], |track: &GazePath| &track.points)
    }

    /// In the camera of the same sample, at 30 Hz.
    #[must_use]
    pub fn left_hand(&self) -> &[Joints] {
        self.joints("left_hand")
    }

    /// In the camera of the same sample, at 30 Hz.
    #[must_use]
    pub fn right_hand(&self) -> &[Joints] {
        self.joints("right_hand")
    }

    /// In the world, at 30 Hz.
    #[must_use]
    pub fn body(&self) -> &[Joints] {
        self.joints("body")
    }

    /// A modality that brings no track of its own, at its own rate.
    #[must_use]
    pub fn signal(&self, modality: &str) -> Option<&SignalTrack> {
        self.get(modality)
    }

    fn joints(&self, modality: &str) -> &[Joints] {
        self.get(modality)
            .map_or(&[], |track: &JointPath| &track.poses)
    }
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
    /// Mean distances of other modalities, by the name of the quantity.
    #[serde(flatten)]
    pub others: BTreeMap<String, f64>,
}

impl WindowBoundary {
    /// The distances, by what they are of.
    pub fn metres(&self) -> impl Iterator<Item = (&str, f64)> {
        let own = [
            ("body", self.body_m),
            ("camera", self.camera_m),
            ("hands", self.hands_m),
        ];
        let others = self.others.iter();
        let others = others.filter_map(|(name, v)| Some((name.strip_suffix("_m")?, *v)));
        own.into_iter()
            .filter_map(|(name, v)| Some((name, v?)))
            .chain(others)
    }
}

/// Takes windows in order and builds [`Tracks`].
#[derive(Debug)]
pub struct Stitcher {
    /// Pose of the first camera in the world.
    first: Rigid,
    described: BTreeMap<String, Description>,
    tracks: Tracks,
    boundaries: Vec<WindowBoundary>,
}

impl Stitcher {
    /// `first` is the world pose of the video's first camera: [`crate::geometry::rigid::level_camera`] where nothing better is known.
    pub fn new(first: Rigid) -> Self {
        Self {
            first,
            described: BTreeMap::new(),
            tracks: Tracks::default(),
            boundaries: Vec::new(),
        }
    }

    /// With what the modalities of a format say of themselves: channels, units and rates of those that bring no track.
    #[must_use]
    pub fn with_format(mut self, format: &ClipFormat) -> Self {
        let all = modality::all(format);
        let described = all
            .iter()
            .map(|m| (m.name().to_owned(), Description::of(m.as_ref())));
        self.described = described.collect();
        self
    }

    /// An empty one that knows the same of the modalities.
    #[must_use]
    pub fn another(&self) -> Self {
        Self {
            described: self.described.clone(),
            ..Self::new(self.first)
        }
    }

    /// Adds the decoded clip of a window. Windows must come in order.
    pub fn push(&mut self, window: &Window, clip: &Clip) {
        let mut place = Placement {
            window,
            T_world_first: self.first,
        };
        let mut gaps: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        // Frames and depth are streamed to the folder, not held.
        let pictures = [RGB.name(), DEPTH.name()];
        let mut present: Vec<&str> = clip
            .modalities()
            .filter(|m| !pictures.contains(m))
            .collect();
        // The camera first: it says where the window is.
        let order = |m: &str| {
            (
                BUILT_IN
                    .iter()
                    .position(|b| *b == m)
                    .unwrap_or(BUILT_IN.len()),
                m.to_owned(),
            )
        };
        present.sort_by_key(|m| order(m));
        for modality in present {
            let held = &mut self.tracks.held;
            let at = held
                .iter()
                .position(|(name, _)| name == modality)
                .unwrap_or_else(|| {
                    let at = held.partition_point(|(name, _)| order(name) < order(modality));
                    held.insert(at, (modality.to_owned(), track(modality, &self.described)));
                    at
                });
            for gap in held[at].1.push(clip, &mut place) {
                gaps.entry(gap.name).or_default().extend(gap.distances);
            }
        }
        if window.overlap > 0 {
            let mut means: BTreeMap<String, f64> = gaps
                .into_iter()
                .filter_map(|(name, d)| Some((name, mean(&d)?)))
                .collect();
            self.boundaries.push(WindowBoundary {
                window: window.index,
                at_seconds: window.start_seconds(),
                camera_m: means.remove("camera_m"),
                camera_deg: means.remove("camera_deg"),
                body_m: means.remove("body_m"),
                hands_m: means.remove("hands_m"),
                others: means,
            });
        }
    }

    /// What has been built, and how the windows agreed.
    pub fn finish(self) -> (Tracks, Vec<WindowBoundary>) {
        (self.tracks, self.boundaries)
    }
}

/// Whether several windows of a modality need the camera's path, which says where each of them starts.
#[must_use]
pub fn follows_camera(modality: &str) -> bool {
    track(modality, &BTreeMap::new()).follows_camera()
}

fn track(modality: &str, described: &BTreeMap<String, Description>) -> Box<dyn Track> {
    let mut description = described.get(modality).cloned().unwrap_or_default();
    modality.clone_into(&mut description.modality);
    let mut linked = inventory::iter::<TrackEntry>();
    match linked.find(|entry| entry.modality == modality) {
        Some(entry) => (entry.make)(&description),
        None => Box::new(SignalTrack::new(description)),
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{BODY, CameraTrack, JointTrack, LEFT_HAND};
    use crate::geometry::rigid::level_camera;
    use crate::geometry::skeleton::JOINTS;
    use crate::reconstruction::tracks::blend_joints;
    use crate::reconstruction::windows::windows;
    use nalgebra::{Point3, UnitQuaternion, Vector3};
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
        assert_eq!(tracks.camera().len(), 219);
        assert_eq!(tracks.body().len(), 219);
        assert_eq!(seams.len(), list.len() - 1);
        for (sample, pose) in tracks.camera().iter().enumerate() {
            let truth = walk(sample);
            assert!((pose.translation.vector - truth.translation.vector).norm() < 1e-9);
            assert!(pose.rotation.angle_to(&truth.rotation) < 1e-7);
            let head = Vector3::from(tracks.body()[sample][0].map(f64::from));
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
        let x: Vec<f32> = tracks.left_hand().iter().map(|p| p[0][0]).collect();
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
