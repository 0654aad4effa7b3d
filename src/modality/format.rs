//! The sizes that all clips of one artifact share; every modality's shape follows from it.

use super::DeclaredSettings;
use crate::clip::clock;
use crate::clip::depth_video::DepthCoding;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes and rates of clips; recorded in the manifest of every clips artifact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ClipFormat {
    /// Video frames per clip.
    pub frames: usize,
    /// Video frames per second.
    pub video_rate: f64,
    /// Height and width of a video frame, pixels.
    pub size: usize,
    /// Samples per clip of everything that is not video.
    pub samples: usize,
    /// Samples per second of everything that is not video.
    pub signal_rate: f64,
    /// How depth becomes video.
    pub depth: DepthCoding,
    /// Modalities beyond the built-in ones.
    pub declared: Vec<DeclaredSettings>,
}

impl Default for ClipFormat {
    /// The paper's 256 pathway.
    fn default() -> Self {
        Self {
            frames: 16,
            video_rate: clock::VIDEO_RATE,
            size: 256,
            samples: clock::SIGNAL_SAMPLES,
            signal_rate: clock::SIGNAL_RATE,
            depth: DepthCoding::relative(),
            declared: Vec::new(),
        }
    }
}
