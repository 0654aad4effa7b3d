//! The settings by which clips are cut from recordings, the same for every data set.

use super::ReadError;
use crate::clip::clock::CLIP_SECONDS;
use crate::modality::ClipFormat;
use crate::video::DecoderChoice;

/// How clips are cut from recordings.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CutSettings {
    /// Frames per second of colour and depth: 8 (the 256 pathway) or 16 (the 512 pathway).
    pub fps: f64,
    /// Side of the square frames in pixels: 256 or 512.
    pub side: u32,
    /// Horizontal field of view in degrees of an undistorted (pinhole) picture. Left out: pictures, gaze and depth stay in the
    /// recorded fisheye, as in the paper's data.
    pub undistort: Option<f64>,
    /// Metres along the gaze ray of the point that is projected into the picture.
    pub gaze_distance: f64,
    /// Use the distance at which the eyes converge where the recording has it.
    pub gaze_vergence: bool,
    /// Take a recording shorter than a clip as one clip: the last frame is repeated, signals after the end are invalid.
    pub pad_short: bool,
    /// Seconds from the start of one clip to the start of the next.
    pub stride: f64,
    /// Who decodes videos.
    pub decoder: DecoderChoice,
}

impl Default for CutSettings {
    fn default() -> Self {
        CutSettings {
            fps: 8.0,
            side: 256,
            undistort: None,
            gaze_distance: 1.0,
            gaze_vergence: false,
            pad_short: false,
            stride: CLIP_SECONDS,
            decoder: DecoderChoice::Auto,
        }
    }
}

impl CutSettings {
    /// # Errors
    /// A sentence about the setting that makes no sense.
    pub fn check(&self) -> Result<(), ReadError> {
        let wrong = |what: String| Err(ReadError::Settings(what));
        if !(self.fps > 0.0 && self.fps <= 240.0) {
            return wrong(format!("`fps` is {}", self.fps));
        }
        if !(8..=4096).contains(&self.side) {
            return wrong(format!("`side` is {}", self.side));
        }
        if self
            .undistort
            .is_some_and(|angle| !(10.0..=160.0).contains(&angle))
        {
            return wrong("`undistort` is a field of view between 10 and 160 degrees".to_owned());
        }
        if !(self.gaze_distance > 0.0 && self.gaze_distance.is_finite()) {
            return wrong(format!("`gaze_distance` is {}", self.gaze_distance));
        }
        if !(self.stride >= 0.1 && self.stride.is_finite()) {
            return wrong(format!("`stride` is {} seconds", self.stride));
        }
        Ok(())
    }

    /// The sizes of the clips.
    #[must_use]
    pub fn format(&self) -> ClipFormat {
        ClipFormat {
            frames: self.frames(),
            video_rate: self.fps,
            size: self.side as usize,
            ..ClipFormat::default()
        }
    }

    /// Frames of a clip's video.
    pub(super) fn frames(&self) -> usize {
        (self.fps * CLIP_SECONDS).round().max(1.0) as usize
    }
}
