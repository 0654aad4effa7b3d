//! `tmr/`: resampling, features with their steps, the motion encoder, whole clips, scores, statistics.

use std::path::Path;

use ndarray::{Array3, ArrayView2};
use reviv::engine::parameters::to_host;
use reviv::engine::{Initialise, Parameters, Weights};
use reviv::evaluation::motion::{cosines, frechet_distance, mean_cosine, score01};
use reviv::evaluation::tmr::features::{FEATURES, Features, features};
use reviv::evaluation::tmr::resample::upsampled;
use reviv::evaluation::tmr::skeleton::{Pose, spine_filled};
use reviv::evaluation::tmr::{FeatureRate, MotionEncoder, MotionEncoderSettings, Tmr};
use reviv::import::Checkpoint;
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vectors::{Vectors, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for stem in stems(folder)? {
        let file = Vectors::read(folder, &stem)?;
        let kind = stem.split('_').next().unwrap_or_default();
        match kind {
            "upsample" => upsample(file, report),
            "features" => steps(file, report),
            "encoder" => encoder(file, report),
            "clip" => clip(file, folder, report),
            "scores" => scores(file, report),
            _ => Err("vectors of an unknown kind".into()),
        }
        .map_err(|error| format!("tmr/{stem}: {error}"))?;
    }
    super::vda::checkpoints(folder, report)?;
    statistics(folder, report)
}

fn size(value: &Value, key: &str) -> Outcome<usize> {
    Ok(value[key]
        .as_u64()
        .ok_or_else(|| format!("no number `{key}`"))? as usize)
}

fn poses(file: &Vectors, name: &str) -> Outcome<Vec<Pose>> {
    let values = file.tensor(name)?.f32(name)?;
    Ok(values
        .chunks_exact(66)
        .map(|pose| std::array::from_fn(|j| std::array::from_fn(|k| f64::from(pose[3 * j + k]))))
        .collect())
}

fn flat<'a>(values: impl IntoIterator<Item = &'a f64>) -> Vec<f32> {
    values.into_iter().map(|value| *value as f32).collect()
}

fn joints(poses: &[Pose]) -> Vec<f32> {
    flat(poses.iter().flatten().flatten())
}

fn upsample(mut file: Vectors, report: &mut Report) -> Outcome {
    let factor = size(&file.settings, "factor")?;
    let found = upsampled(&poses(&file, "joints")?, factor);
    file.compare(report, "upsampled", &[found.len(), 22, 3], &joints(&found))?;
    file.finish(report);
    Ok(())
}

/// Columns `from..to` of every row.
fn columns(found: &Features, from: usize, to: usize) -> Vec<f32> {
    flat(found.rows.iter().flat_map(|row| &row[from..to]))
}

fn contacts(found: &Features) -> Vec<u8> {
    found
        .rows
        .iter()
        .flat_map(|row| row[259..].iter().map(|value| u8::from(*value > 0.5)))
        .collect()
}

fn steps(mut file: Vectors, report: &mut Report) -> Outcome {
    let found = features(&poses(&file, "joints")?)?;
    let (frames, rows) = (found.global.len(), found.rows.len());
    file.compare(
        report,
        "retargeted",
        &[frames, 22, 3],
        &joints(&found.retargeted),
    )?;
    file.compare(report, "facing", &[4], &flat(&found.facing))?;
    file.compare(report, "global", &[frames, 22, 3], &joints(&found.global))?;
    let root = flat(found.root_rotation.iter().flatten());
    file.compare(report, "root_rotation", &[frames, 4], &root)?;
    let local = flat(found.local_rotations.iter().flatten().flatten());
    file.compare(report, "local_rotations", &[frames, 22, 4], &local)?;
    for (name, from, to) in [
        ("features", 0, FEATURES),
        ("features.root", 0, 4),
        ("features.positions", 4, 67),
        ("features.rotations", 67, 193),
        ("features.velocities", 193, 259),
    ] {
        let values = columns(&found, from, to);
        file.compare(report, name, &[rows, to - from], &values)?;
    }
    file.compare_bytes(report, "contacts", &[rows, 4], &contacts(&found))?;
    file.finish(report);
    Ok(())
}

/// The encoder of a file's checkpoint.
fn built(file: &Vectors) -> Outcome<MotionEncoder> {
    let settings = MotionEncoderSettings {
        width: size(&file.settings, "latent")?,
        layers: size(&file.settings, "layers")?,
        heads: size(&file.settings, "heads")?,
        hidden: size(&file.settings, "ff")?,
    };
    let compute = super::compute();
    let mut encoder = MotionEncoder::new(&Initialise::empty(&compute), &settings)?;
    encoder.load(&file.checkpoint()?)?;
    Ok(encoder)
}

fn encoder(mut file: Vectors, report: &mut Report) -> Outcome {
    let encoder = built(&file)?;
    let width = encoder.settings().width;
    let x = file.tensor("x")?.clone();
    let (batch, longest) = (x.shape[0], x.shape[1]);
    let padding = file.tensor("padding")?.u8("padding")?.to_vec();
    let lengths: Vec<usize> = padding
        .chunks_exact(longest)
        .map(|clip| clip.iter().map(|flag| usize::from(*flag == 0)).sum())
        .collect();
    let values = x.f32("x")?;
    let clips: Vec<&[f32]> = lengths
        .iter()
        .enumerate()
        .map(|(i, length)| &values[i * longest * FEATURES..][..length * FEATURES])
        .collect();
    let stages = encoder.stages(&clips);
    // Packed rows to padded ones, with zeros where a clip has ended.
    let padded = |packed: Vec<f32>, tokens: usize| -> Vec<f32> {
        let mut all = Vec::new();
        let mut start = 0;
        for length in &lengths {
            let rows = length + tokens;
            all.extend_from_slice(&packed[start * width..][..rows * width]);
            all.resize(all.len() + (longest - length) * width, 0.0);
            start += rows;
        }
        all
    };
    let projected = padded(to_host(stages.projected), 0);
    file.compare(report, "projected", &[batch, longest, width], &projected)?;
    let shape = [batch, longest + 2, width];
    let positions = padded(to_host(stages.with_positions), 2);
    file.compare(report, "with_positions", &shape, &positions)?;
    for (index, layer) in stages.layers.into_iter().enumerate() {
        let rows = padded(to_host(layer), 2);
        file.compare(report, &format!("layer{index}"), &shape, &rows)?;
    }
    let found = encoder.forward(&clips);
    let part = |logvar: bool| -> Vec<f32> {
        let parts = found.iter().map(|clip| {
            if logvar {
                clip.logvar.clone()
            } else {
                clip.mu.clone()
            }
        });
        parts.flatten().collect()
    };
    let tokens: Vec<f32> = found
        .iter()
        .flat_map(|clip| [clip.mu.clone(), clip.logvar.clone()].concat())
        .collect();
    file.compare(report, "tokens", &[batch, 2, width], &tokens)?;
    file.compare(report, "mu", &[batch, width], &part(false))?;
    file.compare(report, "logvar", &[batch, width], &part(true))?;
    file.finish(report);
    Ok(())
}

fn stored_statistics(folder: &Path) -> Outcome<[Vec<f32>; 2]> {
    let weights = Weights::read(&folder.join("stats/humanml3d.safetensors"))?;
    let get = |name: &str| -> Outcome<Vec<f32>> {
        Ok(weights.get(name, &[FEATURES])?.f32(name)?.to_vec())
    };
    Ok([get("mean")?, get("std")?])
}

fn clip(mut file: Vectors, folder: &Path, report: &mut Report) -> Outcome {
    let [mean, deviation] = stored_statistics(folder)?;
    let tmr = Tmr::new(built(&file)?, mean, deviation)?;
    let rate = file.settings["rate"].as_f64().ok_or("no rate")?;
    let feature_rate = file.settings["feature_rate"].as_f64().ok_or("no rate")?;
    let feature_rate = if (feature_rate - rate).abs() < 1e-9 {
        FeatureRate::Native
    } else {
        FeatureRate::Trained
    };
    let source = file.tensor("joints21")?.clone();
    let frames = source.shape[0];
    let values: Vec<f64> = source
        .f32("joints21")?
        .iter()
        .map(|value| f64::from(*value))
        .collect();
    let body = Array3::from_shape_vec((frames, 21, 3), values)?;
    let filled: Vec<Pose> = body
        .outer_iter()
        .map(|pose| {
            spine_filled(&std::array::from_fn(|j| {
                [pose[[j, 0]], pose[[j, 1]], pose[[j, 2]]]
            }))
        })
        .collect();
    file.compare(report, "joints22", &[frames, 22, 3], &joints(&filled))?;
    let input = tmr.input(body.view(), rate, feature_rate)?;
    file.compare(report, "input", &[input.len(), 22, 3], &joints(&input))?;
    let found = features(&input)?;
    let rows = columns(&found, 0, FEATURES);
    let shape = [found.rows.len(), FEATURES];
    file.compare(report, "features", &shape, &rows)?;
    file.compare(report, "normalised", &shape, &tmr.normalise(&rows))?;
    file.compare_bytes(report, "contacts", &[shape[0], 4], &contacts(&found))?;
    let mu = flat(&tmr.embed(body.view(), rate, feature_rate)?);
    file.compare(report, "mu", &[1, mu.len()], &mu)?;
    file.finish(report);
    Ok(())
}

fn scores(mut file: Vectors, report: &mut Report) -> Outcome {
    let rows = |name: &str| -> Outcome<(Vec<f64>, usize)> {
        let tensor = file.tensor(name)?;
        let values = tensor.f32(name)?.iter().map(|value| f64::from(*value));
        Ok((values.collect(), tensor.shape[1]))
    };
    let all = [rows("truth")?, rows("other")?, rows("paired")?];
    let mut views = Vec::new();
    for (values, width) in &all {
        views.push(ArrayView2::from_shape(
            (values.len() / width, *width),
            values,
        )?);
    }
    let (truth, other, paired) = (views[0], views[1], views[2]);
    let one = |value: Option<f64>| vec![value.unwrap_or(f64::NAN) as f32];
    let cosine = mean_cosine(truth, paired)?;
    for (name, found) in [
        ("fid", one(frechet_distance(truth, other, true)?)),
        ("fid_raw", one(frechet_distance(truth, other, false)?)),
        ("similarity", one(cosine.map(score01))),
        ("cosine", one(cosine)),
        ("cosines", flat(&cosines(truth, paired)?)),
    ] {
        file.compare(report, name, &[found.len()], &found)?;
    }
    file.finish(report);
    Ok(())
}

/// The pickled statistics are those of the safetensors file.
fn statistics(folder: &Path, report: &mut Report) -> Outcome {
    let folder = folder.join("stats");
    if !folder.join("mean.pt").is_file() {
        return Ok(());
    }
    let expected = stored_statistics(folder.parent().ok_or("no folder")?)?;
    for (name, expected) in ["mean", "std"].into_iter().zip(expected) {
        let mut checkpoint = Checkpoint::open(&folder.join(format!("{name}.pt")))?;
        let found = checkpoint.values(0)?;
        report.exact(format!("tmr/stats/{name}.pt"), &found, &expected);
    }
    Ok(())
}
