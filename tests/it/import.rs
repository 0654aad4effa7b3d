//! Released files: read bit for bit, checked before anything is dropped, refused when they are not what they seem.

use crate::shared;
use crate::torch::{self, Argument, Saved};
use reviv::engine::{Compute, Initialise, Parameters, Weights};
use reviv::import::{Checkpoint, Format, ImportOptions, import};
use reviv::nn::positions::{self, GridOrder};
use reviv::tokenizer::video::{Network, VideoSettings};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Entries of a checkpoint and of a safetensors file are the same, bit for bit.
fn assert_equal(path: &Path, expected: &Path) {
    let mut found = Checkpoint::open(path).unwrap();
    let expected = Weights::read(expected).unwrap();
    assert_eq!(found.entries().len(), expected.tensors.len());
    for index in 0..found.entries().len() {
        let entry = found.entries()[index].clone();
        let tensor = &expected.tensors[&entry.name];
        assert_eq!(entry.shape(), tensor.shape, "{}", entry.name);
        let values = found.values(index).unwrap();
        let bits = |values: &[f32]| -> Vec<u32> { values.iter().map(|v| v.to_bits()).collect() };
        let expected = tensor.f32(&entry.name).unwrap();
        assert_eq!(bits(&values), bits(expected), "{}", entry.name);
    }
}

fn vectors() -> Option<PathBuf> {
    Some(shared::folder()?.join("vectors/parity"))
}

#[test]
fn checkpoints_hold_what_the_reference_wrote() {
    let Some(vectors) = vectors() else { return };
    for name in [
        "vq/cam",
        "vq/gaze",
        "vq/hand",
        "vq/body",
        "mget/reviv256",
        "mget/egom2p",
    ] {
        let file = |end: &str| vectors.join(format!("{name}_model.{end}"));
        assert_equal(&file("pth"), &file("safetensors"));
        assert_equal(&file("safetensors"), &file("safetensors"));
    }
    let checkpoint = Checkpoint::open(&vectors.join("mget/egom2p_model.pth")).unwrap();
    let arguments = checkpoint.arguments();
    assert_eq!(arguments["model"], "egom2p_base_12e_12d_swiglu_nobias");
    assert_eq!(arguments["lr"], 0.0004);
    assert_eq!(arguments["clip_grad"], 1.0);
    assert_eq!(arguments["total_tokens"], 500);
    assert_eq!(arguments["auto_resume"], true);
    assert_eq!(arguments["s3_data_endpoint"], Value::Null);
    assert_eq!(arguments["opt_betas"], serde_json::json!([0.9, 0.95]));
    assert_eq!(
        checkpoint.others(),
        ["epoch", "args", "scaler", "optimizer"]
    );
}

#[test]
fn torchscript_archives_hold_the_listed_entries() {
    let Some(vectors) = vectors() else { return };
    let folder = vectors.join("cosmos");
    let text = std::fs::read_to_string(folder.join("dv4x8x8_jit_entries.json")).unwrap();
    let listed: Value = serde_json::from_str(&text).unwrap();
    for (file, key) in [
        ("dv4x8x8_f32_encoder", "encoder"),
        ("dv4x8x8_bf16_decoder", "decoder"),
    ] {
        let checkpoint = Checkpoint::open(&folder.join(format!("{file}.jit"))).unwrap();
        assert_eq!(checkpoint.format(), Format::TorchScript);
        let listed = listed["entries"][key].as_object().unwrap();
        assert_eq!(checkpoint.entries().len(), listed.len());
        for entry in checkpoint.entries() {
            let expected = listed[&entry.name].as_array().unwrap();
            let (_, shape) = expected.split_last().unwrap();
            let shape: Vec<u64> = shape.iter().filter_map(Value::as_u64).collect();
            assert_eq!(entry.view.shape, shape, "{}", entry.name);
        }
    }
}

fn read_manifest(folder: &Path) -> Value {
    let text = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// Imports into a fresh folder.
fn imported(files: &[PathBuf]) -> (tempfile::TempDir, PathBuf, Value) {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path().join("model");
    import(files, &folder, &ImportOptions::default()).unwrap();
    let manifest = read_manifest(&folder);
    (temporary, folder, manifest)
}

#[test]
fn video_tokenizers_merge_from_their_two_files_and_reproduce_the_encoder() {
    let Some(vectors) = vectors() else { return };
    let file = |name: &str| vectors.join("cosmos").join(name);
    let (_temporary, folder, manifest) = imported(&[
        file("dv4x8x8_f32_encoder.jit"),
        file("dv4x8x8_bf16_decoder.jit"),
    ]);
    let part = &manifest["parts"]["rgb"];
    let settings: VideoSettings = serde_json::from_value(part["settings"].clone()).unwrap();
    assert_eq!((settings.channels, settings.blocks), (3, 2));
    let weights = Weights::read(&folder.join("tokenizers/rgb/tokenizer.safetensors")).unwrap();
    let compute = Compute::cpu();
    let mut network = Network::new(&Initialise::empty(&compute), &settings).unwrap();
    network.load(&weights).unwrap();
    let reference = Weights::read(&file("dv4x8x8_model.safetensors")).unwrap();
    for (name, tensor) in &weights.tensors {
        let (found, expected) = (
            tensor.f32(name).unwrap(),
            reference.tensors[name].f32(name).unwrap(),
        );
        let half = name.contains("decoder") || name.contains("post_quant");
        let tolerance = if half { 1.0 / 256.0 } else { 0.0 };
        for (a, b) in found.iter().zip(expected) {
            assert!((a - b).abs() <= tolerance * b.abs(), "{name}: {a} {b}");
        }
    }
    // The same network in one archive.
    let (_temporary, _, both) = imported(&[file("dv4x8x8_bf16_autoencoder.jit")]);
    assert_eq!(both["parts"]["rgb"]["settings"], part["settings"]);
}

#[test]
fn files_of_two_sets_are_not_mixed() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path().join("model");
    let files = [
        vectors.join("mget/reviv256_model.pth"),
        vectors.join("vq/gaze_model.pth"),
    ];
    let error = import(&files, &folder, &ImportOptions::default())
        .unwrap_err()
        .to_string();
    assert!(error.contains("different sets"), "{error}");
    assert!(!folder.exists());
    assert_eq!(std::fs::read_dir(temporary.path()).unwrap().count(), 0);
}

/// One line of a structure table, with small dimensions: width 36, hidden 96, at most 50 tokens.
fn shrunk(name: &str, shape: &[usize]) -> Vec<usize> {
    let cut = |vocabulary: usize| vocabulary.min(50);
    match name {
        _ if name.ends_with("qkv.weight") => vec![108, 36],
        _ if name.ends_with("qkv.bias") => vec![108],
        _ if name.ends_with("kv.weight") => vec![72, 36],
        _ if name.contains("rgb") && name.ends_with("proj.weight") => vec![36, shape[1]],
        _ if name.ends_with("out_proj.weight") => vec![shape[0], 36],
        _ if name.ends_with("out_proj.bias") => shape.to_vec(),
        _ if name.ends_with("fc1.weight") || name.ends_with("fc3.weight") => {
            vec![if shape[0] == 4 * shape[1] { 144 } else { 96 }, 36]
        }
        _ if name.ends_with("fc2.weight") => {
            vec![36, if shape[1] == 4 * shape[0] { 144 } else { 96 }]
        }
        _ if name.ends_with("fc1.bias") => vec![144],
        _ if name.ends_with("token_emb.weight") || name.ends_with("to_logits.weight") => {
            vec![cut(shape[0]), 36]
        }
        _ if name.ends_with("_codebook.embed") => vec![cut(shape[0]), 8],
        _ if name.ends_with("cluster_size") => vec![cut(shape[0])],
        _ if name.starts_with("quant_proj") => [
            &[8, 36][..shape.len().min(2)],
            &vec![1; shape.len().saturating_sub(2)],
        ]
        .concat(),
        _ if name.starts_with("post_quant_proj") => [
            &[36, 8][..shape.len().min(2)],
            &vec![1; shape.len().saturating_sub(2)],
        ]
        .concat(),
        _ => shape
            .iter()
            .map(|d| if *d == 768 || *d == 384 { 36 } else { *d })
            .collect(),
    }
}

/// The table that belongs to so many places.
fn table(name: &str, shape: &[usize]) -> Vec<f32> {
    let places: usize = shape[1..shape.len() - 1].iter().product();
    match places {
        210 => positions::grid(30, 7, 36, GridOrder::Released),
        5120 => positions::volume([5, 32, 32], 36),
        4096 => positions::volume([4, 32, 32], 36),
        30 | 512 => positions::line(places, 36),
        other => panic!("{name}: {other} places"),
    }
}

/// A checkpoint with the entries of a structure table at small dimensions.
fn structured(path: &Path) -> (Vec<Saved>, Vec<String>) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut all: Vec<Saved> = Vec::new();
    let mut domains = Vec::new();
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let fields: Vec<&str> = line.split('\t').collect();
        let name = fields[0].to_owned();
        if let Some(domain) = name.strip_prefix("encoder_embeddings.") {
            domains.push(domain.split('.').next().unwrap().to_owned());
        }
        let shape: Vec<usize> = fields[1].split('x').map(|d| d.parse().unwrap()).collect();
        let shape = shrunk(&name, &shape);
        let alias_of = fields[3]
            .strip_prefix("alias of ")
            .map(|owner| all.iter().position(|s| s.name == owner).unwrap());
        let count = shape.iter().product::<usize>();
        let is_table = name.ends_with("pos_emb") || name.ends_with("position_embeddings");
        let is_zero = fields[3] == "buffer"
            && name
                .rsplit_once('.')
                .is_some_and(|(_, last)| last == "bias");
        let values: Vec<f32> = if is_table {
            table(&name, &shape)
        } else if is_zero {
            vec![0.0; count]
        } else {
            (0..count).map(|i| (i as f32 * 0.37).sin()).collect()
        };
        all.push(Saved {
            name,
            shape,
            alias_of,
            values: Box::new(move || values.clone()),
        });
    }
    domains.dedup();
    (all, domains)
}

fn write(folder: &Path, name: &str, tensors: &[Saved], arguments: &[(&str, Argument)]) -> PathBuf {
    let path = folder.join(name);
    let file = std::io::BufWriter::new(std::fs::File::create(&path).unwrap());
    torch::save(file, tensors, arguments);
    path
}

fn main_arguments(domains: Vec<String>) -> Vec<(&'static str, Argument)> {
    vec![
        (
            "model",
            Argument::Text("fm_base_12e_12d_swiglu_nobias".into()),
        ),
        ("all_domains", Argument::Texts(domains)),
        ("num_register_tokens", Argument::Number(0)),
    ]
}

#[test]
fn every_released_structure_imports_with_all_entries_accounted_for() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir().unwrap();
    for (name, entries, kept) in [
        ("egom2p", 335, 245),
        ("mget_reviv_256_base_body1024", 359, 256),
        ("mget_reviv_256_tiny", 209, 142),
        ("mget_reviv_512", 376, 264),
        ("mget_reviv_512_caption", 383, 264),
        ("vq_body", 313, 313),
        ("vq_cam", 313, 313),
        ("vq_gaze", 313, 313),
        ("vq_hand", 313, 313),
    ] {
        let (tensors, domains) = structured(&vectors.join(format!("structure/{name}.tsv")));
        assert_eq!(tensors.len(), entries, "{name}");
        let is_main = !name.starts_with("vq");
        let arguments = if is_main {
            main_arguments(domains)
        } else {
            let kind = name.replace("vq_hand", "vq_lhand");
            vec![("domain", Argument::Text(kind))]
        };
        let path = write(
            temporary.path(),
            &format!("{name}.pth").replace("vq_hand", "vq_lhand"),
            &tensors,
            &arguments,
        );
        let folder = temporary.path().join(format!("{name}-imported"));
        let report = import(&[path], &folder, &ImportOptions::default()).unwrap();
        assert_eq!(
            (report.parts[0].entries, report.parts[0].written),
            (entries, kept),
            "{name}"
        );
        let manifest = read_manifest(&folder);
        let accounts = manifest["inputs"][0]["entries"].as_object().unwrap();
        assert_eq!(accounts.len(), entries, "{name}");
        let caption = accounts
            .values()
            .any(|v| v.as_str().unwrap().contains("captions"));
        assert_eq!(caption, name.ends_with("caption"));
    }
}

#[test]
fn nothing_is_dropped_unless_it_is_redundant() {
    let Some(vectors) = vectors() else { return };
    let temporary = tempfile::tempdir().unwrap();
    let table = vectors.join("structure/mget_reviv_256_tiny.tsv");
    let changes: [(&str, Change, &str); 5] = [
        (
            "bias",
            |tensors| {
                let saved = tensors
                    .iter_mut()
                    .find(|t| t.name == "encoder.2.norm1.bias");
                saved.unwrap().values = Box::new(|| vec![1e-3; 36]);
            },
            "not zero",
        ),
        (
            "alias",
            |tensors| {
                let saved = tensors
                    .iter_mut()
                    .find(|t| t.name.ends_with("tok_cam.to_logits.weight"));
                let saved = saved.unwrap();
                saved.alias_of = None;
                saved.values = Box::new(|| vec![0.5; 50 * 36]);
            },
            "tied",
        ),
        (
            "table",
            |tensors| {
                let saved = tensors
                    .iter_mut()
                    .find(|t| t.name == "encoder_embeddings.tok_body.pos_emb");
                saved.unwrap().values = Box::new(|| positions::grid(30, 7, 36, GridOrder::Aligned));
            },
            "position table",
        ),
        (
            "unknown",
            |tensors| {
                tensors[40].name = "encoder.0.extra.weight".into();
            },
            "not an entry of any known release",
        ),
        (
            "shape",
            |tensors| {
                let saved = tensors
                    .iter_mut()
                    .find(|t| t.name == "encoder.1.attn.qkv.weight");
                let saved = saved.unwrap();
                saved.shape = vec![36, 108];
            },
            "expected",
        ),
    ];
    for (name, change, part) in changes {
        let (mut tensors, domains) = structured(&table);
        change(&mut tensors);
        let path = write(
            temporary.path(),
            &format!("{name}.pth"),
            &tensors,
            &main_arguments(domains),
        );
        let folder = temporary.path().join(name);
        let error = import(&[path], &folder, &ImportOptions::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains(part), "{name}: {error}");
        assert!(!folder.exists());
    }
}

type Change = fn(&mut Vec<Saved>);
