//! The page of a reconstruction folder.

use super::{Folder, Manifest};
use crate::clip::clock::SIGNAL_RATE;
use crate::geometry::skeleton::JOINTS;
use crate::reconstruction::depth::stack;
use crate::reconstruction::export::ply::Point;
use crate::reconstruction::predictions::ScaleStatus;
use crate::reconstruction::stitch::{Joints, Stitcher, Tracks, WindowBoundary};
use crate::reconstruction::windows::Window;
use crate::view::scene::Tone;
use crate::view::{Badge, Confidence, DepthGrids, Fact, Scene, Track};
use nalgebra::Point3;
use ndarray::{Array2, Array3, s};

impl Folder {
    pub(super) fn page(
        &self,
        tracks: Tracks,
        cloud: Vec<Point>,
        floor: Option<f64>,
        manifest: &Manifest,
    ) -> Scene {
        let mut badges = self.setting.badges.clone();
        let tone = if matches!(manifest.scale, ScaleStatus::Metric { .. }) {
            Tone::Good
        } else {
            Tone::Warn
        };
        if !self.grids.is_empty() {
            badges.push(Badge {
                text: format!("depth: {}", manifest.scale.words()),
                tone,
            });
        }
        let mut facts = self.setting.assumptions.clone();
        facts.push(fact(
            "World",
            "z up, metres, origin and heading of the first camera",
        ));
        if let Some(fit) = &manifest.fit {
            let value = format!(
                "depth x {:.3} + {:.3} m, residual {:.3} m over {} points",
                fit.scale, fit.shift, fit.residual, fit.points
            );
            facts.push(fact("Scale fit", &value));
        }
        if let Some(reason) = &manifest.refused {
            facts.push(fact("No metric depth", reason));
        }
        for (name, value) in &manifest.confidence {
            facts.push(fact(
                &format!("Confidence, {name}"),
                &format!("{value:.2} (token entropy)"),
            ));
        }
        if let Some(seam) = worst_seam(&manifest.seams) {
            facts.push(fact("Largest seam", &seam));
        }
        let mut list = vec![track_of("prediction", false, &tracks)];
        if let Some(truth) = &self.setting.truth {
            let window = Window {
                index: 0,
                start: 0,
                inside: self.setting.samples,
                overlap: 0,
            };
            let mut stitcher = Stitcher::new(self.setting.first);
            stitcher.push(&window, truth);
            list.push(track_of("truth", true, &stitcher.finish().0));
        }
        for track in &mut list {
            fit_length(track, self.setting.samples);
        }
        let frames = self.grids.len().min(self.video.len());
        let depth = (frames > 0 && frames == self.video.len()).then(|| DepthGrids {
            metres: stack(&self.grids[..frames]),
        });
        Scene {
            title: self.setting.title.clone(),
            badges,
            facts,
            rate: SIGNAL_RATE,
            samples: self.setting.samples,
            intrinsics: self.setting.intrinsics,
            video: (!self.video.is_empty()).then(|| self.video.clone()),
            depth,
            cloud,
            floor,
            tracks: list,
            confidence: self
                .confidence
                .iter()
                .map(|(name, values)| Confidence {
                    name: name.clone(),
                    values: values.clone(),
                })
                .collect(),
        }
    }
}

fn fact(label: &str, value: &str) -> Fact {
    Fact {
        label: label.into(),
        value: value.into(),
    }
}

fn worst_seam(seams: &[WindowBoundary]) -> Option<String> {
    let size = |seam: &WindowBoundary| {
        let parts = [seam.body_m, seam.camera_m, seam.hands_m];
        parts.into_iter().flatten().fold(0.0, f64::max)
    };
    let worst = seams.iter().max_by(|a, b| size(a).total_cmp(&size(b)))?;
    let part =
        |name: &str, value: Option<f64>| value.map(|v| format!("{name} {:.0} mm", v * 1000.0));
    let parts = [
        part("body", worst.body_m),
        part("camera", worst.camera_m),
        part("hands", worst.hands_m),
    ];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| format!("at {:.1} s: {}", worst.at_seconds, parts.join(", ")))
}

/// A track of the page: hands are moved to the world, gaze stays in the image.
fn track_of(name: &str, truth: bool, tracks: &Tracks) -> Track {
    let array = |joints: &[Joints], in_camera: bool| {
        (!joints.is_empty()).then(|| {
            Array3::from_shape_fn((joints.len(), JOINTS, 3), |(t, j, k)| {
                let p = joints[t][j];
                match tracks.camera.get(t) {
                    Some(pose) if in_camera => (pose * Point3::from(p.map(f64::from)))[k] as f32,
                    _ => p[k],
                }
            })
        })
    };
    Track {
        name: name.into(),
        truth,
        camera: (!tracks.camera.is_empty())
            .then(|| tracks.camera.iter().copied().map(Some).collect()),
        gaze: (!tracks.gaze.is_empty())
            .then(|| Array2::from_shape_fn((tracks.gaze.len(), 2), |(t, k)| tracks.gaze[t][k])),
        body: array(&tracks.body, false),
        left_hand: array(&tracks.left_hand, true),
        right_hand: array(&tracks.right_hand, true),
    }
}

/// Cuts or fills (with unknown) every part of a track to the timeline.
fn fit_length(track: &mut Track, samples: usize) {
    if let Some(camera) = &mut track.camera {
        camera.resize(samples, None);
    }
    if let Some(gaze) = &mut track.gaze {
        let held = std::mem::replace(gaze, Array2::from_elem((samples, 2), f32::NAN));
        let n = held.nrows().min(samples);
        gaze.slice_mut(s![..n, ..]).assign(&held.slice(s![..n, ..]));
    }
    for joints in [&mut track.body, &mut track.left_hand, &mut track.right_hand]
        .into_iter()
        .flatten()
    {
        let held = std::mem::replace(joints, Array3::from_elem((samples, JOINTS, 3), f32::NAN));
        let n = held.shape()[0].min(samples);
        joints
            .slice_mut(s![..n, .., ..])
            .assign(&held.slice(s![..n, .., ..]));
    }
}
