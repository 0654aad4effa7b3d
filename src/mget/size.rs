//! Model sizes: the contents of `registry/size/*.yaml` (Supp. B).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Depth and width of the encoder-decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Size {
    /// Width of every token; divisible by `heads`, by 6 where a modality has a video grid and by 4 where it has a
    /// time-by-joints grid.
    pub width: usize,
    /// Attention heads.
    pub heads: usize,
    /// Encoder blocks.
    pub encoder_depth: usize,
    /// Decoder blocks.
    pub decoder_depth: usize,
    /// Hidden width of the SwiGLU; 0 means two thirds of four times the width, rounded down.
    pub hidden: usize,
}

impl Default for Size {
    fn default() -> Self {
        Self {
            width: 144,
            heads: 6,
            encoder_depth: 3,
            decoder_depth: 3,
            hidden: 0,
        }
    }
}

impl Size {
    /// The smallest size that still learns.
    pub const LAPTOP_SMALL: Self = Self::of(96, 4, 2);
    /// For two cores and minutes.
    pub const LAPTOP: Self = Self::of(144, 6, 3);
    /// The paper's small model.
    pub const TINY: Self = Self::of(384, 6, 6);
    /// The paper's model.
    pub const BASE: Self = Self::of(768, 12, 12);
    /// The release's largest usable size.
    pub const LARGE: Self = Self::of(1020, 15, 24);

    const fn of(width: usize, heads: usize, depth: usize) -> Self {
        Self {
            width,
            heads,
            encoder_depth: depth,
            decoder_depth: depth,
            hidden: 0,
        }
    }

    /// The hidden width of the SwiGLU.
    #[must_use]
    pub fn hidden(&self) -> usize {
        if self.hidden == 0 {
            2 * (4 * self.width) / 3
        } else {
            self.hidden
        }
    }

    /// Parameters of one encoder block: qkv, projection, SwiGLU, two norms.
    #[must_use]
    pub fn encoder_block_parameters(&self) -> usize {
        let (d, h) = (self.width, self.hidden());
        4 * d * d + 3 * d * h + 2 * d
    }

    /// Parameters of one decoder block: self-attention, cross-attention, SwiGLU, four norms.
    #[must_use]
    pub fn decoder_block_parameters(&self) -> usize {
        let (d, h) = (self.width, self.hidden());
        8 * d * d + 3 * d * h + 4 * d
    }

    /// Parameters of everything but the modalities' own tables.
    #[must_use]
    pub fn trunk_parameters(&self) -> usize {
        let d = self.width;
        let context = d * d + d;
        let norms_and_mask_token = 3 * d;
        self.encoder_depth * self.encoder_block_parameters()
            + self.decoder_depth * self.decoder_block_parameters()
            + context
            + norms_and_mask_token
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trunks_have_the_published_number_of_parameters() {
        let size = |width, heads, depth| Size {
            width,
            heads,
            encoder_depth: depth,
            decoder_depth: depth,
            hidden: 0,
        };
        // Counted from the released code.
        assert_eq!(size(384, 6, 6).trunk_parameters(), 24_935_424);
        assert_eq!(size(512, 8, 8).trunk_parameters(), 59_000_832);
        assert_eq!(size(768, 12, 12).trunk_parameters(), 198_829_056);
        assert_eq!(size(1020, 15, 24).trunk_parameters(), 700_340_160);
        assert_eq!(size(2046, 31, 24).trunk_parameters(), 2_817_558_876);
    }
}
