//! Reconstruction errors of one modality in physical units, averaged over clips.

use crate::clip::{Clip, Intrinsics, Signal};
use crate::evaluation::statistics::{RESAMPLES, bootstrap_mean};
use crate::modality::camera::row_to_pose;
use crate::modality::{Modality, Shape};
use crate::tokenizer::video::psnr;
use serde::Serialize;
use std::collections::BTreeMap;

/// The one metric of which more is better.
const PSNR: &str = "psnr_db";

/// A difference of errors on the same clips, positive where the first are better, with its 95 % interval over clips.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gain {
    /// Over clips.
    pub mean: f64,
    /// The interval's lower end.
    pub low: f64,
    /// The interval's upper end.
    pub high: f64,
}

/// The mean error of every clip, by metric; the name says the unit.
#[derive(Debug, Clone, Default)]
pub(super) struct Errors {
    clips: Vec<BTreeMap<String, f64>>,
}

/// The errors of one clip.
#[derive(Debug, Default)]
struct Sums(BTreeMap<String, Sum>);

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    total: f64,
    count: u64,
    /// The root of the mean is reported.
    root: bool,
}

impl Sums {
    fn add(&mut self, name: &str, value: f64) {
        let sum = self.0.entry(name.to_owned()).or_default();
        sum.total += value;
        sum.count += 1;
    }

    fn add_square(&mut self, name: &str, difference: f64) {
        self.add(name, difference * difference);
        if let Some(sum) = self.0.get_mut(name) {
            sum.root = true;
        }
    }

    fn means(self) -> BTreeMap<String, f64> {
        let mean = |sum: Sum| {
            let mean = sum.total / sum.count as f64;
            if sum.root { mean.sqrt() } else { mean }
        };
        self.0
            .into_iter()
            .map(|(name, sum)| (name, mean(sum)))
            .collect()
    }
}

impl Errors {
    /// Of every metric the mean over clips.
    pub(super) fn means(&self) -> BTreeMap<String, f64> {
        let mut values: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for (name, value) in self.clips.iter().flatten() {
            values.entry(name).or_default().push(*value);
        }
        values
            .into_iter()
            .map(|(name, values)| (name.to_owned(), mean(&values)))
            .collect()
    }

    /// How much better these are than `others` on the same clips, by metric: the mean over clips, and where it would lie on
    /// other clips of the kind.
    pub(super) fn gain(&self, others: &Self) -> BTreeMap<String, Gain> {
        let mut differences: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for (own, other) in self.clips.iter().zip(&others.clips) {
            for (name, own) in own {
                if let Some(other) = other.get(name) {
                    let sign = if name == PSNR { 1.0 } else { -1.0 };
                    differences
                        .entry(name)
                        .or_default()
                        .push(sign * (own - other));
                }
            }
        }
        differences
            .into_iter()
            .filter_map(|(name, values)| {
                let interval = bootstrap_mean(&values, 0.95, RESAMPLES, 0)?;
                let gain = Gain {
                    mean: mean(&values),
                    low: interval.low,
                    high: interval.high,
                };
                Some((name.to_owned(), gain))
            })
            .collect()
    }

    /// Compares the values `found` with the signal `truth` of `clip`; what is invalid in the truth does not count.
    pub(super) fn compare(
        &mut self,
        modality: &dyn Modality,
        clip: &Clip,
        truth: &Signal,
        found: &[f32],
    ) {
        let mut sums = Sums::default();
        let values: Vec<f32> = truth.values.iter().copied().collect();
        let valid: Option<Vec<bool>> = truth.valid.as_ref().map(|v| v.iter().copied().collect());
        let counts = |item: usize| valid.as_ref().is_none_or(|valid| valid[item]);
        let channels = truth.values.shape().last().copied().unwrap_or(1);
        let rows = values
            .chunks_exact(channels)
            .zip(found.chunks_exact(channels))
            .enumerate()
            .filter(|(item, _)| counts(*item))
            .map(|(_, rows)| rows);
        match (modality.shape(), modality.name()) {
            (Shape::Video { .. }, _) => {
                let (truth, found): (Vec<&[f32]>, Vec<&[f32]>) = rows.unzip();
                if !truth.is_empty() {
                    sums.add(PSNR, psnr(&found.concat(), &truth.concat()).min(99.0));
                }
            }
            (Shape::Kinematic { .. }, _) => {
                for (truth, found) in rows {
                    sums.add("mpjpe_mm", 1000.0 * distance(truth, found));
                }
            }
            (_, "camera") => {
                for (truth, found) in rows {
                    sums.add("position_mm", 1000.0 * distance(&truth[6..], &found[6..]));
                    sums.add("rotation_deg", rotation(truth, found));
                }
            }
            (_, "gaze") => {
                let intrinsics = clip.camera().and_then(|camera| camera.intrinsics);
                for (truth, found) in rows {
                    sums.add("distance_percent", 100.0 * distance(truth, found));
                    if let Some(intrinsics) = &intrinsics {
                        sums.add(
                            "angle_deg",
                            angle(&ray(intrinsics, truth), &ray(intrinsics, found)),
                        );
                    }
                }
            }
            _ => {
                for (truth, found) in rows {
                    for (channel, (truth, found)) in truth.iter().zip(found).enumerate() {
                        sums.add_square(&format!("rmse_{channel}"), f64::from(found - truth));
                    }
                }
            }
        }
        self.clips.push(sums.means());
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| f64::from(a - b).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// Degrees between two rows of the camera signal; a row without a rotation is as wrong as can be.
fn rotation(truth: &[f32], found: &[f32]) -> f64 {
    let pose = |row: &[f32]| row_to_pose(&std::array::from_fn(|i| f64::from(row[i])));
    match (pose(truth), pose(found)) {
        (Some(truth), Some(found)) => truth.rotation.angle_to(&found.rotation).to_degrees(),
        _ => 180.0,
    }
}

/// The direction of a point of the image, whose sides are 0 to 1.
fn ray(k: &Intrinsics, point: &[f32]) -> [f64; 3] {
    let x = f64::from(point[0]) * f64::from(k.width) - 0.5;
    let y = f64::from(point[1]) * f64::from(k.height) - 0.5;
    [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0]
}

fn angle(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    let (a, b) = (nalgebra::Vector3::from(*a), nalgebra::Vector3::from(*b));
    a.angle(&b).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modality::{ClipFormat, built_in};
    use ndarray::{ArrayD, IxDyn};

    fn signal(shape: &[usize], value: impl Fn(usize) -> f32) -> Signal {
        let count: usize = shape.iter().product();
        Signal {
            values: ArrayD::from_shape_vec(IxDyn(shape), (0..count).map(value).collect()).unwrap(),
            valid: None,
        }
    }

    fn means(name: &str, truth: &Signal, found: &[f32]) -> BTreeMap<String, f64> {
        let modality = built_in(name, &ClipFormat::default()).unwrap();
        let mut errors = Errors::default();
        errors.compare(modality.as_ref(), &Clip::empty("a", "t"), truth, found);
        errors.means()
    }

    #[test]
    fn errors_are_in_physical_units_and_skip_what_is_invalid() {
        let mut joints = signal(&[60, 21, 3], |_| 0.0);
        let mut valid = ArrayD::from_elem(IxDyn(&[60, 21]), true);
        valid[[0, 0]] = false;
        joints.valid = Some(valid);
        let mut found: Vec<f32> = (0..60 * 63).map(|i| [0.003, 0.0, 0.004][i % 3]).collect();
        found[0] = 50.0;
        assert!((means("body", &joints, &found)["mpjpe_mm"] - 5.0).abs() < 1e-4);

        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.25];
        let found: Vec<f32> = (0..540).map(|i| turned[i % 9]).collect();
        let camera = means("camera", &signal(&[60, 9], |i| identity[i % 9]), &found);
        assert!((camera["rotation_deg"] - 90.0).abs() < 1e-4);
        assert!((camera["position_mm"] - 250.0).abs() < 1e-3);
    }

    #[test]
    fn a_gain_is_positive_where_the_first_is_better_on_the_same_clips() {
        let body = built_in("body", &ClipFormat::default()).unwrap();
        let truth = signal(&[60, 21, 3], |_| 0.0);
        let (mut near, mut far) = (Errors::default(), Errors::default());
        for clip in 0..8 {
            // Clips differ far more than the two do.
            let error = 0.1 * clip as f32;
            for (errors, extra) in [(&mut near, 0.0), (&mut far, 0.01)] {
                let found = vec![(error + extra) / 3_f32.sqrt(); 60 * 63];
                errors.compare(body.as_ref(), &Clip::empty("a", "t"), &truth, &found);
            }
        }
        let gain = near.gain(&far)["mpjpe_mm"];
        for value in [gain.mean, gain.low, gain.high] {
            assert!((value - 10.0).abs() < 1e-3, "{gain:?}");
        }
        assert!(far.gain(&near)["mpjpe_mm"].high < 0.0);

        let rgb = built_in("rgb", &ClipFormat::default()).unwrap();
        let truth = signal(&[2, 4, 4, 3], |_| 0.0);
        let (mut good, mut bad) = (Errors::default(), Errors::default());
        for _ in 0..2 {
            for (errors, value) in [(&mut good, 0.1), (&mut bad, 0.2)] {
                let found = [value; 96];
                errors.compare(rgb.as_ref(), &Clip::empty("a", "t"), &truth, &found);
            }
        }
        assert!((good.gain(&bad)[PSNR].mean - 20.0 * 2_f64.log10()).abs() < 1e-4);
    }
}
