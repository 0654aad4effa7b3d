//! Damaged jsonl, json, YAML and tar files: an error that names the file and the place in it, never a panic, whatever was flipped.

use crate::recordings_bad::neutral_folder;
use proptest::prelude::*;
use reviv::clip::store::ClipSet;
use reviv::datasets::aria::calibration;
use reviv::datasets::convert::ShardSink;
use reviv::datasets::recording::CutSettings;
use reviv::datasets::shards::{ShardClips, TarSink};
use reviv::datasets::umetrack::{self, HandProfile};
use reviv::datasets::{ClipSource, neutral};
use reviv::world::{World, WorldClips, WorldSettings};
use serde_json::json;
use std::path::Path;
use std::sync::OnceLock;

/// Two lines of a calibration over time.
pub fn calibration_lines() -> String {
    let line = |us: u64| {
        json!({"tracking_timestamp_us": us, "CameraCalibrations": [{
            "Label": "camera-rgb",
            "T_Device_Camera": {"Translation": [0.0, 0.01, -0.01], "UnitQuaternion": [1.0, [0.0, 0.0, 0.0]]},
            "Projection": {"Name": "FisheyeRadTanThinPrism", "Params":
                [1220.0, 1440.0, 1440.0, 0.4, -0.4, 0.1, 0.2, -0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]},
        }]})
        .to_string()
    };
    format!("{}\n\n{}\n", line(1_000_000), line(1_100_000))
}

/// The shape of a hand, and two lines of its poses.
pub fn hand() -> (String, String) {
    let profile = json!({"hand_model": {
        "joint_rest_positions": (0..22).map(|k| [f64::from(k), 10.0, 0.0]).collect::<Vec<_>>(),
        "joint_rotation_axes": vec![[0.0, 0.0, 1.0]; 22],
        "landmark_rest_positions": (0..21).map(|k| [f64::from(k), 50.0, 5.0]).collect::<Vec<_>>(),
        "landmark_rest_bone_indices": vec![[4.0, 0.0, 0.0]; 21],
        "landmark_rest_bone_weights": vec![[1.0, 0.0, 0.0]; 21],
    }});
    let line = |time: u64| {
        json!({"timestamp_ns": time, "hand_poses": {"0": {
            "wrist_xform": {"t_xyz": [0.0, 0.1, 0.2], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            "joint_angles": vec![0.1; 22], "hand_confidence": 1.0,
        }}})
        .to_string()
    };
    (
        profile.to_string(),
        format!("{}\n{}\n", line(5), line(33_000_005)),
    )
}

#[test]
fn jsonl_files_of_our_own_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("online_calibration.jsonl");
    std::fs::write(&path, calibration_lines()).unwrap();
    let cameras = calibration::online(&path, 1408).unwrap();
    assert_eq!(cameras.len(), 2);
    assert_eq!(cameras[1].0, 1_100_000_000);
    assert_eq!(cameras[0].1.camera.width, 1408);
    let (profile, poses) = hand();
    let (shape, path) = (
        folder.path().join("profile.json"),
        folder.path().join("poses.jsonl"),
    );
    std::fs::write(&shape, profile).unwrap();
    std::fs::write(&path, &poses).unwrap();
    let profile = HandProfile::read(&shape).unwrap();
    let [left, right] = umetrack::read(&path, &profile).unwrap();
    assert_eq!(
        (left.times(), right.times().len()),
        (&[5, 33_000_005][..], 0)
    );
    std::fs::write(&path, poses.replace("33000005", "\"soon\"")).unwrap();
    let message = umetrack::read(&path, &profile).unwrap_err().to_string();
    assert!(
        message.contains("poses.jsonl") && message.contains("line 2"),
        "{message}"
    );
}

/// The tars of four tiny clips, by their place below the root.
fn tars() -> &'static [(String, Vec<u8>)] {
    static TARS: OnceLock<Vec<(String, Vec<u8>)>> = OnceLock::new();
    TARS.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let settings = WorldSettings {
            size: 8,
            frames: 2,
            ..WorldSettings::default()
        };
        let world = WorldClips::new(World::new(settings, 1), 0..2);
        let clip = |index| {
            world
                .clip(index)
                .map(|outcome| outcome.into_clip().unwrap())
        };
        let sink = TarSink::new(folder.path(), &folder.path().join(".finished")).unwrap();
        sink.write(0, &mut (0..2).map(clip), &Default::default)
            .unwrap();
        ["rgb", "depth", "camera", "gaze", "body"]
            .map(|modality| {
                let name = format!("{modality}/world/shard-000000.tar");
                let bytes = std::fs::read(folder.path().join(&name)).unwrap();
                (name, bytes)
            })
            .to_vec()
    })
}

fn mutated(bytes: &[u8], flips: &[(usize, u8)], keep: Option<usize>) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for (at, value) in flips {
        let at = at % bytes.len();
        bytes[at] ^= value;
    }
    if let Some(keep) = keep {
        bytes.truncate(keep % bytes.len());
    }
    bytes
}

fn named(path: &Path, message: &str) -> bool {
    message.contains(&path.file_name().unwrap().to_string_lossy().into_owned())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_jsonl_never_panics(
        flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..4),
        keep in proptest::option::of(0usize..4000),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.jsonl");
        std::fs::write(&path, mutated(calibration_lines().as_bytes(), &flips, keep)).unwrap();
        if let Err(error) = calibration::online(&path, 1408) {
            prop_assert!(named(&path, &error.to_string()), "{error}");
        }
        let (shape, poses) = hand();
        let good = folder.path().join("profile.json");
        std::fs::write(&good, &shape).unwrap();
        let profile = HandProfile::read(&good).unwrap();
        std::fs::write(&path, mutated(poses.as_bytes(), &flips, keep)).unwrap();
        if let Err(error) = umetrack::read(&path, &profile) {
            prop_assert!(named(&path, &error.to_string()), "{error}");
        }
        std::fs::write(&path, mutated(shape.as_bytes(), &flips, keep)).unwrap();
        if let Err(error) = HandProfile::read(&path) {
            prop_assert!(named(&path, &error.to_string()), "{error}");
        }
    }

    #[test]
    fn damaged_shards_never_panic(
        which in 0usize..5,
        flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..6),
        headers in any::<bool>(),
        keep in proptest::option::of(0usize..20_000),
    ) {
        let folder = tempfile::tempdir().unwrap();
        // Half of the cases damage headers of the tar and of the archive in it, where every field matters.
        let flips: Vec<_> = flips.into_iter().map(|(at, v)| (if headers { at % 700 } else { at }, v)).collect();
        let mut damaged = folder.path().to_owned();
        for (number, (name, bytes)) in tars().iter().enumerate() {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            if number == which {
                std::fs::write(&path, mutated(bytes, &flips, keep)).unwrap();
                damaged = path;
            } else {
                std::fs::write(&path, bytes).unwrap();
            }
        }
        match ClipSet::open(folder.path()) {
            Ok(set) => {
                for index in 0..set.len() {
                    if let Err(error) = set.clip(index) {
                        prop_assert!(error.to_string().contains("shard-000000.tar"), "{error}");
                    }
                }
                let source = ShardClips::open(folder.path()).unwrap();
                for index in 0..source.len() {
                    let _ = source.clip(index);
                }
            }
            Err(error) => prop_assert!(named(&damaged, &error.to_string()), "{error}"),
        }
    }

    #[test]
    fn a_damaged_manifest_never_panics(
        flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..4),
        keep in proptest::option::of(0usize..2000),
    ) {
        static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
        let whole = FOLDER.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            neutral_folder(folder.path(), 30.0, 0.0);
            folder
        });
        let folder = tempfile::tempdir().unwrap();
        for name in ["rgb.mp4", "signals.npz"] {
            std::os::unix::fs::symlink(whole.path().join(name), folder.path().join(name)).unwrap();
        }
        let text = std::fs::read(whole.path().join("recording.yaml")).unwrap();
        std::fs::write(folder.path().join("recording.yaml"), mutated(&text, &flips, keep)).unwrap();
        let settings = CutSettings { side: 16, ..CutSettings::default() };
        match neutral::source(folder.path(), settings) {
            Ok(source) => for index in 0..source.len().min(2) {
                let _ = source.clip(index);
            },
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }
}
