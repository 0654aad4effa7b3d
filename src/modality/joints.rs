//! Body and hands as 60 x 21 x 3 joints.

use super::{ClipFormat, Modality, ModalityError, Shape, expect_shape};
use crate::clip::{Clip, JointTrack, Signal};
use crate::geometry::skeleton::{self, JOINTS, Skeleton};
use ndarray::{Array2, Array3, Ix2, Ix3};

/// Which joints of the clip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    LeftHand,
    RightHand,
    Body,
}

/// Joints of the body or of one hand.
#[derive(Debug, Clone)]
pub struct Joints {
    part: Part,
    samples: usize,
    rate: f64,
}

impl Joints {
    fn new(part: Part, format: &ClipFormat) -> Self {
        Self {
            part,
            samples: format.samples,
            rate: format.signal_rate,
        }
    }
    /// The left hand, in the camera of the same sample.
    pub fn left_hand(format: &ClipFormat) -> Self {
        Self::new(Part::LeftHand, format)
    }
    /// The right hand, in the camera of the same sample.
    pub fn right_hand(format: &ClipFormat) -> Self {
        Self::new(Part::RightHand, format)
    }
    /// The body, in the gravity frame of the first camera.
    pub fn body(format: &ClipFormat) -> Self {
        Self::new(Part::Body, format)
    }
    /// The joint list and its tree.
    pub fn skeleton(&self) -> &'static Skeleton {
        match self.part {
            Part::Body => &skeleton::BODY,
            _ => &skeleton::HAND,
        }
    }
    fn track<'a>(&self, clip: &'a Clip) -> Option<&'a JointTrack> {
        match self.part {
            Part::LeftHand => clip.left_hand.as_ref(),
            Part::RightHand => clip.right_hand.as_ref(),
            Part::Body => clip.body.as_ref(),
        }
    }
}

impl Modality for Joints {
    fn name(&self) -> &'static str {
        match self.part {
            Part::LeftHand => "left_hand",
            Part::RightHand => "right_hand",
            Part::Body => "body",
        }
    }
    fn about(&self) -> &'static str {
        match self.part {
            Part::LeftHand => "21 joints of the left hand.",
            Part::RightHand => "21 joints of the right hand.",
            Part::Body => "21 joints of the wearer's body.",
        }
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
    fn frame(&self) -> &'static str {
        match self.part {
            Part::Body => "gravity frame of the first camera (x right, y forward, z up)",
            _ => "camera of the same sample (x right, y down, z forward)",
        }
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(track) = self.track(clip) else {
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
        let track = Some(JointTrack {
            rate: self.rate,
            joints,
            valid,
        });
        match self.part {
            Part::LeftHand => clip.left_hand = track,
            Part::RightHand => clip.right_hand = track,
            Part::Body => clip.body = track,
        }
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
        for part in [Part::LeftHand, Part::RightHand, Part::Body] {
            let modality = Joints::new(part, &format);
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
        clip.left_hand = Some(JointTrack {
            rate: 30.0,
            joints: Array3::zeros((60, 21, 3)),
            valid: Array2::from_elem((60, 21), false),
        });
        assert!(modality.extract(&clip).unwrap().is_none());
    }
}
