//! The sizes that all clips of one artifact share; every modality's shape follows from it.

use super::DeclaredSettings;
use super::declared::{Normalize, SignalSettings, SignalSource};
use crate::clip::Clip;
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

impl ClipFormat {
    /// What a clip shows of the format it was made in; the rest is the paper's. Declared modalities get numbers as channel names.
    pub fn of(clip: &Clip) -> Self {
        let mut format = Self::default();
        let video = clip
            .rgb()
            .map(|rgb| (rgb.rate, [rgb.frames.shape()[0], rgb.frames.shape()[1]]))
            .or_else(|| {
                let depth = clip.depth()?;
                Some((
                    depth.rate,
                    [depth.metres.shape()[0], depth.metres.shape()[1]],
                ))
            });
        if let Some((rate, [frames, size])) = video {
            (format.video_rate, format.frames, format.size) = (rate, frames, size);
        }
        for (name, signal) in clip.signals() {
            let &[samples, channels] = signal.values.shape() else {
                continue;
            };
            format.declared.push(DeclaredSettings {
                name: name.to_owned(),
                about: String::new(),
                signal: SignalSettings {
                    rate: samples as f64 / clock::CLIP_SECONDS,
                    channels: (0..channels).map(|channel| channel.to_string()).collect(),
                    units: vec!["?".to_owned()],
                    frame: String::new(),
                    missing: crate::modality::declared::Missing::Nan,
                },
                normalize: Normalize::default(),
                source: SignalSource::default(),
            });
        }
        format
    }
}
