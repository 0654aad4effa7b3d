//! `vq/`: the VQ-VAE tokenizers: stages, tokens, losses, gradients, codebook updates.

use std::path::Path;

use reviv::engine::parameters::to_host;
use reviv::engine::{Compute, Cuts, Gradients, Initialise, Parameters};
use reviv::modality::Shape;
use reviv::tokenizer::quantizer::{Assignment, Quantizer, Update};
use reviv::tokenizer::vq::{Batch, Loss, VqSettings, VqVae};
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vectors::{Vectors, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for stem in stems(folder)? {
        one(Vectors::read(folder, &stem)?, report)
            .map_err(|error| format!("vq/{stem}: {error}"))?;
    }
    Ok(())
}

/// One signal of the file's clip: values and, where the file has a flag, validity.
struct Clip {
    values: Vec<f32>,
    valid: Option<Vec<bool>>,
}

fn size(settings: &Value, key: &str) -> Outcome<usize> {
    Ok(settings[key]
        .as_u64()
        .ok_or_else(|| format!("no setting `{key}`"))? as usize)
}

fn build(file: &Vectors, compute: &Compute) -> Outcome<VqVae> {
    let settings = &file.settings;
    let kernel: Vec<usize> = settings["kernel"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(Value::as_u64)
        .map(|k| k as usize)
        .collect();
    let samples = size(settings, "frames")?;
    let clip = &file.tensor("clip")?.shape;
    let shape = if kernel.len() == 2 {
        Shape::Kinematic {
            samples,
            joints: clip[2],
        }
    } else {
        Shape::Temporal {
            samples,
            channels: size(settings, "in_channels")?,
        }
    };
    let number = |key: &str| {
        settings[key]
            .as_f64()
            .ok_or_else(|| format!("no setting `{key}`"))
    };
    let settings = VqSettings {
        codebook: size(settings, "codebook")?,
        code_width: size(settings, "latent")?,
        compression: kernel,
        width: size(settings, "dim")?,
        depth: size(settings, "depth")?,
        heads: size(settings, "heads")?,
        mlp_ratio: size(settings, "mlp_ratio")?,
        loss: if settings["recon_loss"] == "mse" {
            Loss::Mse
        } else {
            Loss::MaskedMse
        },
        ema_decay: number("decay")?,
        dead_below: number("dead_threshold")?,
        commitment_weight: number("commitment")?,
        ..VqSettings::default()
    };
    let mut model = VqVae::new(&Initialise::empty(compute), &settings, &shape)?;
    model.load(&file.checkpoint()?)?;
    Ok(model)
}

/// Splits the clip of the file into signals and flags.
fn clips(file: &Vectors, channels: usize) -> Outcome<Vec<Clip>> {
    let clip = file.tensor("clip")?;
    let stored = *clip.shape.last().ok_or("a clip has axes")?;
    let values = clip.f32("clip")?;
    let each = values.len() / clip.shape[0];
    let rows = values.chunks_exact(each).map(|signal| Clip {
        values: signal
            .chunks_exact(stored)
            .flat_map(|row| row[..channels].iter().copied())
            .collect(),
        valid: (stored > channels).then(|| {
            signal
                .chunks_exact(stored)
                .map(|row| row[channels] != 0.0)
                .collect()
        }),
    });
    Ok(rows.collect())
}

/// `[samples * tokens, width]` to `[samples, width, grid...]`, as the reference has it.
fn channel_first(rows: &[f32], samples: usize, width: usize) -> Vec<f32> {
    let tokens = rows.len() / samples / width;
    let mut out = Vec::with_capacity(rows.len());
    for sample in rows.chunks_exact(tokens * width) {
        for channel in 0..width {
            out.extend((0..tokens).map(|token| sample[token * width + channel]));
        }
    }
    out
}

/// The inverse of [`channel_first`].
fn channel_last(values: &[f32], samples: usize, width: usize) -> Vec<f32> {
    let tokens = values.len() / samples / width;
    channel_first(values, samples, tokens)
}

fn ids(assignment: &[u32]) -> Vec<i64> {
    assignment.iter().map(|id| i64::from(*id)).collect()
}

/// Moves the codebook as the file's step `prefix` does, with its replacement rows.
fn update(
    quantizer: &mut Quantizer,
    assignment: &Assignment,
    file: &Vectors,
    prefix: &str,
) -> Outcome<Update> {
    let name = format!("{prefix}replacement_rows");
    let rows: Vec<usize> = file
        .tensor(&name)?
        .i64(&name)?
        .iter()
        .map(|row| *row as usize)
        .collect();
    let sums = quantizer.sums(assignment);
    Ok(quantizer.update_from(&sums, &assignment.unit, |_| rows))
}

fn flags(update: &Update, codes: usize) -> Vec<bool> {
    (0..codes).map(|code| update.dead.contains(&code)).collect()
}

fn one(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    let mut model = build(&file, &compute)?;
    let (width, code) = (model.settings().width, model.settings().code_width);
    let codes = model.settings().codebook;
    let clips = clips(&file, model.patches().channels())?;
    let batch = model.batch(
        clips
            .iter()
            .map(|clip| (clip.values.as_slice(), clip.valid.as_deref())),
    );
    let samples = clips.len();
    let mut start = model.quantizer().clone();

    let with = |first: &[usize], rest: &[usize]| -> Vec<usize> { [first, rest].concat() };
    let grid = model.patches().grid();
    let token_shape = with(&[samples], &grid);
    let signal_shape = with(&[samples], &model.patches().signal_shape());
    evaluate(
        &model,
        &batch,
        &clips,
        &mut file,
        report,
        &grid,
        &signal_shape,
    )?;

    model.start_training();
    let trained = model.forward_training(&batch, &mut Cuts::none());
    let numbers = trained.numbers.read();
    for (name, value) in [
        ("train_recon_loss", numbers[1]),
        ("train_commit_loss", numbers[2]),
        (
            "train_total_loss",
            f64::from(to_host(trained.loss.clone())[0]),
        ),
    ] {
        file.compare(report, name, &[1], &[value as f32])?;
    }
    let gradients = Gradients::of(&trained.loss, &model);
    file.compare(
        report,
        "grad_norm_all",
        &[1],
        &[gradients.norm().read() as f32],
    )?;
    for (name, shape, _) in model.inventory() {
        let output = format!("grad.{name}");
        if let (Some(gradient), true) = (gradients.get(&name), file.has_output(&output)) {
            file.compare(report, &output, &shape, &to_host(gradient.clone()))?;
        }
    }
    let moved = update(
        model.quantizer_mut(),
        &trained.assigned.to_host(),
        &file,
        "",
    )?;
    file.compare_flags(report, "dead_after_ema", &[codes], &flags(&moved, codes))?;
    file.compare(
        report,
        "cb_embed_after",
        &[codes, code],
        &model.quantizer().codes(),
    )?;
    file.compare(
        report,
        "cb_cluster_size_after",
        &[codes],
        &model.quantizer().counts(),
    )?;
    debug_assert!(token_shape.iter().product::<usize>() * width > 0);

    for step in 0.. {
        let prefix = format!("ema{step}.");
        let name = format!("{prefix}z");
        let Ok(z) = file.tensor(&name) else {
            break;
        };
        let (samples, shape) = (z.shape[0], z.shape.clone());
        let z = channel_last(z.f32(&name)?, samples, code);
        let assignment = start.assign(z.clone());
        let quantised = start.look_up(&assignment.ids);
        let step_by: Vec<f32> = quantised.iter().zip(&z).map(|(q, z)| q - z).collect();
        let out: Vec<f32> = z.iter().zip(&step_by).map(|(z, step)| z + step).collect();
        let square: f64 = step_by.iter().map(|value| f64::from(*value).powi(2)).sum();
        let moved = update(&mut start, &assignment, &file, &prefix)?;
        let token_shape = with(&shape[..1], &shape[2..]);
        file.compare_ids(
            report,
            &format!("{prefix}indices"),
            &token_shape,
            &ids(&assignment.ids),
        )?;
        file.compare(
            report,
            &format!("{prefix}out"),
            &shape,
            &channel_first(&out, samples, code),
        )?;
        file.compare(
            report,
            &format!("{prefix}loss"),
            &[1],
            &[(square / out.len() as f64) as f32],
        )?;
        file.compare_flags(
            report,
            &format!("{prefix}dead"),
            &[codes],
            &flags(&moved, codes),
        )?;
        file.compare(
            report,
            &format!("{prefix}embed_after"),
            &[codes, code],
            &start.codes(),
        )?;
        file.compare(
            report,
            &format!("{prefix}cluster_size_after"),
            &[codes],
            &start.counts(),
        )?;
    }
    file.finish(report);
    Ok(())
}

/// The stages of one pass without training.
fn evaluate(
    model: &VqVae,
    batch: &Batch,
    clips: &[Clip],
    file: &mut Vectors,
    report: &mut Report,
    grid: &[usize],
    signal_shape: &[usize],
) -> Outcome {
    let (width, code) = (model.settings().width, model.settings().code_width);
    let samples = clips.len();
    let shaped = |channels: usize| [&[samples, channels], grid].concat();
    let hidden = model.encode_hidden(batch, &mut Cuts::none());
    let states = to_host(hidden.clone());
    file.compare(
        report,
        "enc_out",
        &shaped(width),
        &channel_first(&states, samples, width),
    )?;
    let latents = to_host(model.latents(hidden));
    file.compare(
        report,
        "latent",
        &shaped(code),
        &channel_first(&latents, samples, code),
    )?;
    let tokens = model.encode(batch);
    file.compare_ids(
        report,
        "indices",
        &[&[samples], grid].concat(),
        &ids(&tokens),
    )?;
    let quantised = model.quantizer().look_up(&tokens);
    file.compare(
        report,
        "quant",
        &shaped(code),
        &channel_first(&quantised, samples, code),
    )?;

    let found = model.decode(&tokens, samples);
    let loss = to_host(model.loss(found.clone(), batch))[0];
    file.compare(report, "recon_loss", &[1], &[loss])?;
    let rows = to_host(found);
    let signals: Vec<f32> = rows
        .chunks_exact(rows.len() / samples)
        .flat_map(|patches| model.patches().join(patches))
        .collect();
    file.compare(report, "recon", signal_shape, &signals)?;
    let stored = clips.iter().flat_map(|clip| &clip.values);
    let square: f64 = signals
        .iter()
        .zip(stored)
        .map(|(a, b)| f64::from(a - b).powi(2))
        .sum();
    file.compare(
        report,
        "mse_plain",
        &[1],
        &[(square / signals.len() as f64) as f32],
    )?;
    Ok(())
}
