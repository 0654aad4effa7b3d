//! What a model is made of: size, modalities and their grids, and from that every parameter by name.
//!
//! A [`MgetSpec`] is stored with the weights; nothing here allocates a parameter, so a plan can count any size.

use super::positions::{self, Positions};
use super::size::Size;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The architecture of one Masked Generative Egocentric Transformer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MgetSpec {
    /// Depth and width.
    pub size: Size,
    /// Position tables of time-by-joints grids.
    #[serde(default)]
    pub positions: Positions,
    /// The modalities; their order is the order of tokens within a sample.
    pub modalities: Vec<ModalitySpec>,
}

/// One modality of a model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ModalitySpec {
    /// Its name, without dots.
    pub name: String,
    /// How it enters.
    pub input: Input,
}

/// How a modality enters the encoder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Input {
    /// Discrete tokens; also predicted by the decoder.
    Tokens {
        /// Camera and gaze `[30]`, body and hands `[30, 7]`, video `[5, 32, 32]`.
        grid: Vec<usize>,
        /// How many different tokens.
        vocabulary: usize,
    },
    /// Raw video in non-overlapping tubelets through one linear map (the paper's ViT branch); never predicted.
    Pixels {
        /// Frames, height, width, channels.
        clip: [usize; 4],
        /// Frames, height and width of a tubelet.
        tubelet: [usize; 3],
    },
}

/// Tokens of one modality and sample, at most: position tables are made for all of them.
const MOST_TOKENS: usize = 1 << 20;
/// The largest width, also within the SwiGLU.
const MOST_WIDTH: usize = 1 << 16;
/// The most blocks of encoder and decoder.
const MOST_DEPTH: usize = 1 << 10;

/// The product of sizes; `None` where it is no `usize`.
fn product(sizes: &[usize]) -> Option<usize> {
    sizes
        .iter()
        .try_fold(1_usize, |product, size| product.checked_mul(*size))
}

/// Why a model cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SpecError {
    /// The width does not split evenly over the attention heads.
    #[error("width {width} is not divisible by {heads} heads")]
    Heads {
        /// Width of the model.
        width: usize,
        /// Attention heads of every block.
        heads: usize,
    },
    /// The width does not suit the position code of a modality's grid.
    #[error(
        "width {width} is not divisible by {divisor}, which the position code of `{modality}` ({axes} axes) needs; divisible by 12 always works"
    )]
    Width {
        /// Width of the model.
        width: usize,
        /// What the width must be a multiple of for this grid: 2, 4 or 6.
        divisor: usize,
        /// The modality's name.
        modality: String,
        /// Axes of the modality's grid, 1 to 3.
        axes: usize,
    },
    /// A grid has a number of axes for which there is no position code.
    #[error(
        "`{modality}` has a grid of {axes} axes; position codes exist for 1 (time), 2 (time, joints) and 3 (video)"
    )]
    Axes {
        /// The modality's name.
        modality: String,
        /// Axes of its grid.
        axes: usize,
    },
    /// A clip does not divide into whole tubelets, or a side of the tubelet is 0.
    #[error("`{modality}`: clip {clip:?} is not divisible into tubelets of {tubelet:?}")]
    Tubelet {
        /// The modality's name.
        modality: String,
        /// Frames, height, width and channels of the clip.
        clip: [usize; 4],
        /// Frames, height and width of a tubelet.
        tubelet: [usize; 3],
    },
    /// The vocabulary or a side of the grid is 0.
    #[error("`{modality}` has an empty {what}")]
    Empty {
        /// The modality's name.
        modality: String,
        /// `vocabulary` or `grid`.
        what: &'static str,
    },
    /// A sample has more tokens or tubelets of a modality than a model can have.
    #[error("`{modality}`: {sizes:?} is too large, a sample has at most {MOST_TOKENS} tokens")]
    TooMany {
        /// The modality's name.
        modality: String,
        /// The grid of tokens, or frames, height, width and channels of the clip.
        sizes: Vec<usize>,
    },
    /// Two modalities have this name.
    #[error("modality `{0}` appears twice")]
    Twice(String),
    /// A modality has this name, which cannot stand in the name of a parameter.
    #[error("modality name `{0}` is empty or holds a dot or a blank")]
    Name(String),
    /// All modalities are raw video, or there are none.
    #[error("no modality has tokens: there is nothing to predict")]
    NothingToPredict,
    /// The width, the number of heads or a depth of this size is 0.
    #[error("the model's size has a zero: {0:?}")]
    ZeroSize(Size),
    /// A width or a depth of this size is above its limit.
    #[error(
        "the model's size is out of range, widths to {MOST_WIDTH} and depths to {MOST_DEPTH}: {0:?}"
    )]
    HugeSize(Size),
    /// There are no position codes for a modality's grid at the width of the model.
    #[error("`{modality}` has no position table of this width")]
    NoTable {
        /// The modality's name.
        modality: String,
    },
}

impl ModalitySpec {
    /// A modality of discrete tokens.
    #[must_use]
    pub fn tokens(name: &str, grid: &[usize], vocabulary: usize) -> Self {
        Self {
            name: name.to_owned(),
            input: Input::Tokens {
                grid: grid.to_vec(),
                vocabulary,
            },
        }
    }

    /// Raw video.
    #[must_use]
    pub fn pixels(name: &str, clip: [usize; 4], tubelet: [usize; 3]) -> Self {
        Self {
            name: name.to_owned(),
            input: Input::Pixels { clip, tubelet },
        }
    }

    /// The grid of its tokens or tubelets.
    #[must_use]
    pub fn grid(&self) -> Vec<usize> {
        match &self.input {
            Input::Tokens { grid, .. } => grid.clone(),
            Input::Pixels { clip, tubelet } => (0..3)
                .map(|axis| clip[axis] / tubelet[axis].max(1))
                .collect(),
        }
    }

    /// How many tokens or tubelets a sample has of it.
    #[must_use]
    pub fn count(&self) -> usize {
        self.grid().iter().product()
    }

    /// Its vocabulary; `None` for raw video.
    #[must_use]
    pub fn vocabulary(&self) -> Option<usize> {
        match self.input {
            Input::Tokens { vocabulary, .. } => Some(vocabulary),
            Input::Pixels { .. } => None,
        }
    }

    /// Values of one tubelet; `None` for tokens.
    #[must_use]
    pub fn tubelet_values(&self) -> Option<usize> {
        match self.input {
            Input::Tokens { .. } => None,
            Input::Pixels { clip, tubelet } => Some(tubelet.iter().product::<usize>() * clip[3]),
        }
    }

    fn check(&self, width: usize) -> Result<(), SpecError> {
        let modality = || self.name.clone();
        if self.name.is_empty() || self.name.contains(['.', ' ']) {
            return Err(SpecError::Name(self.name.clone()));
        }
        let grid = self.grid();
        let Some(divisor) = positions::divisor(&grid) else {
            return Err(SpecError::Axes {
                modality: modality(),
                axes: grid.len(),
            });
        };
        if self.vocabulary() == Some(0) {
            return Err(SpecError::Empty {
                modality: modality(),
                what: "vocabulary",
            });
        }
        if let Input::Pixels { clip, tubelet } = self.input
            && (tubelet.contains(&0)
                || (0..3).any(|axis| !clip[axis].is_multiple_of(tubelet[axis])))
        {
            return Err(SpecError::Tubelet {
                modality: modality(),
                clip,
                tubelet,
            });
        }
        if grid.contains(&0) {
            return Err(SpecError::Empty {
                modality: modality(),
                what: "grid",
            });
        }
        let sizes = match self.input {
            Input::Tokens { .. } => grid.clone(),
            Input::Pixels { clip, .. } => clip.to_vec(),
        };
        if product(&sizes).is_none() || product(&grid).is_none_or(|tokens| tokens > MOST_TOKENS) {
            return Err(SpecError::TooMany {
                modality: modality(),
                sizes,
            });
        }
        if !width.is_multiple_of(divisor) {
            return Err(SpecError::Width {
                width,
                divisor,
                modality: modality(),
                axes: grid.len(),
            });
        }
        Ok(())
    }
}

impl MgetSpec {
    /// Checks that the model can be built.
    ///
    /// # Errors
    /// The first reason why not; see [`SpecError`].
    pub fn check(&self) -> Result<(), SpecError> {
        let Size {
            width,
            heads,
            encoder_depth,
            decoder_depth,
            hidden,
        } = self.size;
        if [width, heads, encoder_depth, decoder_depth].contains(&0) {
            return Err(SpecError::ZeroSize(self.size));
        }
        if width.max(hidden) > MOST_WIDTH || encoder_depth.max(decoder_depth) > MOST_DEPTH {
            return Err(SpecError::HugeSize(self.size));
        }
        if !width.is_multiple_of(heads) {
            return Err(SpecError::Heads { width, heads });
        }
        for (index, modality) in self.modalities.iter().enumerate() {
            modality.check(width)?;
            if self.modalities[..index]
                .iter()
                .any(|other| other.name == modality.name)
            {
                return Err(SpecError::Twice(modality.name.clone()));
            }
        }
        if self
            .modalities
            .iter()
            .all(|modality| modality.vocabulary().is_none())
        {
            return Err(SpecError::NothingToPredict);
        }
        Ok(())
    }

    /// The index of a modality.
    #[must_use]
    pub fn index(&self, name: &str) -> Option<usize> {
        self.modalities
            .iter()
            .position(|modality| modality.name == name)
    }

    /// How many modalities the decoder predicts.
    #[must_use]
    pub fn predicted(&self) -> usize {
        self.modalities
            .iter()
            .filter(|m| m.vocabulary().is_some())
            .count()
    }

    /// The modalities as masking sees them.
    #[must_use]
    pub fn slots(&self) -> Vec<crate::masking::Slot> {
        self.modalities
            .iter()
            .map(|modality| {
                if modality.vocabulary().is_some() {
                    crate::masking::Slot::both(&modality.name, modality.count())
                } else {
                    crate::masking::Slot::input_only(&modality.name, modality.count())
                }
            })
            .collect()
    }

    /// Names and shapes of all parameters, in the order of the model.
    #[must_use]
    pub fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        let (d, h) = (self.size.width, self.size.hidden());
        let mut all = vec![("mask_token".to_owned(), vec![d])];
        let mut push = |name: String, shape: &[usize]| all.push((name, shape.to_vec()));
        for modality in &self.modalities {
            let path = format!("encoder_embeddings.{}", modality.name);
            push(format!("{path}.mod_emb"), &[d]);
            match (modality.vocabulary(), modality.tubelet_values()) {
                (Some(vocabulary), _) => push(format!("{path}.token_emb.weight"), &[vocabulary, d]),
                (None, values) => push(format!("{path}.proj.weight"), &[d, values.unwrap_or(0)]),
            }
        }
        for modality in &self.modalities {
            if let Some(vocabulary) = modality.vocabulary() {
                push(
                    format!("decoder_embeddings.{}.token_emb.weight", modality.name),
                    &[vocabulary, d],
                );
            }
        }
        for block in 0..self.size.encoder_depth {
            for (name, shape) in [
                ("norm1.weight", vec![d]),
                ("attn.qkv.weight", vec![3 * d, d]),
                ("attn.proj.weight", vec![d, d]),
                ("norm2.weight", vec![d]),
                ("mlp.fc1.weight", vec![h, d]),
                ("mlp.fc2.weight", vec![d, h]),
                ("mlp.fc3.weight", vec![h, d]),
            ] {
                push(format!("encoder.{block}.{name}"), &shape);
            }
        }
        push("encoder_norm.weight".into(), &[d]);
        push("decoder_proj_context.weight".into(), &[d, d]);
        push("decoder_proj_context.bias".into(), &[d]);
        for block in 0..self.size.decoder_depth {
            for (name, shape) in [
                ("norm1.weight", vec![d]),
                ("self_attn.qkv.weight", vec![3 * d, d]),
                ("self_attn.proj.weight", vec![d, d]),
                ("cross_attn.q.weight", vec![d, d]),
                ("cross_attn.kv.weight", vec![2 * d, d]),
                ("cross_attn.proj.weight", vec![d, d]),
                ("query_norm.weight", vec![d]),
                ("context_norm.weight", vec![d]),
                ("norm2.weight", vec![d]),
                ("mlp.fc1.weight", vec![h, d]),
                ("mlp.fc2.weight", vec![d, h]),
                ("mlp.fc3.weight", vec![h, d]),
            ] {
                push(format!("decoder.{block}.{name}"), &shape);
            }
        }
        push("decoder_norm.weight".into(), &[d]);
        all
    }

    /// How many trainable numbers the model has; exact, without building it.
    #[must_use]
    pub fn parameter_count(&self) -> usize {
        let d = self.size.width;
        let modalities: usize = self
            .modalities
            .iter()
            .map(|modality| match modality.vocabulary() {
                Some(vocabulary) => 2 * vocabulary * d + d,
                None => modality.tubelet_values().unwrap_or(0) * d + d,
            })
            .sum();
        self.size.trunk_parameters() + modalities
    }

    /// Multiply-accumulates of one forward pass over a sample with `inputs` visible and `targets` target tokens, the targets
    /// spread over modalities as `targets_of` says.
    #[must_use]
    pub fn multiply_accumulates(&self, inputs: usize, targets_of: &[usize]) -> f64 {
        let (d, h) = (self.size.width as f64, self.size.hidden() as f64);
        let (n, m) = (inputs as f64, targets_of.iter().sum::<usize>() as f64);
        let mlp = 3.0 * d * h;
        let encoder = n * (4.0 * d * d + mlp) + 2.0 * n * n * d;
        let within: f64 = targets_of
            .iter()
            .map(|t| 2.0 * (*t as f64).powi(2) * d)
            .sum();
        let decoder = m * (6.0 * d * d + mlp) + 2.0 * n * d * d + within + 2.0 * n * m * d;
        let heads: f64 = self
            .modalities
            .iter()
            .zip(targets_of)
            .map(|(modality, t)| *t as f64 * d * modality.vocabulary().unwrap_or(0) as f64)
            .sum();
        self.size.encoder_depth as f64 * encoder
            + self.size.decoder_depth as f64 * decoder
            + n * d * d
            + heads
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(size: (usize, usize, usize), body: usize, pixels: bool) -> MgetSpec {
        let mut modalities = vec![
            ModalitySpec::tokens("body", &[30, 7], body),
            ModalitySpec::tokens("camera", &[30], 256),
            ModalitySpec::tokens("depth", &[5, 32, 32], 64_000),
            ModalitySpec::tokens("gaze", &[30], 512),
            ModalitySpec::tokens("left_hand", &[30, 7], 1024),
            ModalitySpec::tokens("rgb", &[5, 32, 32], 64_000),
            ModalitySpec::tokens("right_hand", &[30, 7], 1024),
        ];
        if pixels {
            modalities.push(ModalitySpec::pixels("pixels", [16, 256, 256, 3], [4, 8, 8]));
        }
        MgetSpec {
            size: Size {
                width: size.0,
                heads: size.1,
                encoder_depth: size.2,
                decoder_depth: size.2,
                hidden: 0,
            },
            positions: Positions::Released,
            modalities,
        }
    }

    #[test]
    fn models_have_the_published_number_of_parameters() {
        let (tiny, base) = ((384, 6, 6), (768, 12, 12));
        for (spec, expected) in [
            (spec(tiny, 2048, false), 126_977_664),
            (spec(tiny, 2048, true), 127_272_960),
            (spec(tiny, 1024, true), 126_486_528),
            (spec(base, 2048, false), 402_913_536),
            (spec(base, 2048, true), 403_504_128),
            (spec(base, 1024, true), 401_931_264),
        ] {
            spec.check().unwrap();
            assert_eq!(spec.parameter_count(), expected);
            let listed: usize = spec
                .parameters()
                .iter()
                .map(|(_, shape)| shape.iter().product::<usize>())
                .sum();
            assert_eq!(listed, expected, "the list and the formula agree");
        }
    }

    #[test]
    fn forward_cost_is_that_of_the_reference() {
        // By hand from the sizes: 0.64 T trunk and 0.10 T logits at 2048 in, 2048 targets of one 64 000-entry modality.
        let spec = spec((768, 12, 12), 2048, true);
        let mut targets = vec![0; spec.modalities.len()];
        targets[spec.index("rgb").unwrap()] = 2048;
        let cost = spec.multiply_accumulates(2048, &targets) / 1e12;
        assert!((cost - 0.74).abs() < 0.02, "{cost}");
    }

    #[test]
    fn models_that_cannot_be_built_say_why() {
        let message = |change: fn(&mut MgetSpec)| {
            let mut spec = spec((768, 12, 12), 1024, true);
            change(&mut spec);
            spec.check().unwrap_err().to_string()
        };
        assert!(message(|s| s.size.width = 512).contains("512 is not divisible by 12 heads"));
        let six = message(|s| (s.size.width, s.size.heads) = (512, 8));
        assert!(
            six.contains("not divisible by 6") && six.contains("`depth`"),
            "{six}"
        );
        assert!(message(|s| (s.size.width, s.size.heads) = (2046, 31)).contains("divisible by 4"));
        let grid = |grid: [usize; 3]| {
            let mut spec = spec((768, 12, 12), 1024, true);
            spec.modalities[5] = ModalitySpec::tokens("rgb", &grid, 64_000);
            spec.check()
        };
        assert_eq!(grid([4, 512, 512]), Ok(()));
        for huge in [[4, 512, 513], [3, 1 << 20, 1 << 20], [usize::MAX; 3]] {
            let message = grid(huge).unwrap_err().to_string();
            assert!(message.contains("at most 1048576 tokens"), "{message}");
        }
        let huge = ModalitySpec::pixels("p", [1, 1 << 40, 1 << 40, 1], [1, 1 << 40, 1 << 40]);
        let mut pixels = spec((768, 12, 12), 1024, true);
        pixels.modalities[7] = huge;
        assert!(matches!(pixels.check(), Err(SpecError::TooMany { .. })));
        assert!(message(|s| s.size.encoder_depth = 1 << 40).contains("out of range"));
        assert!(message(|s| s.modalities.truncate(0)).contains("nothing to predict"));
        assert!(message(|s| s.modalities[0].name = "camera".into()).contains("twice"));
        assert!(message(|s| s.modalities[0].name = "a.b".into()).contains("dot"));
        assert!(
            message(|s| s.modalities[7] = ModalitySpec::pixels("p", [16, 250, 256, 3], [4, 8, 8]))
                .contains("not divisible into tubelets")
        );
    }
}
