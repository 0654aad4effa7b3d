//! What becomes of data sets whose files are empty, cut off, out of order, of another kind or flipped: one sentence that names the
//! file, never a panic; and of recordings that lack files: the rest of their signals, and a note.

use proptest::prelude::*;
use reviv::datasets::open::{Dataset, OpenWith, open};
use reviv::datasets::recording::CutSettings;
use reviv::datasets::{ClipSource, Outcome, holoassist};
use reviv::formats::npz::Npz;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Copies a layout without its golden answers.
pub fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else if !target.to_string_lossy().contains("golden") {
            std::fs::write(&target, std::fs::read(&path).unwrap()).unwrap();
        }
    }
}

/// Every file below a folder, sorted.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn opened(root: &Path, kind: Dataset) -> Result<Arc<dyn ClipSource>, String> {
    open(
        root,
        Some(kind),
        &CutSettings::default(),
        OpenWith::default(),
    )
    .map_err(|error| error.to_string())
}

/// Everything that is said when a data set is opened and its first clips are made.
fn sentences(root: &Path, kind: Dataset) -> Vec<String> {
    let source = match opened(root, kind) {
        Ok(source) => source,
        Err(error) => return vec![error],
    };
    let mut said: Vec<String> = source.excluded().into_iter().map(|e| e.reason).collect();
    for index in 0..source.len().min(2) {
        if let Err(error) = source.clip(index) {
            said.push(error.to_string());
        }
    }
    said
}

/// The data sets of the layouts that are read here, and the names of files that their readers do not need where better ones are there.
const SETS: [(&str, Dataset, &[&str]); 4] = [
    (
        "nymeria",
        Dataset::Nymeria,
        &["metadata.json", "atomic_action.csv", "general_eye_gaze.csv"],
    ),
    (
        "ego_exo4d",
        Dataset::EgoExo4d,
        &[
            "captures.json",
            "summary.json",
            "general_eye_gaze.csv",
            "gopro_calibs.csv",
            "448/",
        ],
    ),
    (
        "holoassist",
        Dataset::Holoassist,
        &[
            "data_split",
            "Eyes_proj.txt",
            "Head_sync.txt",
            "Video_compress.mp4",
        ],
    ),
    ("egogen", Dataset::Egogen, &[]),
];

#[test]
fn every_damaged_file_of_every_layout_is_named_in_a_sentence() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let mut silent = Vec::new();
    for (set, kind, unused) in SETS {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join(set);
        copy(&shared.join("layouts").join(set), &root);
        // What the sample itself lacks, such as a take without pictures and poses, is said of the whole set, too.
        let lacks = sentences(&root, kind);
        assert!(lacks.len() <= 1, "{set}: {lacks:?}");
        for path in files(&root) {
            let needed = !unused
                .iter()
                .any(|name| path.to_string_lossy().contains(name));
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let good = std::fs::read(&path).unwrap();
            let lines: Vec<&[u8]> = good.split_inclusive(|byte| *byte == b'\n').collect();
            let text = std::str::from_utf8(&good).is_ok();
            let one_line = lines.len() < 2;
            for (what, bytes, must) in [
                ("empty", Vec::new(), true),
                ("foreign", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR".repeat(9), true),
                ("half", good[..good.len() / 2].to_vec(), !text),
                (
                    "reversed",
                    lines.into_iter().rev().collect::<Vec<_>>().concat(),
                    text && !one_line,
                ),
            ] {
                std::fs::write(&path, bytes).unwrap();
                let said = sentences(&root, kind);
                // A calibration has no order, and a line of JSON is a row.
                let must = must && needed && !(what == "reversed" && name.ends_with("jsonl"));
                if must && !said.iter().any(|sentence| sentence.contains(&name)) {
                    silent.push(format!("{set}: {name} {what}: {said:?}"));
                }
                for sentence in said {
                    assert!(!sentence.contains('\n'), "{sentence}");
                    if text && what != "empty" && sentence.contains(&name) {
                        assert!(sentence.contains("line "), "{set} {what}: {sentence}");
                    }
                }
            }
            std::fs::write(&path, good).unwrap();
        }
    }
    assert!(silent.is_empty(), "{}", silent.join("\n"));
}

#[test]
fn what_a_recording_lacks_is_noted_and_the_rest_is_read() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let layouts = shared.join("layouts");
    let without = |set: &str, kind: Dataset, part: &str| {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join(set);
        copy(&layouts.join(set), &root);
        for path in files(&root) {
            if path.to_string_lossy().contains(part) {
                std::fs::remove_file(path).unwrap();
            }
        }
        let source = opened(&root, kind).unwrap();
        let notes: Vec<String> = source.notes().into_iter().map(|(note, _)| note).collect();
        (source.modalities().join(" "), notes.join("; "))
    };
    for (set, kind, part, modalities, note) in [
        (
            "nymeria",
            Dataset::Nymeria,
            "xdata",
            "rgb camera gaze",
            "no body",
        ),
        (
            "nymeria",
            Dataset::Nymeria,
            "eye_gaze",
            "rgb camera body",
            "no gaze",
        ),
        (
            "nymeria",
            Dataset::Nymeria,
            "data.vrs",
            "camera gaze",
            "no pictures",
        ),
        (
            "ego_exo4d",
            Dataset::EgoExo4d,
            ".mp4",
            "camera gaze",
            "no pictures",
        ),
        (
            "ego_exo4d",
            Dataset::EgoExo4d,
            "timesync",
            "camera gaze",
            "no pictures",
        ),
        (
            "ego_exo4d",
            Dataset::EgoExo4d,
            "closed_loop",
            "rgb gaze",
            "no camera",
        ),
        (
            "holoassist",
            Dataset::Holoassist,
            "Left_sync",
            "rgb camera gaze right_hand",
            "hand",
        ),
        (
            "holoassist",
            Dataset::Holoassist,
            "Intrinsics",
            "rgb camera left_hand right_hand",
            "no lens",
        ),
        (
            "holoassist",
            Dataset::Holoassist,
            ".mp4",
            "camera gaze left_hand right_hand",
            "no pictures",
        ),
        (
            "egogen",
            Dataset::Egogen,
            "cam/scene0_00012",
            "rgb depth camera",
            "no camera",
        ),
    ] {
        let (found, notes) = without(set, kind, part);
        assert_eq!(found, modalities, "{set} without {part}: {notes}");
        assert!(notes.contains(note), "{set} without {part}: {notes}");
    }
}

/// A session of our own: two seconds and a bit, without a video.
fn session(root: &Path, flags: bool) -> PathBuf {
    let export = root.join("R001-1July-Own/Export_py");
    for folder in ["Video", "Hands", "Eyes"] {
        std::fs::create_dir_all(export.join(folder)).unwrap();
    }
    let (mut poses, mut eyes) = (String::new(), String::new());
    let mut hands = String::new();
    for row in 0..64_i64 {
        let seconds = row as f64 / 30.0;
        let tick = 637_917_497_146_886_552 + row * 333_333;
        writeln!(
            poses,
            "{seconds}\t{tick}\t1\t0\t0\t{}\t0\t1\t0\t0\t0\t0\t1\t1.6\t0\t0\t0\t1",
            0.01 * row as f64
        )
        .unwrap();
        writeln!(
            eyes,
            "{seconds}\t{tick}\t{}\t0\t1.6\t1\t0\t0\t1",
            0.01 * row as f64
        )
        .unwrap();
        write!(hands, "{seconds}\t{tick}\t1").unwrap();
        for joint in 0..26 {
            let y = 0.01 * f64::from(joint) - 0.1;
            write!(
                hands,
                "\t1\t0\t0\t0.5\t0\t1\t0\t{y}\t0\t0\t1\t1.5\t0\t0\t0\t1"
            )
            .unwrap();
        }
        hands.push_str(&(if flags { "\t1" } else { "\t0" }).repeat(52));
        hands.push('\n');
    }
    let lens = "500\t0\t448\t0\t500\t252\t0\t0\t1\t0\t0\t0\t0\t0\t0\t0\t0\t500\t500\t500\t448\t252\t0\t896\t504\n";
    for (name, text) in [
        ("Video/Pose_sync.txt", poses.as_str()),
        ("Video/Intrinsics.txt", lens),
        ("Hands/Left_sync.txt", &hands),
        ("Hands/Right_sync.txt", &hands),
        ("Eyes/Eyes_sync.txt", &eyes),
    ] {
        std::fs::write(export.join(name), text).unwrap();
    }
    root.join("R001-1July-Own")
}

#[test]
fn a_session_without_pictures_or_flags_gives_camera_gaze_and_hands() {
    let folder = tempfile::tempdir().unwrap();
    for flags in [true, false] {
        session(folder.path(), flags);
        let source = opened(folder.path(), Dataset::Holoassist).unwrap();
        assert_eq!(
            source.modalities().join(" "),
            "camera gaze left_hand right_hand"
        );
        // Flags that are never set are not flags.
        let noted = source
            .notes()
            .iter()
            .any(|(note, _)| note.contains("flags"));
        assert_eq!(noted, !flags);
        let Outcome::Clip(clip) = source.clip(0).unwrap() else {
            panic!("dropped")
        };
        let hand = clip.left_hand().unwrap();
        assert!(hand.valid.iter().all(|valid| *valid));
        // The wrist is joint 1 of the file: 0.5 m ahead of the world's origin, 9 cm to the right of it, 10 cm below the eyes.
        let wrist = [0.09, 0.1, 0.5];
        for (k, expected) in wrist.into_iter().enumerate() {
            assert!((hand.joints[[0, 0, k]] - expected).abs() < 1e-6, "{k}");
        }
        let gaze = clip.gaze().unwrap();
        assert!((gaze.points[[30, 0]] - 0.5).abs() < 1e-6 && gaze.valid[30]);
        assert_eq!(
            clip.camera().unwrap().valid.iter().filter(|v| **v).count(),
            60
        );
    }
}

#[test]
fn a_table_of_another_width_or_order_names_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let session = session(folder.path(), true);
    let path = session.join("Export_py/Hands/Left_sync.txt");
    let good = std::fs::read_to_string(&path).unwrap();
    let mut lines: Vec<&str> = good.lines().collect();
    lines.swap(10, 11);
    let swapped = lines.join("\n");
    let short = good.replacen("\t1\n", "\n", 5);
    for (text, line) in [
        (swapped, "line 12"),
        (short, "line 1"),
        (good.replacen("0.5", "x", 2), "line 1"),
    ] {
        std::fs::write(&path, text).unwrap();
        let message = holoassist::open(&session).unwrap_err().to_string();
        assert!(
            message.contains("Left_sync.txt") && message.contains(line),
            "{message}"
        );
    }
}

fn flipped(mut bytes: Vec<u8>, flips: &[(usize, u8)], keep: usize) -> Vec<u8> {
    for (at, value) in flips {
        let at = at % bytes.len();
        bytes[at] ^= value;
    }
    bytes.truncate(keep.max(1));
    bytes
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn no_damage_to_a_session_makes_its_reader_panic(
        file in 0usize..5,
        flips in proptest::collection::vec((any::<usize>(), any::<u8>()), 1..5),
        keep in prop_oneof![Just(usize::MAX), 0usize..30_000],
    ) {
        let folder = tempfile::tempdir().unwrap();
        let root = session(folder.path(), true);
        let path = files(&root)[file].clone();
        let bytes = flipped(std::fs::read(&path).unwrap(), &flips, keep);
        std::fs::write(&path, bytes).unwrap();
        for sentence in sentences(folder.path(), Dataset::Holoassist) {
            prop_assert!(sentence.contains(".txt") && !sentence.contains('\n'), "{}", sentence);
        }
    }

    #[test]
    fn no_damage_to_poses_of_egogen_makes_the_reader_panic(
        flips in proptest::collection::vec((any::<usize>(), any::<u8>()), 1..5),
        keep in prop_oneof![Just(usize::MAX), 0usize..9000],
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cam/a.npz");
        std::fs::create_dir(folder.path().join("cam")).unwrap();
        let poses = ndarray::Array3::from_shape_fn((60, 4, 4), |(_, r, c)| f64::from(u8::from(r == c)));
        Npz::default().with("arr_0", poses).write(&path).unwrap();
        let bytes = flipped(std::fs::read(&path).unwrap(), &flips, keep);
        std::fs::write(&path, bytes).unwrap();
        for sentence in sentences(folder.path(), Dataset::Egogen) {
            prop_assert!(sentence.contains("a.npz") && !sentence.contains('\n'), "{}", sentence);
        }
    }
}
