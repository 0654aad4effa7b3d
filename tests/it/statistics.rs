//! `op: statistics` as an experiment runs it.

use crate::run_text::{failures, run_text};
use reviv::run::Cache;
use reviv::run::State;
use reviv::run::execute::Outcome;
use serde_json::Value;
use std::path::{Path, PathBuf};

const EXPERIMENT: &str = "
experiment: what_clips_hold
about: Clips of the built-in world, counted.
stages:
  clips:
    op: clips
    source: {use: world_small, world: {size: 8, rooms: 3}}
    train: 3
    test: 2
  statistics: {op: statistics, clips: clips}
";

fn run(folder: &Path, text: &str) -> Result<Outcome, String> {
    let outcome = run_text(folder, text)?;
    assert_eq!(outcome.state, State::Done, "{:?}", failures(&outcome));
    Ok(outcome)
}

fn artifacts(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = Cache::of(&folder.join("runs"))
        .entries()
        .unwrap()
        .into_iter()
        .map(|entry| entry.path)
        .filter(|path| path.join("statistics.json").is_file())
        .collect();
    found.sort();
    found
}

#[test]
fn every_split_modality_and_channel_is_counted_in_its_unit() {
    let folder = tempfile::tempdir().unwrap();
    run(folder.path(), EXPERIMENT).unwrap();
    let [artifact] = artifacts(folder.path()).try_into().unwrap();
    let text = std::fs::read_to_string(artifact.join("statistics.json")).unwrap();
    let found: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(found["train"]["clips"], 3);
    assert_eq!(found["test"]["clips"], 2);
    let rows = found["train"]["modalities"].as_array().unwrap();
    let row = |name: &str| rows.iter().find(|row| row["modality"] == name).unwrap();
    assert_eq!(row("body")["shapes"]["60x21x3"], 3);
    assert_eq!(row("body")["statistics"]["channels"][0]["unit"], "m");
    assert_eq!(row("gaze")["statistics"]["samples"], 180);
    let depth = &row("depth")["statistics"]["channels"][0];
    assert!(depth["mean"].as_f64().unwrap() > 0.3, "{depth}");
    let csv = std::fs::read_to_string(artifact.join("statistics.csv")).unwrap();
    // Three of colour, one of depth, nine of the camera, two of gaze, three each of hands and body; two splits.
    assert_eq!(csv.lines().count(), 1 + 2 * (3 + 1 + 9 + 2 + 9), "{csv}");
    assert!(artifact.join("report/statistics.md").is_file());
}

#[test]
fn only_what_depends_on_a_change_is_made_again() {
    let folder = tempfile::tempdir().unwrap();
    let first = run(folder.path(), EXPERIMENT).unwrap();
    assert_eq!((first.made, first.found), (2, 0));
    let changed = EXPERIMENT.replace("clips: clips}", "clips: clips, modalities: [gaze]}");
    let second = run(folder.path(), &changed).unwrap();
    assert_eq!((second.made, second.found), (1, 1));
    assert_eq!(artifacts(folder.path()).len(), 2);
}

#[test]
fn a_modality_that_the_clips_lack_is_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    let wrong = EXPERIMENT.replace("clips: clips}", "clips: clips, modalities: [gase]}");
    let message = run(folder.path(), &wrong).unwrap_err();
    assert!(message.contains("`gase`"), "{message}");
    assert!(message.contains("E0203"), "{message}");
}
