//! Reconstruction errors of one modality in physical units, averaged over clips.

use crate::clip::{Clip, Intrinsics, Signal};
use crate::modality::camera::row_to_pose;
use crate::modality::{Modality, Shape};
use crate::tokenizer::video::psnr;
use std::collections::BTreeMap;

/// Running means by metric; the name says the unit.
#[derive(Debug, Clone, Default)]
pub(super) struct Errors {
    sums: BTreeMap<String, Sum>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    total: f64,
    count: u64,
    /// The root of the mean is reported.
    root: bool,
}

impl Errors {
    /// The mean of every metric.
    pub(super) fn means(&self) -> BTreeMap<String, f64> {
        let mean = |sum: &Sum| {
            let mean = sum.total / sum.count as f64;
            if sum.root { mean.sqrt() } else { mean }
        };
        self.sums
            .iter()
            .filter(|(_, sum)| sum.count > 0)
            .map(|(name, sum)| (name.clone(), mean(sum)))
            .collect()
    }

    fn add(&mut self, name: &str, value: f64) {
        let sum = self.sums.entry(name.to_owned()).or_default();
        sum.total += value;
        sum.count += 1;
    }

    fn add_square(&mut self, name: &str, difference: f64) {
        self.add(name, difference * difference);
        if let Some(sum) = self.sums.get_mut(name) {
            sum.root = true;
        }
    }

    /// Compares the values `found` with the signal `truth` of `clip`; what is invalid in the truth does not count.
    pub(super) fn compare(
        &mut self,
        modality: &dyn Modality,
        clip: &Clip,
        truth: &Signal,
        found: &[f32],
    ) {
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
                    self.add("psnr_db", psnr(&found.concat(), &truth.concat()).min(99.0));
                }
            }
            (Shape::Kinematic { .. }, _) => {
                for (truth, found) in rows {
                    self.add("mpjpe_mm", 1000.0 * distance(truth, found));
                }
            }
            (_, "camera") => {
                for (truth, found) in rows {
                    self.add("position_mm", 1000.0 * distance(&truth[6..], &found[6..]));
                    self.add("rotation_deg", rotation(truth, found));
                }
            }
            (_, "gaze") => {
                let intrinsics = clip.camera.as_ref().and_then(|camera| camera.intrinsics);
                for (truth, found) in rows {
                    self.add("distance_percent", 100.0 * distance(truth, found));
                    if let Some(intrinsics) = &intrinsics {
                        self.add(
                            "angle_deg",
                            angle(&ray(intrinsics, truth), &ray(intrinsics, found)),
                        );
                    }
                }
            }
            _ => {
                for (truth, found) in rows {
                    for (channel, (truth, found)) in truth.iter().zip(found).enumerate() {
                        self.add_square(&format!("rmse_{channel}"), f64::from(found - truth));
                    }
                }
            }
        }
    }
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
}
