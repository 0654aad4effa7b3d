//! Depth labels and the motion encoder: released files at their full size, videos of every shape, and the road from labels into
//! training.
#![allow(clippy::unwrap_used)] // a test that panics is a test that fails

use crate::shared;
use crate::torch::{self, Saved};
use reviv::engine::{Compute, Initialise, Parameters};
use reviv::evaluation::tmr::Tmr;
use reviv::evaluation::tmr::features::FEATURES;
use reviv::formats::npz::Npz;
use reviv::formats::png::{self, Picture};
use reviv::import::{ImportOptions, import};
use reviv::labelling::{DepthLabelKind, DepthLabeller, DepthNetwork, NetworkSettings, stored};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

fn tiny() -> NetworkSettings {
    NetworkSettings {
        patch: 14,
        grid: 4,
        width: 16,
        blocks: 4,
        heads: 2,
        hidden: 32,
        taps: [0, 1, 2, 3],
        levels: [8, 8, 32, 32],
        features: 32,
    }
}

/// A folder of a small network with random weights that says far and near.
pub fn random_network(folder: &Path, kind: DepthLabelKind) {
    std::fs::create_dir_all(folder).unwrap();
    let compute = Compute::cpu();
    let mut network = DepthNetwork::new(&Initialise::new(&compute, 4), &tiny()).unwrap();
    let mut weights = network.weights();
    // Away from zero, where the last step would cut everything off.
    weights.insert_f32("head.scratch.output_conv2.2.bias", vec![2.0], &[1]);
    network.load(&weights).unwrap();
    DepthLabeller::new(network, kind, &compute)
        .write(folder)
        .unwrap();
}

/// The entries of a name table: name and shape.
fn entries(table: &Path) -> Vec<(String, Vec<usize>)> {
    let text = std::fs::read_to_string(table).unwrap();
    text.lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| {
            let mut columns = line.split('\t');
            let name = columns.next().unwrap().to_owned();
            let shape = columns.next().unwrap().split('x');
            (name, shape.map(|side| side.parse().unwrap()).collect())
        })
        .collect()
}

/// A file as torch writes it, of zeros, at its full size.
fn synthesise(table: &Path, path: &Path, prefix: &str) {
    let tensors: Vec<Saved> = entries(table)
        .into_iter()
        .map(|(name, shape)| {
            let count = shape.iter().product();
            Saved {
                name: format!("{prefix}{name}"),
                shape,
                alias_of: None,
                values: Box::new(move || vec![0.0; count]),
            }
        })
        .collect();
    let file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    torch::save_state(file, &tensors);
}

fn vectors() -> Option<PathBuf> {
    Some(shared::folder()?.join("vectors"))
}

fn with_depth(kind: DepthLabelKind) -> ImportOptions {
    ImportOptions {
        depth: Some(kind),
        ..ImportOptions::default()
    }
}

#[test]
fn depth_networks_of_every_released_size_import() {
    let Some(vectors) = vectors() else { return };
    let metric = DepthLabelKind::Metric;
    for (size, settings) in [
        ("vits", NetworkSettings::small()),
        ("vitb", NetworkSettings::base()),
        ("vitl", NetworkSettings::large()),
    ] {
        let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let file = temporary
            .path()
            .join(format!("metric_video_depth_anything_{size}.pth"));
        synthesise(
            &vectors.join(format!("vda/structure/{size}.tsv")),
            &file,
            "",
        );
        let folder = temporary.path().join("model");
        let report = import(&[file], &folder, &with_depth(metric)).unwrap();
        assert_eq!(
            stored::described(&folder).unwrap(),
            (metric, settings.clone())
        );
        let compute = Compute::cpu();
        let network = DepthNetwork::new(&Initialise::meta(&compute), &settings).unwrap();
        let expected: usize = network
            .inventory()
            .iter()
            .map(|(_, shape, _)| shape.iter().product::<usize>())
            .sum();
        assert_eq!(report.parts[0].values, expected as u64, "{size}");
        let licence = report.notices.iter().any(|n| n.contains("CC BY-NC"));
        assert_eq!(licence, size != "vits");
    }
}

#[test]
fn a_depth_network_says_its_kind_only_by_the_user_and_doubts_are_told() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let file = temporary.path().join("video_depth_anything_vits.pth");
    synthesise(&vectors.join("vda/structure/vits.tsv"), &file, "");
    let folder = temporary.path().join("model");
    let files = [file];
    let error = import(&files, &folder, &ImportOptions::default()).unwrap_err();
    assert!(error.to_string().contains("--depth"), "{error}");
    let report = import(&files, &folder, &with_depth(DepthLabelKind::Metric)).unwrap();
    let told = report.notices.iter().any(|n| n.contains("relative depth"));
    assert!(told, "{:?}", report.notices);
}

#[test]
fn weights_of_other_models_are_refused_in_one_sentence() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir().unwrap();
    // A small model with the right names, and one of single pictures.
    let small = vectors.join("vda/a_model.pth");
    let folder = temporary.path().join("model");
    let options = with_depth(DepthLabelKind::Relative);
    let error = import(&[small], &folder, &options).unwrap_err().to_string();
    assert!(error.contains("neither Small, Base nor Large"), "{error}");
    let single = temporary.path().join("depth_anything_v2_vits.pth");
    let file = std::fs::File::create(&single).unwrap();
    let token = Saved {
        name: "pretrained.cls_token".to_owned(),
        shape: vec![1, 1, 384],
        alias_of: None,
        values: Box::new(|| vec![0.0; 384]),
    };
    torch::save_state(file, &[token]);
    let error = import(&[single], &folder, &options)
        .unwrap_err()
        .to_string();
    assert!(error.contains("single pictures"), "{error}");
    assert!(!folder.exists());
}

#[test]
fn the_motion_encoder_imports_alone_and_from_a_lightning_checkpoint_with_its_statistics() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let table = vectors.join("tmr/structure/motion_encoder.tsv");
    let statistics = ["mean", "std"].map(|name| vectors.join(format!("tmr/stats/{name}.pt")));
    for (file, prefix) in [("motion_encoder.pt", ""), ("last.ckpt", "motion_encoder.")] {
        let file = temporary.path().join(file);
        synthesise(&table, &file, prefix);
        let folder = temporary.path().join(format!("model{}", prefix.len()));
        let alone = import(
            std::slice::from_ref(&file),
            &folder,
            &ImportOptions::default(),
        );
        let error = alone.unwrap_err().to_string();
        assert!(error.contains("mean.pt"), "{error}");
        let files: Vec<PathBuf> = [file].into_iter().chain(statistics.clone()).collect();
        let report = import(&files, &folder, &ImportOptions::default()).unwrap();
        assert_eq!(report.parts[0].values, 4_806_656 + 2 * FEATURES as u64);
        let tmr = Tmr::open(&folder, &Compute::cpu()).unwrap();
        assert_eq!(tmr.encoder.settings().width, 256);
        let [mean, deviation] = tmr.statistics();
        assert!(mean.iter().any(|v| *v != 0.0) && deviation.iter().all(|v| *v > 0.0));
    }
}

fn reviv(arguments: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(arguments)
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A folder of pictures of a size; the first of them black.
fn pictures(folder: &Path, count: usize, height: usize, width: usize) {
    std::fs::create_dir_all(folder).unwrap();
    for frame in 0..count {
        let value = |y: usize, x: usize, c: usize| {
            if frame == 0 {
                0
            } else {
                ((y * 3 + x * 5 + c * 40 + frame * 9) % 256) as u8
            }
        };
        let picture =
            ndarray::Array3::from_shape_fn((height, width, 3), |(y, x, c)| value(y, x, c));
        png::write(
            &folder.join(format!("{frame:04}.png")),
            &Picture::Rgb8(picture),
        )
        .unwrap();
    }
}

#[test]
fn videos_of_every_length_and_shape_are_labelled() {
    let temporary = tempfile::tempdir().unwrap();
    let place = temporary.path();
    random_network(&place.join("relative"), DepthLabelKind::Relative);
    random_network(&place.join("metric"), DepthLabelKind::Metric);
    for (name, count, height, width) in [
        ("one", 1, 24, 32),
        ("thirty_three", 33, 20, 28),
        ("portrait", 3, 64, 30),
        ("large", 2, 1080, 1920),
    ] {
        pictures(&place.join(name), count, height, width);
        for kind in ["relative", "metric"] {
            let output = format!("{name}_{kind}");
            let run = reviv(
                &[
                    "data",
                    "label-depth",
                    name,
                    "-m",
                    kind,
                    "-o",
                    &output,
                    "--input-size",
                    "28",
                    "--max-side",
                    "640",
                ],
                place,
            );
            assert!(run.status.success(), "{}", said(&run));
            let npz = Npz::read(&place.join(&output).join("depth.npz")).unwrap();
            let depth: ndarray::Array3<f32> = npz.get("depth").unwrap().to_dim().unwrap();
            let expected = if name == "large" {
                (360, 640)
            } else {
                (height, width)
            };
            assert_eq!(depth.dim(), (count, expected.0, expected.1), "{name}");
            assert!(depth.iter().all(|value| value.is_finite() && *value >= 0.0));
            assert!(place.join(&output).join("preview.png").is_file());
            let text = std::fs::read_to_string(place.join(&output).join("depth.json")).unwrap();
            let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
            assert_eq!(summary["kind"], *kind);
        }
    }
    for format in ["png", "exr"] {
        let run = reviv(
            &[
                "data",
                "label-depth",
                "one",
                "-m",
                "metric",
                "-o",
                format,
                "--format",
                format,
                "--input-size",
                "28",
            ],
            place,
        );
        assert!(run.status.success(), "{}", said(&run));
        assert!(
            place
                .join(format)
                .join(format!("000000.{format}"))
                .is_file()
        );
    }
}

#[test]
fn a_wrong_folder_of_weights_or_an_existing_output_is_one_sentence() {
    let temporary = tempfile::tempdir().unwrap();
    let place = temporary.path();
    random_network(&place.join("metric"), DepthLabelKind::Metric);
    pictures(&place.join("video"), 1, 16, 16);
    std::fs::create_dir(place.join("empty")).unwrap();
    std::fs::create_dir(place.join("other")).unwrap();
    let weights = reviv::engine::Weights::default();
    weights
        .write(&place.join("other").join(stored::FILE))
        .unwrap();
    for (model, output, expected) in [
        ("empty", "out", "does not exist"),
        ("other", "out", "no weights of a depth network"),
        ("metric", "video", "exists already"),
    ] {
        let run = reviv(
            &["data", "label-depth", "video", "-m", model, "-o", output],
            place,
        );
        let said = said(&run);
        assert_eq!(run.status.code(), Some(1), "{said}");
        assert!(
            said.contains(expected) && !said.contains("panicked"),
            "{said}"
        );
        assert!(!place.join("out").exists());
    }
}

const ROAD: &str = "
experiment: road
seed: 3
stages:
  measured: {op: clips, source: {use: world_small, world: {size: 16, rooms: 2}}, train: 4, validation: 2}
  clips: {op: label_depth, clips: measured, network: network, input_size: 28, replace: true}
  tok_depth:
    op: train_tokenizer
    clips: clips
    modality: depth
    tokenizer: video_tiny
    steps: 2
    warmup: {steps: 1}
    batch: 1
  tok_gaze: {op: train_tokenizer, clips: clips, modality: gaze, tokenizer: vq_temporal_small, steps: 2, warmup: {steps: 1}, batch: 2}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_depth, tok_gaze]}
  mget:
    op: train_mget
    tokens: [tokens]
    size: laptop_small
    masking: dirichlet
    steps: 2
    warmup: {steps: 1}
    batch: 2
";

#[test]
fn labels_of_the_synthetic_world_go_into_training() {
    for kind in [DepthLabelKind::Relative, DepthLabelKind::Metric] {
        let temporary = tempfile::tempdir().unwrap();
        let place = temporary.path();
        random_network(&place.join("network"), kind);
        std::fs::write(place.join("road.yaml"), ROAD).unwrap();
        let run = reviv(&["run", "road.yaml", "--runs", "runs"], place);
        assert!(run.status.success(), "{}", said(&run));
        let manifest = walk(place)
            .into_iter()
            .filter(|path| path.ends_with("manifest.json"))
            .map(|path| std::fs::read_to_string(path).unwrap())
            .find(|text| text.contains("depth_labels"))
            .expect("the artifact says what its depth is");
        let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
        let labels = &manifest["contents"]["depth_labels"];
        assert_eq!(labels["kind"], kind.name());
        assert_eq!(labels["weights_sha256"].as_str().unwrap().len(), 64);
    }
}

fn walk(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.is_symlink() {
            found.extend(walk(&path));
        } else {
            found.push(path);
        }
    }
    found
}
