//! A source of clips whose depth is labelled, clip by clip.

use std::sync::{Mutex, PoisonError};

use ndarray::Array3;

use super::{DepthLabelKind, DepthLabeller, LabelError, LabelOptions};
use crate::clip::source::{ClipSource, Outcome};
use crate::clip::{Clip, DEPTH, Depth};
use crate::formats::ReadError;
use crate::modality::ClipFormat;
use crate::video::image::Image;

/// The clips of another source, with depth where they have colour.
///
/// The 16 or 32 frames of a clip are a video of their own. Relative labels are inverse depth without a unit; a clip holds the
/// inverse of the label, so that its disparity is the label, and its "metres" have no scale either.
pub struct LabelledClips<S> {
    inner: S,
    /// One clip at a time: the network takes all cores, and its memory is there once.
    labeller: Mutex<DepthLabeller>,
    options: LabelOptions,
    format: Option<ClipFormat>,
    replace: bool,
}

impl<S: ClipSource> LabelledClips<S> {
    /// `format` is that of the labelled clips; measured depth is kept unless `replace`.
    pub fn new(
        inner: S,
        labeller: DepthLabeller,
        options: LabelOptions,
        format: Option<ClipFormat>,
        replace: bool,
    ) -> Self {
        Self {
            inner,
            labeller: Mutex::new(labeller),
            options,
            format,
            replace,
        }
    }

    fn labelled(&self, mut clip: Clip) -> Result<Clip, ReadError> {
        let Some(rgb) = clip.rgb() else {
            return Ok(clip);
        };
        if clip.depth().is_some() && !self.replace {
            return Ok(clip);
        }
        let (frames, height, width, _) = rgb.frames.dim();
        let images = rgb.frames.outer_iter().map(|frame| {
            Ok::<_, LabelError>(Image {
                width: width as u32,
                height: height as u32,
                data: frame.iter().copied().collect(),
            })
        });
        let labeller = self.labeller.lock().unwrap_or_else(PoisonError::into_inner);
        let kind = labeller.kind();
        let mut metres = Vec::with_capacity(frames * height * width);
        let refuse =
            |error: &dyn std::fmt::Display| ReadError::Settings(format!("{}: {error}", clip.id));
        labeller
            .label(images, &self.options, &mut |_, labels| {
                metres.extend(labels.into_iter().map(|label| stored(kind, label)));
                Ok(())
            })
            .map_err(|error| refuse(&error))?;
        let metres = Array3::from_shape_vec((frames, height, width), metres)
            .map_err(|error| refuse(&error))?;
        let rate = rgb.rate;
        clip.set(DEPTH, Depth { rate, metres });
        Ok(clip)
    }
}

/// A label as a clip holds it.
fn stored(kind: DepthLabelKind, label: f32) -> f32 {
    match kind {
        DepthLabelKind::Metric => label,
        // As far as it goes is a value like any other: its inverse again is 0.
        DepthLabelKind::Relative => (1.0 / label).min(f32::MAX),
    }
}

impl<S: ClipSource> ClipSource for LabelledClips<S> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn len(&self) -> usize {
        self.inner.len()
    }

    fn modalities(&self) -> Vec<String> {
        let mut names = self.inner.modalities();
        if !names.iter().any(|name| name == "depth") {
            let behind = names.iter().position(|name| name == "rgb");
            names.insert(behind.map_or(0, |at| at + 1), "depth".to_owned());
        }
        names
    }

    fn format(&self) -> Option<ClipFormat> {
        self.format.clone().or_else(|| self.inner.format())
    }

    fn recordings(&self) -> Vec<(String, std::ops::Range<usize>)> {
        self.inner.recordings()
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        Ok(match self.inner.clip(index)? {
            Outcome::Clip(clip) => Outcome::Clip(Box::new(self.labelled(*clip)?)),
            dropped @ Outcome::Dropped { .. } => dropped,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::depth_video::DepthCoding;
    use crate::labelling::levels::levels;

    #[test]
    fn a_clip_of_labels_becomes_the_levels_of_the_labels() {
        let labels: Vec<f32> = (0..48).map(|i| (i * 7 % 48) as f32 * 0.37).collect();
        for (kind, coding) in [
            (DepthLabelKind::Relative, DepthCoding::relative()),
            (DepthLabelKind::Metric, DepthCoding::metric()),
        ] {
            // Zero metres is no measurement; zero disparity is far away.
            let labels: Vec<f32> = labels
                .iter()
                .map(|l| {
                    if kind == DepthLabelKind::Metric {
                        l + 0.1
                    } else {
                        *l
                    }
                })
                .collect();
            let metres = labels.iter().map(|label| stored(kind, *label)).collect();
            let metres = Array3::from_shape_vec((3, 4, 4), metres).unwrap();
            let (found, valid) = coding.encode(&metres);
            assert!(valid.iter().all(|valid| *valid));
            let expected = levels(kind, &labels);
            let off = found.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b));
            // A label may lie on the edge of a level, and its inverse is rounded twice.
            assert!(off.max() <= Some(1), "{kind:?}");
        }
    }
}
