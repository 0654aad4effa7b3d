//! Modalities that `src/` does not know, from clips to a row of a table: one declared in YAML, one computed by a plug-in crate.

use self::object_pose::{OBJECT, ObjectPath, ObjectTrack};
use crate::run_text::{failures, run_text};
use nalgebra::{UnitQuaternion, Vector3};
use reviv::clip::store::ClipSet;
use reviv::clip::{CAMERA, CameraTrack, Clip};
use reviv::evaluation::table::{RowKind, Table};
use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::{Request, load};
use reviv::formats::npz::Npz;
use reviv::geometry::rigid::{Rigid, level_camera};
use reviv::reconstruction::folder::{FOLDER, PAGE};
use reviv::reconstruction::predictions::Predictions;
use reviv::reconstruction::stitch::Stitcher;
use reviv::reconstruction::windows::windows;
use reviv::run::Cache;
use reviv::run::State;
use serde_json::Value;
use std::path::{Path, PathBuf};

// The example crate's own files: this test program links them in as the crate's binary does.
#[path = "../../examples/plugin_modality/src/feet_contact.rs"]
mod feet_contact;
#[path = "../../examples/plugin_modality/src/head_turn.rs"]
mod head_turn;
#[path = "../../examples/plugin_modality/src/object_pose.rs"]
#[allow(non_snake_case, reason = "transforms are named `T_to_from`")]
mod object_pose;

const EXPERIMENT: &str = "
experiment: plugins
about: Two modalities that are not built in, and one that is.
stages:
  clips:
    op: clips
    source: {use: world_small, world: {size: 16, rooms: 3}}
    train: 12
    validation: 2
    test: 4
    declared: [head_imu, head_turn]
  tok_imu: {op: train_tokenizer, clips: clips, modality: head_imu, steps: 3, batch: 4, warmup: {steps: 0}, kmeans: false}
  tok_turn:
    op: train_tokenizer
    clips: clips
    modality: head_turn
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 5
    warmup: {steps: 0}
  tok_camera:
    op: train_tokenizer
    clips: clips
    modality: camera
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 3
    warmup: {steps: 0}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_imu, tok_turn, tok_camera]}
  mget:
    op: train_mget
    tokens: [tokens]
    size: {use: laptop_small, width: 24, heads: 2, encoder_depth: 1, decoder_depth: 1}
    masking: {use: dirichlet_mixture, input_tokens: 30, target_tokens: 30}
    steps: 3
    batch: 4
    warmup: {steps: 1}
  predictions: {op: predict, model: mget, clips: clips, inputs: [camera]}
  scores: {op: evaluate, predictions: predictions, clips: clips, suite: {use: world_camera, metrics: []}}
  table: {op: table, scores: [scores]}
";

const ODD: &str = "
experiment: odd
about: A pose of a type of its own and two channels with a metric of their own, from clips to a table and a page.
stages:
  clips:
    op: clips
    source: {use: world_small, world: {size: 16, rooms: 3}}
    train: 12
    validation: 2
    test: 4
    declared: [object_pose, feet_contact]
  tok_object: {op: train_tokenizer, clips: clips, modality: object_pose, tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}, steps: 5, warmup: {steps: 0}}
  tok_feet: {op: train_tokenizer, clips: clips, modality: feet_contact, tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}, steps: 5, warmup: {steps: 0}}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}, steps: 5, warmup: {steps: 0}}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_object, tok_feet, tok_camera], pixels: rgb}
  mget:
    op: train_mget
    tokens: [tokens]
    size: {use: laptop_small, width: 24, heads: 2, encoder_depth: 1, decoder_depth: 1}
    masking: {use: dirichlet_mixture, input_tokens: 30, target_tokens: 30}
    pixels: rgb
    tubelet: [4, 16, 16]
    steps: 3
    batch: 4
    warmup: {steps: 1}
  predictions: {op: predict, model: mget, clips: clips, inputs: [pixels]}
  scores: {op: evaluate, predictions: predictions, clips: clips, suite: {use: world_camera, metrics: []}}
  table: {op: table, scores: [scores]}
  view: {op: reconstruct, model: mget, clips: clips, inputs: [pixels]}
";

fn run(folder: &Path) -> PathBuf {
    let outcome = run_text(folder, EXPERIMENT).unwrap_or_else(|report| panic!("{report}"));
    assert_eq!(outcome.state, State::Done, "{:?}", failures(&outcome));
    folder.join("runs")
}

/// What a stage of this op (and modality) left, with its manifest's contents.
fn made(runs: &Path, op: &str, modality: &str) -> (PathBuf, Value) {
    let entries = Cache::of(runs).entries().unwrap();
    let found = entries.into_iter().find_map(|leaf| {
        let text = std::fs::read_to_string(leaf.path.join("manifest.json")).ok()?;
        let manifest: Value = serde_json::from_str(&text).ok()?;
        let contents = manifest["contents"].clone();
        let named = contents["modality"].as_str().unwrap_or_default() == modality;
        (manifest["recipe"]["op"] == op && named).then_some((leaf.path, contents))
    });
    found.unwrap_or_else(|| panic!("no {op} of {modality}"))
}

#[test]
fn declared_and_coded_modalities_reach_the_table_beside_their_baseline() {
    let folder = tempfile::tempdir().unwrap();
    let runs = run(folder.path());
    // The entry's own tokenizer, as no stage names one.
    let (_, tokenizer) = made(&runs, "train_tokenizer", "head_imu");
    assert_eq!(tokenizer["tokenizer"], "vq_temporal_small");
    assert_eq!(tokenizer["tokens"]["head_imu"]["vocabulary"], 512);
    let (_, tokenizer) = made(&runs, "train_tokenizer", "head_turn");
    assert_eq!(tokenizer["tokens"]["head_turn"]["vocabulary"], 16);
    // The entries' own metrics, as the suite names none.
    let (path, _) = made(&runs, "table", "");
    let text = std::fs::read_to_string(path.join("table.json")).unwrap();
    let table: Table = serde_json::from_str(&text).unwrap();
    let columns: Vec<&str> = table.columns.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(columns, ["head_imu.rmse", "head_turn.rmse"]);
    let row = |label: &str, kind: RowKind| {
        let found = table
            .rows
            .iter()
            .find(|r| r.label == label && r.kind == kind);
        found.unwrap_or_else(|| panic!("no row `{label}`: {:?}", table.rows))
    };
    let own = row("reviv", RowKind::System);
    let mean = row("mean value", RowKind::Baseline);
    let floor = row("reconstruction bound", RowKind::Baseline);
    for ((own, mean), floor) in own.cells.iter().zip(&mean.cells).zip(&floor.cells) {
        assert_eq!((own.n, mean.n, floor.n), (4, 4, 4));
        for cell in [own, mean, floor] {
            assert!(cell.value.unwrap() > 0.0);
        }
    }
    let page = std::fs::read_to_string(path.join("report/table.md")).unwrap();
    assert!(path.join("report/table_intervals.svg").is_file());
    assert!(
        page.contains("head_imu.rmse") && page.contains("mean value"),
        "{page}"
    );
    the_clock_is_in_the_record_alone(&runs);
}

/// Seconds per clip and part, and none of them in an artifact.
fn the_clock_is_in_the_record_alone(runs: &Path) {
    let record = std::fs::read_dir(runs)
        .unwrap()
        .map(|entry| {
            entry
                .unwrap()
                .path()
                .join("stages/predictions/metrics.jsonl")
        })
        .find(|path| path.is_file())
        .unwrap();
    let record = std::fs::read_to_string(record).unwrap();
    for part in ["read", "encode", "generate", "detokenize"] {
        assert!(
            record.contains(&format!("seconds_per_clip/{part}")),
            "{record}"
        );
    }
    let (path, _) = made(runs, "predict", "");
    let text = std::fs::read_to_string(path.join("manifest.json")).unwrap();
    assert!(!text.contains("seconds_per_clip"));
}

#[test]
fn modalities_of_another_shape_go_from_clips_to_a_table_and_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let outcome = run_text(folder.path(), ODD).unwrap_or_else(|report| panic!("{report}"));
    assert_eq!(outcome.state, State::Done, "{:?}", failures(&outcome));
    let runs = folder.path().join("runs");

    // Clips hold the plug-in's own type, in shards too.
    let (path, _) = made(&runs, "clips", "");
    let clip = ClipSet::open(&path.join("test")).unwrap().clip(0).unwrap();
    let track = clip.get(OBJECT).unwrap();
    assert_eq!(track.T_first_object.len(), 60);
    assert!(track.T_first_object.iter().any(Option::is_some));
    assert_eq!(clip.signal("feet_contact").unwrap().values.shape(), [60, 2]);
    let (path, _) = made(&runs, "predict", "");
    let predicted = Predictions::open(&path).unwrap().load(0).unwrap();
    assert_eq!(predicted.get(OBJECT).unwrap().T_first_object.len(), 60);

    // Scores, each beside its own baseline and its tokenizer's bound.
    let (path, _) = made(&runs, "table", "");
    let text = std::fs::read_to_string(path.join("table.json")).unwrap();
    let table: Table = serde_json::from_str(&text).unwrap();
    let columns: Vec<&str> = table.columns.iter().map(|c| c.name.as_str()).collect();
    let expected = [
        "feet_contact.accuracy",
        "object_pose.position",
        "object_pose.rotation",
    ];
    assert_eq!(columns, expected);
    let has = |label: &str| {
        let row = table.rows.iter().find(|row| row.label == label);
        let row = row.unwrap_or_else(|| panic!("no row `{label}`: {:?}", table.rows));
        row.cells
            .iter()
            .map(|cell| cell.value.is_some())
            .collect::<Vec<bool>>()
    };
    assert_eq!(has("reviv"), [true; 3]);
    assert_eq!(has("reconstruction bound"), [true; 3]);
    assert_eq!(has("mean value"), [true, false, false]);
    assert_eq!(has("still object"), [false, true, true]);

    // The reconstruction has arrays of both, and the page draws both beside their truth.
    let (path, contents) = made(&runs, "reconstruct", "");
    assert_eq!(
        contents["modalities"],
        serde_json::json!(["camera", "feet_contact", "object_pose"])
    );
    let path = path.join(FOLDER);
    let poses = Npz::read(&path.join("object_pose.npz")).unwrap();
    assert_eq!(poses.get("T_world_object").unwrap().shape, [60, 4, 4]);
    let feet = Npz::read(&path.join("feet_contact.npz")).unwrap();
    assert_eq!(feet.get("feet_contact").unwrap().shape, [60, 2]);
    assert_eq!(feet.get("feet_contact_valid").unwrap().shape, [60]);
    let manifest = std::fs::read_to_string(path.join("manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&manifest).unwrap();
    let arrays = manifest["arrays"].as_array().unwrap();
    let about = |name: &str| arrays.iter().find(|array| array["name"] == name).unwrap();
    assert_eq!(
        about("T_world_object")["scale"]["metric"]["by"],
        "learning from metric data"
    );
    assert_eq!(about("feet_contact")["frame"], "body");
    let page = std::fs::read_to_string(path.join(PAGE)).unwrap();
    for track in ["prediction", "truth"] {
        for modality in ["object_pose", "feet_contact"] {
            assert!(
                page.contains(&format!("id=\"blob-{track}-{modality}\"")),
                "{track} {modality}"
            );
        }
    }
    assert!(
        page.contains("\"kind\":\"pose\"") && page.contains("\"channels\":[\"left\",\"right\"]")
    );
}

#[test]
fn an_object_that_stands_in_the_world_stands_still_across_windows() {
    let still = Rigid::translation(0.3, 2.0, -0.4);
    let camera = |sample: usize| {
        let t = sample as f64 / 30.0;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.4 * t);
        Rigid::from_parts(
            Vector3::new(t.sin(), 0.8 * t, 0.0).into(),
            turn * level_camera().rotation,
        )
    };
    let mut stitcher = Stitcher::new(camera(0));
    let all = windows(5.2, 0.5).unwrap();
    for window in &all {
        let first = camera(window.start);
        let mut clip = Clip::empty("walk", "test");
        let poses = (window.start..window.start + 60).map(|s| first.inv_mul(&camera(s)));
        clip.set(
            CAMERA,
            CameraTrack {
                rate: 30.0,
                T_world_camera: poses.collect(),
                valid: vec![true; 60],
                up_world: None,
                intrinsics: None,
            },
        );
        // One sample of the second window is not known: the first window's counts.
        let poses = (0..60).map(|t| (window.index != 1 || t != 3).then(|| first.inv_mul(&still)));
        clip.set(
            OBJECT,
            ObjectTrack {
                rate: 30.0,
                T_first_object: poses.collect(),
            },
        );
        stitcher.push(window, &clip);
    }
    let (tracks, boundaries) = stitcher.finish();
    let path: &ObjectPath = tracks.get("object_pose").unwrap();
    assert_eq!(path.T_world_object.len(), 156);
    for pose in &path.T_world_object {
        let pose = pose.unwrap();
        assert!((pose.translation.vector - still.translation.vector).norm() < 1e-9);
        assert!(pose.rotation.angle() < 1e-7);
    }
    assert_eq!(boundaries.len(), all.len() - 1);
    assert!(boundaries.iter().all(|b| b.others["object_m"] < 1e-9));
}

#[test]
fn the_experiment_of_the_example_crate_checks() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/examples/plugin_modality/head_turn.yaml"
    );
    let request = Request {
        path: path.into(),
        ..Request::default()
    };
    let (experiment, report) = load(&Catalog::linked(), &request);
    assert!(!report.failed(), "{}", report.render(false));
    let stages = &experiment.unwrap().cells[0].graph;
    let scores = stages.find("scores").unwrap();
    assert_eq!(scores.description.columns, ["head_turn.rmse"]);
}

#[test]
fn code_that_is_not_linked_in_is_named_where_it_is_written() {
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["check", "--json"])
        .arg(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/examples/plugin_modality/src/head_turn.yaml"
        ))
        .output()
        .unwrap();
    let folder = tempfile::tempdir().unwrap();
    assert!(output.status.success(), "the entry itself is sound");
    let entry = include_str!("../../examples/plugin_modality/src/head_turn.yaml");
    let entries = folder.path().join("registry/modality");
    std::fs::create_dir_all(&entries).unwrap();
    std::fs::write(entries.join("head_turn.yaml"), entry).unwrap();
    let file = folder.path().join("a.yaml");
    let text = "experiment: a\nstages: {clips: {op: clips, source: world_small, train: 1, declared: [head_turn]}}\n";
    std::fs::write(&file, text).unwrap();
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
        .arg("check")
        .arg(&file)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("no code `head_turn` is linked"), "{said}");
}

#[test]
fn the_skeleton_of_a_modality_checks_and_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let reviv = |arguments: &[&str]| {
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
            .args(arguments)
            .current_dir(folder.path())
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        (
            output.status.code(),
            String::from_utf8(output.stdout).unwrap(),
            said,
        )
    };
    let (code, path, said) = reviv(&["new", "modality", "heart_rate"]);
    assert_eq!(
        (code, path.trim()),
        (Some(0), "registry/modality/heart_rate.yaml"),
        "{said}"
    );
    let (code, _, said) = reviv(&["check", path.trim()]);
    assert_eq!(code, Some(0), "{said}");
    let text = std::fs::read_to_string(folder.path().join(path.trim())).unwrap();
    std::fs::write(
        folder.path().join(path.trim()),
        text.replace("sentence", "word"),
    )
    .unwrap();
    let (code, _, said) = reviv(&["new", "modality", "heart_rate"]);
    assert_eq!(code, Some(1));
    assert!(said.contains("is there already"), "{said}");
    let kept = std::fs::read_to_string(folder.path().join(path.trim())).unwrap();
    assert!(kept.contains("What it measures, in a word."));
    for (name, reason) in [
        ("camera", "there is a modality"),
        ("head_imu", "there is a modality"),
        ("../up", "cannot name"),
        ("a.b", "cannot name"),
    ] {
        let (code, _, said) = reviv(&["new", "modality", name]);
        assert_eq!(code, Some(1), "{name}");
        assert!(said.contains(reason), "{said}");
    }
}
