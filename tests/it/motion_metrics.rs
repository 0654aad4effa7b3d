//! FID and similarity of motions through `op: evaluate`, with a motion encoder of random weights.

use crate::run_text::{failures, run_text};
use ndarray::Array3;
use reviv::clip::store::ClipSet;
use reviv::engine::{Compute, Initialise};
use reviv::evaluation::scores::{ScoreSet, Scores};
use reviv::evaluation::tmr::features::FEATURES;
use reviv::evaluation::tmr::{MotionEncoder, MotionEncoderSettings, Tmr};
use reviv::formats::npz::Npz;
use reviv::run::Cache;
use reviv::run::State;
use std::path::{Path, PathBuf};

const CLIPS: &str = "
experiment: motions
about: Motions of the built-in world.
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 8, rooms: 3}}, test: 12}
";

fn motion_encoder(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    let settings = MotionEncoderSettings {
        width: 16,
        layers: 1,
        heads: 2,
        hidden: 32,
    };
    let encoder = MotionEncoder::new(&Initialise::new(&Compute::cpu(), 5), &settings).unwrap();
    let tmr = Tmr::new(encoder, vec![0.0; FEATURES], vec![1.0; FEATURES]).unwrap();
    tmr.write(folder).unwrap();
}

fn run(folder: &Path, text: &str) {
    let outcome = run_text(folder, text).unwrap_or_else(|report| panic!("{report}"));
    assert_eq!(outcome.state, State::Done, "{:?}", failures(&outcome));
}

fn artifact(folder: &Path, file: &str) -> PathBuf {
    let entries = Cache::of(&folder.join("runs")).entries().unwrap();
    let mut found = entries.into_iter().map(|entry| entry.path.join(file));
    found.find(|path| path.exists()).unwrap()
}

#[test]
fn motions_are_embedded_and_compared_by_an_encoder_of_the_user() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    motion_encoder(&root.join("tmr"));
    run(root, CLIPS);
    let clips = ClipSet::open(&artifact(root, "test")).unwrap();
    let mut bodies = 0;
    // The truth itself, and the truth walking backwards with its arms still.
    for index in 0..clips.len() {
        let clip = clips.clip(index).unwrap();
        let Some(body) = clip.body() else { continue };
        if body.valid.iter().any(|valid| !valid) {
            continue;
        }
        bodies += 1;
        let other = Array3::from_shape_fn(body.joints.raw_dim(), |(t, j, axis)| {
            let t = if j > 12 { 0 } else { 59 - t };
            body.joints[[t, j, axis]]
        });
        for (name, joints) in [("same", body.joints.clone()), ("other", other)] {
            let path = root.join(name).join(format!("{}.npz", clip.id));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            Npz::default().with("body", joints).write(&path).unwrap();
        }
    }
    assert!(bodies >= 6, "{bodies} bodies of {}", clips.len());
    std::fs::write(root.join("data.yaml"), "same: same\nother: other\n").unwrap();
    let evaluate = |predictions: &str, more: &str| -> ScoreSet {
        let text = format!(
            "{CLIPS}  scores: {{op: evaluate, predictions_data: {predictions}, clips: clips, suite: {{use: world_body, metrics: \
             [motion.fid, motion.fid_raw, motion.similarity, motion.cosine, body.mpjpe]}}{more}}}\n"
        );
        std::fs::remove_dir_all(root.join("runs")).unwrap();
        run(root, &text);
        Scores::read(&artifact(root, "scores.json")).unwrap().own
    };
    let with = ", motion_encoder: tmr";
    let value = |set: &ScoreSet, name: &str| {
        let score = set.set(name).unwrap();
        assert_eq!((score.n, score.dim), (bodies, 16), "{name}");
        score.value.unwrap()
    };
    let same = evaluate("same", with);
    assert!(
        value(&same, "motion.fid").abs() < 1e-3,
        "{}",
        value(&same, "motion.fid")
    );
    assert!((value(&same, "motion.similarity") - 1.0).abs() < 1e-6);
    let other = evaluate("other", with);
    assert!(value(&other, "motion.fid") > value(&same, "motion.fid") + 1e-4);
    assert!(value(&other, "motion.similarity") < 1.0 - 1e-5);
    let (cosine, similarity) = (
        value(&other, "motion.cosine"),
        value(&other, "motion.similarity"),
    );
    assert!((similarity - f64::midpoint(cosine, 1.0)).abs() < 1e-9);
    // Another rate is another number.
    let native = evaluate("other", ", motion_encoder: tmr, motion_rate: native");
    assert!((value(&native, "motion.fid") - value(&other, "motion.fid")).abs() > 1e-9);
    // Without an encoder the rows are there, and say why they are empty.
    let none = evaluate("other", "");
    let fid = none.set("motion.fid").unwrap();
    assert!(
        fid.value.is_none()
            && fid
                .unavailable
                .as_ref()
                .unwrap()
                .contains("`motion_encoder`")
    );
}
