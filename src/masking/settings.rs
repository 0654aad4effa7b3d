//! What a masking policy is told: the contents of `registry/masking/*.yaml`.

use super::{PIXELS, Slot};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How visible and target tokens of a sample are drawn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MaskingSettings {
    /// `dirichlet` draws how the budget is shared among modalities; `uniform` draws positions from all tokens pooled.
    pub policy: Policy,
    /// Concentration of the Dirichlet distribution; a list is a mixture, one component per sample for both sides.
    pub alpha: Alphas,
    /// How often each component of the mixture is drawn; empty means equally often.
    pub weights: Vec<f64>,
    /// Concentrations of single modalities on the input side (scalar, or one per component); 0 means never.
    pub input_alpha: BTreeMap<String, Alphas>,
    /// Concentrations of single modalities on the target side; 0 means never.
    pub target_alpha: BTreeMap<String, Alphas>,
    /// The only modalities that are inputs; empty means all. `pixels` is raw video.
    pub inputs: Vec<String>,
    /// The only modalities that are targets; empty means all. Raw video is never a target.
    pub targets: Vec<String>,
    /// Visible tokens of a sample: a number, or `{min, max}`.
    pub input_tokens: TokenBudget,
    /// Target tokens of a sample: a number, or `{min, max}`.
    pub target_tokens: TokenBudget,
    /// What becomes of the part of a budget that exceeds a modality's tokens.
    pub overflow: Overflow,
    /// Use the input's proportions for the targets too (the letter of the paper's Alg. 1) instead of an independent draw.
    pub shared_proportions: bool,
    /// Let one modality take the whole budget. Off, shares stay just below one, where the reference's sampler clamps them: a
    /// draw that favours one modality alone then leaves one token over, which goes to the winner of a fresh draw.
    pub whole_budget: bool,
}

impl Default for MaskingSettings {
    fn default() -> Self {
        Self {
            policy: Policy::Dirichlet,
            alpha: Alphas::Mixture(vec![0.01, 0.1, 1.0, 10.0]),
            weights: Vec::new(),
            input_alpha: BTreeMap::new(),
            target_alpha: BTreeMap::new(),
            inputs: Vec::new(),
            targets: Vec::new(),
            input_tokens: TokenBudget::Fixed(2048),
            target_tokens: TokenBudget::Fixed(2048),
            overflow: Overflow::Drop,
            shared_proportions: false,
            whole_budget: false,
        }
    }
}

/// The family of a masking policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Policy {
    /// Proportions from a Dirichlet distribution (Alg. 1).
    Dirichlet,
    /// Positions uniformly from the pooled tokens of all modalities (the ablation `ReViV-Uniform`).
    Uniform,
}

/// What happens to budget that a modality cannot use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Overflow {
    /// It is lost, as in the reference: about half of the nominal tokens.
    Drop,
    /// It is drawn again among the modalities that have room.
    Redistribute,
}

/// One concentration, or one per mixture component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Alphas {
    /// The same in every component.
    One(f64),
    /// One per component.
    Mixture(Vec<f64>),
}

impl Alphas {
    fn values(&self) -> &[f64] {
        match self {
            Self::One(alpha) => std::slice::from_ref(alpha),
            Self::Mixture(alphas) => alphas,
        }
    }

    /// The value in `component` of `components`.
    fn spread(&self, components: usize) -> Option<Vec<f64>> {
        match self.values() {
            [alpha] => Some(vec![*alpha; components]),
            alphas if alphas.len() == components => Some(alphas.to_vec()),
            _ => None,
        }
    }
}

/// How many tokens one side of a sample gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum TokenBudget {
    /// Always this many.
    Fixed(usize),
    /// Uniformly from `min` to `max`, both included.
    Range {
        /// At least.
        min: usize,
        /// At most.
        max: usize,
    },
}

impl TokenBudget {
    /// The smallest and the largest budget.
    #[must_use]
    pub fn bounds(self) -> (usize, usize) {
        match self {
            Self::Fixed(tokens) => (tokens, tokens),
            Self::Range { min, max } => (min, max),
        }
    }
}

/// Why masking settings do not work with a set of modalities.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MaskingError {
    /// A budget, or the lower end of its range, is zero.
    #[error("`{setting}` is {tokens}: a sample needs at least one token on each side")]
    ZeroBudget {
        /// `input_tokens` or `target_tokens`.
        setting: &'static str,
        /// The budget, or the lower end of its range.
        tokens: usize,
    },
    /// The lower end of a budget is above its upper end.
    #[error("`{setting}`: min {min} is above max {max}")]
    Range {
        /// `input_tokens` or `target_tokens`.
        setting: &'static str,
        /// The lower end.
        min: usize,
        /// The upper end.
        max: usize,
    },
    /// A concentration or a weight is negative, infinite or NaN.
    #[error(
        "`{setting}` holds {value}: a concentration or weight is a finite number, not negative"
    )]
    Value {
        /// `alpha`, `weights`, or a modality's own: `input_alpha.body`.
        setting: String,
        /// The first such value.
        value: f64,
    },
    /// `alpha` is an empty list.
    #[error("`alpha` has no component")]
    NoComponent,
    /// The sum of `weights` is zero.
    #[error("`weights` are all zero: no component can be drawn")]
    NoWeight,
    /// A list has not one value per component of `alpha`.
    #[error("`{setting}` has {found} values for {expected} mixture components")]
    Components {
        /// `weights`, or a modality's own: `target_alpha.body`.
        setting: String,
        /// Values in the list.
        found: usize,
        /// Components of `alpha`.
        expected: usize,
    },
    /// A setting names a modality that the model does not have.
    #[error("`{setting}` names `{name}`, which does not take part; taking part: {}", .known.join(", "))]
    UnknownModality {
        /// `inputs`, `targets`, `input_alpha` or `target_alpha`.
        setting: &'static str,
        /// The name, as written.
        name: String,
        /// Names of the modalities that take part.
        known: Vec<String>,
    },
    /// On one side, no modality has a concentration above 0 in any component.
    #[error("no modality can be {side}: every one is excluded or has concentration 0")]
    NothingLeft {
        /// Which side, in words: `an input` or `a target`.
        side: &'static str,
    },
    /// A modality of the model is empty.
    #[error("modality `{name}` has no tokens")]
    NoTokens {
        /// Name of the modality.
        name: String,
    },
}

/// Settings resolved against the modalities of a model: per component and slot the concentration, 0 meaning never.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Resolved {
    /// Cumulative shares of the components, the last is 1.
    pub(super) cumulative: Vec<f64>,
    /// `[components][slots]`.
    pub(super) input: Vec<Vec<f64>>,
    /// `[components][slots]`.
    pub(super) target: Vec<Vec<f64>>,
}

impl MaskingSettings {
    /// Checks the settings against the modalities they are for.
    ///
    /// # Errors
    /// The first thing that cannot work; see [`MaskingError`].
    pub fn check(&self, slots: &[Slot]) -> Result<(), MaskingError> {
        self.resolve(slots).map(drop)
    }

    pub(super) fn resolve(&self, slots: &[Slot]) -> Result<Resolved, MaskingError> {
        budget("input_tokens", self.input_tokens)?;
        budget("target_tokens", self.target_tokens)?;
        if let Some(slot) = slots.iter().find(|slot| slot.tokens == 0) {
            return Err(MaskingError::NoTokens {
                name: slot.name.clone(),
            });
        }
        let components = self.alpha.values().len();
        if components == 0 {
            return Err(MaskingError::NoComponent);
        }
        let base = finite("alpha", self.alpha.values())?;
        let cumulative = self.cumulative(components)?;
        known("inputs", &self.inputs, slots)?;
        known("targets", &self.targets, slots)?;
        known_keys("input_alpha", &self.input_alpha, slots)?;
        known_keys("target_alpha", &self.target_alpha, slots)?;

        let side = |setting: &'static str,
                    own: &BTreeMap<String, Alphas>,
                    only: &[String],
                    allowed: fn(&Slot) -> bool|
         -> Result<Vec<Vec<f64>>, MaskingError> {
            let mut table = vec![vec![0.0; slots.len()]; components];
            for (index, slot) in slots.iter().enumerate() {
                let takes_part = allowed(slot) && (only.is_empty() || only.contains(&slot.name));
                if !takes_part {
                    continue;
                }
                let alphas = match own.get(&slot.name) {
                    None => base.clone(),
                    Some(alphas) => {
                        let name = format!("{setting}.{}", slot.name);
                        finite(&name, alphas.values())?;
                        alphas
                            .spread(components)
                            .ok_or_else(|| MaskingError::Components {
                                setting: name,
                                found: alphas.values().len(),
                                expected: components,
                            })?
                    }
                };
                for (row, alpha) in table.iter_mut().zip(alphas) {
                    row[index] = alpha;
                }
            }
            Ok(table)
        };
        let input = side("input_alpha", &self.input_alpha, &self.inputs, |slot| {
            slot.input
        })?;
        let target = side("target_alpha", &self.target_alpha, &self.targets, |slot| {
            slot.target
        })?;
        for (table, side) in [(&input, "an input"), (&target, "a target")] {
            if table.iter().flatten().all(|alpha| *alpha == 0.0) {
                return Err(MaskingError::NothingLeft { side });
            }
        }
        Ok(Resolved {
            cumulative,
            input,
            target,
        })
    }

    fn cumulative(&self, components: usize) -> Result<Vec<f64>, MaskingError> {
        let equal = vec![1.0; components];
        let weights = if self.weights.is_empty() {
            &equal
        } else {
            &self.weights
        };
        if weights.len() != components {
            return Err(MaskingError::Components {
                setting: "weights".into(),
                found: weights.len(),
                expected: components,
            });
        }
        finite("weights", weights)?;
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            return Err(MaskingError::NoWeight);
        }
        let mut sum = 0.0;
        Ok(weights
            .iter()
            .map(|weight| {
                sum += weight;
                sum / total
            })
            .collect())
    }
}

fn budget(setting: &'static str, tokens: TokenBudget) -> Result<(), MaskingError> {
    let (min, max) = tokens.bounds();
    if min == 0 {
        return Err(MaskingError::ZeroBudget {
            setting,
            tokens: min,
        });
    }
    if min > max {
        return Err(MaskingError::Range { setting, min, max });
    }
    Ok(())
}

fn finite(setting: &str, values: &[f64]) -> Result<Vec<f64>, MaskingError> {
    match values
        .iter()
        .find(|value| !(value.is_finite() && **value >= 0.0))
    {
        Some(value) => Err(MaskingError::Value {
            setting: setting.to_owned(),
            value: *value,
        }),
        None => Ok(values.to_vec()),
    }
}

fn known(setting: &'static str, names: &[String], slots: &[Slot]) -> Result<(), MaskingError> {
    // Raw video may be switched off by one word elsewhere; naming it here must not break that.
    match names
        .iter()
        .find(|name| *name != PIXELS && slots.iter().all(|slot| slot.name != **name))
    {
        Some(name) => Err(MaskingError::UnknownModality {
            setting,
            name: name.clone(),
            known: slots.iter().map(|slot| slot.name.clone()).collect(),
        }),
        None => Ok(()),
    }
}

fn known_keys(
    setting: &'static str,
    own: &BTreeMap<String, Alphas>,
    slots: &[Slot],
) -> Result<(), MaskingError> {
    known(setting, &own.keys().cloned().collect::<Vec<_>>(), slots)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slots() -> Vec<Slot> {
        vec![
            Slot::both("body", 210),
            Slot::both("camera", 30),
            Slot::input_only(PIXELS, 4096),
        ]
    }

    #[test]
    fn settings_that_cannot_work_are_refused() {
        let refused = |change: fn(&mut MaskingSettings)| {
            let mut settings = MaskingSettings::default();
            change(&mut settings);
            settings.check(&slots()).unwrap_err().to_string()
        };
        assert!(
            refused(|s| s.input_tokens = TokenBudget::Fixed(0)).contains("`input_tokens` is 0")
        );
        assert!(
            refused(|s| s.target_tokens = TokenBudget::Range { min: 9, max: 3 })
                .contains("above max 3")
        );
        assert!(refused(|s| s.weights = vec![1.0]).contains("1 values for 4"));
        assert!(refused(|s| s.weights = vec![0.0; 4]).contains("all zero"));
        assert!(refused(|s| s.alpha = Alphas::One(f64::NAN)).contains("NaN"));
        assert!(refused(|s| s.alpha = Alphas::Mixture(vec![])).contains("no component"));
        assert!(refused(|s| s.targets = vec!["bodi".into()]).contains("body, camera"));
        assert!(
            refused(|s| s.targets = vec![PIXELS.into()]).contains("no modality can be a target")
        );
        assert!(refused(|s| s.alpha = Alphas::One(0.0)).contains("no modality can be an input"));
    }

    #[test]
    fn yaml_forms_of_one_setting_mean_the_same() {
        let read =
            |text: &str| -> MaskingSettings { serde_json::from_str(text).expect("valid settings") };
        assert_eq!(
            read(r#"{"alpha": 0.001}"#).alpha,
            Alphas::One(0.001),
            "a number"
        );
        assert_eq!(
            read(r#"{"input_tokens": {"min": 64, "max": 128}}"#)
                .input_tokens
                .bounds(),
            (64, 128)
        );
        assert!(serde_json::from_str::<MaskingSettings>(r#"{"alfa": 1}"#).is_err());
    }
}
