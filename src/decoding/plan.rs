//! From settings to steps: what is decided when, from which inputs, and what the pass without conditions does not see.

use super::model::{DecodingError, TokenModality};
use super::settings::{DecodingSettings, Order, Scheme, TargetSettings};

/// Chains are independent of each other: each starts from the inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    /// One after the other; what a group decides is input to the next.
    pub groups: Vec<Group>,
}

/// Targets that are decided together, step by step.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// What is generated together.
    pub targets: Vec<Target>,
    /// By modality: not seen by the pass without conditions.
    pub hidden: Vec<bool>,
    /// Tokens decided by each step from the pool of all targets; `None`: every target has its own counts.
    pub pooled: Option<Vec<usize>>,
}

/// One target and its steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// Index of the modality.
    pub modality: usize,
    /// How its tokens are decided.
    pub settings: TargetSettings,
    /// Tokens decided by each step.
    pub counts: Vec<usize>,
    /// Temperature of each step.
    pub temperatures: Vec<f64>,
}

impl Group {
    /// Steps of the longest target.
    #[must_use]
    pub fn steps(&self) -> usize {
        if let Some(pooled) = &self.pooled {
            return pooled.len();
        }
        self.targets
            .iter()
            .map(|t| t.counts.len())
            .max()
            .unwrap_or(0)
    }
}

/// The plan for the targets `names`; `is_input[m]` says which modalities have input tokens, `masked_tokens[m]` how many are still masked.
///
/// # Errors
/// When a name is unknown or a target is raw video.
pub fn plan(
    settings: &DecodingSettings,
    modalities: &[TokenModality],
    is_input: &[bool],
    masked_tokens: &[usize],
    names: &[&str],
) -> Result<Vec<Chain>, DecodingError> {
    let index = |name: &str| {
        modalities
            .iter()
            .position(|m| m.name == name)
            .ok_or_else(|| DecodingError::UnknownModality {
                name: name.to_owned(),
                known: modalities.iter().map(|m| m.name.clone()).collect(),
            })
    };
    let mut targets = Vec::new();
    for name in names {
        let modality = index(name)?;
        if modalities[modality].vocabulary.is_none() {
            return Err(DecodingError::NotPredicted {
                name: (*name).to_owned(),
            });
        }
        if !targets.contains(&modality) {
            targets.push(modality);
        }
    }
    let hidden: Vec<bool> = match &settings.uncond_drop {
        None => (0..modalities.len())
            .map(|m| is_input[m] && !targets.contains(&m))
            .collect(),
        // A name the model does not have hides nothing: presets name the inputs of every model.
        Some(names) => modalities.iter().map(|m| names.contains(&m.name)).collect(),
    };
    let target = |modality: usize| {
        let settings = settings.target(&modalities[modality].name);
        let counts = settings.schedule_counts(masked_tokens[modality]);
        Target {
            modality,
            temperatures: settings
                .temperature_schedule
                .values(settings.temperature, &counts),
            counts,
            settings,
        }
    };
    let chain = |members: &[usize]| {
        let mut hidden = hidden.clone();
        let groups = members
            .iter()
            .map(|&modality| {
                let group = Group {
                    targets: vec![target(modality)],
                    hidden: hidden.clone(),
                    pooled: None,
                };
                hidden[modality] |= settings.grow;
                group
            })
            .collect();
        Chain { groups }
    };
    Ok(match settings.order {
        Order::Chained => vec![chain(&targets)],
        Order::Joint => vec![Chain {
            groups: vec![Group {
                targets: targets.iter().map(|&m| target(m)).collect(),
                hidden,
                pooled: None,
            }],
        }],
        Order::Pooled => {
            let masked = targets.iter().map(|&m| masked_tokens[m]).sum();
            let counts = super::schedule::linear(settings.all.steps, masked);
            let in_pool = |&m: &usize| {
                let mut target = target(m);
                // The steps are the pool's; a target may have no token in one of them.
                target.settings.scheme = Scheme::Roar;
                let own = &target.settings;
                target.temperatures = own.temperature_schedule.values(own.temperature, &counts);
                target.counts = vec![0; counts.len()];
                target
            };
            vec![Chain {
                groups: vec![Group {
                    targets: targets.iter().map(in_pool).collect(),
                    hidden,
                    pooled: Some(counts.clone()),
                }],
            }]
        }
        Order::Independent => {
            let mut chains: Vec<Chain> = Vec::new();
            let mut done = vec![false; modalities.len()];
            for &modality in &targets {
                if done[modality] {
                    continue;
                }
                let name = &modalities[modality].name;
                let members: Vec<usize> =
                    match settings.chains.iter().find(|list| list.contains(name)) {
                        None => vec![modality],
                        Some(list) => list
                            .iter()
                            .filter_map(|name| {
                                targets
                                    .iter()
                                    .copied()
                                    .find(|&m| &modalities[m].name == name)
                            })
                            .filter(|&m| !done[m])
                            .collect(),
                    };
                for &m in &members {
                    done[m] = true;
                }
                chains.push(chain(&members));
            }
            chains
        }
    })
}

impl TargetSettings {
    fn schedule_counts(&self, tokens: usize) -> Vec<usize> {
        // Random positions are spread evenly: there is nothing to be careful about first.
        match self.scheme {
            Scheme::Roar => super::schedule::linear(self.steps, tokens),
            Scheme::Maskgit => self.schedule.counts(self.steps, tokens),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn modalities() -> Vec<TokenModality> {
        ["rgb", "camera", "right_hand", "left_hand"]
            .iter()
            .map(|name| TokenModality {
                name: (*name).to_owned(),
                tokens: 30,
                vocabulary: Some(64),
            })
            .collect()
    }

    #[test]
    fn chains_keep_their_order_and_hide_what_is_finished() {
        let settings = DecodingSettings {
            chains: vec![vec!["right_hand".into(), "left_hand".into()]],
            ..DecodingSettings::default()
        };
        let is_input = [true, false, false, false];
        let chains = plan(
            &settings,
            &modalities(),
            &is_input,
            &[30; 4],
            &["left_hand", "camera", "right_hand"],
        )
        .unwrap();
        let members: Vec<Vec<usize>> = chains
            .iter()
            .map(|c| c.groups.iter().map(|g| g.targets[0].modality).collect())
            .collect();
        assert_eq!(members, [vec![2, 3], vec![1]]);
        assert_eq!(chains[0].groups[0].hidden, [true, false, false, false]);
        assert_eq!(chains[0].groups[1].hidden, [true, false, true, false]);
        assert_eq!(chains[1].groups[0].hidden, [true, false, false, false]);
    }

    #[test]
    fn unknown_names_and_raw_video_are_refused() {
        let mut all = modalities();
        all[0].vocabulary = None;
        let ask = |names: &[&str]| {
            plan(
                &DecodingSettings::default(),
                &all,
                &[false; 4],
                &[30; 4],
                names,
            )
        };
        assert!(matches!(
            ask(&["gaze"]),
            Err(DecodingError::UnknownModality { .. })
        ));
        assert!(matches!(
            ask(&["rgb"]),
            Err(DecodingError::NotPredicted { .. })
        ));
        assert_eq!(ask(&["camera", "camera"]).unwrap().len(), 1);
    }
}
