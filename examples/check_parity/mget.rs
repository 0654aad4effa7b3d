//! `mget/`: position tables; forward pass, logits, losses and gradients; training steps.

use std::collections::BTreeMap;
use std::path::Path;

use reviv::engine::parameters::to_host;
use reviv::engine::{Gradients, HostTensor, Parameters, Tensor, Weights};
use reviv::masking::Mask;
use reviv::mget::names::{from_release, modality_from_release};
use reviv::mget::{
    Batch, Content, Loss, Mget, MgetSpec, ModalitySpec, Positions, Sequence, Size, positions,
};
use reviv::training::{AdamW, AdamWSettings};
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vectors::{Vectors, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for stem in stems(folder)? {
        let file = Vectors::read(folder, &stem)?;
        if stem == "position_tables" {
            tables(file, report)?;
        } else if stem.ends_with("_train") {
            training(file, report)?;
        } else {
            forward(file, report)?;
        }
    }
    Ok(())
}

fn tables(mut file: Vectors, report: &mut Report) -> Outcome {
    for output in file.outputs() {
        let name = output.strip_suffix(".values").ok_or("values")?;
        let (kind, width) = name.split_once(".d").ok_or("a width")?;
        let width: usize = width.parse()?;
        let grid: &[usize] = match kind {
            "1d_30" => &[30],
            "hand_210" | "vq_hand_30x7" => &[30, 7],
            "video_5x32x32" => &[5, 32, 32],
            "raw_4x32x32" => &[4, 32, 32],
            other => return Err(format!("unknown table {other}").into()),
        };
        let table = positions::table(grid, width, Positions::Released).ok_or("a table")?;
        let rows = file.tensor(&format!("{name}.rows"))?.i64("rows")?.to_vec();
        let found: Vec<f32> = rows
            .iter()
            .flat_map(|row| table[*row as usize * width..][..width].to_vec())
            .collect();
        let sum: f64 = table.iter().map(|value| f64::from(*value)).sum();
        let expected = number(&file.settings["tables"][name]["sum"])?;
        report.relative(
            format!("mget/position_tables {name} sum"),
            &[sum],
            &[expected],
            1e-6,
        );
        file.compare(report, &output, &[rows.len(), width], &found)?;
    }
    file.finish(report);
    Ok(())
}

fn number(value: &Value) -> Outcome<f64> {
    Ok(value
        .as_f64()
        .ok_or_else(|| format!("{value} is no number"))?)
}

fn sizes(value: &Value) -> Vec<usize> {
    let list = value.as_array().into_iter().flatten();
    list.filter_map(Value::as_u64)
        .map(|size| size as usize)
        .collect()
}

/// A fixture: the model with its weights, the batch, and the release's names of the modalities in order.
struct Fixture {
    spec: MgetSpec,
    model: Mget,
    batch: Batch,
    theirs: Vec<String>,
    /// `[samples][modalities]`.
    masks: Vec<Mask>,
}

/// The model that `settings` describe, and the release's names of its modalities in order.
pub(super) fn spec_of(settings: &Value) -> Outcome<(MgetSpec, Vec<String>)> {
    let size =
        |name: &str| -> Outcome<usize> { Ok(settings[name].as_u64().ok_or("a size")? as usize) };
    let theirs: Vec<String> = settings["modality_order"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|name| name.as_str().map(str::to_owned))
        .collect();
    let mut modalities = Vec::new();
    for name in &theirs {
        let own = modality_from_release(name).ok_or("an unknown modality")?;
        let entry = &settings["modalities"][name];
        let tokens = entry["tokens"].as_u64().ok_or("tokens")? as usize;
        modalities.push(match entry["vocab"].as_u64() {
            None => {
                let clip = sizes(&settings["raw_clip"])
                    .try_into()
                    .map_err(|_| "a clip")?;
                let tubelet = sizes(&settings["raw_tubelet"])
                    .try_into()
                    .map_err(|_| "a tubelet")?;
                ModalitySpec::pixels(own, clip, tubelet)
            }
            Some(vocabulary) => {
                let grid = match own {
                    "rgb" | "depth" => sizes(&settings["video_grid"]),
                    _ if tokens == 210 => vec![30, 7],
                    _ => vec![tokens],
                };
                ModalitySpec::tokens(own, &grid, vocabulary as usize)
            }
        });
    }
    let spec = MgetSpec {
        size: Size {
            width: size("dim")?,
            heads: size("heads")?,
            encoder_depth: size("encoder_depth")?,
            decoder_depth: size("decoder_depth")?,
            hidden: size("mlp_hidden")?,
        },
        positions: Positions::Released,
        modalities,
    };
    Ok((spec, theirs))
}

fn fixture(file: &Vectors) -> Outcome<Fixture> {
    let (spec, theirs) = spec_of(&file.settings)?;
    let mut model = Mget::empty(&spec, &super::compute())?;
    model.load(&parameters_of(&file.checkpoint()?, &model))?;

    let samples = file.tensor(&format!("in.{}.tensor", theirs[0]))?.shape[0];
    let mut masks = vec![Mask::default(); samples];
    let mut ids: Vec<Vec<Vec<u32>>> = vec![Vec::new(); samples];
    let mut clips: Vec<Vec<Vec<f32>>> = vec![Vec::new(); samples];
    for (modality, name) in spec.modalities.iter().zip(&theirs) {
        let values = file.tensor(&format!("in.{name}.tensor"))?;
        for (sample, mask) in masks.iter_mut().enumerate() {
            let used = |side: &str| -> Outcome<Vec<u32>> {
                let mask = file.tensor(&format!("in.{name}.{side}_mask"))?.u8(name)?;
                let own = &mask[sample * modality.count()..][..modality.count()];
                let positions = own.iter().enumerate().filter(|(_, unused)| **unused == 0);
                Ok(positions.map(|(position, _)| position as u32).collect())
            };
            mask.input.push(used("input")?);
            mask.target.push(used("target")?);
            let length = values.shape[1..].iter().product::<usize>();
            let range = sample * length..(sample + 1) * length;
            if modality.vocabulary().is_some() {
                let own = values.i64(name)?[range].iter().map(|id| *id as u32);
                ids[sample].push(own.collect());
                clips[sample].push(Vec::new());
            } else {
                clips[sample].push(values.f32(name)?[range].to_vec());
                ids[sample].push(Vec::new());
            }
        }
    }
    let contents: Vec<Vec<Content<'_>>> = (0..samples)
        .map(|sample| {
            spec.modalities
                .iter()
                .enumerate()
                .map(|(index, modality)| match modality.vocabulary() {
                    Some(_) => Content::Ids(&ids[sample][index]),
                    None => Content::Floats(&clips[sample][index]),
                })
                .collect()
        })
        .collect();
    let batch = Batch::new(&spec, &contents, &masks)?;
    Ok(Fixture {
        spec,
        model,
        batch,
        theirs,
        masks,
    })
}

/// The checkpoint's entries that are parameters of `model`, under our names and shapes.
pub(super) fn parameters_of(checkpoint: &Weights, model: &Mget) -> Weights {
    let shapes: BTreeMap<String, Vec<usize>> = model
        .inventory()
        .into_iter()
        .map(|(name, shape, _)| (name, shape))
        .collect();
    let mut weights = Weights::default();
    for (name, tensor) in &checkpoint.tensors {
        let own = from_release(name);
        if let Some(shape) = shapes.get(&own) {
            let values = tensor.values.clone();
            let shape = shape.clone();
            weights.tensors.insert(own, HostTensor { shape, values });
        }
    }
    weights
}

fn rows(tensor: &Tensor<2>) -> ([usize; 2], Vec<f32>) {
    (tensor.dims(), to_host(tensor.clone()))
}

fn forward(mut file: Vectors, report: &mut Report) -> Outcome {
    let Fixture {
        spec,
        mut model,
        batch,
        theirs,
        masks,
    } = fixture(&file)?;
    packing(&mut file, report, &spec, &masks, &batch)?;

    let context = model.encode(&batch.visible);
    let asked = &batch.targets.sequence;
    if let Some(stages) = context.stages() {
        for (name, stage) in ["enc_in_valid", "enc_out_valid", "context_valid"]
            .iter()
            .zip(&stages)
        {
            let (shape, values) = rows(stage);
            file.compare(report, name, &shape, &values)?;
        }
    }
    if let Some(answers) = model.decode(&context, asked) {
        let (shape, values) = rows(&answers);
        file.compare(report, "dec_out_valid", &shape, &values)?;
        for (index, name) in theirs.iter().enumerate() {
            if let Some(logits) = model.logits(&answers, asked, index) {
                let (shape, values) = rows(&logits);
                file.compare(report, &format!("logits.{name}"), &shape, &values)?;
            }
        }
    }
    model.start_training();
    for (kind, name) in [
        (Loss::Mod, "mod"),
        (Loss::ReleaseToken, "token"),
        (Loss::WeightedMod, "weighted_mod"),
    ] {
        let losses = model.losses(&batch, kind);
        let values = losses.values();
        file.compare(
            report,
            &format!("loss.{name}.total"),
            &[1],
            &[values.total as f32],
        )?;
        for (modality, theirs) in spec.modalities.iter().zip(&theirs) {
            let output = format!("loss.{name}.{theirs}");
            let index = spec.index(&modality.name).ok_or("an index")?;
            let mean = values.modalities[index].map_or(0.0, |(mean, _)| mean);
            // The reference reports this one already weighted.
            let factor = match (kind, modality.vocabulary()) {
                (Loss::WeightedMod, Some(vocabulary)) => 256_f64.ln() / (vocabulary as f64).ln(),
                _ => 1.0,
            };
            if file.has_output(&output) {
                file.compare(report, &output, &[1], &[(mean * factor) as f32])?;
            }
        }
        let Some(total) = losses.total else { continue };
        gradients(
            &mut file,
            report,
            &Gradients::of(&total, &model),
            &format!("grad.{name}."),
        )?;
    }
    file.finish(report);
    Ok(())
}

/// Which tokens stand where, in the reference's padded form.
fn packing(
    file: &mut Vectors,
    report: &mut Report,
    spec: &MgetSpec,
    masks: &[Mask],
    batch: &Batch,
) -> Outcome {
    let all: Vec<usize> = (0..spec.modalities.len()).collect();
    let predicted: Vec<usize> = all
        .iter()
        .copied()
        .filter(|i| spec.modalities[*i].vocabulary().is_some())
        .collect();
    let id = |name: &str| {
        file.settings["modalities"][name]["id"]
            .as_i64()
            .unwrap_or(-1)
    };
    let ids: Vec<i64> = file.settings["modality_order"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|name| name.as_str().map(id))
        .collect();
    for (part, modalities, sequence, width) in [
        ("enc", &all, &batch.visible.sequence, "num_encoder_tokens"),
        (
            "dec",
            &predicted,
            &batch.targets.sequence,
            "num_decoder_tokens",
        ),
    ] {
        let width = file.settings[width].as_u64().ok_or("a width")? as usize;
        let shape = [masks.len(), width];
        let keep = file.tensor(&format!("{part}_keep"))?.i64("keep")?.to_vec();
        let kinds = file.tensor(&format!("{part}_mod"))?.i64("mod")?.to_vec();
        let (mut own_keep, mut own_mask, mut own_kinds) = (keep.clone(), Vec::new(), kinds.clone());
        let mut row = 0;
        for (sample, length) in sequence.lengths.iter().enumerate() {
            own_mask.extend((0..width).map(|column| column >= *length));
            for column in 0..*length {
                let modality = sequence.modalities[row] as usize;
                let before = modalities.iter().filter(|other| **other < modality);
                let start: usize = before.map(|other| spec.modalities[*other].count()).sum();
                own_keep[sample * width + column] =
                    (start + sequence.positions[row] as usize) as i64;
                own_kinds[sample * width + column] = ids[modality];
                row += 1;
            }
        }
        file.compare_ids(report, &format!("{part}_keep"), &shape, &own_keep)?;
        file.compare_ids(report, &format!("{part}_mod"), &shape, &own_kinds)?;
        file.compare_flags(report, &format!("{part}_mask"), &shape, &own_mask)?;
        if part == "dec" {
            let mut target_ids = file.tensor("dec_target_ids")?.i64("ids")?.to_vec();
            fill(&mut target_ids, sequence, width, &true_ids(batch));
            file.compare_ids(report, "dec_target_ids", &shape, &target_ids)?;
            blocked(file, report, sequence, width)?;
        }
    }
    Ok(())
}

fn true_ids(batch: &Batch) -> Vec<i64> {
    let mut ids = vec![0; batch.targets.sequence.len()];
    for (rows, own) in batch.targets.sequence.rows.iter().zip(&batch.targets.ids) {
        for (row, id) in rows.iter().zip(own) {
            ids[*row as usize] = i64::from(*id);
        }
    }
    ids
}

fn fill(padded: &mut [i64], sequence: &Sequence, width: usize, values: &[i64]) {
    let mut row = 0;
    for (sample, length) in sequence.lengths.iter().enumerate() {
        padded[sample * width..][..*length].copy_from_slice(&values[row..row + length]);
        row += length;
    }
}

/// Which asked tokens may not see each other: those of other modalities. Padding is the reference's.
fn blocked(file: &mut Vectors, report: &mut Report, sequence: &Sequence, width: usize) -> Outcome {
    let name = "dec_attention_blocked";
    let mut own: Vec<bool> = file
        .tensor(name)?
        .u8(name)?
        .iter()
        .map(|flag| *flag != 0)
        .collect();
    let mut start = 0;
    for (sample, length) in sequence.lengths.iter().enumerate() {
        for a in 0..*length {
            for b in 0..*length {
                let different = sequence.modalities[start + a] != sequence.modalities[start + b];
                own[(sample * width + a) * width + b] = different;
            }
        }
        start += length;
    }
    file.compare_flags(report, name, &[sequence.lengths.len(), width, width], &own)
}

fn gradients(file: &mut Vectors, report: &mut Report, found: &Gradients, prefix: &str) -> Outcome {
    for output in file.outputs() {
        let Some(name) = output.strip_prefix(prefix) else {
            continue;
        };
        if name == "__norm__" {
            file.compare(report, &output, &[1], &[found.norm().read() as f32])?;
            continue;
        }
        let gradient = found
            .get(&from_release(name))
            .ok_or_else(|| format!("no gradient of {name}"))?;
        let shape = file.tensor(&output)?.shape.clone();
        file.compare(report, &output, &shape, &to_host(gradient.clone()))?;
    }
    Ok(())
}

fn training(mut file: Vectors, report: &mut Report) -> Outcome {
    let Fixture {
        mut model, batch, ..
    } = fixture(&file)?;
    let settings = &file.settings;
    let settings = AdamWSettings {
        betas: [
            number(&settings["betas"][0])?,
            number(&settings["betas"][1])?,
        ],
        epsilon: number(&settings["eps"])?,
        weight_decay: number(&settings["weight_decay"])?,
        clip_norm: Some(number(&settings["clip"])?),
        shard: false,
        muon: false,
    };
    model.start_training();
    let mut optimizer = AdamW::new(settings, &model);
    let rates = file.settings["lr"].as_array().ok_or("rates")?.clone();
    for (step, rate) in rates.iter().enumerate() {
        let losses = model.losses(&batch, Loss::Mod);
        let loss = losses.values().total as f32;
        let total = losses.total.ok_or("a loss")?;
        let gradients = Gradients::of(&total, &model);
        drop(total);
        let norm = optimizer.step(&mut model, gradients, number(rate)?)?;
        file.compare(report, &format!("step{step}.loss"), &[1], &[loss])?;
        file.compare(
            report,
            &format!("step{step}.grad_norm"),
            &[1],
            &[norm as f32],
        )?;
    }
    let weights = model.weights();
    for output in file.outputs() {
        let Some(name) = output.strip_prefix("after.") else {
            continue;
        };
        if name == "__norm__" {
            let square = |tensor: &HostTensor| -> f64 {
                let values = tensor.f32("square").unwrap_or(&[]).iter();
                values.map(|value| f64::from(*value).powi(2)).sum()
            };
            let norm = weights.tensors.values().map(square).sum::<f64>().sqrt();
            file.compare(report, &output, &[1], &[norm as f32])?;
            continue;
        }
        let own = weights
            .tensors
            .get(&from_release(name))
            .ok_or_else(|| format!("no parameter {name}"))?;
        let shape = file.tensor(&output)?.shape.clone();
        file.compare(report, &output, &shape, own.f32(name)?)?;
    }
    file.finish(report);
    Ok(())
}
