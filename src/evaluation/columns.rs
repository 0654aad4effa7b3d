//! The columns a table can have: every metric with its unit and the direction that is better.

use serde::{Deserialize, Serialize};

/// Which way is up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Better {
    Lower,
    Higher,
}

impl Better {
    /// 1 or -1: what values are multiplied by so that lower is better.
    #[must_use]
    pub fn sign(self) -> f64 {
        match self {
            Self::Lower => 1.0,
            Self::Higher => -1.0,
        }
    }
}

/// A metric as a column of scores and tables.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Column {
    /// `modality.metric`, and `@space` where the alignment is part of the metric: `depth.abs_rel@depth`.
    pub name: String,
    /// Empty for numbers without a unit.
    pub unit: String,
    pub better: Better,
}

/// Name, unit, direction, what it is.
type Entry = (&'static str, &'static str, Better, &'static str);

use Better::{Higher, Lower};

/// One number per clip.
pub const PER_CLIP: &[Entry] = &[
    (
        "body.mpjpe",
        "mm",
        Lower,
        "mean joint distance, no alignment",
    ),
    ("body.ra_mpjpe", "mm", Lower, "pelvis subtracted per frame"),
    ("body.ga_mpjpe", "mm", Lower, "one similarity per clip"),
    ("body.pa_mpjpe", "mm", Lower, "one similarity per frame"),
    (
        "body.kin_cos",
        "",
        Higher,
        "cosine of kinematic descriptors (no weights)",
    ),
    (
        "hands.mpjpe",
        "mm",
        Lower,
        "mean of the hands that have a value, no alignment",
    ),
    ("hands.ra_mpjpe", "mm", Lower, "wrist subtracted per frame"),
    (
        "hands.ga_mpjpe",
        "mm",
        Lower,
        "one similarity per clip and hand",
    ),
    ("hands.pa_mpjpe", "mm", Lower, "one similarity per frame"),
    (
        "hands.ra_mpjpe@compat",
        "mm",
        Lower,
        "a hand without a visible frame counts 0.0, as in the published table",
    ),
    (
        "hands.ga_mpjpe@compat",
        "mm",
        Lower,
        "a hand without a visible frame counts 0.0, as in the published table",
    ),
    (
        "hands.pa_mpjpe@compat",
        "mm",
        Lower,
        "a hand without a visible frame counts 0.0, as in the published table",
    ),
    (
        "left_hand.ra_mpjpe",
        "mm",
        Lower,
        "wrist subtracted per frame",
    ),
    ("left_hand.ga_mpjpe", "mm", Lower, "one similarity per clip"),
    (
        "left_hand.pa_mpjpe",
        "mm",
        Lower,
        "one similarity per frame",
    ),
    (
        "right_hand.ra_mpjpe",
        "mm",
        Lower,
        "wrist subtracted per frame",
    ),
    (
        "right_hand.ga_mpjpe",
        "mm",
        Lower,
        "one similarity per clip",
    ),
    (
        "right_hand.pa_mpjpe",
        "mm",
        Lower,
        "one similarity per frame",
    ),
    (
        "camera.ate",
        "m",
        Lower,
        "RMSE of positions after one similarity per clip",
    ),
    (
        "camera.ate_mean",
        "m",
        Lower,
        "mean position error after one similarity per clip",
    ),
    (
        "camera.rte",
        "m",
        Lower,
        "RMSE of the translation between consecutive samples",
    ),
    (
        "camera.rte_mean",
        "m",
        Lower,
        "mean translation error between consecutive samples",
    ),
    (
        "camera.rre",
        "deg",
        Lower,
        "RMSE of the rotation between consecutive samples",
    ),
    (
        "camera.rre_mean",
        "deg",
        Lower,
        "mean rotation error between consecutive samples",
    ),
    (
        "camera.position",
        "m",
        Lower,
        "mean position error without any alignment, first poses laid on each other",
    ),
    (
        "camera.rotation",
        "deg",
        Lower,
        "mean rotation error without any alignment, first poses laid on each other",
    ),
    (
        "gaze.mse",
        "",
        Lower,
        "mean squared error in image widths, both coordinates",
    ),
    ("gaze.l2", "", Lower, "mean distance in image widths"),
    (
        "depth.abs_rel@depth",
        "",
        Lower,
        "scale and shift fitted to depth",
    ),
    (
        "depth.abs_rel@disparity",
        "",
        Lower,
        "scale and shift fitted to inverse depth",
    ),
    ("depth.abs_rel@median", "", Lower, "scaled by the median"),
    (
        "depth.abs_rel@none",
        "",
        Lower,
        "as predicted, for metric models",
    ),
    (
        "depth.delta@depth",
        "%",
        Higher,
        "pixels within a factor 1.25, fitted to depth",
    ),
    (
        "depth.delta@disparity",
        "%",
        Higher,
        "pixels within a factor 1.25, fitted to inverse depth",
    ),
    (
        "depth.delta@median",
        "%",
        Higher,
        "pixels within a factor 1.25, scaled by the median",
    ),
    (
        "depth.delta@none",
        "%",
        Higher,
        "pixels within a factor 1.25, as predicted",
    ),
    (
        "rgb.psnr",
        "dB",
        Higher,
        "peak signal-to-noise ratio of the colour video",
    ),
];

/// One number per set of clips: comparable only at equal n.
pub const PER_SET: &[Entry] = &[
    (
        "body.kin_fid",
        "",
        Lower,
        "Fréchet distance of kinematic descriptors (no weights); not FID",
    ),
    (
        "body.tmr_fid",
        "",
        Lower,
        "Fréchet distance of TMR embeddings, rows of unit length",
    ),
    (
        "body.tmr_fid_raw",
        "",
        Lower,
        "Fréchet distance of TMR embeddings",
    ),
    (
        "body.tmr_similarity",
        "",
        Higher,
        "mean cosine of TMR embeddings",
    ),
];

impl Column {
    /// The column called `name`. A declared modality has the columns `<modality>.<metric>` of [`DECLARED`].
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let entry = PER_CLIP.iter().chain(PER_SET).find(|entry| entry.0 == name);
        match entry {
            Some(&(name, unit, better, _)) => Some(Self {
                name: name.to_owned(),
                unit: unit.to_owned(),
                better,
            }),
            None if declared(name).is_some() => Some(Self {
                name: name.to_owned(),
                unit: String::new(),
                better: Lower,
            }),
            None => None,
        }
    }

    /// The part before the dot.
    #[must_use]
    pub fn modality(&self) -> &str {
        self.name.split('.').next().unwrap_or_default()
    }

    #[must_use]
    pub fn is_per_set(&self) -> bool {
        PER_SET.iter().any(|entry| entry.0 == self.name)
    }

    /// Whether `pattern` names this column: exactly, or without its `@space`.
    #[must_use]
    pub fn answers_to(&self, pattern: &str) -> bool {
        self.name == pattern || self.name.split('@').next() == Some(pattern)
    }
}

/// Metrics of modalities declared in YAML: root mean square error over the valid values, in their own units.
pub const DECLARED: [&str; 1] = ["rmse"];

/// The modality of a column `<modality>.rmse` that is none of the built-in ones.
pub(crate) fn declared(name: &str) -> Option<&str> {
    let built_in = [
        "rgb",
        "depth",
        "camera",
        "gaze",
        "left_hand",
        "right_hand",
        "hands",
        "body",
    ];
    let (modality, metric) = name.split_once('.')?;
    (DECLARED.contains(&metric) && !modality.is_empty() && !built_in.contains(&modality))
        .then_some(modality)
}

/// Every column name, for messages and lists.
#[must_use]
pub fn names() -> Vec<&'static str> {
    PER_CLIP
        .iter()
        .chain(PER_SET)
        .map(|entry| entry.0)
        .collect()
}
