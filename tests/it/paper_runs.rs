//! Every shipped experiment of the paper from its first stage to its last, at a tiny size, on the samples of the layouts put in as data.

use crate::layouts_bad::copy;
use serde_json::{Map, Value, json};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Puts settings over those that are there; a name of the registry becomes `{use: name}` first.
fn put(settings: &mut Map<String, Value>, key: &str, over: &Value) {
    let place = settings.entry(key).or_insert_with(|| json!({}));
    if let Value::String(name) = place {
        *place = json!({ "use": name });
    }
    let (Some(place), Some(over)) = (place.as_object_mut(), over.as_object()) else {
        panic!("`{key}` is no registry entry: {place}");
    };
    place.extend(over.clone());
}

/// A size at which one step takes a moment. Budgets and vocabularies stay what they are, so far as they cost nothing.
fn size() -> Value {
    json!({"width": 48, "heads": 2, "encoder_depth": 1, "decoder_depth": 1})
}

fn masking() -> Value {
    json!({"input_tokens": 96, "target_tokens": 96})
}

/// Makes one stage tiny, or a patch of one.
fn shrink_stage(stage: &mut Map<String, Value>) {
    let op = stage.get("op").and_then(Value::as_str).unwrap_or_default();
    match op.to_owned().as_str() {
        "clips" => {
            for (split, most) in [("train", 6), ("validation", 2), ("test", 2)] {
                if stage.contains_key(split) {
                    stage.insert(split.to_owned(), most.into());
                }
            }
            let cut = json!({"cut": {"side": 32, "stride": 0.25, "pad_short": true}});
            put(stage, "source", &cut);
            let source = stage["source"].as_object_mut().unwrap();
            if source["use"] == "hot3d" {
                source.insert("use".to_owned(), "hot3d_clips".into());
                source.remove("dataset");
            }
            // The samples are one recording each, which is then cut in time.
            let none = json!([]);
            source.insert(
                "split".to_owned(),
                json!({"validation": 0.3, "test": 0.0, "official": false, "validation_recordings": none, "test_recordings": none}),
            );
        }
        // A group names one tokenizer for all of its modalities.
        "train_tokenizer" | "train_tokenizers" => {
            let video = stage["tokenizer"]
                .as_str()
                .is_some_and(|name| name.starts_with("cosmos"));
            let tiny = if video {
                json!({"channels": 8, "multipliers": [1, 1], "blocks": 1})
            } else {
                json!({"width": 16, "depth": 1, "heads": 2})
            };
            put(stage, "tokenizer", &tiny);
            let tiny = json!({"steps": 2, "batch": 2, "warmup": {"steps": 0}, "validation_clips": 2, "kmeans": false});
            stage.extend(tiny.as_object().unwrap().clone());
        }
        "train_mget" => {
            stage.remove("total_tokens");
            let tiny = json!({
                "steps": 2, "batch": 2, "micro_batch": 2, "repeat": 1, "warmup": {"steps": 0}, "checkpoint_every": 0, "validate_every": 0,
                "validation_clips": 2,
            });
            stage.extend(tiny.as_object().unwrap().clone());
            put(stage, "size", &size());
            put(stage, "masking", &masking());
        }
        _ => {
            // A patch of the model's stage.
            if stage.contains_key("size") {
                put(stage, "size", &size());
            }
        }
    }
}

fn shrink(experiment: &mut Value) {
    let stages = experiment.get_mut("stages").and_then(Value::as_object_mut);
    for (_, stage) in stages.into_iter().flatten() {
        shrink_stage(stage.as_object_mut().unwrap());
    }
    let arms = experiment.get_mut("arms").and_then(Value::as_object_mut);
    for (_, arm) in arms.into_iter().flatten() {
        let arm = arm.as_object_mut().unwrap();
        for (key, over) in [
            ("stages.mget.size", size()),
            ("stages.mget.masking", masking()),
        ] {
            if arm.contains_key(key) {
                put(arm, key, &over);
            }
        }
    }
}

/// JSON is YAML, but for lists that stand in place of others.
fn text(experiment: &Value) -> String {
    let text = serde_json::to_string_pretty(experiment).unwrap();
    [
        "compression",
        "multipliers",
        "validation_recordings",
        "test_recordings",
        "weights",
    ]
    .iter()
    .fold(text, |text, key| {
        text.replace(&format!("{key}\": ["), &format!("{key}\": !replace ["))
    })
}

/// The files below `paper/`, tiny, in a folder with the data of the samples; the names of the experiments.
fn tiny_paper(layouts: &Path, adt: Option<&Path>, folder: &Path) -> Vec<String> {
    let paper = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments/paper");
    let mut names = Vec::new();
    for entry in std::fs::read_dir(paper).unwrap() {
        let path = entry.unwrap().path();
        let whole = std::fs::read_to_string(&path).unwrap();
        let mut experiment: Value = serde_saphyr::from_str(&whole).unwrap();
        shrink(&mut experiment);
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        std::fs::write(folder.join(&name), text(&experiment)).unwrap();
        names.push(name);
    }
    names.sort();
    // One scene of EgoGen, the one with depth.
    let egogen = folder.join("egogen");
    copy(&layouts.join("egogen"), &egogen);
    for other in ["cam/scene0_00013.npz", "rgb_256_8fps/scene0_00013.mp4"] {
        std::fs::remove_file(egogen.join(other)).unwrap();
    }
    let mut data = format!("egogen: {}\n", egogen.display());
    for (name, set) in [
        ("nymeria", "nymeria"),
        ("egoexo", "ego_exo4d"),
        ("holoassist", "holoassist"),
        ("holoassist_test", "holoassist"),
        ("hot3d_quest", "hot3d_clips"),
        ("hot3d_aria", "hot3d_clips"),
        ("hot3d_test", "hot3d_clips"),
        ("taco", "taco"),
        ("taco_test", "taco"),
        ("arctic", "arctic"),
        ("arctic_test", "arctic"),
        ("h2o", "h2o"),
        ("mano", "fake_mano"),
    ] {
        writeln!(data, "{name}: {}", layouts.join(set).display()).unwrap();
    }
    if let Some(adt) = adt {
        writeln!(data, "adt: {}", adt.display()).unwrap();
    }
    std::fs::write(folder.join("data.yaml"), data).unwrap();
    names
}

fn reviv(folder: &Path, arguments: &[&str]) -> (bool, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.success(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

#[test]
fn every_experiment_of_the_paper_runs_end_to_end_at_a_tiny_size() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let layouts = shared.join("layouts");
    if !layouts.is_dir() {
        crate::skipped::skipped(&format!(
            "{} is not there: no samples to run the paper's experiments on",
            layouts.display()
        ));
        return;
    }
    let adt: Option<PathBuf> = Some(shared.join("data/adt_sample")).filter(|path| path.is_dir());
    let folder = tempfile::tempdir().unwrap();
    let names = tiny_paper(&layouts, adt.as_deref(), folder.path());
    assert!(names.len() >= 19, "{names:?}");
    let mut failed = Vec::new();
    for name in &names {
        let (planned, _, said) = reviv(folder.path(), &["plan", name]);
        assert!(planned, "plan {name}: {said}");
        if adt.is_none() && said.contains("`adt`") {
            crate::skipped::skipped(&format!(
                "{name} needs the sample of Aria Digital Twin, which is not there"
            ));
            continue;
        }
        let (checked, _, said) = reviv(folder.path(), &["check", name]);
        assert!(checked && !said.contains("W0702"), "check {name}: {said}");
        let (ran, _, said) = reviv(folder.path(), &["run", name]);
        if !ran {
            failed.push(format!("run {name}: {said}"));
        }
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    // Everything is there now.
    let (_, again, _) = reviv(folder.path(), &["plan", "table_hands.yaml"]);
    assert!(again.contains(" 0 to do"), "{again}");
}
