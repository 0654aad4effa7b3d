//! Which entry of a Video Depth Anything file is what: Small, Base or Large, relative or metric.
//!
//! Relative and metric files have the same entries, so the user says which it is; a file's name and hash only warn.

use super::Checkpoint;
use super::rules::{Plan, Rule};
use crate::engine::{Compute, Initialise, Parameters};
use crate::labelling::{DepthLabelKind, DepthNetwork, NetworkSettings};
use std::collections::BTreeMap;
use std::path::Path;

/// Files whose SHA-256 is known, and what they are.
const KNOWN: [(&str, DepthLabelKind); 2] = [
    (
        "13379300b739e659f076a59d52e9801bd8d38c541a7e71f73bbca4dcfb013609",
        DepthLabelKind::Relative,
    ),
    (
        "43df27c6b396042ba34ff7b798ab279f64d204d2e86d7a373968f8fa36d0e6fa",
        DepthLabelKind::Relative,
    ),
];

/// Entries that are stored and never used.
const UNUSED: [&str; 2] = [
    "pretrained.mask_token",
    "head.scratch.refinenet4.resConfUnit1.",
];

/// Whether the names are those of a Depth Anything model.
pub fn matches(checkpoint: &Checkpoint) -> bool {
    checkpoint.find("pretrained.cls_token").is_some()
}

/// One rule per entry.
pub fn plan(checkpoint: &Checkpoint, kind: Option<DepthLabelKind>) -> Result<Plan, String> {
    let settings = settings(checkpoint)?;
    let Some(kind) = kind else {
        return Err(
            "relative and metric depth networks have the same entries; say which this is: `--depth relative` or `--depth metric`"
                .to_owned(),
        );
    };
    let compute = Compute::cpu();
    let network = DepthNetwork::new(&Initialise::meta(&compute), &settings);
    let expected: BTreeMap<String, Vec<usize>> = network
        .map_err(|error| error.to_string())?
        .inventory()
        .into_iter()
        .map(|(name, shape, _)| (name, shape))
        .collect();
    let mut rules = Vec::with_capacity(checkpoint.entries().len());
    for entry in checkpoint.entries() {
        let (name, shape) = (entry.name.as_str(), entry.shape());
        rules.push(match expected.get(name) {
            Some(expected) if *expected == shape => Rule::keep(name, shape),
            Some(expected) => {
                return Err(format!(
                    "`{name}` has shape {shape:?}, expected {expected:?}"
                ));
            }
            None if UNUSED.iter().any(|unused| name.starts_with(unused)) => Rule::NeverRuns,
            None => return Err(format!("`{name}` is no entry of Video Depth Anything")),
        });
    }
    Ok(Plan {
        part: "depth_network".to_owned(),
        family: "vda",
        rules,
        settings: serde_json::json!({ "kind": kind, "network": settings }),
        grid: None,
    })
}

/// The released size that the encoder's width and depth are those of.
fn settings(checkpoint: &Checkpoint) -> Result<NetworkSettings, String> {
    let shape = |name: &str| {
        checkpoint
            .find(name)
            .map(|index| checkpoint.entries()[index].shape())
            .ok_or_else(|| format!("`{name}` is missing"))
    };
    let width = shape("pretrained.cls_token")?.last().copied();
    let blocks = (0..64)
        .take_while(|k| {
            checkpoint
                .find(&format!("pretrained.blocks.{k}.norm1.weight"))
                .is_some()
        })
        .count();
    let temporal = "head.motion_modules.0.temporal_transformer.norm.weight";
    if checkpoint.find(temporal).is_none() {
        return Err(
            "a depth network without temporal modules (a model of single pictures); give a `video_depth_anything_*.pth`"
                .to_owned(),
        );
    }
    [
        NetworkSettings::small(),
        NetworkSettings::base(),
        NetworkSettings::large(),
    ]
    .into_iter()
    .find(|settings| Some(settings.width) == width && settings.blocks == blocks)
    .ok_or_else(|| {
        format!(
            "an encoder of width {} with {blocks} blocks is neither Small, Base nor Large",
            width.unwrap_or(0)
        )
    })
}

/// Why the kind that was given may be wrong, if something says so.
pub fn doubt(path: &Path, sha256: &str, kind: DepthLabelKind) -> Option<String> {
    let given = kind.name();
    if let Some((_, known)) = KNOWN.iter().find(|(hash, _)| *hash == sha256) {
        return (*known != kind).then(|| {
            format!(
                "{}: imported as {given} depth, but this is the released file of {} depth",
                path.display(),
                known.name()
            )
        });
    }
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    let named = match (
        name.starts_with("metric_"),
        name.starts_with("video_depth_anything_"),
    ) {
        (true, _) => DepthLabelKind::Metric,
        (_, true) => DepthLabelKind::Relative,
        _ => return None,
    };
    (named != kind).then(|| {
        format!(
            "{}: imported as {given} depth, but files of this name hold {} depth",
            path.display(),
            named.name()
        )
    })
}

/// What users of a size of the network must know of its licence.
pub fn licence(settings: &NetworkSettings) -> &'static str {
    if *settings == NetworkSettings::small() {
        "Small is released under Apache-2.0"
    } else {
        "Base and Large are released under CC BY-NC 4.0: not for commercial use, nor are labels made with them"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_or_a_known_hash_that_disagrees_with_the_kind_is_told() {
        let (relative, metric) = (DepthLabelKind::Relative, DepthLabelKind::Metric);
        let small = Path::new("x/video_depth_anything_vits.pth");
        let other = Path::new("metric_video_depth_anything_vitl.pth");
        assert!(doubt(small, "", metric).is_some());
        assert!(doubt(small, "", relative).is_none());
        assert!(doubt(other, "", relative).is_some());
        assert!(doubt(other, "", metric).is_none());
        assert!(doubt(Path::new("mine.pth"), "", metric).is_none());
        assert!(doubt(Path::new("mine.pth"), KNOWN[0].0, metric).is_some());
        assert!(doubt(other, KNOWN[0].0, relative).is_none());
    }
}
