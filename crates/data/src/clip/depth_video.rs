//! Depth as video: metres to the 8-bit levels the video tokenizer sees, and back.
//!
//! What the levels mean is always said, never guessed: a kind (depth or disparity) and a range (the clip's own or a fixed one).

use super::Depth;
use ndarray::{Array3, Array4, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which quantity is linear in the levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthKind {
    /// z-depth in metres: far is bright.
    Depth,
    /// Inverse z-depth: near is bright.
    Disparity,
}

/// Which values the darkest and the brightest level stand for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthRange {
    /// The smallest and largest value of the clip: relative depth, the scale is lost.
    ClipMinmax,
    /// `near` and `far`: metric depth.
    Fixed,
}

/// How depth in metres becomes video.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DepthCoding {
    /// Which quantity is linear in the levels.
    pub depth_kind: DepthKind,
    /// Which values the ends of the scale stand for.
    pub range: DepthRange,
    /// Metres of the near end: of the scale (`fixed`), or assumed when relative depth is decoded (`clip_minmax`).
    pub near: f32,
    /// Metres of the far end, likewise.
    pub far: f32,
}

impl Default for DepthCoding {
    fn default() -> Self {
        Self::relative()
    }
}

impl DepthCoding {
    /// The 256 pathway: inverse depth between the clip's extremes; decoded between 0.2 m and 3.8 m.
    pub const fn relative() -> Self {
        Self {
            depth_kind: DepthKind::Disparity,
            range: DepthRange::ClipMinmax,
            near: 0.2,
            far: 3.8,
        }
    }

    /// The 512 pathway: metres between 0 and 15.
    pub const fn metric() -> Self {
        Self {
            depth_kind: DepthKind::Depth,
            range: DepthRange::Fixed,
            near: 0.0,
            far: 15.0,
        }
    }

    /// Why these settings mean nothing, if so.
    pub fn problem(&self) -> Option<String> {
        if !(self.near.is_finite()
            && self.far.is_finite()
            && 0.0 <= self.near
            && self.near < self.far)
        {
            return Some(format!(
                "needs 0 <= near < far, got {} and {}",
                self.near, self.far
            ));
        }
        (self.depth_kind == DepthKind::Disparity && self.near == 0.0)
            .then(|| "disparity needs near > 0".to_owned())
    }

    fn quantity(&self, metres: f32) -> f32 {
        match self.depth_kind {
            DepthKind::Depth => metres,
            DepthKind::Disparity => 1.0 / metres,
        }
    }

    /// The quantity's values at the dark and the bright end.
    fn ends(&self) -> (f32, f32) {
        match self.depth_kind {
            DepthKind::Depth => (self.near, self.far),
            DepthKind::Disparity => (1.0 / self.far, 1.0 / self.near),
        }
    }

    /// Levels 0..=255 (truncated) of a clip's depth `[T, H, W]`, and where it was measured. Unmeasured pixels are level 0.
    pub fn encode(&self, metres: &Array3<f32>) -> (Array3<u8>, Array3<bool>) {
        let measured = |m: f32| m.is_finite() && m > 0.0;
        let valid = metres.mapv(measured);
        let (low, high) = match self.range {
            DepthRange::Fixed => self.ends(),
            DepthRange::ClipMinmax => metres
                .iter()
                .filter(|m| measured(**m))
                .map(|m| self.quantity(*m))
                .fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), q| {
                    (a.min(q), b.max(q))
                }),
        };
        // A constant clip has no scale: all levels are 0.
        let span = if high > low {
            high - low
        } else {
            f32::INFINITY
        };
        let levels = Zip::from(metres).and(&valid).map_collect(|&m, &valid| {
            if valid {
                (((self.quantity(m) - low) / span).clamp(0.0, 1.0) * 255.0) as u8
            } else {
                0
            }
        });
        (levels, valid)
    }

    /// Metres of a level, 0..=255 (fractions welcome).
    pub fn decode(&self, level: f32) -> f32 {
        let (low, high) = self.ends();
        let quantity = low + level / 255.0 * (high - low);
        match self.depth_kind {
            DepthKind::Depth => quantity,
            DepthKind::Disparity => 1.0 / quantity,
        }
    }
}

/// Levels as model input: three equal channels in [-1, 1], `[T, H, W, 3]`.
pub fn to_model(levels: &Array3<u8>) -> Array4<f32> {
    let (t, h, w) = levels.dim();
    Array4::from_shape_fn((t, h, w, 3), |(t, y, x, _)| {
        f32::from(levels[[t, y, x]]) / 127.5 - 1.0
    })
}

/// Metres of decoded video: the mean of the channels, rounded to a level.
pub fn from_model(values: &Array4<f32>, rate: f64, coding: &DepthCoding) -> Depth {
    let (t, h, w, channels) = values.dim();
    let metres = Array3::from_shape_fn((t, h, w), |(t, y, x)| {
        let mean =
            (0..channels).map(|c| values[[t, y, x, c]]).sum::<f32>() / channels.max(1) as f32;
        let level = ((mean + 1.0) * 127.5).round().clamp(0.0, 255.0);
        if level.is_nan() {
            f32::NAN
        } else {
            coding.decode(level)
        }
    });
    Depth { rate, metres }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_levels_decode_to_the_golden_metres() {
        let coding = DepthCoding::relative();
        for (level, metres) in [
            (0.0, 3.8),
            (1.0, 3.549_450_5),
            (64.0, 0.688_699_3),
            (128.0, 0.378_663_5),
            (255.0, 0.2),
        ] {
            assert!((coding.decode(level) - metres).abs() < 1e-5);
        }
    }

    #[test]
    fn metric_depth_survives_within_one_level_and_saturates() {
        let metres = Array3::from_shape_fn((2, 4, 4), |(t, y, x)| {
            0.3 + (t * 16 + y * 4 + x) as f32 * 0.6
        });
        let coding = DepthCoding::metric();
        let (levels, valid) = coding.encode(&metres);
        assert!(valid.iter().all(|v| *v));
        let back = from_model(&to_model(&levels), 8.0, &coding);
        for (m, b) in metres.iter().zip(&back.metres) {
            assert!((m.min(15.0) - b).abs() <= 15.0 / 255.0 + 1e-4, "{m} {b}");
        }
    }

    #[test]
    fn relative_levels_span_the_clip_with_near_bright() {
        let mut metres = Array3::from_elem((1, 2, 2), 2.0);
        metres[[0, 0, 0]] = 0.5;
        metres[[0, 1, 1]] = 4.0;
        metres[[0, 0, 1]] = f32::NAN;
        let (levels, valid) = DepthCoding::relative().encode(&metres);
        assert_eq!(levels[[0, 0, 0]], 255);
        assert_eq!(levels[[0, 1, 1]], 0);
        assert_eq!((levels[[0, 0, 1]], valid[[0, 0, 1]]), (0, false));
    }

    #[test]
    fn constant_and_empty_clips_are_dark_not_nan() {
        for fill in [1.5, f32::NAN] {
            let (levels, _) = DepthCoding::relative().encode(&Array3::from_elem((1, 2, 2), fill));
            assert!(levels.iter().all(|l| *l == 0));
        }
    }

    #[test]
    fn meaningless_codings_are_named() {
        assert_eq!(DepthCoding::relative().problem(), None);
        assert_eq!(DepthCoding::metric().problem(), None);
        let bad = DepthCoding {
            near: 0.0,
            ..DepthCoding::relative()
        };
        assert!(bad.problem().is_some());
    }
}
