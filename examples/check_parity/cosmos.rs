//! `cosmos/`: wavelet, padding, scalar quantisation, and whole networks from safetensors and from TorchScript archives.

use std::path::Path;

use burn::tensor::{Tensor, TensorData};
use reviv::engine::parameters::to_host;
use reviv::engine::{Cuts, Initialise, Parameters, Weights};
use reviv::tokenizer::video::layers::Extent;
use reviv::tokenizer::video::padding::Padding;
use reviv::tokenizer::video::{Fsq, Network, VideoSettings, haar};
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vectors::{Vectors, json, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for stem in stems(folder)? {
        let file = Vectors::read(folder, &stem)?;
        match stem.as_str() {
            "fsq" => fsq(file, report),
            "haar" => wavelet(file, report),
            _ => network(file, report),
        }
        .map_err(|error| format!("cosmos/{stem}: {error}"))?;
    }
    padding(&json(&folder.join("padding.json"))?, report)
}

fn sizes(value: &Value) -> Outcome<Vec<usize>> {
    let list = value
        .as_array()
        .ok_or_else(|| format!("{value} is no list"))?;
    Ok(list
        .iter()
        .filter_map(Value::as_u64)
        .map(|n| n as usize)
        .collect())
}

fn size(settings: &Value, key: &str) -> Outcome<usize> {
    Ok(settings[key]
        .as_u64()
        .ok_or_else(|| format!("no setting `{key}`"))? as usize)
}

/// `[B, C, rest..]` to `[B, rest.., C]`, or back.
fn channels(values: &[f32], shape: &[usize], last: bool) -> Vec<f32> {
    let (batch, channels) = (shape[0], shape[1]);
    let rest: usize = shape[2..].iter().product();
    let mut out = vec![0.0; values.len()];
    for b in 0..batch {
        for c in 0..channels {
            for i in 0..rest {
                let (first, then) = ((b * channels + c) * rest + i, (b * rest + i) * channels + c);
                let (to, from) = if last { (then, first) } else { (first, then) };
                out[to] = values[from];
            }
        }
    }
    out
}

fn fsq(mut file: Vectors, report: &mut Report) -> Outcome {
    let fsq = Fsq::new(&sizes(&file.settings["levels"])?);
    let width = fsq.width();
    let ids = |tokens: Vec<u32>| -> Vec<i64> { tokens.into_iter().map(i64::from).collect() };
    let z = file.tensor("z")?.f32("z")?.to_vec();
    let rows = z.len() / width;
    let bound = fsq.bound(&z);
    let tokens = fsq.encode(&z);
    let code = fsq.decode(&tokens);
    for name in ["index", "index_reference_f32"] {
        file.compare_ids(report, name, &[rows], &ids(tokens.clone()))?;
    }
    file.compare(report, "bound", &[rows, width], &bound)?;
    file.compare(report, "code", &[rows, width], &code)?;
    let ties = file.tensor("after_bound_ties")?.f32("ties")?.to_vec();
    let tokens = fsq.index(&ties);
    let shape = [tokens.len(), width];
    file.compare(
        report,
        "after_bound_ties.code",
        &shape,
        &fsq.decode(&tokens),
    )?;
    file.compare_ids(report, "after_bound_ties.index", &shape[..1], &ids(tokens))?;
    let tokens: Vec<u32> = file
        .tensor("indices")?
        .i64("indices")?
        .iter()
        .map(|id| *id as u32)
        .collect();
    let shape = [tokens.len(), width];
    file.compare(report, "indices_to_codes", &shape, &fsq.decode(&tokens))?;
    file.finish(report);
    Ok(())
}

fn wavelet(mut file: Vectors, report: &mut Report) -> Outcome {
    const PATCH: usize = 4;
    let names = file.outputs();
    for name in names.iter().filter_map(|name| name.strip_suffix(".y")) {
        let x = file.tensor(&format!("{name}.x"))?.clone();
        let v = file.tensor(&format!("{name}.v"))?.clone();
        let (x_shape, v_shape) = (x.shape.clone(), v.shape.clone());
        let size = [x_shape[2], x_shape[3], x_shape[4], x_shape[1]];
        let each = size.iter().product();
        let video = channels(x.f32(name)?, &x_shape, true);
        let coefficients = channels(v.f32(name)?, &v_shape, true);
        let mut y = Vec::new();
        let mut back = Vec::new();
        for clip in video.chunks_exact(each) {
            let one = haar::forward(clip, size, PATCH);
            back.extend(haar::inverse(&one, size, PATCH));
            y.extend(one);
        }
        let unpatched: Vec<f32> = coefficients
            .chunks_exact(y.len() / x_shape[0])
            .flat_map(|one| haar::inverse(one, size, PATCH))
            .collect();
        let y = channels(&y, &v_shape, false);
        file.compare(report, &format!("{name}.y"), &v_shape, &y)?;
        for (part, values) in [("back", back), ("unpatch_v", unpatched)] {
            let values = channels(&values, &x_shape, false);
            file.compare(report, &format!("{name}.{part}"), &x_shape, &values)?;
        }
    }
    file.finish(report);
    Ok(())
}

fn padding(file: &Value, report: &mut Report) -> Outcome {
    for (index, case) in file["cases"]
        .as_array()
        .ok_or("no cases")?
        .iter()
        .enumerate()
    {
        let clip = [size(case, "T")?, size(case, "H")?, size(case, "W")?];
        let padding = Padding::of(clip, 4, 8);
        let mut region = padding.start.to_vec();
        region.extend((0..3).map(|axis| padding.start[axis] + clip[axis]));
        let frames: Vec<usize> = (0..padding.padded[0])
            .map(|frame| padding.source_frame(frame))
            .collect();
        let name = |part: &str| format!("cosmos/padding {index} {part}");
        report.exact(name("padded"), &padding.padded, &sizes(&case["padded"])?);
        report.exact(name("region"), &region, &sizes(&case["crop_region"])?);
        report.exact(name("frames"), &frames, &sizes(&case["source_frame"])?);
        let padded = padding.pad(&vec![1.0; clip.iter().product()], 1);
        let zero = case["corner_is_zero"].as_bool().ok_or("no corner")?;
        report.exact(name("corner"), &[padded[0] == 0.0], &[zero]);
    }
    Ok(())
}

/// The settings of a file, as ours.
fn settings(file: &Value) -> Outcome<VideoSettings> {
    Ok(VideoSettings {
        channels: size(file, "channels")?,
        multipliers: sizes(&file["channels_mult"])?,
        blocks: size(file, "num_res_blocks")?,
        patch: size(file, "patch")?,
        latent_channels: size(file, "z_channels")?,
        levels: sizes(&file["levels"])?,
        spatial: size(file, "spatial_compression")?,
        temporal: size(file, "temporal_compression")?,
    })
}

fn network(mut file: Vectors, report: &mut Report) -> Outcome {
    let settings = settings(&file.settings)?;
    let compute = super::compute();
    let mut network = Network::new(&Initialise::empty(&compute), &settings)?;
    let unused = settings.never_run();
    let mut weights: Weights = file.checkpoint()?;
    weights
        .tensors
        .retain(|name, _| !unused.iter().any(|prefix| name.starts_with(prefix)));
    network.load(&weights)?;

    let video = file.tensor("video")?.clone();
    let shape = &video.shape;
    let pixels = [shape[2], shape[3], shape[4], shape[1]];
    let clip = channels(video.f32("video")?, shape, true);
    let coefficients = haar::forward(&clip, pixels, settings.patch);
    let rows = coefficients.len() / settings.coefficients();
    let x = Tensor::from_data(
        TensorData::new(coefficients, [rows, settings.coefficients()]),
        compute.device(),
    );
    let extent = Extent {
        samples: 1,
        frames: pixels[0].div_ceil(settings.patch),
        height: pixels[1] / settings.patch,
        width: pixels[2] / settings.patch,
    };
    let (hidden, _) = network.hidden(x.clone(), extent, &mut Cuts::none());
    let (latent, extent) = network.encode(x, extent, &mut Cuts::none());
    let fsq = Fsq::new(&settings.levels);
    let z = to_host(latent);
    let tokens = fsq.encode(&z);
    let code = fsq.decode(&tokens);
    let grid = [1, extent.frames, extent.height, extent.width];
    let latent_shape = |channels: usize| [1, channels, grid[1], grid[2], grid[3]];
    for (name, values, width) in [
        ("enc", to_host(hidden), settings.latent_channels),
        ("latent", z, fsq.width()),
        ("code", code.clone(), fsq.width()),
    ] {
        let shape = latent_shape(width);
        file.compare(report, name, &shape, &channels(&values, &shape, false))?;
    }
    let ids: Vec<i64> = tokens.iter().map(|id| i64::from(*id)).collect();
    for name in ["indices", "indices_reference_f32"] {
        file.compare_ids(report, name, &grid, &ids)?;
    }
    let code = Tensor::from_data(
        TensorData::new(code, [tokens.len(), fsq.width()]),
        compute.device(),
    );
    let (coefficients, _) = network.decode(code, extent, &mut Cuts::none());
    let back = haar::inverse(&to_host(coefficients), pixels, settings.patch);
    file.compare(report, "recon", shape, &channels(&back, shape, false))?;
    file.finish(report);
    Ok(())
}
