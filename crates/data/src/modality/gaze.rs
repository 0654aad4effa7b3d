//! Gaze as a point of the upright square image over time, 60 x 2.

use super::{ClipFormat, Modality, ModalityError, Shape, expect_shape};
use crate::clip::{Clip, GAZE, GazeTrack, Signal};
use ndarray::{Array1, Array2, Ix1, Ix2};

/// A point further outside the image than this is invalid.
const MARGIN: f32 = 0.2;

/// Where the wearer looks.
#[derive(Debug, Clone)]
pub struct Gaze {
    samples: usize,
    rate: f64,
}

impl Gaze {
    /// At the sizes of `format`.
    pub fn new(format: &ClipFormat) -> Self {
        Self {
            samples: format.samples,
            rate: format.signal_rate,
        }
    }
}

/// Whether a gaze point counts: finite and at most 0.2 image widths outside.
pub fn is_valid(x: f32, y: f32) -> bool {
    let inside = |v: f32| (-MARGIN..=1.0 + MARGIN).contains(&v);
    inside(x) && inside(y)
}

impl Modality for Gaze {
    fn name(&self) -> &'static str {
        "gaze"
    }
    fn about(&self) -> &'static str {
        "Where the wearer looks, as a point of the image."
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        Shape::Temporal {
            samples: self.samples,
            channels: 2,
        }
    }
    fn units(&self) -> Vec<String> {
        vec!["image widths".to_owned(), "image heights".to_owned()]
    }
    fn frame(&self) -> &'static str {
        "image of the same sample (x right, y down, the image is 0 to 1)"
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(gaze) = clip.gaze() else {
            return Ok(None);
        };
        expect_shape(
            &clip.id,
            self.name(),
            gaze.points.shape(),
            &[self.samples, 2],
        )?;
        expect_shape(&clip.id, self.name(), gaze.valid.shape(), &[self.samples])?;
        let valid = Array1::from_shape_fn(self.samples, |t| {
            gaze.valid[t] && is_valid(gaze.points[[t, 0]], gaze.points[[t, 1]])
        });
        if !valid.iter().any(|v| *v) {
            return Ok(None);
        }
        let values = Array2::from_shape_fn((self.samples, 2), |(t, c)| {
            if valid[t] { gaze.points[[t, c]] } else { 0.0 }
        });
        Ok(Some(Signal {
            values: values.into_dyn(),
            valid: (!valid.iter().all(|v| *v)).then(|| valid.into_dyn()),
        }))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        expect_shape(
            &clip.id,
            self.name(),
            signal.values.shape(),
            &[self.samples, 2],
        )?;
        let points = signal
            .values
            .into_dimensionality::<Ix2>()
            .expect("the shape was just compared with two numbers");
        let valid = match signal.valid {
            Some(valid) => {
                expect_shape(&clip.id, self.name(), valid.shape(), &[self.samples])?;
                valid
                    .into_dimensionality::<Ix1>()
                    .expect("the shape was just compared with one number")
            }
            None => Array1::from_elem(self.samples, true),
        };
        let rate = self.rate;
        clip.set(
            GAZE,
            GazeTrack {
                rate,
                points,
                valid,
            },
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blinks_and_far_points_become_invalid() {
        let gaze = Gaze::new(&ClipFormat::default());
        let mut clip = Clip::empty("a", "test");
        let mut track = GazeTrack {
            rate: 30.0,
            points: Array2::from_elem((60, 2), 0.4),
            valid: Array1::from_elem(60, true),
        };
        track.valid[3] = false;
        track.points[[5, 1]] = 1.3;
        track.points[[6, 0]] = -0.1;
        track.points[[7, 0]] = f32::NAN;
        clip.set(GAZE, track);
        let signal = gaze.extract(&clip).unwrap().unwrap();
        let valid = signal.valid.clone().unwrap();
        let invalid: Vec<usize> = (0..60).filter(|t| !valid[[*t]]).collect();
        assert_eq!(invalid, [3, 5, 7]);
        assert!(signal.values.iter().all(|v| v.is_finite()));
        let mut back = Clip::empty("a", "test");
        gaze.insert(signal.clone(), &mut back).unwrap();
        assert_eq!(gaze.extract(&back).unwrap().unwrap(), signal);
    }
}
