//! ARCTIC, TACO, H2O and HOT3D-Clips with files that are empty, cut off, of another kind or flipped: one sentence that names the file,
//! never a panic; and without files: the rest of their signals, and a note that says what to supply.

use crate::layouts_bad::{copy, files};
use proptest::prelude::*;
use reviv::datasets::ClipSource;
use reviv::datasets::open::{Dataset, OpenWith, open};
use reviv::datasets::recording::CutSettings;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const SETS: [(&str, Dataset); 4] = [
    ("arctic", Dataset::Arctic),
    ("taco", Dataset::Taco),
    ("h2o", Dataset::H2o),
    ("hot3d_clips", Dataset::Hot3dClips),
];

/// One file of each kind: the first of a folder of many.
fn kinds(root: &Path) -> Vec<PathBuf> {
    let mut kinds = Vec::new();
    let mut seen = std::collections::BTreeSet::new();
    for path in files(root) {
        let numbered = path
            .file_stem()
            .is_some_and(|stem| stem.to_string_lossy().bytes().all(|b| b.is_ascii_digit()));
        if !numbered || seen.insert(path.parent().unwrap().to_owned()) {
            kinds.push(path);
        }
    }
    kinds
}

fn opened(root: &Path, kind: Dataset, mano: Option<&Path>) -> Result<Arc<dyn ClipSource>, String> {
    let with = OpenWith {
        mano,
        ..OpenWith::default()
    };
    open(root, Some(kind), &CutSettings::default(), with).map_err(|error| error.to_string())
}

/// Everything that is said when a data set is opened and its first clip is made.
fn sentences(root: &Path, kind: Dataset, mano: Option<&Path>) -> Vec<String> {
    let source = match opened(root, kind, mano) {
        Ok(source) => source,
        Err(error) => return vec![error],
    };
    let mut said: Vec<String> = source.excluded().into_iter().map(|e| e.reason).collect();
    said.extend(source.notes().into_iter().map(|(note, _)| note));
    if !source.is_empty()
        && let Err(error) = source.clip(0)
    {
        said.push(error.to_string());
    }
    said
}

#[test]
fn every_kind_of_damaged_file_is_named_in_a_sentence() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let layouts = shared.join("layouts");
    let mut silent = Vec::new();
    for (set, kind) in SETS {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join(set);
        copy(&layouts.join(set), &root);
        let mano = layouts.join("fake_mano");
        for path in kinds(&root) {
            // What no reader needs where the models are there.
            let unused = [
                "hand_joints",
                "smplx",
                "object",
                "splits",
                "Object_Poses",
                "hand_pose_MANO",
            ];
            let text = path.to_string_lossy();
            // Pictures 1 and 2 of ARCTIC come before its labels.
            if unused.iter().any(|name| text.contains(name)) || text.ends_with("00001.jpg") {
                continue;
            }
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let good = std::fs::read(&path).unwrap();
            for (what, bytes) in [
                ("empty", Vec::new()),
                ("foreign", b"PK\x03\x04 not what it says\n".repeat(9)),
                ("half", good[..good.len() / 2].to_vec()),
            ] {
                std::fs::write(&path, bytes).unwrap();
                let said = sentences(&root, kind, Some(&mano));
                if !said.iter().any(|sentence| sentence.contains(&name)) {
                    silent.push(format!("{set}: {name} {what}: {said:?}"));
                }
                for sentence in said {
                    assert!(!sentence.contains('\n'), "{sentence}");
                }
            }
            std::fs::write(&path, good).unwrap();
        }
    }
    assert!(silent.is_empty(), "{}", silent.join("\n"));
}

#[test]
fn without_models_and_joints_the_hands_are_absent_and_a_note_says_what_to_supply() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let layouts = shared.join("layouts");
    for (set, kind, without, modalities, note) in [
        (
            "arctic",
            Dataset::Arctic,
            "splits/",
            "rgb camera",
            "MANO_LEFT.pkl",
        ),
        (
            "taco",
            Dataset::Taco,
            "hand_joints.npz",
            "rgb depth camera",
            "MANO_LEFT.pkl",
        ),
        (
            "taco",
            Dataset::Taco,
            "Hand_Poses",
            "rgb depth camera",
            "no hands",
        ),
        (
            "taco",
            Dataset::Taco,
            "egocentric_depth.avi",
            "rgb camera left_hand right_hand",
            "no depth",
        ),
        (
            "h2o",
            Dataset::H2o,
            "hand_pose/",
            "rgb depth camera",
            "MANO_LEFT.pkl",
        ),
        (
            "h2o",
            Dataset::H2o,
            "rgb/",
            "camera left_hand right_hand",
            "no pictures",
        ),
        (
            "arctic",
            Dataset::Arctic,
            "cropped_images",
            "camera left_hand right_hand",
            "no pictures",
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join(set);
        copy(&layouts.join(set), &root);
        for path in files(&root) {
            if path.to_string_lossy().contains(without) {
                std::fs::remove_file(&path).unwrap();
                let _ = std::fs::remove_dir(path.parent().unwrap());
            }
        }
        let source = opened(&root, kind, None).unwrap();
        let notes: Vec<String> = source.notes().into_iter().map(|(note, _)| note).collect();
        assert_eq!(
            source.modalities().join(" "),
            modalities,
            "{set} {without}: {notes:?}"
        );
        let said = notes.iter().any(|found| found.contains(note));
        assert!(said, "{set} without {without}: {notes:?}");
    }
}

#[test]
fn a_sequence_whose_counts_differ_is_excluded_and_the_others_are_read() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("taco");
    copy(&shared.join("layouts/taco"), &root);
    // The same sequence a second time, with a pose too few.
    for kind in [
        "Egocentric_RGB_Videos",
        "Egocentric_Camera_Parameters",
        "Hand_Poses",
    ] {
        let triplet = std::fs::read_dir(root.join(kind))
            .unwrap()
            .next()
            .unwrap()
            .unwrap();
        let sequence = std::fs::read_dir(triplet.path())
            .unwrap()
            .next()
            .unwrap()
            .unwrap();
        copy(&sequence.path(), &triplet.path().join("20990106_001"));
    }
    let short = files(&root)
        .into_iter()
        .find(|path| path.ends_with("20990106_001/egocentric_frame_extrinsic.npy"))
        .unwrap();
    let array = reviv::formats::npy::read(&short).unwrap();
    let poses = array.to_dim::<f64, ndarray::Ix3>().unwrap();
    let fewer = poses.slice(ndarray::s![1.., .., ..]).to_owned();
    reviv::formats::npy::write(&short, &(&fewer).into()).unwrap();
    let source = opened(&root, Dataset::Taco, None).unwrap();
    assert_eq!(source.recordings().len(), 1);
    let excluded = source.excluded();
    assert_eq!(excluded.len(), 1);
    let reason = &excluded[0].reason;
    assert!(
        reason.contains("color.mp4") && reason.contains("65"),
        "{reason}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn no_damage_makes_a_reader_panic(
        set in 0usize..4,
        file in any::<usize>(),
        flips in proptest::collection::vec((any::<usize>(), 1u8..), 1..6),
        keep in prop_oneof![Just(usize::MAX), 0usize..30_000],
    ) {
        if let Some(shared) = crate::shared::folder() {
            let layouts = shared.join("layouts");
            let (name, kind) = SETS[set];
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join(name);
            copy(&layouts.join(name), &root);
            let kinds = kinds(&root);
            let path = &kinds[file % kinds.len()];
            let mut bytes = std::fs::read(path).unwrap();
            for (at, value) in flips {
                let at = at % bytes.len();
                bytes[at] ^= value;
            }
            bytes.truncate(keep.max(1));
            std::fs::write(path, bytes).unwrap();
            for mano in [None, Some(layouts.join("fake_mano"))] {
                for sentence in sentences(&root, kind, mano.as_deref()) {
                    prop_assert!(!sentence.contains('\n'), "{}", sentence);
                }
            }
        }
    }
}
