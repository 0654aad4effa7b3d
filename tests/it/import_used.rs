//! Imported models in use: by `reviv reconstruct`, and by an experiment through `op: import`.

use crate::import_models::small_set;
use crate::released;
use crate::tiny_movie::{Movie, Picture};
use assert_cmd::Command;
use std::path::{Path, PathBuf};

/// A folder with `model`, imported through the binary from a set of small dimensions.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let released = place.path("reviv_500b");
        std::fs::create_dir(&released).unwrap();
        small_set(&released, true);
        let video = released::video(&released);
        let files = [released.to_str().unwrap(), video.to_str().unwrap()];
        place.reviv(&["import", files[0], files[1], "-o", "model"], 0);
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Runs it and gives what it said on stderr.
    fn reviv(&self, arguments: &[&str], code: i32) -> String {
        let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
            .current_dir(self.0.path())
            .args(arguments)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
        said
    }
}

#[test]
fn a_video_is_reconstructed_with_an_imported_model() {
    let place = Place::new();
    let pictures = (0..70).map(|at| Picture::Flat(20 + 3 * at)).collect();
    let movie = Movie::new([32, 32], 30, pictures).bytes();
    std::fs::write(place.path("walk.mp4"), movie).unwrap();
    let said = place.reviv(
        &["reconstruct", "walk.mp4", "--model", "model", "-o", "walk"],
        0,
    );
    assert!(said.contains("the centre 32 x 32"), "{said}");
    let folder = place.path("walk");
    for file in [
        "body.bvh",
        "body.npz",
        "camera.npz",
        "camera.tum",
        "depth.npz",
        "gaze.csv",
        "hands.npz",
        "manifest.json",
        "points.ply",
        "view.html",
    ] {
        assert!(folder.join(file).is_file(), "{file}");
    }
}

const EXPERIMENT: &str = "\
experiment: released
about: Scores of imported weights on the built-in world.
seed: 0
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 16, rooms: 2}}, train: 1, validation: 1, test: 2}
  model: {op: import, folder: model}
  predictions: {op: predict, model: model, clips: clips, inputs: [rgb], targets: [camera]}
  scores: {op: evaluate, predictions: predictions, clips: clips, suite: world_camera}
";

fn made(place: &Path, stage: &str) -> PathBuf {
    let run = std::fs::read_dir(place.join("runs")).unwrap();
    let run = run
        .map(|entry| entry.unwrap().path())
        .find(|path| path.join("run.json").is_file())
        .unwrap();
    let link = run.join("plan.json");
    let plan: serde_json::Value = serde_json::from_slice(&std::fs::read(link).unwrap()).unwrap();
    let works = plan["works"].as_array().unwrap();
    let work = works.iter().find(|work| work["stage"] == stage).unwrap();
    let key = work["key"].as_str().unwrap();
    place.join("runs/cache").join(&key[..2]).join(key)
}

#[test]
fn an_experiment_predicts_and_scores_with_an_imported_model() {
    let place = Place::new();
    std::fs::write(place.path("released.yaml"), EXPERIMENT).unwrap();
    place.reviv(&["check", "released.yaml"], 0);
    place.reviv(&["run", "released.yaml"], 0);
    let model = made(place.0.path(), "model");
    // What the import said of the released files stays with the model.
    let said = std::fs::read_to_string(model.join("imported.json")).unwrap();
    assert!(said.contains("reviv_main.pth"), "{said}");
    let scores = made(place.0.path(), "scores");
    assert!(scores.join("manifest.json").is_file());

    // The identity is that of the bytes: the same folder elsewhere is the same model, another one is another.
    std::fs::rename(place.path("model"), place.path("moved")).unwrap();
    let plan = |folder: &str| {
        let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
            .current_dir(place.0.path())
            .args(["plan", "released.yaml", "--json", "--set"])
            .arg(format!("stages.model.folder={folder}"))
            .output()
            .unwrap();
        let plan: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let mut stages = plan["stages"].as_array().unwrap().iter();
        stages.all(|stage| stage["cached"] == true)
    };
    assert!(plan("moved"));
    let path = place.path("moved/weights.safetensors");
    let mut weights = std::fs::read(&path).unwrap();
    *weights.last_mut().unwrap() ^= 1;
    std::fs::write(&path, weights).unwrap();
    assert!(!plan("moved"));

    let said = place.reviv(&["check", "released.yaml"], 1);
    assert!(said.contains("error[E0601]"), "{said}");
    assert!(said.contains("there is no such folder"), "{said}");
    assert!(said.contains("1 error"), "{said}");
    std::fs::remove_file(place.path("moved/model.json")).unwrap();
    let said = place.reviv(
        &[
            "check",
            "released.yaml",
            "--set",
            "stages.model.folder=moved",
        ],
        1,
    );
    assert!(said.contains("it has no `model.json`"), "{said}");
}
