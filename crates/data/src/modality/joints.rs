//! Body and hands as 60 x 21 x 3 joints.

use super::{ClipFormat, Lengths, Modality, ModalityError, Shape, expect_shape};
use crate::clip::{BODY, Clip, JointTrack, Key, LEFT_HAND, RIGHT_HAND, Signal};
use crate::geometry::skeleton::{self, JOINTS, Skeleton};
use ndarray::{Array2, Array3, Ix2, Ix3};

/// Joints of the body or of one hand.
#[derive(Debug, Clone)]
pub struct Joints {
    key: Key<'static, JointTrack>,
    about: &'static str,
    frame: &'static str,
    skeleton: &'static Skeleton,
    samples: usize,
    rate: f64,
}

/// The frame of both hands.
const CAMERA: &str = "camera of the same sample (x right, y down, z forward)";

impl Joints {
    fn new(
        key: Key<'static, JointTrack>,
        about: &'static str,
        frame: &'static str,
        skeleton: &'static Skeleton,
        format: &ClipFormat,
    ) -> Self {
        Self {
            key,
            about,
            frame,
            skeleton,
            samples: format.samples,
            rate: format.signal_rate,
        }
    }

    /// The left hand, in the camera of the same sample.
    pub fn left_hand(format: &ClipFormat) -> Self {
        let about = "21 joints of the left hand.";
        Self::new(LEFT_HAND, about, CAMERA, &skeleton::HAND, format)
    }

    /// The right hand, in the camera of the same sample.
    pub fn right_hand(format: &ClipFormat) -> Self {
        let about = "21 joints of the right hand.";
        Self::new(RIGHT_HAND, about, CAMERA, &skeleton::HAND, format)
    }

    /// The body, in the gravity frame of the first camera.
    pub fn body(format: &ClipFormat) -> Self {
        let about = "21 joints of the wearer's body.";
        let frame = "gravity frame of the first camera (x right, y forward, z up)";
        Self::new(BODY, about, frame, &skeleton::BODY, format)
    }

    /// The joint list and its tree.
    pub fn skeleton(&self) -> &'static Skeleton {
        self.skeleton
    }
}

impl Modality for Joints {
    fn name(&self) -> &'static str {
        self.key.name()
    }
    fn about(&self) -> &'static str {
        self.about
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        Shape::Kinematic {
            samples: self.samples,
            joints: JOINTS,
        }
    }
    fn units(&self) -> Vec<String> {
        vec!["m".to_owned()]
    }
    fn lengths(&self) -> Lengths {
        Lengths::Metric
    }
    fn frame(&self) -> &'static str {
        self.frame
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(track) = clip.get(self.key) else {
            return Ok(None);
        };
        let shape = [self.samples, JOINTS, 3];
        expect_shape(&clip.id, self.name(), track.joints.shape(), &shape)?;
        expect_shape(&clip.id, self.name(), track.valid.shape(), &shape[..2])?;
        let valid = Array2::from_shape_fn((self.samples, JOINTS), |(t, j)| {
            track.valid[[t, j]] && (0..3).all(|k| track.joints[[t, j, k]].is_finite())
        });
        if !valid.iter().any(|v| *v) {
            return Ok(None);
        }
        let values = Array3::from_shape_fn((self.samples, JOINTS, 3), |(t, j, k)| {
            if valid[[t, j]] {
                track.joints[[t, j, k]]
            } else {
                0.0
            }
        });
        Ok(Some(Signal {
            values: values.into_dyn(),
            valid: (!valid.iter().all(|v| *v)).then(|| valid.into_dyn()),
        }))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        let shape = [self.samples, JOINTS, 3];
        expect_shape(&clip.id, self.name(), signal.values.shape(), &shape)?;
        let valid = match signal.valid {
            Some(valid) => {
                expect_shape(&clip.id, self.name(), valid.shape(), &shape[..2])?;
                valid
                    .into_dimensionality::<Ix2>()
                    .expect("the shape was just compared with two numbers")
            }
            None => Array2::from_elem((self.samples, JOINTS), true),
        };
        let joints = signal
            .values
            .into_dimensionality::<Ix3>()
            .expect("the shape was just compared with three numbers");
        let rate = self.rate;
        let track = JointTrack {
            rate,
            joints,
            valid,
        };
        clip.set(self.key, track);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_go_to_their_own_place_and_back() {
        let format = ClipFormat::default();
        let mut clip = Clip::empty("a", "test");
        for modality in [Joints::left_hand, Joints::right_hand, Joints::body] {
            let modality = modality(&format);
            assert!(modality.extract(&clip).unwrap().is_none());
            let values =
                Array3::from_shape_fn((60, 21, 3), |(t, j, k)| (t * 63 + j * 3 + k) as f32);
            let mut valid = Array2::from_elem((60, 21), true);
            valid[[2, 3]] = false;
            let signal = Signal {
                values: values.into_dyn(),
                valid: Some(valid.into_dyn()),
            };
            modality.insert(signal, &mut clip).unwrap();
            let back = modality.extract(&clip).unwrap().unwrap();
            assert_eq!(back.values[[1, 1, 1]], 67.0);
            assert_eq!(back.values[[2, 3, 0]], 0.0);
            assert!(!back.valid.unwrap()[[2, 3]]);
        }
    }

    #[test]
    fn a_hand_never_seen_is_absent_not_zero() {
        let modality = Joints::left_hand(&ClipFormat::default());
        let mut clip = Clip::empty("a", "test");
        let track = JointTrack {
            rate: 30.0,
            joints: Array3::zeros((60, 21, 3)),
            valid: Array2::from_elem((60, 21), false),
        };
        clip.set(LEFT_HAND, track);
        assert!(modality.extract(&clip).unwrap().is_none());
    }
}
