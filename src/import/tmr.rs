//! Which entry of TMR's files is what: the motion encoder (alone or in a Lightning checkpoint), and the statistics of its
//! inputs.

use super::Checkpoint;
use super::rules::{Plan, Rule};
use crate::engine::{Compute, Initialise, Parameters};
use crate::evaluation::tmr::features::FEATURES;
use crate::evaluation::tmr::stored::{DEVIATION, MEAN};
use crate::evaluation::tmr::{MotionEncoder, MotionEncoderSettings};
use crate::formats::checkpoint::BARE;
use std::collections::BTreeMap;

/// What a Lightning checkpoint puts in front of the names.
const PREFIX: &str = "motion_encoder.";
const FIRST_LAYER: &str = "seqTransEncoder.layers.0.linear1.weight";
/// Attention heads of every released encoder; its file does not say.
const HEADS: usize = 4;

/// Whether the names are those of TMR.
pub fn matches(checkpoint: &Checkpoint) -> bool {
    checkpoint.find(FIRST_LAYER).is_some()
        || checkpoint.find(&format!("{PREFIX}{FIRST_LAYER}")).is_some()
        || is_statistics(checkpoint)
}

/// One tensor without a name: a mean or a deviation.
fn is_statistics(checkpoint: &Checkpoint) -> bool {
    matches!(checkpoint.entries(), [only] if only.name == BARE)
}

/// One rule per entry.
pub fn plan(checkpoint: &Checkpoint, heads: Option<usize>) -> Result<Plan, String> {
    let (rules, settings) = if is_statistics(checkpoint) {
        (vec![statistics(checkpoint)?], serde_json::Value::Null)
    } else {
        let (rules, settings) = encoder(checkpoint, heads)?;
        let settings = serde_json::to_value(settings).map_err(|error| error.to_string())?;
        (rules, settings)
    };
    Ok(Plan {
        part: "motion_encoder".to_owned(),
        family: "tmr",
        rules,
        settings,
        grid: None,
    })
}

fn statistics(checkpoint: &Checkpoint) -> Result<Rule, String> {
    let stem = checkpoint.path().file_stem();
    let name = match stem.and_then(|stem| stem.to_str()) {
        Some("mean") => MEAN,
        Some("std") => DEVIATION,
        _ => return Err("a tensor whose file is called neither `mean.pt` nor `std.pt`".to_owned()),
    };
    let shape = checkpoint.entries()[0].shape();
    if shape != [FEATURES] {
        return Err(format!(
            "statistics of shape {shape:?}; the encoder's inputs have {FEATURES} features"
        ));
    }
    Ok(Rule::keep(name, shape))
}

fn encoder(
    checkpoint: &Checkpoint,
    heads: Option<usize>,
) -> Result<(Vec<Rule>, MotionEncoderSettings), String> {
    let prefix = if checkpoint.find(FIRST_LAYER).is_some() {
        ""
    } else {
        PREFIX
    };
    let shape = |name: &str| -> Result<Vec<usize>, String> {
        let name = format!("{prefix}{name}");
        let index = checkpoint.find(&name);
        let index = index.ok_or_else(|| format!("`{name}` is missing"))?;
        let shape = checkpoint.entries()[index].shape();
        (shape.len() == 2)
            .then_some(shape.clone())
            .ok_or_else(|| format!("`{name}` has shape {shape:?}"))
    };
    let projection = shape("projection.weight")?;
    if projection[1] != FEATURES {
        return Err(format!(
            "an encoder of {} features per step; the motion encoder has {FEATURES} (is this the text encoder?)",
            projection[1]
        ));
    }
    let layers = (0..64)
        .take_while(|k| {
            let name = format!("{prefix}seqTransEncoder.layers.{k}.linear1.weight");
            checkpoint.find(&name).is_some()
        })
        .count();
    let settings = MotionEncoderSettings {
        width: projection[0],
        layers,
        heads: heads.unwrap_or(HEADS),
        hidden: shape("seqTransEncoder.layers.0.linear1.weight")?[0],
    };
    let compute = Compute::cpu();
    let expected: BTreeMap<String, Vec<usize>> =
        MotionEncoder::new(&Initialise::meta(&compute), &settings)?
            .inventory()
            .into_iter()
            .map(|(name, shape, _)| (name, shape))
            .collect();
    let mut rules = Vec::new();
    for entry in checkpoint.entries() {
        let Some(name) = entry.name.strip_prefix(prefix) else {
            rules.push(Rule::Unsupported {
                why: "not of the motion encoder",
            });
            continue;
        };
        let shape = entry.shape();
        match expected.get(name) {
            Some(expected) if *expected == shape => rules.push(Rule::keep(name, shape)),
            Some(expected) => {
                return Err(format!(
                    "`{name}` has shape {shape:?}, expected {expected:?}"
                ));
            }
            None => return Err(format!("`{name}` is no entry of TMR's motion encoder")),
        }
    }
    Ok((rules, settings))
}
