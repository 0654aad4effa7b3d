//! The camera trajectory as 60 x 9: poses relative to the first, two rotation columns then translation.

use super::{ClipFormat, Lengths, Modality, ModalityError, Shape, expect_shape};
use crate::clip::{CAMERA, CameraTrack, Clip, Signal};
use crate::geometry::{rigid, rotation};
use nalgebra::Isometry3;
use ndarray::{Array1, Array2};

/// Numbers per pose.
pub const CHANNELS: usize = 9;

/// The head camera's trajectory.
#[derive(Debug, Clone)]
pub struct Camera {
    samples: usize,
    rate: f64,
}

impl Camera {
    /// At the sizes of `format`.
    pub fn new(format: &ClipFormat) -> Self {
        Self {
            samples: format.samples,
            rate: format.signal_rate,
        }
    }
}

/// `[r00 r10 r20 | r01 r11 r21 | tx ty tz]`: two rotation columns, then translation; one row of the camera signal.
pub fn pose_to_row(pose: &Isometry3<f64>) -> [f64; CHANNELS] {
    let six = rotation::to_6d(&pose.rotation);
    let t = pose.translation.vector;
    [
        six[0], six[1], six[2], six[3], six[4], six[5], t.x, t.y, t.z,
    ]
}

/// The pose of one row; `None` where the numbers are not finite or hold no rotation.
pub fn row_to_pose(row: &[f64; CHANNELS]) -> Option<Isometry3<f64>> {
    let [a, b, c, d, e, f, x, y, z] = *row;
    let rotation = rotation::from_6d(&[a, b, c, d, e, f])?;
    let finite = x.is_finite() && y.is_finite() && z.is_finite();
    finite.then(|| Isometry3::from_parts(nalgebra::Translation3::new(x, y, z), rotation))
}

impl Modality for Camera {
    fn name(&self) -> &'static str {
        "camera"
    }
    fn about(&self) -> &'static str {
        "Head camera trajectory relative to its first pose: 6D rotation and translation."
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        Shape::Temporal {
            samples: self.samples,
            channels: CHANNELS,
        }
    }
    fn units(&self) -> Vec<String> {
        let unit = |c| if c < 6 { "1" } else { "m" };
        (0..CHANNELS).map(|c| unit(c).to_owned()).collect()
    }
    fn lengths(&self) -> Lengths {
        Lengths::Metric
    }
    fn frame(&self) -> &'static str {
        "first camera of the clip (x right, y down, z forward)"
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(camera) = clip.camera() else {
            return Ok(None);
        };
        expect_shape(
            &clip.id,
            self.name(),
            &[camera.T_world_camera.len(), camera.valid.len()],
            &[self.samples; 2],
        )?;
        if !camera.valid.iter().any(|v| *v) {
            return Ok(None);
        }
        if !camera.valid.first().is_some_and(|v| *v) {
            return Err(ModalityError::Degenerate {
                clip: clip.id.clone(),
                modality: self.name().to_owned(),
                reason: "the first pose is invalid, there is nothing to be relative to".to_owned(),
            });
        }
        let first = camera.T_world_camera[0];
        let mut values = Array2::zeros((self.samples, CHANNELS));
        for (t, pose) in camera.T_world_camera.iter().enumerate() {
            if camera.valid[t] {
                for (c, v) in pose_to_row(&rigid::relative(&first, pose))
                    .iter()
                    .enumerate()
                {
                    values[[t, c]] = *v as f32;
                }
            }
        }
        let valid = Array1::from(camera.valid.clone());
        Ok(Some(Signal {
            values: values.into_dyn(),
            valid: (!valid.iter().all(|v| *v)).then(|| valid.into_dyn()),
        }))
    }

    /// The track starts at the clip's own first pose where it has one, else at the identity.
    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        expect_shape(
            &clip.id,
            self.name(),
            signal.values.shape(),
            &[self.samples, CHANNELS],
        )?;
        let before = clip.take(CAMERA);
        let first = before
            .as_ref()
            .and_then(|c| c.T_world_camera.first().copied())
            .unwrap_or_else(Isometry3::identity);
        let mut valid = vec![true; self.samples];
        let mut poses = Vec::with_capacity(self.samples);
        for t in 0..self.samples {
            let row = std::array::from_fn(|c| f64::from(signal.values[[t, c]]));
            let given = signal.valid.as_ref().is_none_or(|v| v[[t]]);
            let pose = row_to_pose(&row).filter(|_| given);
            valid[t] = pose.is_some();
            poses.push(pose.map_or(first, |p| first * p));
        }
        let track = CameraTrack {
            rate: self.rate,
            T_world_camera: poses,
            valid,
            up_world: before.as_ref().and_then(|c| c.up_world),
            intrinsics: before.and_then(|c| c.intrinsics),
        };
        clip.set(CAMERA, track);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn clip(samples: usize) -> Clip {
        let mut clip = Clip::empty("a", "test");
        let track = CameraTrack {
            rate: 30.0,
            T_world_camera: (0..samples)
                .map(|t| {
                    let t = t as f64;
                    Isometry3::new(
                        Vector3::new(3.0 + 0.1 * t, -1.0, 0.02 * t),
                        Vector3::new(0.02 * t, 1.0, -0.5),
                    )
                })
                .collect(),
            valid: vec![true; samples],
            up_world: Some(Vector3::z_axis()),
            intrinsics: None,
        };
        clip.set(CAMERA, track);
        clip
    }

    #[test]
    fn the_first_row_is_the_identity_and_poses_come_back() {
        let camera = Camera::new(&ClipFormat::default());
        let clip = clip(60);
        let signal = camera.extract(&clip).unwrap().unwrap();
        let first: Vec<f32> = (0..9).map(|c| signal.values[[0, c]]).collect();
        for (found, expected) in first
            .iter()
            .zip([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        {
            assert!((found - expected).abs() < 1e-7);
        }
        let mut back = clip.clone();
        camera.insert(signal, &mut back).unwrap();
        let (a, b) = (clip.camera().unwrap(), back.camera().unwrap());
        for (a, b) in a.T_world_camera.iter().zip(&b.T_world_camera) {
            assert!((a.translation.vector - b.translation.vector).norm() < 1e-5);
            assert!(a.rotation.angle_to(&b.rotation) < 1e-5);
        }
    }

    #[test]
    fn gaps_stay_gaps_and_a_missing_start_is_refused() {
        let camera = Camera::new(&ClipFormat::default());
        let mut clip = clip(60);
        clip.get_mut(CAMERA).unwrap().valid[7] = false;
        let signal = camera.extract(&clip).unwrap().unwrap();
        assert!(!signal.valid.as_ref().unwrap()[[7]]);
        camera.insert(signal, &mut clip).unwrap();
        assert!(!clip.camera().unwrap().valid[7]);
        clip.get_mut(CAMERA).unwrap().valid[0] = false;
        assert!(camera.extract(&clip).is_err());
        clip.get_mut(CAMERA).unwrap().valid = vec![false; 60];
        assert!(camera.extract(&clip).unwrap().is_none());
    }
}
