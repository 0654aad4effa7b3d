//! `optim/`: AdamW with parameter groups, clipping by the global norm, which parameters decay, learning rates.

use std::collections::BTreeMap;
use std::path::Path;

use burn::tensor::{Tensor, TensorData};
use reviv::engine::parameters::{Kind, to_host};
use reviv::engine::{Compute, Gradients, Parameter, Parameters};
use reviv::training::optimizer::decays;
use reviv::training::schedule::Shape;
use reviv::training::{AdamW, AdamWSettings, Schedule};
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vectors::{Vectors, json};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    adamw(Vectors::read(folder, "adamw")?, report)?;
    clip(Vectors::read(folder, "clip")?, report)?;
    groups(&json(&folder.join("groups.json"))?, report);
    rates(&json(&folder.join("lr.json"))?, report)
}

fn number(value: &Value) -> Outcome<f64> {
    Ok(value
        .as_f64()
        .ok_or_else(|| format!("{value} is no number"))?)
}

fn flat(values: &[f32], compute: &Compute) -> Tensor<1> {
    Tensor::from_data(
        TensorData::new(values.to_vec(), [values.len()]),
        compute.device(),
    )
}

/// The largest power of nested names: a map of parameters is a model.
fn adamw(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    let mut model: BTreeMap<String, Parameter> = BTreeMap::new();
    let outputs = file.outputs();
    let names: Vec<String> = outputs
        .iter()
        .filter_map(|name| name.strip_prefix("step0.param.").map(str::to_owned))
        .collect();
    for name in &names {
        let initial = file.tensor(&format!("init.{name}"))?;
        let values = initial.f32(name)?.to_vec();
        let parameter = Parameter::new(Kind::Trainable, values, &initial.shape, compute.device());
        model.insert(name.clone(), parameter);
    }
    model.start_training();
    let settings = &file.settings;
    let mut optimizer = AdamW::new(
        AdamWSettings {
            betas: [
                number(&settings["betas"][0])?,
                number(&settings["betas"][1])?,
            ],
            epsilon: number(&settings["eps"])?,
            weight_decay: number(&settings["weight_decay"])?,
            clip_norm: Some(number(&settings["clip"])?),
            shard: false,
            muon: false,
        },
        &model,
    );
    let rates = settings["lr"].as_array().ok_or("lr is a list")?.clone();
    for (step, rate) in rates.iter().enumerate() {
        let mut gradients = BTreeMap::new();
        for name in &names {
            let values = file.tensor(&format!("step{step}.grad.{name}"))?.f32(name)?;
            gradients.insert(name.clone(), flat(values, &compute));
        }
        let norm = optimizer.step(&mut model, Gradients::from_map(gradients), number(rate)?)?;
        file.compare(
            report,
            &format!("step{step}.grad_norm"),
            &[1],
            &[norm as f32],
        )?;
        for (name, parameter) in &model {
            let output = format!("step{step}.param.{name}");
            file.compare(report, &output, parameter.shape(), &parameter.to_vec())?;
        }
    }
    let state = optimizer.state()?.ok_or("the state of one rank")?;
    for (name, parameter) in &model {
        for kind in ["exp_avg", "exp_avg_sq"] {
            let values = state.get(&format!("{kind}.{name}"), &[parameter.len()])?;
            let output = format!("final.{kind}.{name}");
            file.compare(report, &output, parameter.shape(), values.f32(name)?)?;
        }
    }
    file.finish(report);
    Ok(())
}

fn clip(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    for case in 0.. {
        let Some(limit) = file.settings.get(format!("clip{case}.max_norm")) else {
            break;
        };
        let limit = number(limit)?;
        let mut map = BTreeMap::new();
        for part in 0..2 {
            let name = format!("clip{case}.g{part}");
            map.insert(
                part.to_string(),
                flat(file.tensor(&name)?.f32(&name)?, &compute),
            );
        }
        let gradients = Gradients::from_map(map);
        let norm = gradients.norm();
        file.compare(
            report,
            &format!("clip{case}.norm"),
            &[1],
            &[norm.read() as f32],
        )?;
        let factor = norm.clip_factor(limit);
        for (part, gradient) in gradients.iter() {
            let shape = file.tensor(&format!("clip{case}.g{part}"))?.shape.clone();
            let clipped = to_host(gradient.clone() * factor);
            file.compare(report, &format!("clip{case}.out{part}"), &shape, &clipped)?;
        }
    }
    file.finish(report);
    Ok(())
}

fn groups(file: &Value, report: &mut Report) {
    for (model, entry) in file.as_object().into_iter().flatten() {
        for group in entry["groups"].as_array().into_iter().flatten() {
            let expected = group["weight_decay"].as_f64() != Some(0.0);
            let names: Vec<&str> = group["names"]
                .as_array()
                .into_iter()
                .flatten()
                .filter_map(Value::as_str)
                .collect();
            let found: Vec<bool> = names.iter().map(|name| decays(name)).collect();
            let kind = if expected { "decay" } else { "no decay" };
            report.exact(
                format!("optim/groups {model} {kind}"),
                &found,
                &vec![expected; names.len()],
            );
        }
    }
}

fn rates(file: &Value, report: &mut Report) -> Outcome {
    let tolerance = number(&file["tol"])?;
    for (index, entry) in file["schedules"]
        .as_array()
        .into_iter()
        .flatten()
        .enumerate()
    {
        let count = |key: &str| entry[key].as_u64();
        let per_epoch = count("steps_per_epoch").ok_or("steps per epoch")?;
        let warmup = count("warmup_steps")
            .or_else(|| Some(count("warmup_epochs")? * per_epoch))
            .ok_or("warm-up")?;
        let kind = entry["kind"].as_str().ok_or("kind")?;
        let shape = if kind == "inverse_sqrt" {
            Shape::InverseSqrt {
                timescale: count("timescale").ok_or("timescale")?,
                cooldown_steps: count("cooldown_steps").ok_or("cool-down")?,
            }
        } else {
            Shape::Cosine
        };
        let total = count("total").ok_or("total")?;
        let steps = count("epochs").ok_or("epochs")? * per_epoch;
        if warmup > steps {
            // The reference's release runs on inside the warm-up; its ancestor stops, and so do we.
            let refused = Schedule::new(shape, 1.0, 0.0, warmup, steps).is_err();
            report.exact(
                format!("optim/lr {index} long warm-up is refused"),
                &[refused],
                &[true],
            );
        }
        let schedule = Schedule::new(
            shape,
            number(&entry["base"])?,
            number(&entry["final"])?,
            warmup,
            total,
        )?;
        for (step, value) in entry["values"].as_object().into_iter().flatten() {
            let found = schedule.rate(step.parse()?);
            let name = format!("optim/lr {index} step {step}");
            report.relative(name, &[found], &[number(value)?], tolerance);
        }
    }
    Ok(())
}
