//! Which entry of a released VQ-VAE tokenizer is what: camera, gaze, hands, body.

use super::Checkpoint;
use super::rules::{Layout, Plan, Rule};
use crate::tokenizer::vq::VqSettings;
use serde_json::Value;
use std::path::Path;

/// All released tokenizers have the heads of ViT-B, which is not in their files.
const HEADS: usize = 12;

/// Whether the names are those of a VQ-VAE.
pub fn matches(checkpoint: &Checkpoint) -> bool {
    checkpoint
        .entries()
        .iter()
        .any(|e| e.name == "quantize._codebook.embed")
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
    let modality = modality(checkpoint)?;
    let conv = shape("encoder.conv.weight")?;
    let (width, channels, patch) = match conv[..] {
        [width, channels, ref patch @ ..] if matches!(patch.len(), 1 | 2) => {
            (width, channels, patch.to_vec())
        }
        _ => return Err(format!("`encoder.conv.weight` has shape {conv:?}")),
    };
    let kinematic = patch.len() == 2;
    let expected_channels = match modality {
        "camera" => 9,
        "gaze" => 2,
        _ => 3,
    };
    if kinematic != (expected_channels == 3) || channels != expected_channels {
        return Err(format!(
            "a tokenizer of `{modality}` whose first convolution has shape {conv:?}"
        ));
    }
    let codebook = match shape("quantize._codebook.embed")?[..] {
        [codes, dim] => [codes, dim],
        ref other => return Err(format!("`quantize._codebook.embed` has shape {other:?}")),
    };
    let heads = heads.unwrap_or(HEADS);
    // Zero is a multiple of every number.
    if width == 0 || heads == 0 || !width.is_multiple_of(heads) {
        return Err(format!("width {width} does not divide into {heads} heads"));
    }
    let mut rules = Vec::with_capacity(entries.len());
    let mut depth = [0usize; 2];
    let mut hidden = 4 * width;
    for entry in entries {
        let unknown = || format!("`{}` is not an entry of any known release", entry.name);
        let found = entry.shape();
        let parts: Vec<&str> = entry.name.split('.').collect();
        let size = |expected: &[usize]| {
            (found == expected).then_some(()).ok_or_else(|| {
                format!(
                    "`{}` has shape {found:?}, expected {expected:?}",
                    entry.name
                )
            })
        };
        let patch_values: usize = patch.iter().product();
        let mut rule = Rule::keep(&entry.name, found.clone());
        match parts.as_slice() {
            ["encoder" | "decoder", "position_embeddings"] => {
                rule = Rule::Table {
                    layout: if kinematic {
                        Layout::Grid
                    } else {
                        Layout::Line
                    },
                    keep: true,
                };
            }
            ["encoder", "conv", "weight"] => {}
            ["encoder", "conv", "bias"] => size(&[width])?,
            [side @ ("encoder" | "decoder"), "blocks", block, layer @ ..] => {
                let block: usize = block.parse().map_err(|_| unknown())?;
                if block > 1000 {
                    return Err(unknown());
                }
                let depth = &mut depth[usize::from(*side == "decoder")];
                *depth = (*depth).max(block + 1);
                match layer {
                    ["norm1" | "norm2", "weight" | "bias"]
                    | ["attn", "proj", "bias"]
                    | ["mlp", "fc2", "bias"] => size(&[width])?,
                    ["attn", "qkv", "weight"] => size(&[3 * width, width])?,
                    ["attn", "qkv", "bias"] => size(&[3 * width])?,
                    ["attn", "proj", "weight"] => size(&[width, width])?,
                    ["mlp", "fc1", "weight"] => {
                        hidden = found.first().copied().unwrap_or(0);
                        size(&[hidden, width])?;
                    }
                    ["mlp", "fc1", "bias"] => size(&[hidden])?,
                    ["mlp", "fc2", "weight"] => size(&[width, hidden])?,
                    _ => return Err(unknown()),
                }
            }
            ["encoder" | "decoder", "norm_mlp", "weight" | "bias"] => size(&[width])?,
            [
                "encoder" | "decoder",
                "post_mlp",
                "fc1" | "fc2",
                "weight" | "bias",
            ] => {}
            ["decoder", "out_proj", "weight"] => size(&[channels * patch_values, width])?,
            ["decoder", "out_proj", "bias"] => size(&[channels * patch_values])?,
            ["quant_proj", "weight"] if found.len() == patch.len() + 2 => {}
            ["quant_proj", "bias"] => size(&[codebook[1]])?,
            ["post_quant_proj", "weight"] if found.len() == patch.len() + 2 => {}
            ["post_quant_proj", "bias"] => size(&[width])?,
            ["quantize", "_codebook", "initted"] => size(&[1])?,
            ["quantize", "_codebook", "cluster_size"] => size(&[codebook[0]])?,
            ["quantize", "_codebook", "embed"] => {}
            _ => return Err(unknown()),
        }
        rules.push(rule);
    }
    if depth[0] != depth[1] || !hidden.is_multiple_of(width) {
        return Err(format!(
            "an encoder of {} and a decoder of {} blocks, {hidden} wide inside",
            depth[0], depth[1]
        ));
    }
    let settings = VqSettings {
        codebook: codebook[0],
        code_width: codebook[1],
        compression: patch,
        width,
        depth: depth[0],
        heads,
        mlp_ratio: hidden / width,
        ..VqSettings::default()
    };
    Ok(Plan {
        part: modality.to_owned(),
        family: "vq",
        rules,
        settings: serde_json::to_value(settings).map_err(|e| e.to_string())?,
        grid: None,
    })
}

/// Our name of the modality: from the file's name, else from what the checkpoint says about itself.
fn modality(checkpoint: &Checkpoint) -> Result<&'static str, String> {
    let file = checkpoint
        .path()
        .file_name()
        .map(Path::new)
        .map(|f| f.to_string_lossy().to_lowercase())
        .unwrap_or_default();
    let arguments = checkpoint.arguments();
    let text = |key: &str| {
        arguments
            .get(key)
            .and_then(Value::as_str)
            .unwrap_or_default()
    };
    let side = |text: &str| {
        if text.contains("lhand") || text.contains("left") {
            Some("left_hand")
        } else if text.contains("rhand") || text.contains("right") {
            Some("right_hand")
        } else {
            None
        }
    };
    let kind = |text: &str| {
        let known = [("cam", "camera"), ("gaze", "gaze"), ("body", "body")];
        known
            .into_iter()
            .find(|(word, _)| text.contains(word))
            .map(|(_, ours)| ours)
    };
    let is_hand = file.contains("hand") || text("encoder_type") == "HandTransformer";
    if is_hand {
        let by_flag = (arguments.get("rhand") == Some(&Value::Bool(true))).then_some("right_hand");
        return side(&file)
            .or(by_flag)
            .or_else(|| side(text("domain")))
            .ok_or_else(|| "a hand tokenizer that does not say which hand; put `lhand` or `rhand` into the file's name".to_owned());
    }
    kind(&text("encoder_type").to_lowercase())
        .or_else(|| kind(text("domain")))
        .or_else(|| kind(&file))
        .ok_or_else(|| {
            "a tokenizer that does not say for what; put `cam`, `gaze`, `body`, `lhand` or `rhand` into the file's name".to_owned()
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_of_no_width_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cam.safetensors");
        let header = r#"{"encoder.conv.weight":{"dtype":"F32","shape":[0,9,2],"data_offsets":[0,0]},"quantize._codebook.embed":{"dtype":"F32","shape":[2,1],"data_offsets":[0,8]}}"#;
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend([0; 8]);
        std::fs::write(&path, bytes).unwrap();
        let checkpoint = Checkpoint::open(&path).unwrap();
        let error = plan(&checkpoint, None).unwrap_err();
        assert_eq!(error, "width 0 does not divide into 12 heads");
    }
}
