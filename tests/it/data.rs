//! `reviv data` and `op: clips` on recordings: one road for whatever clips come from.

use crate::recordings_bad::neutral_folder;
use crate::run_text::{failures, run_text};
use assert_cmd::Command;
use reviv::clip::store::ClipSet;
use reviv::formats::npy::NpyArray;
use reviv::formats::npz::Npz;
use reviv::formats::png::{Picture, read};
use reviv::run::Cache;
use reviv::run::State;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Recordings `take_0`, `take_1`, ... of two and a half seconds each.
fn takes(root: &Path, count: usize) {
    for take in 0..count {
        let folder = root.join(format!("take_{take}"));
        std::fs::create_dir_all(&folder).unwrap();
        neutral_folder(&folder, 30.0, 0.0);
        let file = folder.join("recording.yaml");
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(
            &file,
            text.replace("name: one", &format!("name: take_{take}")),
        )
        .unwrap();
        let imu = ndarray::Array2::from_shape_fn((75, 6), |(row, channel)| {
            if row == 40 {
                f32::NAN
            } else {
                (row + 100 * channel) as f32
            }
        });
        let npz = Npz::default().with("imu", NpyArray::from(&imu));
        npz.write(&folder.join("imu.npz")).unwrap();
    }
}

fn reviv(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (
        output.status.code().unwrap(),
        text(output.stdout),
        text(output.stderr),
    )
}

fn run(folder: &Path, experiment: &str) -> Result<PathBuf, String> {
    let outcome = run_text(folder, experiment)?;
    if outcome.state != State::Done {
        return Err(failures(&outcome).concat());
    }
    let mut entries = Cache::of(&folder.join("runs"))
        .entries()
        .unwrap()
        .into_iter()
        .map(|entry| entry.path);
    Ok(entries.find(|path| path.join("train").is_dir()).unwrap())
}

const EXPERIMENT: &str = "
experiment: clips_of_recordings
about: Clips of a folder of recordings, by split.
stages:
  clips:
    op: clips
    source:
      use: recordings
      data: mine
      cut: {side: 16, stride: 0.25}
      split: {validation_recordings: [take_1], validation: 0, test: 0}
    train: 5
    validation: 100
    declared: [head_imu]
  statistics: {op: statistics, clips: clips}
";

#[test]
fn an_experiment_makes_clips_of_recordings_by_split() {
    let folder = tempfile::tempdir().unwrap();
    takes(&folder.path().join("recordings"), 3);
    std::fs::write(folder.path().join("data.yaml"), "mine: recordings\n").unwrap();
    let artifact = run(folder.path(), EXPERIMENT).unwrap();
    let train = ClipSet::open(&artifact.join("train")).unwrap();
    let validation = ClipSet::open(&artifact.join("validation")).unwrap();
    // Two and a half seconds with a quarter between starts make three clips per recording.
    assert_eq!((train.len(), validation.len()), (5, 3));
    assert!(
        train.ids().iter().all(|id| !id.contains("take_1")),
        "{:?}",
        train.ids()
    );
    assert!(
        train.ids().iter().any(|id| id.contains("take_2")),
        "{:?}",
        train.ids()
    );
    let clip = validation.clip(1).unwrap();
    assert_eq!(clip.id, "mine/take_1/000001");
    let imu = &clip.signal("head_imu").unwrap();
    assert_eq!(imu.values.shape(), [60, 6]);
    // A quarter of a second at 30 Hz is sample 7.5, rounded up.
    assert_eq!(imu.values[[0, 2]], 208.0);
    let valid = imu.valid.as_ref().unwrap();
    assert!(!valid[[32]] && valid[[31]] && valid[[33]]);
    let manifest: Value =
        serde_json::from_slice(&std::fs::read(artifact.join("manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["contents"]["splits"]["train"]["clips"], 5);
    assert_eq!(manifest["contents"]["source"], "mine");
}

#[test]
fn what_recordings_cannot_give_is_said() {
    let folder = tempfile::tempdir().unwrap();
    takes(&folder.path().join("recordings"), 2);
    let unknown = run(folder.path(), EXPERIMENT).unwrap_err();
    assert!(
        unknown.contains("mine") && unknown.contains("data.yaml"),
        "{unknown}"
    );
    std::fs::write(folder.path().join("data.yaml"), "mine: recordings\n").unwrap();
    let named = EXPERIMENT.replace("[take_1]", "[take_7]");
    let message = run(folder.path(), &named).unwrap_err();
    assert!(
        message.contains("`take_7`") && message.contains("take_0"),
        "{message}"
    );
    let nobody = EXPERIMENT.replace("validation_recordings: [take_1], ", "");
    let message = run(folder.path(), &nobody).unwrap_err();
    assert!(
        message.contains("no recording for `validation`"),
        "{message}"
    );
    let share = EXPERIMENT.replace("test: 0}", "test: 1.5}");
    assert!(run(folder.path(), &share).unwrap_err().contains("E020"));
    std::fs::write(
        folder.path().join("recordings/take_0/rgb.mp4"),
        b"not a video",
    )
    .unwrap();
    let message = run(folder.path(), EXPERIMENT).unwrap_err();
    assert!(message.contains("rgb.mp4"), "{message}");
}

#[test]
fn conversion_goes_on_where_it_stopped_and_refuses_a_folder_of_another() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("in"), folder.path().join("out"));
    takes(&from, 3);
    let (from, to) = (from.to_str().unwrap(), to.to_str().unwrap());
    let convert = ["data", "convert", from, "-o", to, "--side", "16", "--json"];
    let arguments = [&convert[..], &["--clips-per-shard", "2"]].concat();
    let (code, out, err) = reviv(&arguments);
    assert_eq!(code, 0, "{err}");
    let result: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(
        (&result["clips"], &result["shards"], &result["reused"]),
        (&3.into(), &2.into(), &0.into())
    );
    let tar = Path::new(to).join("body/mine/shard-000001.tar");
    let bytes = std::fs::read(&tar).unwrap();
    // As if it had been killed while the second shard was written.
    std::fs::remove_file(Path::new(to).join(".finished/shard-000001.json")).unwrap();
    std::fs::remove_file(&tar).unwrap();
    std::fs::write(tar.with_extension("tar.part"), b"half").unwrap();
    let result: Value = serde_json::from_str(&reviv(&arguments).1).unwrap();
    assert_eq!(
        (&result["clips"], &result["reused"]),
        (&3.into(), &1.into())
    );
    assert_eq!(std::fs::read(&tar).unwrap(), bytes);
    // Other clips do not go into the same folder.
    let (code, _, err) = reviv(&[&arguments[..], &["--fps", "4"]].concat());
    assert_eq!(code, 1);
    assert!(err.contains("another conversion"), "{err}");
    // What was converted is a source again.
    let (code, out, err) = reviv(&["data", "inspect", to, "--json", "-o", &format!("{to}-seen")]);
    assert_eq!(code, 0, "{err}");
    let seen: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(seen["survey"]["source"], "mine");
    assert_eq!(seen["survey"]["recordings"], 3);
    assert_eq!(seen["survey"]["format"]["size"], 16);
}

#[test]
fn inspection_shows_numbers_and_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let (clips, seen) = (folder.path().join("clips"), folder.path().join("seen"));
    let (clips, seen) = (clips.to_str().unwrap(), seen.to_str().unwrap());
    let (code, _, err) = reviv(&[
        "data",
        "synthesize",
        "world_small",
        "--size",
        "16",
        "-n",
        "2",
        "-o",
        clips,
    ]);
    assert_eq!(code, 0, "{err}");
    let (code, out, err) = reviv(&["data", "inspect", clips, "-o", seen]);
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("world: 2 clips"), "{out}");
    for words in [
        "right_hand",
        "60x21x3",
        "16x16x16x1",
        "100.0 %",
        "head_imu",
        "gravity frame",
    ] {
        assert!(out.contains(words), "{words}: {out}");
    }
    for name in ["contact_sheet.png", "paths.png"] {
        let Picture::Rgb8(picture) = read(&Path::new(seen).join(name)).unwrap() else {
            panic!("{name} has no colour");
        };
        let first = picture[[0, 0, 0]];
        let other = picture.iter().filter(|value| **value != first).count();
        assert!(other * 10 > picture.len(), "{name} is empty");
    }
}

#[test]
fn what_is_not_there_or_damaged_ends_with_code_one() {
    let folder = tempfile::tempdir().unwrap();
    let (code, _, err) = reviv(&["data", "inspect", "nowhere"]);
    assert_eq!(code, 1);
    assert!(
        err.contains("`nowhere`") && err.contains("world_small"),
        "{err}"
    );
    let empty = folder.path().to_str().unwrap();
    let (code, _, err) = reviv(&["data", "inspect", empty]);
    assert_eq!(code, 1);
    assert!(err.contains("no recordings found"), "{err}");
    takes(&folder.path().join("in"), 2);
    std::fs::write(folder.path().join("in/take_1/signals.npz"), b"PK nothing").unwrap();
    let from = folder.path().join("in");
    let to = folder.path().join("out");
    let (code, _, err) = reviv(&[
        "data",
        "convert",
        from.to_str().unwrap(),
        "-o",
        to.to_str().unwrap(),
    ]);
    // The other recording is converted, and what is left out is said.
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("excluded: `take_1`") && err.contains("signals.npz"),
        "{err}"
    );
    std::fs::write(folder.path().join("in/take_0/signals.npz"), b"PK nothing").unwrap();
    let (code, _, err) = reviv(&["data", "inspect", from.to_str().unwrap()]);
    assert_eq!(code, 1, "{err}");
    assert!(err.contains("signals.npz"), "{err}");
}
