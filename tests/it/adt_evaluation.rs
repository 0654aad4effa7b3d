//! The Aria Digital Twin sample through `op: clips` and `op: evaluate`, against arrays in the form that EgoM2P writes.

use ndarray::{Array2, Array3};
use reviv::datasets::recording::CutSettings;
use reviv::datasets::{ClipSource as _, adt};
use reviv::evaluation::scores::{ScoreSet, Scores};
use reviv::evaluation::statistics::summarise;
use reviv::formats::npz::Npz;
use std::path::{Path, PathBuf};
use std::process::Command;

const EXPERIMENT: &str = "
experiment: adt
about: Known mistakes on one real clip.
stages:
  adt: {op: clips, source: {use: adt, cut: {pad_short: true}}, test: 10}
  scores:
    op: evaluate
    predictions_data: egom2p
    clips: adt
    suite:
      use: world_all
      metrics: [camera.ate, camera.rte, camera.rre, gaze.mse, depth.abs_rel, depth.delta@depth, body.mpjpe, body.ga_mpjpe]
  table: {op: table, scores: [scores], published: adt_camera}
";

/// The truth with mistakes whose metrics are known: another world, twice as large; gaze 0.01 off in both axes; depth halved and
/// 0.2 m off; the body 5 cm away.
fn predictions(sample: &Path, place: &Path) {
    let settings = CutSettings {
        pad_short: true,
        ..CutSettings::default()
    };
    let source = adt::source(sample, settings).unwrap();
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    let path = place.join(format!("{}.npz", clip.id));
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();

    let camera = clip.camera().unwrap();
    let turn = nalgebra::UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9);
    let mut cam = Array2::zeros((60, 9));
    for (t, pose) in camera.T_world_camera.iter().enumerate() {
        let rotation = (turn * pose.rotation).to_rotation_matrix();
        let position = turn * pose.translation.vector * 2.0;
        for axis in 0..3 {
            cam[[t, axis]] = rotation[(axis, 0)];
            cam[[t, 3 + axis]] = rotation[(axis, 1)];
            cam[[t, 6 + axis]] = position[axis];
        }
    }
    let gaze = clip.gaze().unwrap();
    let gaze = Array2::from_shape_fn((60, 2), |(t, axis)| {
        if gaze.valid[t] {
            gaze.points[[t, axis]] + 0.01
        } else {
            0.5
        }
    });
    let depth = clip.depth().unwrap();
    let depth = depth
        .metres
        .mapv(|d| if d.is_finite() { 0.5 * d + 0.2 } else { 1.0 });
    let body = clip.body().unwrap();
    let body = Array3::from_shape_fn(body.joints.raw_dim(), |(t, j, axis)| {
        let off = [0.03, 0.04, 0.0][axis];
        let joint = body.joints[[t, j, axis]];
        if body.valid[[t, j]] { joint + off } else { 0.0 }
    });
    Npz::default()
        .with("cam", cam)
        .with("gaze", gaze)
        .with("depth", depth)
        .with("body", body)
        .write(&path)
        .unwrap();
}

fn find(folder: &Path, name: &str) -> Option<PathBuf> {
    let mut inside: Vec<PathBuf> = std::fs::read_dir(folder)
        .ok()?
        .map(|entry| entry.unwrap().path())
        .collect();
    inside.sort();
    let own = inside.iter().find(|path| path.ends_with(name)).cloned();
    own.or_else(|| inside.iter().find_map(|path| find(path, name)))
}

#[test]
fn the_adt_sample_is_evaluated_against_arrays_with_known_mistakes() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let sample = shared.join("data/adt_sample");
    if !sample.is_dir() {
        crate::skipped::skipped("no ADT sample");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    predictions(&sample, &at("egom2p"));
    std::fs::write(at("adt.yaml"), EXPERIMENT).unwrap();
    let data = format!("adt: {}\negom2p: egom2p\n", sample.display());
    std::fs::write(at("data.yaml"), data).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["run", "adt.yaml"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");

    let scores = Scores::read(&find(&at("runs/cache"), "scores.json").unwrap()).unwrap();
    assert_eq!((scores.system.as_str(), scores.clips.len()), ("egom2p", 1));
    let mean =
        |set: &ScoreSet, name: &str| summarise(&set.column(name).unwrap().values).mean.unwrap();
    let own = |name: &str| mean(&scores.own, name);
    // A similarity is undone by the alignment; a scale is undone before steps are compared.
    for name in ["camera.ate", "camera.rte"] {
        assert!(own(name) < 1e-6, "{name}: {}", own(name));
    }
    assert!(own("camera.rre") < 1e-3, "{}", own("camera.rre"));
    assert!((own("gaze.mse") - 1e-4).abs() < 1e-7, "{}", own("gaze.mse"));
    assert!(
        (own("body.mpjpe") - 50.0).abs() < 1e-2,
        "{}",
        own("body.mpjpe")
    );
    assert!(own("body.ga_mpjpe") < 1e-2, "{}", own("body.ga_mpjpe"));
    assert!(
        own("depth.abs_rel@depth") < 1e-5,
        "{}",
        own("depth.abs_rel@depth")
    );
    assert!(own("depth.delta@depth") > 99.999);
    // What only an affine change of depth undoes is not undone by anything else.
    assert!(own("depth.abs_rel@none") > 0.1 && own("depth.abs_rel@disparity") > 1e-3);
    assert!(mean(&scores.baselines["still camera"], "camera.rre") > 0.01);
    assert!(mean(&scores.baselines["image centre"], "gaze.mse") > own("gaze.mse"));
    assert!(
        !scores.baselines.contains_key("reconstruction bound"),
        "no model, no floor"
    );
}
