//! The rest of `vda/`: windows to a video, whole videos, labels as levels.

use reviv::labelling::levels::levels;
use reviv::labelling::plan::{self, plan};
use reviv::labelling::preprocess::{network_size, normalised, patches};
use reviv::labelling::stitch::Fit;
use reviv::labelling::{DepthLabelKind, DepthLabeller, LabelError, LabelOptions, Map, Stitcher};
use reviv::video::image::Image;
use serde_json::Value;

use super::Outcome;
use super::report::Report;
use super::vda::{built, frame, size, upload};
use super::vectors::Vectors;

fn kind(settings: &Value) -> Outcome<DepthLabelKind> {
    Ok(if settings["metric"].as_bool().ok_or("no kind")? {
        DepthLabelKind::Metric
    } else {
        DepthLabelKind::Relative
    })
}

/// Stitches windows `[K, 32, size]` of maps: the video, and what each window after the first was fitted by.
fn stitched(
    kind: DepthLabelKind,
    maps: &[f32],
    from: [usize; 2],
    size: [usize; 2],
    frames: usize,
) -> Outcome<(Vec<f32>, Vec<f32>)> {
    let pixels = from[0] * from[1];
    let mut stitcher = Stitcher::new(kind, size);
    let (mut depth, mut fits) = (Vec::new(), Vec::new());
    for (index, window) in maps.chunks_exact(32 * pixels).enumerate() {
        let window = window
            .chunks_exact(pixels)
            .enumerate()
            .map(|(slot, values)| {
                let map = Map {
                    values: values.to_vec(),
                    size: from,
                };
                (slot, map)
            })
            .collect();
        let fit: Fit = stitcher.push(window, Some(frames), &mut |_, map| {
            depth.extend(map);
            Ok::<(), LabelError>(())
        })?;
        if index > 0 {
            fits.extend([fit.scale as f32, fit.shift as f32]);
        }
    }
    Ok((depth, fits))
}

pub(super) fn windows(mut file: Vectors, report: &mut Report) -> Outcome {
    let kind = kind(&file.settings)?;
    let cases = file.settings["cases"].clone();
    for case in cases.as_array().ok_or("no cases")? {
        let name = case["name"].as_str().ok_or("no name")?;
        let frames = size(case, "frames")?;
        let own = [size(case, "height")?, size(case, "width")?];
        let input = format!("{name}.windows");
        let maps = file.tensor(&input)?.f32(&input)?.to_vec();
        let (depth, fits) = stitched(kind, &maps, own, own, frames)?;
        let shape = [frames, own[0], own[1]];
        file.compare(report, &format!("{name}.depth"), &shape, &depth)?;
        let fitted = format!("{name}.scale_shift");
        if file.has_output(&fitted) {
            file.compare(report, &fitted, &[fits.len() / 2, 2], &fits)?;
        }
    }
    file.finish(report);
    Ok(())
}

pub(super) fn video(mut file: Vectors, report: &mut Report) -> Outcome {
    let compute = super::compute();
    let network = built(&file, &compute)?;
    let kind = kind(&file.settings)?;
    let video = file.tensor("frames")?.clone();
    let [count, height, width, _] = video.shape[..] else {
        return Err("frames have not four axes".into());
    };
    let own = [height, width];
    let input_size = size(&file.settings, "input_size")?;
    let images: Vec<Image> = video
        .u8("frames")?
        .chunks_exact(height * width * 3)
        .map(|bytes| frame(bytes, height, width))
        .collect();
    // Every slot of every window, as the reference runs them.
    let patch = network.settings().patch;
    let seen = network_size(height, width, input_size, patch)?;
    let cells = seen.map(|side| side / patch);
    let positions = network.encoder().positions(cells);
    let features: Vec<_> = images
        .iter()
        .flat_map(|image| {
            let pixels = patches(&normalised(image, seen), seen, patch);
            let pixels = upload(pixels, 3 * patch * patch, &compute);
            network.encode(pixels, 1, cells, &positions)
        })
        .collect();
    let all: Vec<usize> = (0..32).collect();
    let (mut maps, mut full) = (Vec::new(), Vec::new());
    for slots in plan(count) {
        let window: Vec<_> = slots.iter().map(|slot| &features[*slot]).collect();
        network.decode(&window, &all, &mut |_, values| {
            let map = Map { values, size: seen };
            full.extend(map.resized(own));
            maps.extend(map.values);
            Ok::<(), LabelError>(())
        })?;
    }
    if file.has_output("windows") {
        let shape = [plan::windows(count), 32, height, width];
        file.compare(report, "windows", &shape, &full)?;
    }
    let (_, fits) = stitched(kind, &maps, seen, own, count)?;
    if file.has_output("scale_shift") {
        file.compare(report, "scale_shift", &[fits.len() / 2, 2], &fits)?;
    }
    // The result, as the product runs it.
    let labeller = DepthLabeller::new(network, kind, &compute);
    let mut depth = Vec::new();
    let frames = images.into_iter().map(Ok::<Image, LabelError>);
    labeller.label(frames, &LabelOptions { input_size }, &mut |_, map| {
        depth.extend(map);
        Ok(())
    })?;
    file.compare(report, "depth", &[count, height, width], &depth)?;
    file.finish(report);
    Ok(())
}

pub(super) fn labels(mut file: Vectors, report: &mut Report) -> Outcome {
    for (input, output, kind) in [
        ("disparity", "levels_relative", DepthLabelKind::Relative),
        ("metres", "levels_metric", DepthLabelKind::Metric),
    ] {
        let values = file.tensor(input)?.clone();
        let found = levels(kind, values.f32(input)?);
        file.compare_bytes(report, output, &values.shape, &found)?;
    }
    file.finish(report);
    Ok(())
}
