//! Cross-entropy over target tokens (Eq. 3).

use super::batch::Targets;
use super::embedding::Heads;
use super::spec::MgetSpec;
use crate::engine::ops::tied_cross_entropy;
use crate::engine::{Reading, Tensor};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the losses of modalities become one number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// The mean over modalities of each one's mean over its tokens in the batch; a modality without tokens counts as 0.
    /// The release's default.
    #[default]
    Mod,
    /// The mean over all tokens (the paper's equation, normalised).
    Token,
    /// As `mod`, each modality multiplied by ln 256 / ln(vocabulary).
    WeightedMod,
    /// As the release computes its option `token`: modalities weighted by tokens times vocabulary.
    ReleaseToken,
}

/// The losses of one batch.
#[derive(Debug, Clone)]
pub struct Losses {
    /// What training minimises, `[1]`; `None` when there is no target.
    pub total: Option<Tensor<1>>,
    /// Per modality of the spec.
    pub modalities: Vec<Option<ModalityLoss>>,
}

/// The loss of one modality.
#[derive(Debug, Clone)]
pub struct ModalityLoss {
    /// Mean cross-entropy in nats, `[1]`.
    pub mean: Tensor<1>,
    /// Over how many tokens.
    pub tokens: usize,
}

/// Numbers read back from [`Losses`].
#[derive(Debug, Clone, PartialEq)]
pub struct LossValues {
    /// What training minimises; 0 when there is no target.
    pub total: f64,
    /// Per modality of the spec: mean cross-entropy in nats and its number of tokens.
    pub modalities: Vec<Option<(f64, usize)>>,
}

impl Losses {
    /// The total, where there is one, and the means of the modalities that have one, where they are.
    #[must_use]
    pub fn reading(&self) -> Reading {
        let means = self.modalities.iter().flatten().map(|loss| &loss.mean);
        Reading::of(self.total.iter().chain(means).cloned())
    }

    /// The same losses, without the graph that they came from.
    #[must_use]
    pub(super) fn untracked(&self) -> Self {
        let of = |loss: &ModalityLoss| ModalityLoss {
            mean: loss.mean.clone().without_autodiff(),
            tokens: loss.tokens,
        };
        Self {
            total: self.total.clone().map(Tensor::without_autodiff),
            modalities: (self.modalities.iter())
                .map(|loss| loss.as_ref().map(of))
                .collect(),
        }
    }

    /// Whether there is a total that is known, and is no number to step by.
    #[must_use]
    pub(crate) fn is_known_bad(&self) -> bool {
        let total = Reading::of(self.total.clone());
        total
            .known()
            .is_some_and(|known| known.iter().any(|total| !total.is_finite()))
    }

    /// Reads the numbers back, at once.
    #[must_use]
    pub fn values(&self) -> LossValues {
        let mut read = self.reading().read().into_iter();
        let mut next = || read.next().unwrap_or(f64::NAN);
        LossValues {
            total: self.total.as_ref().map_or(0.0, |_| next()),
            modalities: self
                .modalities
                .iter()
                .map(|loss| loss.as_ref().map(|loss| (next(), loss.tokens)))
                .collect(),
        }
    }
}

pub(super) fn losses(
    spec: &MgetSpec,
    heads: &Heads,
    y_MD: Option<Tensor<2>>,
    targets: &Targets,
    kind: Loss,
) -> Losses {
    let mut modalities: Vec<Option<ModalityLoss>> = vec![None; spec.modalities.len()];
    let Some(y_MD) = y_MD else {
        return Losses {
            total: None,
            modalities,
        };
    };
    for (index, ids) in targets.ids.iter().enumerate() {
        let Some(table_VD) = heads.table(index).filter(|_| !ids.is_empty()) else {
            continue;
        };
        let y_mD = Heads::rows(&y_MD, &targets.sequence.rows[index]);
        let nats_m = tied_cross_entropy(heads.precision(), y_mD, table_VD, ids);
        modalities[index] = Some(ModalityLoss {
            mean: nats_m.mean(),
            tokens: ids.len(),
        });
    }
    let weights = weights(spec, targets, kind);
    let total = modalities
        .iter()
        .zip(weights)
        .filter_map(|(loss, weight)| Some(loss.as_ref()?.mean.clone() * weight))
        .reduce(|sum, part| sum + part);
    Losses { total, modalities }
}

/// What each modality's mean is multiplied by.
fn weights(spec: &MgetSpec, targets: &Targets, kind: Loss) -> Vec<f64> {
    let predicted = spec.predicted().max(1) as f64;
    let vocabulary = |index: usize| spec.modalities[index].vocabulary().unwrap_or(1) as f64;
    let raw: Vec<f64> = targets
        .ids
        .iter()
        .enumerate()
        .map(|(index, ids)| match kind {
            Loss::Mod => 1.0 / predicted,
            Loss::WeightedMod => 256_f64.ln() / vocabulary(index).max(2.0).ln() / predicted,
            Loss::Token => ids.len() as f64,
            Loss::ReleaseToken => ids.len() as f64 * vocabulary(index),
        })
        .collect();
    match kind {
        Loss::Mod | Loss::WeightedMod => raw,
        Loss::Token | Loss::ReleaseToken => {
            let sum: f64 = raw.iter().sum();
            raw.iter().map(|weight| weight / sum.max(1.0)).collect()
        }
    }
}
