//! Colour and depth as video in [-1, 1].

use super::{ClipFormat, Lengths, Measured, Modality, ModalityError, Shape, expect_shape};
use crate::clip::depth_video::{self, DepthCoding};
use crate::clip::{self, Clip, DEPTH, RGB, Signal};
use ndarray::{Array4, ArrayD, Axis, Ix4};

/// Colour video.
#[derive(Debug, Clone)]
pub struct Rgb {
    shape: [usize; 4],
    rate: f64,
}

impl Rgb {
    /// At the sizes of `format`.
    pub fn new(format: &ClipFormat) -> Self {
        Self {
            shape: [format.frames, format.size, format.size, 3],
            rate: format.video_rate,
        }
    }
}

impl Modality for Rgb {
    fn name(&self) -> &'static str {
        "rgb"
    }
    fn about(&self) -> &'static str {
        "Colour video of the head camera, upright and square."
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        video_shape(&self.shape)
    }
    fn units(&self) -> Vec<String> {
        vec!["sRGB, -1 black to 1 white".to_owned()]
    }
    fn frame(&self) -> &'static str {
        "image"
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(rgb) = clip.rgb() else {
            return Ok(None);
        };
        expect_shape(&clip.id, "rgb", rgb.frames.shape(), &self.shape)?;
        let values = rgb.frames.mapv(|v| f32::from(v) / 127.5 - 1.0);
        Ok(Some(Signal {
            values: values.into_dyn(),
            valid: None,
        }))
    }

    /// In levels of 0 to 255.
    fn measure(&self, clip: &Clip) -> Result<Measured, ModalityError> {
        let levels = |rgb: &clip::Rgb| Signal {
            values: rgb.frames.mapv(f32::from).into_dyn(),
            valid: None,
        };
        Ok((clip.rgb().map(levels), vec!["level".to_owned()]))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        let values = values_4(&clip.id, "rgb", signal.values, &self.shape)?;
        let rgb = clip::Rgb {
            rate: self.rate,
            frames: values.mapv(|v| ((v + 1.0) * 127.5).round().clamp(0.0, 255.0) as u8),
        };
        clip.set(RGB, rgb);
        Ok(())
    }
}

/// Depth video: 8-bit levels of a [`DepthCoding`], three equal channels.
#[derive(Debug, Clone)]
pub struct Depth {
    shape: [usize; 4],
    rate: f64,
    coding: DepthCoding,
}

impl Depth {
    /// At the sizes and with the coding of `format`.
    pub fn new(format: &ClipFormat) -> Self {
        Self {
            shape: [format.frames, format.size, format.size, 3],
            rate: format.video_rate,
            coding: format.depth,
        }
    }
}

impl Modality for Depth {
    fn name(&self) -> &'static str {
        "depth"
    }
    fn about(&self) -> &'static str {
        "Depth along the optical axis as grey video."
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        video_shape(&self.shape)
    }
    fn units(&self) -> Vec<String> {
        use depth_video::{DepthKind::Disparity, DepthRange::Fixed};
        let kind = if self.coding.depth_kind == Disparity {
            "inverse depth"
        } else {
            "depth"
        };
        let range = if self.coding.range == Fixed {
            format!("{} m to {} m", self.coding.near, self.coding.far)
        } else {
            "the clip's own range".to_owned()
        };
        vec![format!("{kind}, -1 to 1 over {range}")]
    }
    fn lengths(&self) -> Lengths {
        match self.coding.range {
            depth_video::DepthRange::Fixed => Lengths::Metric,
            depth_video::DepthRange::ClipMinmax => Lengths::Relative,
        }
    }
    fn frame(&self) -> &'static str {
        "image"
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(depth) = clip.depth() else {
            return Ok(None);
        };
        expect_shape(&clip.id, "depth", depth.metres.shape(), &self.shape[..3])?;
        let (levels, valid) = self.coding.encode(&depth.metres);
        Ok(Some(Signal {
            values: depth_video::to_model(&levels).into_dyn(),
            valid: (!valid.iter().all(|v| *v)).then(|| valid.into_dyn()),
        }))
    }

    /// In metres.
    fn measure(&self, clip: &Clip) -> Result<Measured, ModalityError> {
        let metres = |depth: &clip::Depth| Signal {
            values: depth.metres.clone().insert_axis(Axis(3)).into_dyn(),
            valid: Some(depth.metres.mapv(f32::is_finite).into_dyn()),
        };
        Ok((clip.depth().map(metres), vec!["m".to_owned()]))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        let values = values_4(&clip.id, "depth", signal.values, &self.shape)?;
        clip.set(
            DEPTH,
            depth_video::from_model(&values, self.rate, &self.coding),
        );
        Ok(())
    }
}

fn video_shape(shape: &[usize; 4]) -> Shape {
    Shape::Video {
        frames: shape[0],
        height: shape[1],
        width: shape[2],
    }
}

fn values_4(
    clip: &str,
    modality: &str,
    values: ArrayD<f32>,
    expected: &[usize; 4],
) -> Result<Array4<f32>, ModalityError> {
    expect_shape(clip, modality, values.shape(), expected)?;
    Ok(values
        .into_dimensionality::<Ix4>()
        .expect("the shape was just compared with four numbers"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    fn format() -> ClipFormat {
        ClipFormat {
            frames: 2,
            size: 4,
            ..ClipFormat::default()
        }
    }

    #[test]
    fn every_byte_of_colour_survives() {
        let rgb = Rgb::new(&format());
        let mut clip = Clip::empty("a", "test");
        assert!(rgb.extract(&clip).unwrap().is_none());
        let frames = Array4::from_shape_fn((2, 4, 4, 3), |(t, y, x, c)| {
            (t * 127 + y * 31 + x * 7 + c) as u8
        });
        clip.set(RGB, clip::Rgb { rate: 8.0, frames });
        let mut back = Clip::empty("a", "test");
        let signal = rgb.extract(&clip).unwrap().unwrap();
        assert!(signal.values.iter().all(|v| (-1.0..=1.0).contains(v)));
        rgb.insert(signal, &mut back).unwrap();
        assert_eq!(back, clip);
    }

    #[test]
    fn depth_is_grey_and_marks_what_was_not_measured() {
        let depth = Depth::new(&format());
        let mut clip = Clip::empty("a", "test");
        let mut metres = Array3::from_shape_fn((2, 4, 4), |(t, y, x)| {
            0.2 + (t * 16 + y * 4 + x) as f32 * 0.1
        });
        metres[[0, 1, 2]] = f32::NAN;
        clip.set(DEPTH, clip::Depth { rate: 8.0, metres });
        let signal = depth.extract(&clip).unwrap().unwrap();
        let valid = signal.valid.clone().unwrap();
        assert!(!valid[[0, 1, 2]] && valid[[0, 0, 0]]);
        assert_eq!(signal.values[[1, 2, 3, 0]], signal.values[[1, 2, 3, 2]]);
        depth.insert(signal, &mut clip).unwrap();
        assert_eq!(clip.depth().unwrap().metres[[0, 0, 0]], 0.2);
    }

    #[test]
    fn another_size_is_an_error_that_names_the_clip() {
        let mut clip = Clip::empty("world/000003", "test");
        let rgb = clip::Rgb {
            rate: 8.0,
            frames: Array4::zeros((2, 4, 5, 3)),
        };
        clip.set(RGB, rgb);
        let error = Rgb::new(&format()).extract(&clip).unwrap_err().to_string();
        assert!(
            error.contains("world/000003") && error.contains('5'),
            "{error}"
        );
    }
}
