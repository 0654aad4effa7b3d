//! `vda/`: depth labels. Position tables, frames to input, temporal modules, whole networks with every stage, window plans; and
//! with [`vda_video`] alignment, whole videos, levels.

use std::collections::BTreeMap;
use std::path::Path;

use burn::tensor::{Tensor, TensorData};
use reviv::engine::parameters::to_host;
use reviv::engine::{Compute, HostTensor, Initialise, Parameters, Values, Weights};
use reviv::import::Checkpoint;
use reviv::labelling::encoder::resample_positions;
use reviv::labelling::head::Maps;
use reviv::labelling::plan::{self, plan};
use reviv::labelling::preprocess::{
    effective_input_size, limited_size, network_size, normalised, patches, stride,
};
use reviv::labelling::{DepthNetwork, LabelError, NetworkSettings};
use reviv::video::image::Image;
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vda_video;
use super::vectors::{Vectors, json, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for stem in stems(folder)? {
        let file = Vectors::read(folder, &stem)?;
        let kind = stem.split('_').next().unwrap_or_default();
        match kind {
            "positions" => positions(file, report),
            "preprocess" => preprocess(file, report),
            "motion" => motion(file, report),
            "net" => network(file, report),
            "windows" => vda_video::windows(file, report),
            "video" => vda_video::video(file, report),
            "labels" => vda_video::labels(file, report),
            _ => Err("vectors of an unknown kind".into()),
        }
        .map_err(|error| format!("vda/{stem}: {error}"))?;
    }
    checkpoints(folder, report)?;
    if folder.join("sizes.json").is_file() {
        sizes(&json(&folder.join("sizes.json"))?, report)?;
    }
    if folder.join("plan.json").is_file() {
        plans(&json(&folder.join("plan.json"))?, report)?;
    }
    Ok(())
}

pub(super) fn size(value: &Value, key: &str) -> Outcome<usize> {
    Ok(value[key]
        .as_u64()
        .ok_or_else(|| format!("no number `{key}`"))? as usize)
}

fn list(value: &Value) -> Outcome<Vec<usize>> {
    let items = value
        .as_array()
        .ok_or_else(|| format!("{value} is no list"))?;
    Ok(items
        .iter()
        .filter_map(Value::as_u64)
        .map(|n| n as usize)
        .collect())
}

fn four(value: &Value) -> Outcome<[usize; 4]> {
    Ok(list(value)?.try_into().map_err(|_| "not four numbers")?)
}

fn settings(file: &Value) -> Outcome<NetworkSettings> {
    let width = size(file, "dim")?;
    Ok(NetworkSettings {
        patch: size(file, "patch")?,
        grid: size(file, "grid")?,
        width,
        blocks: size(file, "depth")?,
        heads: size(file, "heads")?,
        hidden: width * size(file, "mlp_ratio")?,
        taps: four(&file["taps"])?,
        levels: four(&file["out_channels"])?,
        features: size(file, "features")?,
    })
}

/// The network of a file's checkpoint.
pub(super) fn built(file: &Vectors, compute: &Compute) -> Outcome<DepthNetwork> {
    let settings = settings(&file.settings)?;
    let mut network = DepthNetwork::new(&Initialise::empty(compute), &settings)?;
    network.load(&used(file.checkpoint()?))?;
    Ok(network)
}

/// Without what the network never runs.
fn used(mut weights: Weights) -> Weights {
    weights.tensors.retain(|name, _| {
        name != "pretrained.mask_token" && !name.contains("refinenet4.resConfUnit1")
    });
    weights
}

/// Rows `[frames * height * width, C]` as `[frames, C, height, width]`.
fn channels_first(maps: &Maps) -> (Vec<usize>, Vec<f32>) {
    let [_, channels] = maps.rows.dims();
    let (frames, [height, width]) = (maps.frames, maps.size);
    let rows = maps
        .rows
        .clone()
        .reshape([frames, height, width, channels])
        .permute([0, 3, 1, 2]);
    (vec![frames, channels, height, width], to_host(rows))
}

pub(super) fn upload(values: Vec<f32>, width: usize, compute: &Compute) -> Tensor<2> {
    let rows = values.len() / width;
    Tensor::from_data(TensorData::new(values, [rows, width]), compute.device())
}

fn positions(mut file: Vectors, report: &mut Report) -> Outcome {
    let (grid, width) = (size(&file.settings, "grid")?, size(&file.settings, "dim")?);
    let table = file.tensor("table")?.f32("table")?.to_vec();
    let sizes = file.settings["sizes_height_width"].clone();
    for pair in sizes.as_array().ok_or("no sizes")? {
        let pair = list(pair)?;
        let cells = [pair[0] / 14, pair[1] / 14];
        let found = if cells == [grid, grid] {
            table.clone()
        } else {
            resample_positions(&table, grid, width, cells)
        };
        let shape = [1, found.len() / width, width];
        let name = format!("h{}w{}", pair[0], pair[1]);
        file.compare(report, &name, &shape, &found)?;
    }
    file.finish(report);
    Ok(())
}

pub(super) fn frame(bytes: &[u8], height: usize, width: usize) -> Image {
    Image {
        width: width as u32,
        height: height as u32,
        data: bytes.to_vec(),
    }
}

fn preprocess(mut file: Vectors, report: &mut Report) -> Outcome {
    let cases = file.settings["cases"].clone();
    for case in cases.as_array().ok_or("no cases")? {
        let name = case["name"].as_str().ok_or("no name")?;
        let (height, width) = (size(case, "height")?, size(case, "width")?);
        let seen = network_size(height, width, size(case, "input_size")?, 14)?;
        let expected = [size(case, "net_height")?, size(case, "net_width")?];
        report.exact(format!("vda/preprocess {name} size"), &seen, &expected);
        let input = format!("{name}.frame");
        let image = frame(file.tensor(&input)?.u8(&input)?, height, width);
        let found = normalised(&image, seen);
        file.compare(report, &format!("{name}.x"), &[3, seen[0], seen[1]], &found)?;
    }
    file.finish(report);
    Ok(())
}

fn sizes(file: &Value, report: &mut Report) -> Outcome {
    for case in file["network_size"].as_array().ok_or("no sizes")? {
        let (height, width) = (size(case, "height")?, size(case, "width")?);
        let input = size(case, "input_size")?;
        let seen = network_size(height, width, input, 14)?;
        report.exact(
            format!("vda/sizes {width} x {height} at {input}"),
            &[
                effective_input_size(height, width, input, 14),
                seen[0],
                seen[1],
            ],
            &[
                size(case, "effective_input_size")?,
                size(case, "net_height")?,
                size(case, "net_width")?,
            ],
        );
    }
    for case in file["stride"].as_array().ok_or("no strides")? {
        let fps = case["source_fps"].as_f64().ok_or("no rate")?;
        let target = case["target_fps"].as_f64().filter(|target| *target > 0.0);
        let step = stride(fps, target);
        let kept: Vec<usize> = (0..size(case, "frames")?).step_by(step).collect();
        let name = format!("vda/stride {fps} to {target:?}");
        report.exact(
            name.clone(),
            &[step, kept.len()],
            &[size(case, "stride")?, size(case, "kept")?],
        );
        let first = list(&case["first_indices"])?;
        report.exact(name, &kept[..first.len().min(kept.len())], &first);
    }
    for case in file["max_res"].as_array().ok_or("no limits")? {
        let (height, width) = (size(case, "height")?, size(case, "width")?);
        // Without a limit there is nothing to do.
        let Ok(longest) = size(case, "max_res") else {
            continue;
        };
        report.exact(
            format!("vda/max_res {width} x {height} to {longest}"),
            &limited_size(height, width, longest),
            &list(&case["opencv"])?,
        );
    }
    Ok(())
}

fn plans(file: &Value, report: &mut Report) -> Outcome {
    report.exact(
        "vda/plan key slots".to_owned(),
        &plan::KEY_SLOTS,
        &list(&file["key_slots"])?,
    );
    for case in file["cases"].as_array().ok_or("no cases")? {
        let frames = size(case, "frames")?;
        let expected: Vec<usize> = case["source_frame"]
            .as_array()
            .ok_or("no slots")?
            .iter()
            .map(list)
            .collect::<Outcome<Vec<_>>>()?
            .concat();
        report.exact(
            format!("vda/plan {frames}"),
            &plan(frames).concat(),
            &expected,
        );
    }
    Ok(())
}

fn motion(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    let weights = file.checkpoint()?;
    let module = size(&file.settings, "module")?;
    let channels = size(&file.settings, "channels")?;
    let prefix = format!("head.motion_modules.{module}.temporal_transformer");
    let mut motion = reviv::labelling::motion::Motion::new(&Initialise::empty(&compute), channels);
    motion.load(&weights.below(&prefix))?;
    let x = file.tensor("x")?.clone();
    let [batch, _, frames, height, width] = x.shape[..] else {
        return Err("x has not five axes".into());
    };
    let each = x.values.len() / batch;
    let (pixels, rows) = (height * width, frames * height * width);
    let mut found: BTreeMap<String, Vec<f32>> = BTreeMap::new();
    for sample in x.f32("x")?.chunks_exact(each) {
        // [C, T, h, w] to rows of C.
        let sample =
            Tensor::<1>::from_data(TensorData::new(sample.to_vec(), [each]), compute.device());
        let packed = sample.reshape([channels, rows]).swap_dims(0, 1);
        let steps = motion.steps(packed, frames);
        let mut add = |name: &str, x: Tensor<2>| {
            found.entry(name.to_owned()).or_default().extend(to_host(x));
        };
        let group_norm: Tensor<2> = steps
            .group_norm
            .reshape([frames, pixels, channels])
            .swap_dims(1, 2)
            .reshape([frames * channels, pixels]);
        add("group_norm", group_norm);
        add("proj_in", steps.proj_in);
        for (index, [norm, mixed]) in steps.attention.into_iter().enumerate() {
            add(&format!("norm{index}"), norm);
            add(&format!("attention{index}"), mixed);
        }
        add("ff_norm", steps.ff_norm);
        add("geglu", steps.geglu);
        add("ff", steps.ff);
        add("block", steps.block);
        add("proj_out", steps.proj_out);
        add("y", steps.y.swap_dims(0, 1));
    }
    let all = batch * frames;
    for (name, values) in found {
        let shape = match name.as_str() {
            "group_norm" => vec![all, channels, height, width],
            "y" => x.shape.clone(),
            _ => vec![all, pixels, values.len() / (all * pixels)],
        };
        file.compare(report, &name, &shape, &values)?;
    }
    file.finish(report);
    Ok(())
}

fn network(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    let network = built(&file, &compute)?;
    let patch = network.settings().patch;
    let x = file.tensor("x")?.clone();
    let [batch, frames, _, height, width] = x.shape[..] else {
        return Err("x has not five axes".into());
    };
    let (each, seen) = (3 * height * width, [height, width]);
    let cells = seen.map(|side| side / patch);
    let positions = network.encoder().positions(cells);
    let mut depth = Vec::new();
    let mut stages: BTreeMap<String, (Vec<usize>, Vec<f32>)> = BTreeMap::new();
    for sample in x.f32("x")?.chunks_exact(frames * each) {
        let pixels: Vec<f32> = sample
            .chunks_exact(each)
            .flat_map(|picture| patches(picture, seen, patch))
            .collect();
        let pixels = upload(pixels, 3 * patch * patch, &compute);
        let features = network.encode(pixels.clone(), frames, cells, &positions);
        let window: Vec<_> = features.iter().collect();
        let all: Vec<usize> = (0..frames).collect();
        network.decode(&window, &all, &mut |_, map| {
            depth.extend(map);
            Ok::<(), LabelError>(())
        })?;
        for (name, (shape, values)) in staged(&network, pixels, frames, cells, &positions) {
            let entry = stages.entry(name).or_insert_with(|| (shape, Vec::new()));
            entry.1.extend(values);
        }
    }
    for (name, (mut shape, values)) in stages {
        shape[0] *= batch;
        if file.has_output(&name) {
            file.compare(report, &name, &shape, &values)?;
        }
    }
    file.compare(report, "depth", &[batch, frames, height, width], &depth)?;
    file.finish(report);
    Ok(())
}

type Stages = Vec<(String, (Vec<usize>, Vec<f32>))>;

/// Every stage of one window, all frames together.
fn staged(
    network: &DepthNetwork,
    pixels: Tensor<2>,
    frames: usize,
    cells: [usize; 2],
    positions: &Tensor<2>,
) -> Stages {
    let (encoder, head, settings) = (network.encoder(), network.head(), network.settings());
    let mut stages: Stages = Vec::new();
    let add_rows = |stages: &mut Stages, name: String, x: &Tensor<2>| {
        let [rows, width] = x.dims();
        let shape = vec![frames, rows / frames, width];
        stages.push((name, (shape, to_host(x.clone()))));
    };
    let embedded = encoder.embed(pixels);
    add_rows(&mut stages, "patch".to_owned(), &embedded);
    let mut tokens = encoder.tokens(embedded, frames, positions);
    add_rows(&mut stages, "tokens".to_owned(), &tokens);
    let mut features = Vec::new();
    for index in 0..settings.blocks {
        tokens = encoder.block(index, tokens, frames);
        add_rows(&mut stages, format!("block{index}"), &tokens);
        if settings.taps.contains(&index) {
            let feature = encoder.feature(tokens.clone(), frames);
            add_rows(&mut stages, format!("feature{}", features.len()), &feature);
            features.push(Maps {
                rows: feature,
                frames,
                size: cells,
            });
        }
    }
    let mut add = |name: String, maps: &Maps| stages.push((name, channels_first(maps)));
    let times = |n: usize| cells.map(|side| side * n);
    let mut levels = Vec::new();
    for (k, feature) in features.iter().enumerate() {
        let projected = head.project(k, feature);
        add(format!("project{k}"), &projected);
        let level = head.resize(k, &projected);
        add(format!("resize{k}"), &level);
        levels.push(level);
    }
    for (module, level) in [(0, 2), (1, 3)] {
        levels[level] = head.motion(module, &levels[level]);
        add(format!("motion{module}"), &levels[level]);
    }
    let rn: Vec<Maps> = (0..4).map(|k| head.rn(k, &levels[k])).collect();
    for (k, maps) in rn.iter().enumerate() {
        add(format!("rn{}", k + 1), maps);
    }
    let mut fused = head.fuse(3, &rn[3], None, cells);
    add("fuse4".to_owned(), &fused);
    fused = head.motion(2, &fused);
    add("motion2".to_owned(), &fused);
    fused = head.fuse(2, &fused, Some(&rn[2]), times(2));
    add("fuse3".to_owned(), &fused);
    fused = head.motion(3, &fused);
    add("motion3".to_owned(), &fused);
    fused = head.fuse(1, &fused, Some(&rn[1]), times(4));
    add("fuse2".to_owned(), &fused);
    fused = head.fuse(0, &fused, Some(&rn[0]), times(8));
    add("fuse1".to_owned(), &fused);
    let output = head.output(&fused);
    add("conv1".to_owned(), &output);
    let up = head.up(&output, times(settings.patch));
    add("up".to_owned(), &up);
    add("raw".to_owned(), &head.raw(&up));
    stages
}

/// Every `.pth` or `.pt` beside a `.safetensors` of the same name holds the same tensors, bit for bit.
pub fn checkpoints(folder: &Path, report: &mut Report) -> Outcome {
    let mut files: Vec<_> = std::fs::read_dir(folder)?
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| {
            path.extension().is_some_and(|e| e == "pth" || e == "pt")
                && path.with_extension("safetensors").is_file()
        })
        .collect();
    files.sort();
    for path in files {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
        let expected = Weights::read(&path.with_extension("safetensors"))?;
        let mut checkpoint = Checkpoint::open(&path)?;
        let mut found = Weights::default();
        for index in 0..checkpoint.entries().len() {
            let entry = &checkpoint.entries()[index];
            let (name, shape) = (entry.name.clone(), entry.shape());
            let values = Values::F32(checkpoint.values(index)?);
            found.tensors.insert(name, HostTensor { shape, values });
        }
        let same = found.tensors == expected.tensors;
        report.exact(
            format!("checkpoint {}", name.unwrap_or_default()),
            &[same],
            &[true],
        );
    }
    Ok(())
}
