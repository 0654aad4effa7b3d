//! The page of a reconstruction folder.

use super::Manifest;
use crate::clip::clock::SIGNAL_RATE;
use crate::reconstruction::depth::stack;
use crate::reconstruction::predictions::ScaleStatus;
use crate::reconstruction::result::Reconstruction;
use crate::reconstruction::samples::mean_of;
use crate::reconstruction::stitch::{Tracks, WindowBoundary};
use crate::reconstruction::track::Timeline;
use crate::view::scene::{SAMPLE, Tone};
use crate::view::{Badge, Certainty, DepthGrids, Fact, Part, Scene, Track};
use ndarray::Array2;

/// Samples that the page draws beside the reconstruction; the file has all of them.
const GHOSTS: usize = 8;

impl Reconstruction {
    pub(super) fn page(&self, manifest: &Manifest) -> Scene {
        let mut badges = self.info.badges.clone();
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
        let mut facts = self.info.assumptions.clone();
        facts.push(fact(
            "World",
            "z up, metres, origin and heading of the first camera",
        ));
        if let Some(fit) = &manifest.fit {
            let value = format!(
                "{}, residual {:.3} m over {} points",
                fit.words(),
                fit.residual,
                fit.points
            );
            facts.push(fact("Scale fit", &value));
        }
        if let Some(reason) = &manifest.refused {
            facts.push(fact("No metric depth", reason));
        }
        for (name, value) in &manifest.certainty {
            facts.push(fact(
                &format!("Token certainty, {name}"),
                &format!("{value:.2} (1 less the entropy of the tokens; not an accuracy)"),
            ));
        }
        for (name, values) in self.spread() {
            let Some(mean) = mean_of(&values) else {
                continue;
            };
            let n = self.samples.len();
            let value = if name == "gaze" {
                format!("{:.1} % of the image over {n} samples", 100.0 * mean)
            } else {
                format!("{:.0} mm over {n} samples", 1000.0 * mean)
            };
            facts.push(fact(&format!("Spread, {name}"), &value));
        }
        if let Some(seam) = worst_seam(&manifest.seams) {
            facts.push(fact("Largest seam", &seam));
        }
        let samples = self.info.samples;
        let mut list = vec![track_of("prediction", false, &self.tracks, samples)];
        let others = self.samples.iter().take(GHOSTS).enumerate();
        list.extend(others.map(|(k, sample)| {
            let mut ghost = track_of(&format!("{SAMPLE}{k}"), false, sample, samples);
            ghost.parts.retain(|part| part.modality != "gaze");
            ghost
        }));
        if let Some(truth) = &self.truth {
            list.push(track_of("truth", true, truth, samples));
        }
        let frames = self.grids.len().min(self.video.len());
        let depth = (frames > 0 && frames == self.video.len()).then(|| DepthGrids {
            metres: stack(&self.grids[..frames]),
        });
        Scene {
            title: self.info.title.clone(),
            badges,
            facts,
            rate: SIGNAL_RATE,
            samples,
            intrinsics: self.info.intrinsics,
            video: (!self.video.is_empty()).then(|| self.video.clone()),
            depth,
            cloud: self.cloud.clone(),
            floor: self.floor,
            tracks: list,
            certainty: self
                .certainty
                .iter()
                .map(|(name, values)| Certainty {
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
    let size = |seam: &WindowBoundary| seam.metres().map(|(_, v)| v).fold(0.0, f64::max);
    let worst = seams.iter().max_by(|a, b| size(a).total_cmp(&size(b)))?;
    let part = |(name, metres): (&str, f64)| format!("{name} {:.0} mm", metres * 1000.0);
    let parts: Vec<String> = worst.metres().map(part).collect();
    (!parts.is_empty()).then(|| format!("at {:.1} s: {}", worst.at_seconds, parts.join(", ")))
}

/// A track of the page, every part as long as the timeline.
fn track_of(name: &str, truth: bool, tracks: &Tracks, samples: usize) -> Track {
    let timeline = Timeline {
        samples,
        cameras: tracks.camera(),
    };
    let mut parts: Vec<Part> = tracks
        .iter()
        .flat_map(|(_, t)| t.parts(&timeline))
        .collect();
    for part in &mut parts {
        let held = std::mem::take(&mut part.values);
        let known = |at: (usize, usize)| held.get(at).copied().unwrap_or(f32::NAN);
        part.values = Array2::from_shape_fn((samples, held.ncols()), known);
    }
    Track {
        name: name.into(),
        truth,
        parts,
    }
}
