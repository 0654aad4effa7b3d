//! Sizes of the depth network, and what kind of depth its weights give.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::LabelError;

/// What the output of a set of weights means. Files of both kinds have the same entries: nothing in them tells which it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthLabelKind {
    /// Inverse depth, near is large, 0 is as far as it goes; scale and shift are unknown and the same for a whole video.
    Relative,
    /// z-depth in metres.
    Metric,
}

impl DepthLabelKind {
    /// `relative` or `metric`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Relative => "relative",
            Self::Metric => "metric",
        }
    }
}

impl std::str::FromStr for DepthLabelKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "relative" => Ok(Self::Relative),
            "metric" => Ok(Self::Metric),
            _ => Err(format!("`{text}` is neither `relative` nor `metric`")),
        }
    }
}

/// Frames of a window; the temporal modules have positions for so many.
pub const WINDOW: usize = 32;
/// Heads of every temporal attention.
pub const MOTION_HEADS: usize = 8;
/// Groups of every group norm.
pub const MOTION_GROUPS: usize = 32;

/// Sizes of the network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkSettings {
    /// Side of the encoder's patches in pixels.
    pub patch: usize,
    /// Side of the square grid that the position table was trained on.
    pub grid: usize,
    /// Width, blocks and heads of the encoder, and the width inside its MLP.
    pub width: usize,
    /// Transformer blocks of the encoder.
    pub blocks: usize,
    /// Attention heads of every block of the encoder; they divide `width`.
    pub heads: usize,
    /// Width inside the MLP of every block of the encoder.
    pub hidden: usize,
    /// The blocks whose outputs the head sees.
    pub taps: [usize; 4],
    /// Width of the four levels of the head.
    pub levels: [usize; 4],
    /// Width of the fused maps.
    pub features: usize,
}

impl NetworkSettings {
    /// Small: 28 M parameters.
    #[must_use]
    pub fn small() -> Self {
        Self::official(384, 12, [2, 5, 8, 11], [48, 96, 192, 384], 64)
    }

    /// Base: 113 M parameters.
    #[must_use]
    pub fn base() -> Self {
        Self::official(768, 12, [2, 5, 8, 11], [96, 192, 384, 768], 128)
    }

    /// Large: 382 M parameters.
    #[must_use]
    pub fn large() -> Self {
        Self::official(1024, 24, [4, 11, 17, 23], [256, 512, 1024, 1024], 256)
    }

    fn official(
        width: usize,
        blocks: usize,
        taps: [usize; 4],
        levels: [usize; 4],
        features: usize,
    ) -> Self {
        Self {
            patch: 14,
            grid: 37,
            width,
            blocks,
            heads: width / 64,
            hidden: 4 * width,
            taps,
            levels,
            features,
        }
    }

    /// `Small`, `Base` or `Large`, where it is one of the released sizes.
    #[must_use]
    pub fn name(&self) -> Option<&'static str> {
        [
            ("Small", Self::small()),
            ("Base", Self::base()),
            ("Large", Self::large()),
        ]
        .into_iter()
        .find(|(_, settings)| settings == self)
        .map(|(name, _)| name)
    }

    /// Channels that the four temporal modules act on.
    #[must_use]
    pub fn motion_widths(&self) -> [usize; 4] {
        [self.levels[2], self.levels[3], self.features, self.features]
    }

    /// Why no network can have these sizes, if so.
    ///
    /// # Errors
    /// The first reason.
    pub fn check(&self) -> Result<(), LabelError> {
        const MOST: usize = 1 << 14;
        let refuse = |reason: String| Err(LabelError::Settings(reason));
        let sizes = [
            self.patch,
            self.grid,
            self.width,
            self.blocks,
            self.heads,
            self.hidden,
            self.features,
        ];
        let all = sizes.iter().chain(&self.levels);
        if let Some(size) = all.clone().find(|size| !(1..=MOST).contains(*size)) {
            return refuse(format!("a size of {size}"));
        }
        if self.patch > 64 || self.grid > 256 || self.blocks > 64 {
            return refuse(format!(
                "patches of {}, a grid of {}, {} blocks",
                self.patch, self.grid, self.blocks
            ));
        }
        if !self.width.is_multiple_of(self.heads) {
            return refuse(format!("width {} in {} heads", self.width, self.heads));
        }
        if !self.features.is_multiple_of(2) {
            return refuse(format!("{} features cannot be halved", self.features));
        }
        let unit = MOTION_HEADS.max(MOTION_GROUPS);
        if let Some(width) = self
            .motion_widths()
            .iter()
            .find(|w| !w.is_multiple_of(unit))
        {
            return refuse(format!(
                "a temporal module of {width} channels, not a multiple of {unit}"
            ));
        }
        let ascending = self.taps.windows(2).all(|pair| pair[0] < pair[1]);
        if !ascending || self.taps[3] >= self.blocks {
            return refuse(format!("taps {:?} of {} blocks", self.taps, self.blocks));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_released_sizes_are_valid_and_known_by_name() {
        for (settings, name) in [
            (NetworkSettings::small(), "Small"),
            (NetworkSettings::base(), "Base"),
            (NetworkSettings::large(), "Large"),
        ] {
            settings.check().unwrap();
            assert_eq!(settings.name(), Some(name));
        }
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        for change in [
            |s: &mut NetworkSettings| s.heads = 5,
            |s: &mut NetworkSettings| s.features = 0,
            |s: &mut NetworkSettings| s.levels[2] = 200,
            |s: &mut NetworkSettings| s.taps = [2, 5, 8, 12],
            |s: &mut NetworkSettings| s.blocks = usize::MAX,
        ] {
            let mut settings = NetworkSettings::small();
            change(&mut settings);
            assert!(settings.check().is_err(), "{settings:?}");
        }
    }
}
