//! Decoding as registry entries write it: `paper`, `release`, `fast`, or anyone's own.

use super::filter::{Filter, Sampling, TopK};
use super::schedule::{TemperatureSchedule, TokenSchedule};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Which positions a step decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Scheme {
    /// Random open positions; only they are decoded.
    Roar,
    /// All open positions are decoded, and the ones it is surest of stay.
    Maskgit,
}

/// How several targets depend on each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Every target sees only the inputs (and, within a chain of `chains`, the targets before it).
    Independent,
    /// One after the other; finished targets are inputs of the next.
    Chained,
    /// All targets in every step, each by its own schedule.
    Joint,
    /// All targets in every step, from one pool: of the n masked tokens of all targets, every step decides n / `steps` random
    /// ones, whichever modality they are of (Supp. C). `steps` is that of `all`; the scheme is `roar`.
    Pooled,
}

/// How tokens of one target are decided.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetSettings {
    /// Which positions a step decides.
    pub scheme: Scheme,
    /// Decoding steps; fewer are taken where there are fewer tokens.
    #[schemars(range(min = 1))]
    pub steps: usize,
    /// How many tokens each step decides.
    pub schedule: TokenSchedule,
    /// 0 takes the most likely token.
    #[schemars(range(min = 0.0))]
    pub temperature: f64,
    /// How the temperature changes over the steps.
    pub temperature_schedule: TemperatureSchedule,
    /// Classifier-free guidance: logits are `without + scale * (with - without)`. 1 is off and costs half.
    pub guidance: f64,
    /// Mass of the nucleus; 0 is off.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub top_p: f64,
    /// How many of the most likely tokens stay.
    pub top_k: TopK,
    /// How one of the tokens that stay is taken.
    pub sampling: Sampling,
}

impl Default for TargetSettings {
    fn default() -> Self {
        Self {
            scheme: Scheme::Roar,
            steps: 3,
            schedule: TokenSchedule::Linear,
            temperature: 0.01,
            temperature_schedule: TemperatureSchedule::Constant,
            guidance: 2.0,
            top_p: 0.8,
            top_k: TopK::Off,
            sampling: Sampling::Random,
        }
    }
}

impl TargetSettings {
    pub(crate) fn filter(&self, temperature: f64) -> Filter {
        Filter {
            top_k: self.top_k,
            top_p: self.top_p,
            temperature,
            sampling: self.sampling,
        }
    }
}

/// Changes to the settings for one target; what is not named stays.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetChanges {
    /// Which positions a step decides.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheme: Option<Scheme>,
    /// Decoding steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub steps: Option<usize>,
    /// How many tokens each step decides.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub schedule: Option<TokenSchedule>,
    /// 0 takes the most likely token.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.0))]
    pub temperature: Option<f64>,
    /// How the temperature changes over the steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature_schedule: Option<TemperatureSchedule>,
    /// Scale of the classifier-free guidance; 1 is off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub guidance: Option<f64>,
    /// Mass of the nucleus; 0 is off.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub top_p: Option<f64>,
    /// How many of the most likely tokens stay.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub top_k: Option<TopK>,
    /// How one of the tokens that stay is taken.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sampling: Option<Sampling>,
    /// How many of the samples are decoded for the mean; fewer for video, whose decoding takes longest.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub samples: Option<usize>,
}

/// How targets are generated from the inputs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DecodingSettings {
    /// How targets depend on each other.
    pub order: Order,
    /// With `order: independent`: targets that are chained nevertheless, each list in its order.
    pub chains: Vec<Vec<String>>,
    /// Modalities that the pass without conditions does not see; absent: all inputs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub uncond_drop: Option<Vec<String>>,
    /// The pass without conditions does not see finished targets of its chain either.
    pub grow: bool,
    /// How often every clip is generated; the answer is the mean of the decoded signals. One sample looks like a motion that
    /// happens; the mean of several has the smaller squared error and lies between motions.
    #[schemars(range(min = 1))]
    pub samples: usize,
    /// For every target.
    pub all: TargetSettings,
    /// Changes by target.
    pub targets: BTreeMap<String, TargetChanges>,
}

impl Default for DecodingSettings {
    fn default() -> Self {
        Self {
            order: Order::Independent,
            chains: Vec::new(),
            uncond_drop: None,
            grow: true,
            samples: 1,
            all: TargetSettings::default(),
            targets: BTreeMap::new(),
        }
    }
}

impl DecodingSettings {
    /// How many samples of one target are averaged.
    #[must_use]
    pub fn samples_of(&self, name: &str) -> usize {
        let own = self.targets.get(name).and_then(|changes| changes.samples);
        own.unwrap_or(self.samples).min(self.samples).max(1)
    }

    /// The settings of one target.
    #[must_use]
    pub fn target(&self, name: &str) -> TargetSettings {
        let all = self.all.clone();
        let Some(changes) = self.targets.get(name) else {
            return all;
        };
        TargetSettings {
            scheme: changes.scheme.unwrap_or(all.scheme),
            steps: changes.steps.unwrap_or(all.steps),
            schedule: changes.schedule.unwrap_or(all.schedule),
            temperature: changes.temperature.unwrap_or(all.temperature),
            temperature_schedule: changes
                .temperature_schedule
                .unwrap_or(all.temperature_schedule),
            guidance: changes.guidance.unwrap_or(all.guidance),
            top_p: changes.top_p.unwrap_or(all.top_p),
            top_k: changes.top_k.unwrap_or(all.top_k),
            sampling: changes.sampling.unwrap_or(all.sampling),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bounds of a property in a schema.
    fn bounds(schema: &serde_json::Value, name: &str) -> [Option<f64>; 3] {
        let property = &schema["properties"][name];
        ["minimum", "maximum", "exclusiveMinimum"].map(|bound| property[bound].as_f64())
    }

    #[test]
    fn changes_for_one_target_have_the_bounds_of_the_settings_for_all() {
        let all = serde_json::to_value(schemars::schema_for!(TargetSettings)).unwrap();
        let changes = serde_json::to_value(schemars::schema_for!(TargetChanges)).unwrap();
        for name in ["steps", "temperature", "top_p"] {
            let own = bounds(&changes, name);
            assert!(own[0].is_some(), "{name}");
            assert_eq!(own, bounds(&all, name), "{name}");
        }
    }

    #[test]
    fn a_power_that_gives_no_temperature_is_out_of_bounds() {
        let schedule = serde_json::to_value(schemars::schema_for!(TemperatureSchedule)).unwrap();
        let variants = schedule["oneOf"].as_array().unwrap();
        let onex = variants.iter().find_map(|variant| {
            let onex = &variant["properties"]["onex"];
            onex.is_object().then_some(onex)
        });
        assert_eq!(bounds(onex.unwrap(), "power"), [None, None, Some(0.0)]);
        let onex = TemperatureSchedule::Onex {
            min: 0.1,
            power: 0.0,
        };
        let values = onex.values(1.0, &[1, 1]);
        assert!(values.iter().any(|v| v.is_nan()), "{values:?}");
    }
}
