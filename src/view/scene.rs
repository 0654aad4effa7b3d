//! What the page can show. All positions are metres in one world with z up.

use super::cloud::Point;
use crate::clip::Intrinsics;
use ndarray::{Array2, Array3, ArrayView3};

/// Everything on one timeline.
#[derive(Debug, Clone)]
pub struct Scene {
    /// The page's heading.
    pub title: String,
    /// Short statements beside the title: scale status, synthetic or real.
    pub badges: Vec<Badge>,
    /// Label and value pairs: unit, frame, rates, what was assumed.
    pub facts: Vec<Fact>,
    /// Motion samples per second.
    pub rate: f64,
    /// Motion samples on the timeline.
    pub samples: usize,
    /// The camera's projection, in pixels of the video.
    pub intrinsics: Intrinsics,
    /// `None` for a page without images.
    pub video: Option<VideoFrames>,
    /// `None` where there is no depth.
    pub depth: Option<DepthGrids>,
    /// Points of the whole recording, world.
    pub cloud: Vec<Point>,
    /// Height of the floor in the world, metres.
    pub floor: Option<f64>,
    /// The prediction first; the truth, where it is known, beside it.
    pub tracks: Vec<Track>,
    /// One per modality for which it is known.
    pub certainty: Vec<Certainty>,
}

/// How a badge is meant; the words say it too.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tone {
    /// A fact, neither good nor bad.
    Plain,
    /// A reason for trust: a metric scale.
    Good,
    /// A reason for care: a scale that is not known.
    Warn,
}

/// A short statement beside the title.
#[derive(Debug, Clone)]
pub struct Badge {
    /// As shown.
    pub text: String,
    /// How it is meant.
    pub tone: Tone,
}

/// A label and its value.
#[derive(Debug, Clone)]
pub struct Fact {
    /// What the value is of.
    pub label: String,
    /// As shown, with its unit.
    pub value: String,
}

/// The input video, square and upright, as the model saw it. Frames are kept as JPEG, so a long video stays small.
#[derive(Debug, Clone)]
pub struct VideoFrames {
    /// Hz.
    pub rate: f64,
    bytes: Vec<u8>,
    offsets: Vec<usize>,
}

/// JPEG quality of the embedded video.
const QUALITY: u8 = 82;

impl VideoFrames {
    /// A video without frames.
    pub fn new(rate: f64) -> Self {
        Self {
            rate,
            bytes: Vec::new(),
            offsets: vec![0],
        }
    }

    /// Adds a frame, `[H, W, 3]`.
    ///
    /// # Errors
    /// When the frame has no pixel, not three channels, or a side beyond what JPEG can store.
    pub fn push(&mut self, frame: ArrayView3<u8>) -> Result<(), ViewError> {
        let (height, width, channels) = frame.dim();
        let refuse = |reason: String| ViewError::Jpeg {
            width,
            height,
            reason,
        };
        if channels != 3 {
            return Err(refuse(format!("{channels} channels, expected 3")));
        }
        let side = |n: usize| u16::try_from(n).map_err(|e| refuse(e.to_string()));
        let (w, h) = (side(width)?, side(height)?);
        let frame = frame.as_standard_layout();
        let pixels = frame.as_slice().expect("standard layout is contiguous");
        jpeg_encoder::Encoder::new(&mut self.bytes, QUALITY)
            .encode(pixels, w, h, jpeg_encoder::ColorType::Rgb)
            .map_err(|e| refuse(e.to_string()))?;
        self.offsets.push(self.bytes.len());
        Ok(())
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// All frames, one JPEG after the other.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Where each frame begins, and where the last one ends.
    pub fn offsets(&self) -> &[usize] {
        &self.offsets
    }
}

/// Depth of each video frame on a grid over the image.
#[derive(Debug, Clone)]
pub struct DepthGrids {
    /// `[T, h, w]`, metres of z-depth; NaN where unknown. `T` equals the number of video frames.
    pub metres: Array3<f32>,
}

/// What names of tracks begin with that are other samples of the prediction; they are drawn faintly and toggled together.
pub const SAMPLE: &str = "sample_";

/// One version of the wearer.
#[derive(Debug, Clone)]
pub struct Track {
    /// `prediction`, `truth`: letters, digits and `_`.
    pub name: String,
    /// Drawn stippled and toggled apart.
    pub truth: bool,
    /// What is known of it, each modality once.
    pub parts: Vec<Part>,
}

/// One modality of one version of the wearer.
#[derive(Debug, Clone)]
pub struct Part {
    /// Name of the modality.
    pub modality: String,
    /// What is shown and hidden together: `body`, `hands`, `gaze`, `camera`, or a name of its own.
    pub layer: String,
    /// What a row of the values holds, and how it is drawn.
    pub drawing: Drawing,
    /// One row per sample of the timeline, NaN where unknown; what a row holds, the drawing says.
    pub values: Array2<f32>,
}

impl Part {
    /// With these values.
    pub fn new(modality: &str, layer: &str, drawing: Drawing, values: Array2<f32>) -> Self {
        Self {
            modality: modality.to_owned(),
            layer: layer.to_owned(),
            drawing,
            values,
        }
    }
}

/// How the page draws a modality.
#[derive(Debug, Clone, PartialEq)]
pub enum Drawing {
    /// The camera: position and quaternion (x y z w) in the world, 7 numbers. A path and a frustum.
    Camera,
    /// Something else with a pose in the world, 7 numbers. A path and its axes.
    Pose,
    /// x and y in the image, `[0, 1]^2`. A ring in the image, a ray in the world.
    ImagePoint,
    /// Joints in the world, 3 numbers each. Bones are pairs of joints and a radius in metres.
    Joints {
        /// Indices of two joints, and the radius of the bone between them in metres.
        bones: Vec<(usize, usize, f32)>,
        /// Drawn into the image too.
        in_image: bool,
    },
    /// Channels over time, one number each. Curves beside the video.
    Plot {
        /// One name per number of a row; empty where they have none.
        channels: Vec<String>,
        /// One unit per channel, or one for all.
        units: Vec<String>,
    },
}

/// A strip under the timeline: 1 is certain, 0 is a guess.
#[derive(Debug, Clone)]
pub struct Certainty {
    /// The modality.
    pub name: String,
    /// In `[0, 1]`, evenly spread over the timeline; NaN where unknown.
    pub values: Vec<f32>,
}

/// Why a scene cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// A part has not one row per sample, its rows not the numbers its drawing needs, or depth not one grid per frame.
    #[error("{what} has {found} entries, the timeline has {expected}")]
    Length {
        /// What does not fit, in words: `prediction left hand`, `prediction gaze values`, `depth`.
        what: String,
        /// Rows, numbers per row or grids that it has.
        found: usize,
        /// As many as it must have.
        expected: usize,
    },
    /// There is no sample, or the rate is not a positive number.
    #[error("a scene needs at least one sample and a positive rate")]
    Empty,
    /// A video frame has no pixel, not three channels, or a side beyond what JPEG can store.
    #[error("video frames of {width}x{height} cannot be stored as JPEG: {reason}")]
    Jpeg {
        /// Pixels across.
        width: usize,
        /// Pixels down.
        height: usize,
        /// What is wrong with it, in words.
        reason: String,
    },
    /// The page cannot be written to the disk.
    #[error("writing the page: {0}")]
    Write(#[from] std::io::Error),
}

impl Scene {
    /// Refuses lengths that disagree before anything is written.
    ///
    /// # Errors
    /// [`ViewError::Empty`] or [`ViewError::Length`], naming what does not fit.
    pub fn check(&self) -> Result<(), ViewError> {
        if self.samples == 0 || self.rate.is_nan() || self.rate <= 0.0 {
            return Err(ViewError::Empty);
        }
        let same = |what: String, found: usize, expected: usize| {
            if found == expected {
                Ok(())
            } else {
                Err(ViewError::Length {
                    what,
                    found,
                    expected,
                })
            }
        };
        for track in &self.tracks {
            for part in &track.parts {
                let what = format!("{} {}", track.name, part.modality.replace('_', " "));
                let (rows, columns) = part.values.dim();
                same(what.clone(), rows, self.samples)?;
                let expected = match &part.drawing {
                    Drawing::Camera | Drawing::Pose => 7,
                    Drawing::ImagePoint => 2,
                    Drawing::Joints { bones, .. } => {
                        let last = bones.iter().map(|(a, b, _)| a.max(b) + 1).max();
                        3 * last.unwrap_or(columns / 3)
                    }
                    Drawing::Plot { .. } => columns,
                };
                same(format!("{what} values"), columns, expected)?;
            }
        }
        if let (Some(video), Some(depth)) = (&self.video, &self.depth) {
            same("depth".into(), depth.metres.shape()[0], video.len())?;
        }
        Ok(())
    }
}
