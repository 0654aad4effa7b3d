//! `reviv show FILE`: the entries of a checkpoint of any container, without reading a tensor.

use crate::torch::{self, Argument};
use reviv::engine::Weights;
use std::path::Path;
use std::process::Command;

fn show(path: &Path, json: bool) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
    command.arg("show").arg(path);
    if json {
        command.arg("--json");
    }
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{error}");
    String::from_utf8(output.stdout).unwrap()
}

/// A zip of a pickle and one storage of 24 bytes, of which `stored` bytes are really there.
fn archive(pickle: &[u8], name: &str, folder: &Path) -> std::path::PathBuf {
    let mut zip = reviv::formats::zip::ZipWriter::new(Vec::new());
    zip.add("a/data.pkl", pickle).unwrap();
    zip.add("a/data/0", &[0; 24]).unwrap();
    let path = folder.join(name);
    std::fs::write(&path, zip.finish().unwrap()).unwrap();
    path
}

#[test]
fn every_container_is_listed() {
    let folder = tempfile::tempdir().unwrap();
    let tensor = || torch::tensor(0, 6, &[2, 3], &[3, 1]);
    let entries = [
        ("a.weight".to_owned(), tensor()),
        ("b.alias".to_owned(), tensor()),
    ];
    let arguments = [("model", Argument::Text("fm_base".into()))];
    let pth = archive(&torch::pickle(&entries, &arguments), "x.pth", folder.path());
    let text = show(&pth, false);
    assert!(text.contains("a.weight  f32   [2, 3]\n"), "{text}");
    assert!(
        text.contains("b.alias   f32   [2, 3]  = a.weight\n"),
        "{text}"
    );
    assert!(text.ends_with("2 entries, 24 bytes\n"), "{text}");
    let json: serde_json::Value = serde_json::from_str(&show(&pth, true)).unwrap();
    assert_eq!(json["format"], "Torch");
    assert_eq!(json["arguments"]["model"], "fm_base");
    assert_eq!(json["entries"][1]["same_as"], "a.weight");

    let script = archive(
        &torch::script(&[("encoder", "weight", tensor())]),
        "x.jit",
        folder.path(),
    );
    let json: serde_json::Value = serde_json::from_str(&show(&script, true)).unwrap();
    assert_eq!(json["format"], "TorchScript");
    assert_eq!(json["entries"][0]["name"], "encoder.weight");

    let mut weights = Weights::default();
    weights.insert_f32("w", vec![1.0; 4], &[4]);
    let path = folder.path().join("x.safetensors");
    weights.write(&path).unwrap();
    assert!(show(&path, false).contains("w  f32   [4]\n1 entries, 16 bytes\n"));
}

#[test]
fn a_file_larger_than_memory_is_listed_at_once() {
    // The header claims 64 GB, and the file (which is sparse) has them.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("huge.safetensors");
    let bytes = 64_u64 << 30;
    let header = format!(
        r#"{{"w":{{"dtype":"F32","shape":[{}],"data_offsets":[0,{bytes}]}}}}"#,
        bytes / 4
    );
    let mut start = (header.len() as u64).to_le_bytes().to_vec();
    start.extend(header.as_bytes());
    std::fs::write(&path, &start).unwrap();
    let file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    file.set_len(start.len() as u64 + bytes).unwrap();
    let text = show(&path, false);
    assert!(text.contains("[17179869184]"), "{text}");
}
