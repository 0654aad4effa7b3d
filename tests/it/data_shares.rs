//! Conversion and tokenization by several processes into one folder, and `reviv data verify`, which says what became of them.

use crate::run_text::{failures, run_text};
use assert_cmd::Command;
use reviv::run::Cache;
use reviv::run::State;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn reviv(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let code = output.status.code().unwrap();
    (code, text(output.stdout), text(output.stderr))
}

/// What `verify` says: its code, and everything as JSON.
fn verify(folder: &Path) -> (i32, Value) {
    let (code, out, err) = reviv(&["data", "verify", folder.to_str().unwrap(), "--json"]);
    let found = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{out}{err}"));
    (code, found)
}

/// The problems of a folder, as one text.
fn problems(folder: &Path) -> String {
    let (code, found) = verify(folder);
    let problems = found["problems"].as_array().unwrap();
    assert_eq!(code == 0, problems.is_empty(), "{found}");
    let problems: Vec<&str> = problems.iter().map(|p| p.as_str().unwrap()).collect();
    problems.join("\n")
}

/// Every file below a folder, by its path from there.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![root.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(root).unwrap().to_owned();
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Flips one byte in the middle of a file.
fn flip(path: &Path) {
    let mut bytes = std::fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(path, bytes).unwrap();
}

fn synthesize(folder: &Path, share: &str) {
    let (code, _, err) = reviv(&[
        "data",
        "synthesize",
        "world_small",
        "--size",
        "8",
        "-n",
        "7",
        "--clips-per-shard",
        "2",
        "--shard",
        share,
        "-o",
        folder.to_str().unwrap(),
    ]);
    assert_eq!(code, 0, "{err}");
}

#[test]
fn verify_finds_what_is_missing_cut_changed_or_foreign() {
    let root = tempfile::tempdir().unwrap();
    let (alone, shared) = (root.path().join("alone"), root.path().join("shared"));
    synthesize(&alone, "1/1");
    assert_eq!(problems(&alone), "");
    let (_, found) = verify(&alone);
    assert_eq!(
        (&found["shards"], &found["finished"]),
        (&4.into(), &4.into())
    );
    assert_eq!(found["tally"]["clips"], 7);

    // Shares, in any order, make the same bytes; what is missing in between is named.
    synthesize(&shared, "2/2");
    let missing = problems(&shared);
    assert!(
        missing.contains("shard 0 is not there: clips 0 to 1"),
        "{missing}"
    );
    assert!(
        missing.contains("shard 2 is not there: clips 4 to 5"),
        "{missing}"
    );
    synthesize(&shared, "1/2");
    assert_eq!(problems(&shared), "");
    assert!(files(&shared) == files(&alone));

    let tar = |name: &str| shared.join(format!("{name}/world/shard-000001.tar"));
    flip(&tar("body"));
    assert!(
        problems(&shared)
            .contains("`body/world/shard-000001.tar` has other bytes than were written")
    );
    flip(&tar("body"));
    let whole = std::fs::read(tar("rgb")).unwrap();
    std::fs::write(tar("rgb"), &whole[..whole.len() - 512]).unwrap();
    let cut = problems(&shared);
    let bytes = format!(
        "`rgb/world/shard-000001.tar` has {} bytes instead of {}",
        whole.len() - 512,
        whole.len()
    );
    assert!(cut.contains(&bytes), "{cut}");
    std::fs::write(tar("rgb"), &whole).unwrap();
    std::fs::copy(tar("rgb"), shared.join("rgb/world/shard-000009.tar")).unwrap();
    assert!(
        problems(&shared).contains("`rgb/world/shard-000009.tar` belongs to no finished shard")
    );
    std::fs::remove_file(shared.join("rgb/world/shard-000009.tar")).unwrap();
    std::fs::remove_file(tar("gaze")).unwrap();
    assert!(problems(&shared).contains("`gaze/world/shard-000001.tar`"));

    // What is no folder of clips is said to be none.
    let (code, _, err) = reviv(&["data", "verify", root.path().to_str().unwrap()]);
    assert!(code == 1 && err.contains("clips.json"), "{code} {err}");
}

const EXPERIMENT: &str = "
experiment: tokens_by_shares
about: Tokens, made here or elsewhere.
stages:
  clips: {op: clips, source: {use: world_small, world: {size: 16, rooms: 2}}, train: 7, validation: 2}
  tok_camera:
    op: train_tokenizer
    clips: clips
    modality: camera
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 2
    warmup: {steps: 0}
  tok_left_hand:
    op: train_tokenizer
    clips: clips
    modality: left_hand
    tokenizer: {use: vq_kinematic_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 2
    batch: 4
    warmup: {steps: 0}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_camera, tok_left_hand], pixels: rgb}
";

/// The artifacts of one op.
fn artifacts(folder: &Path, op: &str) -> Vec<PathBuf> {
    let entries = Cache::of(&folder.join("runs")).entries().unwrap();
    let mut found: Vec<PathBuf> = entries.into_iter().map(|entry| entry.path).collect();
    found.retain(|path| {
        let Ok(manifest) = std::fs::read(path.join("manifest.json")) else {
            return false;
        };
        let manifest: Value = serde_json::from_slice(&manifest).unwrap();
        manifest["recipe"]["op"] == op
    });
    found
}

#[test]
fn tokens_made_by_shares_are_those_of_the_op_and_are_taken_by_it() {
    let root = tempfile::tempdir().unwrap();
    let run = |text: &str| {
        let outcome = run_text(root.path(), text).unwrap_or_else(|report| panic!("{report}"));
        (outcome.state, failures(&outcome).concat())
    };
    let (state, said) = run(EXPERIMENT);
    assert_eq!(state, State::Done, "{said}");
    let clips = artifacts(root.path(), "clips").remove(0);
    let whole = artifacts(root.path(), "tokenize").remove(0);
    let tokenizers = artifacts(root.path(), "train_tokenizer");
    let folder = root.path().join("made");
    let tokenize = |share: &str, more: &[&str]| {
        let mut arguments = vec![
            "data",
            "tokenize",
            clips.to_str().unwrap(),
            "-o",
            folder.to_str().unwrap(),
        ];
        arguments.extend(["--clips-per-shard", "3", "--shard", share, "--tokenizers"]);
        arguments.extend(tokenizers.iter().map(|path| path.to_str().unwrap()));
        arguments.extend(more);
        reviv(&arguments)
    };

    // An experiment does not take what is not finished.
    let made = EXPERIMENT.replace("pixels: rgb}", "pixels: rgb, made: elsewhere}");
    std::fs::write(root.path().join("data.yaml"), "elsewhere: made\n").unwrap();
    let (code, _, err) = tokenize("2/2", &["--pixels"]);
    assert_eq!(code, 0, "{err}");
    assert!(err.contains("other shares are not finished"), "{err}");
    let missing = problems(&folder);
    assert!(
        missing.contains("shard 0 of `train` is not there: clips 0 to 2"),
        "{missing}"
    );
    let (state, said) = run(&made);
    assert!(
        state != State::Done && said.contains("2 of 4 shards are not finished"),
        "{said}"
    );

    let (code, _, err) = tokenize("1/2", &["--pixels"]);
    assert_eq!(code, 0, "{err}");
    assert_eq!(problems(&folder), "");
    assert_eq!(verify(&folder).1["tally"]["clips"], 9);
    // Nothing is made twice.
    let (_, out, _) = tokenize("1/1", &["--pixels", "--json"]);
    let again: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(
        (&again["made"]["shards"], &again["made"]["reused"]),
        (&4.into(), &4.into())
    );
    let (code, _, err) = tokenize("1/1", &[]);
    assert!(code == 1 && err.contains("holds other tokens"), "{err}");

    let (state, said) = run(&made);
    assert_eq!(state, State::Done, "{said}");
    let taken = artifacts(root.path(), "tokenize")
        .into_iter()
        .find(|path| *path != whole)
        .unwrap();
    // The same members, in other shards.
    let members = |root: &Path, modality: &str| {
        let mut found = BTreeMap::new();
        for split in ["train", "validation"] {
            for bytes in files(&root.join(split).join(modality)).into_values() {
                let mut tar = tar::Archive::new(bytes.as_slice());
                for entry in tar.entries().unwrap() {
                    let mut entry = entry.unwrap();
                    let name = entry.path().unwrap().into_owned();
                    let mut bytes = Vec::new();
                    std::io::Read::read_to_end(&mut entry, &mut bytes).unwrap();
                    found.insert((split, name), bytes);
                }
            }
        }
        found
    };
    for modality in ["camera", "left_hand", "pixels"] {
        let (own, other) = (members(&whole, modality), members(&taken, modality));
        assert!(!own.is_empty() && own == other, "{modality}");
    }

    // Tokens of other clips are not taken for these.
    let (state, said) = run(&made.replace("train: 7", "train: 6"));
    assert!(
        state != State::Done
            && said.contains("its 7 clips of `train` are not the 6 clips of this experiment"),
        "{said}"
    );
    flip(&folder.join("train/camera/shard-000001.tar"));
    let changed = problems(&folder);
    assert!(
        changed.contains("`train/camera/shard-000001.tar` has other bytes"),
        "{changed}"
    );
}
