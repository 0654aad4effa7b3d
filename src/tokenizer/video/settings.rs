//! Sizes of a video tokenizer, and what follows from them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::tokenizer::TokenizerError;

/// A discrete video tokenizer. The defaults are Cosmos DV4x8x8.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VideoSettings {
    /// Channels after the first convolution; the levels multiply it.
    pub channels: usize,
    /// Channels of each level, in multiples of `channels`.
    pub multipliers: Vec<usize>,
    /// Residual blocks per level of the encoder; the decoder has one more.
    pub blocks: usize,
    /// Side of the wavelet's blocks in frames and pixels: 1, 2 or 4.
    pub patch: usize,
    /// Channels between the networks and the projections to and from the latent.
    pub latent_channels: usize,
    /// Levels of each latent dimension; their product is the vocabulary.
    pub levels: Vec<usize>,
    /// Pixels per token along height and width: a power of two.
    pub spatial: usize,
    /// Frames per token (after the first): a power of two.
    pub temporal: usize,
}

impl Default for VideoSettings {
    fn default() -> Self {
        Self {
            channels: 128,
            multipliers: vec![2, 4, 4],
            blocks: 2,
            patch: 4,
            latent_channels: 16,
            levels: vec![8, 8, 8, 5, 5, 5],
            spatial: 8,
            temporal: 4,
        }
    }
}

/// What happens to the resolution between two levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Resampling {
    /// Height and width are halved.
    pub space: bool,
    /// Time is halved.
    pub time: bool,
}

/// Colours of a pixel.
pub const COLOURS: usize = 3;

impl VideoSettings {
    /// The smallest, for tests and first tries; the entry `video_tiny`.
    #[must_use]
    pub fn tiny() -> Self {
        Self {
            channels: 16,
            multipliers: vec![1, 2],
            blocks: 1,
            patch: 4,
            latent_channels: 8,
            levels: vec![8, 5, 5],
            spatial: 8,
            temporal: 4,
        }
    }

    /// Cosmos DV8x16x16.
    #[must_use]
    pub fn dv8x16x16() -> Self {
        Self {
            spatial: 16,
            temporal: 8,
            ..Self::default()
        }
    }

    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// With the size that does not fit, and what would.
    pub fn check(&self) -> Result<(), TokenizerError> {
        let wrong = |what: String| Err(TokenizerError::Other(what));
        if !matches!(self.patch, 1 | 2 | 4) {
            return wrong(format!("`patch` is 1, 2 or 4, not {}", self.patch));
        }
        if self.channels == 0 || self.latent_channels == 0 || self.multipliers.contains(&0) {
            return wrong("`channels`, `latent_channels` and `multipliers` are at least 1".into());
        }
        let multiplier = self.multipliers.iter().copied().max().unwrap_or(0);
        for (name, size, most) in [
            ("channels", self.channels, 1 << 16),
            ("multipliers", multiplier, 1 << 8),
            ("blocks", self.blocks, 1 << 8),
            ("latent_channels", self.latent_channels, 1 << 16),
        ] {
            if size > most {
                return wrong(format!("`{name}` is at most {most}, not {size}"));
            }
        }
        if self.multipliers.is_empty() || self.multipliers.len() > 8 {
            return wrong("`multipliers` has one to eight levels".to_owned());
        }
        let vocabulary = self
            .levels
            .iter()
            .try_fold(1usize, |n, &l| n.checked_mul(l))
            .filter(|n| *n <= 1 << 24 && !self.levels.iter().any(|l| *l < 2));
        if vocabulary.is_none() || self.levels.is_empty() {
            return wrong(
                "`levels` are at least 2 each, and their product at most 2^24".to_owned(),
            );
        }
        for (name, value, steps) in [
            ("spatial", self.spatial, self.steps(|r| r.space)),
            ("temporal", self.temporal, self.steps(|r| r.time)),
        ] {
            let fits = value.is_power_of_two()
                && value >= self.patch
                && steps.0 == (value / self.patch).ilog2() as usize
                && steps.0 == steps.1;
            if !fits {
                return wrong(format!(
                    "`{name}` {value} cannot be reached with `patch` {} and {} levels",
                    self.patch,
                    self.multipliers.len()
                ));
            }
        }
        Ok(())
    }

    /// How often the encoder and the decoder resample in one way.
    fn steps(&self, way: impl Fn(Resampling) -> bool) -> (usize, usize) {
        let levels = self.multipliers.len();
        let down = (0..levels).filter(|l| way(self.down(*l))).count();
        let up = (0..levels).filter(|l| way(self.up(*l))).count();
        (down, up)
    }

    /// Halvings of space and time that the network does after the wavelet.
    fn halvings(&self) -> [usize; 2] {
        [self.spatial, self.temporal].map(|size| (size / self.patch).max(1).ilog2() as usize)
    }

    /// What follows level `level` of the encoder: the first levels resample. Never after the last.
    #[must_use]
    pub fn down(&self, level: usize) -> Resampling {
        let [space, time] = self.halvings();
        let inner = level + 1 < self.multipliers.len();
        Resampling {
            space: inner && level < space,
            time: inner && level < time,
        }
    }

    /// What follows level `level` of the decoder (the last level comes first): time is never doubled right after the first
    /// one, and where time is doubled space is too.
    #[must_use]
    pub fn up(&self, level: usize) -> Resampling {
        let [space, time] = self.halvings();
        let step = self.multipliers.len() - 1 - level;
        if level == 0 {
            return Resampling::default();
        }
        let doubles_time = 0 < step && step <= time;
        Resampling {
            space: doubles_time || (step < space && space > time),
            time: doubles_time,
        }
    }

    /// Channels of a level.
    #[must_use]
    pub fn width(&self, level: usize) -> usize {
        self.channels * self.multipliers[level]
    }

    /// Wavelet coefficients per block of pixels.
    #[must_use]
    pub fn coefficients(&self) -> usize {
        COLOURS * self.patch.pow(3)
    }

    /// How many different tokens there are.
    #[must_use]
    pub fn vocabulary(&self) -> usize {
        self.levels.iter().product()
    }

    /// The token grid of a padded clip of `[frames, height, width]`.
    #[must_use]
    pub fn grid(&self, [frames, height, width]: [usize; 3]) -> [usize; 3] {
        [
            (frames - 1) / self.temporal + 1,
            height / self.spatial,
            width / self.spatial,
        ]
    }

    /// Names of tensors that NVIDIA's files hold although the network never runs them, as prefixes.
    #[must_use]
    pub fn never_run(&self) -> Vec<String> {
        let mut prefixes = Vec::new();
        let mut add = |place: String, way: Resampling, convs: [&str; 2]| {
            if way == Resampling::default() {
                prefixes.push(format!("{place}."));
                return;
            }
            for (conv, runs) in convs.into_iter().zip([way.space, way.time]) {
                if !runs {
                    prefixes.push(format!("{place}.{conv}."));
                }
            }
        };
        for level in 0..self.multipliers.len() {
            if level + 1 < self.multipliers.len() {
                let place = format!("encoder.down.{level}.downsample");
                add(place, self.down(level), ["conv1", "conv2"]);
            }
            if level > 0 {
                let place = format!("decoder.up.{level}.upsample");
                add(place, self.up(level), ["conv2", "conv1"]);
            }
        }
        prefixes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resampling_is_where_the_released_networks_have_it() {
        let (space, time) = (true, true);
        let both = Resampling { space, time };
        let space = Resampling { space, time: false };
        let none = Resampling::default();
        let small = VideoSettings::default();
        small.check().unwrap();
        assert_eq!([0, 1, 2].map(|l| small.down(l)), [space, none, none]);
        assert_eq!([0, 1, 2].map(|l| small.up(l)), [none, none, space]);
        let large = VideoSettings::dv8x16x16();
        large.check().unwrap();
        assert_eq!([0, 1, 2].map(|l| large.down(l)), [both, space, none]);
        assert_eq!([0, 1, 2].map(|l| large.up(l)), [none, both, space]);
        assert_eq!(
            small.never_run(),
            [
                "encoder.down.0.downsample.conv2.",
                "encoder.down.1.downsample.",
                "decoder.up.1.upsample.",
                "decoder.up.2.upsample.conv1."
            ]
        );
    }

    #[test]
    fn sizes_that_cannot_be_reached_are_refused() {
        for (spatial, temporal, patch) in [(8, 8, 2), (64, 4, 4), (6, 4, 4), (2, 4, 4), (8, 4, 3)] {
            let settings = VideoSettings {
                patch,
                spatial,
                temporal,
                ..VideoSettings::default()
            };
            assert!(settings.check().is_err(), "{spatial} {temporal} {patch}");
        }
    }
}
