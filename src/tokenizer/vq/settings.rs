//! The sizes and the loss of a VQ-VAE: what a registry entry of the family `vq` holds.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::modality::Shape;
use crate::nn::positions::GridOrder;
use crate::tokenizer::TokenizerError;
use crate::tokenizer::patches::Patches;
use crate::tokenizer::quantizer::QuantizerSettings;

/// What reconstruction is measured by while training; values are normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Mean of squared errors over all values.
    Mse,
    /// Sum of squared errors of valid samples (or joints) divided by how many there are.
    #[default]
    MaskedMse,
}

/// The sizes of a VQ-VAE.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VqSettings {
    /// How many codes there are: the vocabulary.
    pub codebook: usize,
    /// Values per code.
    pub code_width: usize,
    /// Samples per token, and joints per token for joints: `[2]`, `[2, 3]`.
    pub compression: Vec<usize>,
    /// Width of the transformers.
    pub width: usize,
    /// Blocks of the encoder, and of the decoder.
    pub depth: usize,
    /// Attention heads; they divide the width.
    pub heads: usize,
    /// Width inside the MLPs, in widths.
    pub mlp_ratio: usize,
    /// What is minimised.
    pub loss: Loss,
    /// Weight of the errors of steps from sample to sample beside the errors of samples. Small tokenizers jump where a token ends;
    /// this smooths them. 0: none, as in the paper.
    #[serde(alias = "velocity")]
    pub velocity_weight: f64,
    /// For joints: weight of the errors of joints relative to their centre, beside the errors of their places. Places vary most, and
    /// a small codebook spends itself on them; this makes it keep the pose. 0: none, as in the paper.
    #[serde(skip_serializing_if = "is_zero")]
    pub pose_weight: f64,
    /// For joints: all but the first (pelvis, wrist) are seen from it before they are scaled. Where a whole body is varies by metres
    /// and its pose by centimetres; this gives each the same weight. Not in the paper. A sample without its first joint counts as
    /// not valid.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub root_relative: bool,
    /// Decay of the running means of codes and counts.
    pub ema_decay: f64,
    /// Codes with a smaller running count are replaced by latents of the batch.
    pub dead_below: f64,
    /// Weight of the loss that pulls latents to their codes.
    #[serde(alias = "commitment")]
    pub commitment_weight: f64,
    /// How the position table of a grid of joints is enumerated.
    pub positions: GridOrder,
}

/// Left out where it is 0, so that what was made before there was such a weight keeps its identity.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(weight: &f64) -> bool {
    *weight == 0.0
}

impl Default for VqSettings {
    /// The paper's sizes (ViT-B), for signals over time.
    fn default() -> Self {
        Self {
            codebook: 512,
            code_width: 32,
            compression: vec![2],
            width: 768,
            depth: 12,
            heads: 12,
            mlp_ratio: 4,
            loss: Loss::MaskedMse,
            velocity_weight: 0.0,
            pose_weight: 0.0,
            root_relative: false,
            ema_decay: 0.99,
            dead_below: 2.0,
            commitment_weight: 1.0,
            positions: GridOrder::Released,
        }
    }
}

impl VqSettings {
    /// For signals over time on two cores and minutes; the entry `vq_temporal_small`.
    #[must_use]
    pub fn temporal_small() -> Self {
        Self {
            codebook: 256,
            code_width: 8,
            compression: vec![4],
            width: 64,
            depth: 2,
            heads: 4,
            mlp_ratio: 2,
            velocity_weight: 10.0,
            ema_decay: 0.95,
            dead_below: 0.5,
            ..Self::default()
        }
    }

    /// For joints over time on two cores and minutes; the entry `vq_kinematic_small`.
    #[must_use]
    pub fn kinematic_small() -> Self {
        Self {
            codebook: 512,
            compression: vec![4, 3],
            depth: 1,
            velocity_weight: 0.0,
            positions: GridOrder::Aligned,
            ..Self::temporal_small()
        }
    }

    /// How signals of `shape` are cut.
    ///
    /// # Errors
    /// When a size is impossible.
    pub fn patches(&self, shape: &Shape) -> Result<Patches, TokenizerError> {
        let wrong = |what: String| Err(TokenizerError::Other(what));
        let divisor = if matches!(shape, Shape::Kinematic { .. }) {
            4
        } else {
            2
        };
        if self.width == 0 || !self.width.is_multiple_of(divisor) {
            return wrong(format!(
                "width {} is not a multiple of {divisor}, which the position table needs",
                self.width
            ));
        }
        if self.heads == 0 || !self.width.is_multiple_of(self.heads) {
            return wrong(format!(
                "{} heads do not divide width {}",
                self.heads, self.width
            ));
        }
        if self.codebook == 0 || self.code_width == 0 || self.depth == 0 || self.mlp_ratio == 0 {
            return wrong("codebook, code_width, depth and mlp_ratio are at least 1".to_owned());
        }
        for (name, size, most) in [
            ("codebook", self.codebook, 1 << 24),
            ("code_width", self.code_width, 1 << 16),
            ("width", self.width, 1 << 16),
            ("depth", self.depth, 1 << 10),
            ("mlp_ratio", self.mlp_ratio, 1 << 8),
        ] {
            if size > most {
                return wrong(format!("{name} is at most {most}, not {size}"));
            }
        }
        if !(0.0..1.0).contains(&self.ema_decay)
            || self.dead_below < 0.0
            || self.commitment_weight < 0.0
            || self.velocity_weight < 0.0
            || self.pose_weight < 0.0
        {
            return wrong(
                "ema_decay lies in [0, 1), dead_below, commitment_weight, velocity_weight and pose_weight are not negative"
                    .to_owned(),
            );
        }
        if !matches!(shape, Shape::Kinematic { .. }) {
            if self.pose_weight > 0.0 {
                return wrong(
                    "pose_weight is for joints; a signal over time has no pose".to_owned(),
                );
            }
            if self.root_relative {
                return wrong(
                    "root_relative is for joints; a signal over time has no root".to_owned(),
                );
            }
        }
        Patches::new(shape, &self.compression)
    }

    pub(super) fn quantizer(&self) -> QuantizerSettings {
        QuantizerSettings {
            codebook: self.codebook,
            code_width: self.code_width,
            decay: self.ema_decay,
            dead_below: self.dead_below,
            commitment: self.commitment_weight,
        }
    }
}
