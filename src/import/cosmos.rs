//! Which entry of NVIDIA's video tokenizer files is what: encoder, decoder or both, of DV4x8x8, DV8x16x16 and their kin.
//!
//! Sizes come from the tensors. The two compressions have the same tensors, and only differ in which of them run: that is
//! read from the name of the file or its folder, or given.

use super::Checkpoint;
use super::rules::{Plan, Rule};
use crate::engine::{Compute, Initialise, Parameters};
use crate::tokenizer::video::settings::COLOURS;
use crate::tokenizer::video::{Fsq, Network, VideoSettings};
use std::collections::BTreeMap;

/// Whether the names are those of a Cosmos video tokenizer.
pub fn matches(checkpoint: &Checkpoint) -> bool {
    checkpoint.entries().iter().any(|e| {
        e.name == "encoder.conv_in.0.conv3d.weight" || e.name == "decoder.conv_in.0.conv3d.weight"
    })
}

/// One rule per entry. `compression` is frames and pixels per token, where the file's name does not say.
pub fn plan(checkpoint: &Checkpoint, compression: Option<[usize; 2]>) -> Result<Plan, String> {
    let Some([temporal, spatial]) = compression.or_else(|| named_compression(checkpoint)) else {
        return Err(
            "the name of neither file nor folder says which tokenizer this is; give `--video 4x8x8` or `--video 8x16x16`"
                .to_owned(),
        );
    };
    let settings = settings(checkpoint, temporal, spatial)?;
    settings.check().map_err(|e| e.to_string())?;
    let expected = inventory(&settings)?;
    let unused = settings.never_run();
    let fsq = Fsq::new(&settings.levels);
    let mut rules = Vec::with_capacity(checkpoint.entries().len());
    for entry in checkpoint.entries() {
        let shape = entry.shape();
        let name = entry.name.as_str();
        let rule = if let Some(expected) = expected.get(name) {
            if *expected != shape {
                return Err(format!(
                    "`{name}` has shape {shape:?}, expected {expected:?}"
                ));
            }
            Rule::keep(name, shape)
        } else if unused.iter().any(|prefix| name.starts_with(prefix)) {
            Rule::NeverRuns
        } else if let Some(values) = constant(name, &settings, &fsq) {
            Rule::Constant { values }
        } else {
            return Err(format!("`{name}` is not an entry of any known release"));
        };
        rules.push(rule);
    }
    for side in ["encoder.", "decoder."] {
        let has = |name: &str| checkpoint.entries().iter().any(|e| e.name == name);
        if !has(&format!("{side}conv_in.0.conv3d.weight")) {
            continue;
        }
        let projection = if side == "encoder." {
            "quant_conv."
        } else {
            "post_quant_conv."
        };
        if let Some(missing) = expected
            .keys()
            .find(|n| (n.starts_with(side) || n.starts_with(projection)) && !has(n))
        {
            return Err(format!("`{missing}` is missing"));
        }
    }
    Ok(Plan {
        part: format!("cosmos_dv{temporal}x{spatial}x{spatial}"),
        family: "cosmos",
        rules,
        settings: serde_json::to_value(settings).map_err(|e| e.to_string())?,
        grid: None,
    })
}

/// `4x8x8` as frames and pixels per token.
pub fn parse_compression(text: &str) -> Option<[usize; 2]> {
    let mut parts = text.split('x').map(|part| part.parse().ok());
    match (parts.next()?, parts.next()?, parts.next()?, parts.next()) {
        (Some(time), Some(height), Some(width), None) if height == width => Some([time, height]),
        _ => None,
    }
}

fn named_compression(checkpoint: &Checkpoint) -> Option<[usize; 2]> {
    let path = checkpoint.path();
    let names = [path.file_name(), path.parent().and_then(|p| p.file_name())];
    names.into_iter().flatten().find_map(|name| {
        let name = name.to_string_lossy().to_lowercase();
        let at = name.find("dv")? + 2;
        let end = name[at..]
            .find(|c: char| !c.is_ascii_digit() && c != 'x')
            .map_or(name.len(), |n| at + n);
        parse_compression(&name[at..end])
    })
}

fn settings(
    checkpoint: &Checkpoint,
    temporal: usize,
    spatial: usize,
) -> Result<VideoSettings, String> {
    let shape = |name: &str| {
        checkpoint
            .entries()
            .iter()
            .find(|e| e.name == name)
            .map(super::Entry::shape)
            .filter(|shape| shape.len() == 5 && shape[0] > 0)
    };
    let encoder = shape("encoder.conv_in.0.conv3d.weight").is_some();
    let (side, level) = if encoder {
        ("encoder", "down")
    } else {
        ("decoder", "up")
    };
    let mut widths = Vec::new();
    let mut blocks = 0;
    while let Some(conv) = shape(&format!(
        "{side}.{level}.{}.block.0.conv1.0.conv3d.weight",
        widths.len()
    )) {
        while shape(&format!(
            "{side}.{level}.{}.block.{blocks}.conv1.0.conv3d.weight",
            widths.len()
        ))
        .is_some()
        {
            blocks += 1;
        }
        widths.push(conv[0]);
        if widths.len() > 8 {
            return Err("more than eight levels".to_owned());
        }
    }
    let conv = |name: &str| shape(name).ok_or_else(|| format!("`{name}` is missing"));
    let (channels, coefficients, latent_channels, code);
    if encoder {
        let first = conv("encoder.conv_in.0.conv3d.weight")?;
        let last = conv("quant_conv.conv3d.weight")?;
        (channels, coefficients) = (first[0], first[1]);
        (code, latent_channels) = (last[0], last[1]);
    } else {
        let first = conv("post_quant_conv.conv3d.weight")?;
        coefficients = conv("decoder.conv_out.0.conv3d.weight")?[0];
        (latent_channels, code) = (first[0], first[1]);
        // The decoder does not hold the encoder's first width; every release has twice as many at the first level.
        channels = widths.first().copied().unwrap_or(0) / 2;
    }
    let patch = (1..=4)
        .find(|patch: &usize| COLOURS * patch.pow(3) == coefficients)
        .ok_or_else(|| format!("{coefficients} wavelet coefficients of a colour video"))?;
    if channels == 0 || widths.is_empty() || widths.iter().any(|w| !w.is_multiple_of(channels)) {
        return Err(format!(
            "levels of {widths:?} channels after a first convolution to {channels}"
        ));
    }
    let defaults = VideoSettings::default();
    if code != defaults.levels.len() {
        return Err(format!(
            "latents of {code} dimensions; the releases have {}",
            defaults.levels.len()
        ));
    }
    Ok(VideoSettings {
        channels,
        multipliers: widths.iter().map(|w| w / channels).collect(),
        // Blocks were counted over all levels.
        blocks: blocks.max(1) - usize::from(!encoder),
        patch,
        latent_channels,
        spatial,
        temporal,
        ..defaults
    })
}

/// Names and shapes of the parameters of a network of these sizes.
fn inventory(settings: &VideoSettings) -> Result<BTreeMap<String, Vec<usize>>, String> {
    let compute = Compute::cpu();
    let network = Network::new(&Initialise::meta(&compute), settings);
    let all = network.map_err(|e| e.to_string())?.inventory();
    Ok(all
        .into_iter()
        .map(|(name, shape, _)| (name, shape))
        .collect())
}

/// Constants that TorchScript stores beside the weights.
fn constant(name: &str, settings: &VideoSettings, fsq: &Fsq) -> Option<Vec<f32>> {
    let (place, last) = name.rsplit_once('.')?;
    let levels = &settings.levels;
    match (place, last) {
        ("encoder.patcher3d" | "decoder.unpatcher3d", "wavelets") => {
            Some(vec![std::f32::consts::FRAC_1_SQRT_2; 2])
        }
        ("encoder.patcher3d" | "decoder.unpatcher3d", "_arange") => Some(vec![0.0, 1.0]),
        ("encoder.patcher3d" | "decoder.unpatcher3d", "patch_size_buffer") => {
            Some(vec![settings.patch as f32])
        }
        ("quantizer" | "inv_quant.quantizer", "_levels") => {
            Some(levels.iter().map(|l| *l as f32).collect())
        }
        ("quantizer" | "inv_quant.quantizer", "_basis") => Some(
            (0..levels.len())
                .map(|i| levels[..i].iter().product::<usize>() as f32)
                .collect(),
        ),
        ("quantizer" | "inv_quant.quantizer", "implicit_codebook") => {
            let tokens: Vec<u32> = (0..settings.vocabulary() as u32).collect();
            Some(fsq.decode(&tokens))
        }
        _ => None,
    }
}
