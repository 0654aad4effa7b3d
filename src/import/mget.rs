//! Which entry of a released transformer is what: ReViV (256 and 512 pathways, with and without captions) and EgoM2P.
//!
//! Sizes and vocabularies are read from the tensors; only the number of heads comes from the builder's name.

use super::rules::{Layout, Plan, Rule};
use super::{Checkpoint, Format};
use crate::mget::names::{from_release, modality_from_release};
use serde_json::{Value, json};

/// How the tokens of the release's modalities are laid out. Captions are known and left out.
const LAYOUTS: [(&str, Layout); 11] = [
    ("tok_body", Layout::Grid),
    ("tok_cam", Layout::Line),
    ("tok_depth", Layout::Volume),
    ("tok_depth_512", Layout::Volume),
    ("tok_gaze", Layout::Line),
    ("tok_lhand", Layout::Grid),
    ("rgb@256", Layout::Volume),
    ("rgb512", Layout::Volume),
    ("tok_rgb", Layout::Volume),
    ("tok_rgb_512", Layout::Volume),
    ("tok_rhand", Layout::Grid),
];
const CAPTION: &str = "tok_caption";

/// Width of an attention head in every released size but the two large ones, whose names give the number of heads.
const HEAD_WIDTH: usize = 64;

/// Whether the names are those of a transformer.
pub fn matches(checkpoint: &Checkpoint) -> bool {
    checkpoint.entries().iter().any(|e| e.name == "mask_token")
}

/// One rule per entry. `heads` overrides the number of attention heads.
#[allow(clippy::match_same_arms)] // one arm per line of the release's list
pub fn plan(checkpoint: &Checkpoint, heads: Option<usize>) -> Result<Plan, String> {
    let entries = checkpoint.entries();
    let shape = |name: &str| {
        entries
            .iter()
            .find(|e| e.name == name)
            .map(super::Entry::shape)
            .ok_or_else(|| format!("`{name}` is missing"))
    };
    let width = match shape("mask_token")?[..] {
        [1, 1, width] | [width] => width,
        ref other => return Err(format!("`mask_token` has shape {other:?}")),
    };
    let mut rules = Vec::with_capacity(entries.len());
    let mut modalities: Vec<&str> = Vec::new();
    let (mut encoder_depth, mut decoder_depth, mut hidden) = (0, 0, 0);
    for entry in entries {
        let parts: Vec<&str> = entry.name.split('.').collect();
        let shape = entry.shape();
        let expect = |expected: &[usize]| {
            (shape == expected).then_some(()).ok_or_else(|| {
                format!(
                    "`{}` has shape {shape:?}, expected {expected:?}",
                    entry.name
                )
            })
        };
        let unknown = || format!("`{}` is not an entry of any known release", entry.name);
        let keep = |shape: &[usize]| Rule::keep(&entry.name, shape.to_vec());
        let rule = match parts.as_slice() {
            ["mask_token"] => keep(&[width]),
            ["encoder_embeddings" | "decoder_embeddings", CAPTION, ..] => Rule::Unsupported {
                why: "captions are not a modality of this product",
            },
            [
                side @ ("encoder_embeddings" | "decoder_embeddings"),
                name,
                rest @ ..,
            ] => {
                let (theirs, layout) = LAYOUTS
                    .into_iter()
                    .find(|(theirs, _)| theirs == name)
                    .ok_or_else(unknown)?;
                if !modalities.contains(&theirs) {
                    modalities.push(theirs);
                }
                let encoder = *side == "encoder_embeddings";
                let renamed = |shape: &[usize]| Rule::Keep {
                    name: from_release(&entry.name),
                    shape: shape.to_vec(),
                };
                match rest {
                    ["pos_emb"] => Rule::Table {
                        layout,
                        keep: false,
                    },
                    ["mod_emb"] if encoder => {
                        expect(&[1, 1, width])?;
                        renamed(&[width])
                    }
                    ["mod_emb"] => Rule::Alias {
                        owner: format!("encoder_embeddings.{theirs}.mod_emb"),
                    },
                    ["token_emb" | "proj", "weight"] if shape.len() == 2 => renamed(&shape),
                    ["to_logits", "weight"] if !encoder => Rule::Alias {
                        owner: format!("decoder_embeddings.{theirs}.token_emb.weight"),
                    },
                    _ => return Err(unknown()),
                }
            }
            [stack @ ("encoder" | "decoder"), block, rest @ ..] => {
                let block: usize = block.parse().map_err(|_| unknown())?;
                let depth = if *stack == "encoder" {
                    &mut encoder_depth
                } else {
                    &mut decoder_depth
                };
                *depth = (*depth).max(block.saturating_add(1));
                if *depth > 1000 {
                    return Err(unknown());
                }
                match (*stack, rest) {
                    (_, ["norm1" | "norm2", part])
                    | ("decoder", ["query_norm" | "context_norm", part]) => {
                        expect(&[width])?;
                        norm(part, &keep(&[width])).ok_or_else(unknown)?
                    }
                    ("encoder", ["attn", "qkv", "weight"])
                    | ("decoder", ["self_attn", "qkv", "weight"]) => {
                        expect(&[3 * width, width])?;
                        keep(&shape)
                    }
                    ("decoder", ["cross_attn", "kv", "weight"]) => {
                        expect(&[2 * width, width])?;
                        keep(&shape)
                    }
                    ("encoder", ["attn", "proj", "weight"])
                    | (
                        "decoder",
                        ["self_attn" | "cross_attn", "proj", "weight"]
                        | ["cross_attn", "q", "weight"],
                    ) => {
                        expect(&[width, width])?;
                        keep(&shape)
                    }
                    (_, ["mlp", "fc1" | "fc3", "weight"]) if shape.len() == 2 => {
                        hidden = shape[0];
                        expect(&[hidden, width])?;
                        keep(&shape)
                    }
                    (_, ["mlp", "fc2", "weight"]) if shape.len() == 2 => {
                        expect(&[width, shape[1]])?;
                        keep(&shape)
                    }
                    _ => return Err(unknown()),
                }
            }
            ["encoder_norm" | "decoder_norm", part] => {
                expect(&[width])?;
                norm(part, &keep(&[width])).ok_or_else(unknown)?
            }
            ["decoder_proj_context", "weight"] => {
                expect(&[width, width])?;
                keep(&shape)
            }
            ["decoder_proj_context", "bias"] => {
                expect(&[width])?;
                keep(&shape)
            }
            _ => return Err(unknown()),
        };
        rules.push(rule);
    }
    check_arguments(checkpoint, &modalities)?;
    let heads = match heads.or_else(|| builder_heads(checkpoint)) {
        Some(heads) => heads,
        None if width.is_multiple_of(HEAD_WIDTH) => width / HEAD_WIDTH,
        None => {
            return Err(format!(
                "the number of heads is not in the file, and width {width} is not a multiple of {HEAD_WIDTH}; give it with --heads"
            ));
        }
    };
    if heads == 0 || !width.is_multiple_of(heads) {
        return Err(format!("width {width} does not divide into {heads} heads"));
    }
    modalities.sort_unstable_by_key(|theirs| ours(theirs));
    let described: Result<Vec<Value>, String> = modalities
        .iter()
        .map(|theirs| describe(theirs, &shape))
        .collect();
    Ok(Plan {
        part: "mget".to_owned(),
        family: "mget",
        rules,
        settings: json!({
            "size": {
                "width": width,
                "heads": heads,
                "encoder_depth": encoder_depth,
                "decoder_depth": decoder_depth,
                "hidden": hidden,
            },
            "positions": "released",
            "modalities": described?,
        }),
        grid: None,
    })
}

fn ours(theirs: &str) -> &'static str {
    modality_from_release(theirs).unwrap_or_default()
}

/// The weight of a norm is kept; its bias is a zero buffer.
fn norm(part: &str, keep: &Rule) -> Option<Rule> {
    match part {
        "weight" => Some(keep.clone()),
        "bias" => Some(Rule::Zero),
        _ => None,
    }
}

/// The specification of one modality; `grid` is empty until its position table has been read.
fn describe(
    theirs: &str,
    shape: &dyn Fn(&str) -> Result<Vec<usize>, String>,
) -> Result<Value, String> {
    let tubelet = match theirs {
        "rgb@256" => Some([4, 8, 8]),
        "rgb512" => Some([8, 16, 16]),
        _ => None,
    };
    let encoder = format!("encoder_embeddings.{theirs}");
    if let Some([t, h, w]) = tubelet {
        let found = shape(&format!("{encoder}.proj.weight"))?;
        if found.get(1) != Some(&(3 * t * h * w)) {
            return Err(format!(
                "`{encoder}.proj.weight` has shape {found:?}, its tubelets are [{t}, {h}, {w}, 3]"
            ));
        }
        return Ok(json!({
            "name": ours(theirs),
            "input": { "pixels": { "clip": [], "tubelet": [t, h, w] } },
        }));
    }
    let table = shape(&format!("{encoder}.token_emb.weight"))?;
    let logits = shape(&format!("decoder_embeddings.{theirs}.token_emb.weight"))?;
    if table != logits {
        return Err(format!(
            "`{theirs}` has {table:?} embeddings on one side and {logits:?} on the other"
        ));
    }
    Ok(json!({
        "name": ours(theirs),
        "input": { "tokens": { "grid": [], "vocabulary": table[0] } },
    }))
}

/// Fills the grid of a modality into the settings, once its position table has been read.
pub fn set_grid(settings: &mut Value, entry: &str, grid: &[usize]) {
    let Some(name) = entry.split('.').nth(1).map(ours) else {
        return;
    };
    let Some(modalities) = settings["modalities"].as_array_mut() else {
        return;
    };
    for modality in modalities.iter_mut().filter(|m| m["name"] == name) {
        if let Some(tokens) = modality["input"].get_mut("tokens") {
            tokens["grid"] = json!(grid);
        } else if let (Some(pixels), [t, h, w]) = (modality["input"].get_mut("pixels"), grid) {
            let size = |axis: usize, count: usize| {
                pixels["tubelet"][axis].as_u64().unwrap_or(0) * count as u64
            };
            pixels["clip"] = json!([size(0, *t), size(1, *h), size(2, *w), 3]);
        }
    }
}

fn builder_heads(checkpoint: &Checkpoint) -> Option<usize> {
    let builder = checkpoint.arguments().get("model")?.as_str()?;
    let builder = builder
        .strip_prefix("fm_")
        .or_else(|| builder.strip_prefix("reviv_"))
        .or_else(|| builder.strip_prefix("egom2p_"))?;
    match builder.split('_').next()? {
        "tiny" => Some(6),
        "small" => Some(8),
        "base" => Some(12),
        "large" => Some(15),
        "xlarge" => Some(31),
        _ => None,
    }
}

/// What a `.pth` says about itself must agree with its tensors.
fn check_arguments(checkpoint: &Checkpoint, found: &[&str]) -> Result<(), String> {
    if checkpoint.format() != Format::Torch {
        return Ok(());
    }
    let arguments = checkpoint.arguments();
    // Weights that were taken out of a checkpoint and saved alone say nothing of themselves, as those in safetensors.
    if arguments.is_empty() {
        return Ok(());
    }
    let Some(domains) = arguments.get("all_domains").and_then(Value::as_array) else {
        return Err(
            "its `args` have no `all_domains`, so it is not a main model of a release".to_owned(),
        );
    };
    if arguments
        .get("num_register_tokens")
        .is_some_and(|n| n.as_u64() != Some(0))
    {
        return Err("a model with register tokens, which no release uses".to_owned());
    }
    let mut stated: Vec<&str> = domains
        .iter()
        .filter_map(Value::as_str)
        .filter(|d| *d != CAPTION)
        .collect();
    let mut found = found.to_vec();
    stated.sort_unstable();
    found.sort_unstable();
    if stated != found {
        return Err(format!(
            "its `args` name the modalities {stated:?}, its tensors {found:?}"
        ));
    }
    Ok(())
}
