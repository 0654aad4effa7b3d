//! Files as people have them: odd names, marks of editors, wrapped, halved and cut-off weights, matrices the other way round, and
//! output that goes nowhere. Each is read right, or refused in one sentence that names the file.

use proptest::prelude::*;
use reviv::datasets::neutral;
use reviv::datasets::recording::CutSettings;
use reviv::engine::{Compute, Initialise, Parameters, Values};
use reviv::formats::npy::{self, NpyArray};
use reviv::formats::npz::Npz;
use reviv::import::{Checkpoint, ImportOptions, import};
use reviv::modality::Shape;
use reviv::run::gc::{Options, prune};
use reviv::tokenizer::vq::{VqSettings, VqVae};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn reviv(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
    command.current_dir(folder);
    command
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Two trajectories, and a recording of camera poses.
fn some_files(folder: &Path) {
    for name in ["a.txt", "b.txt"] {
        let rows: Vec<String> = (0..9)
            .map(|k| format!("{k} {k} {} 0 0 0 0 1\n", k * k))
            .collect();
        std::fs::write(folder.join(name), rows.concat()).unwrap();
    }
    recording(&folder.join("recording"), |pose| pose);
}

/// A recording whose poses are those of a camera that walks, each changed by `change`.
fn recording(folder: &Path, change: impl Fn([[f64; 4]; 4]) -> [[f64; 4]; 4]) {
    std::fs::create_dir_all(folder).unwrap();
    let poses: Vec<f64> = (0..75)
        .flat_map(|k| {
            let (s, c) = (f64::from(k) * 0.01).sin_cos();
            let pose = change([
                [c, -s, 0.0, f64::from(k) * 0.02],
                [s, c, 0.0, 1.0],
                [0.0, 0.0, 1.0, 1.5],
                [0.0, 0.0, 0.0, 1.0],
            ]);
            pose.into_iter().flatten().collect::<Vec<f64>>()
        })
        .collect();
    let poses = ndarray::Array3::from_shape_vec((75, 4, 4), poses).unwrap();
    let npz = Npz::default().with("poses", poses);
    npz.write(&folder.join("camera.npz")).unwrap();
    std::fs::write(folder.join("recording.yaml"), MANIFEST).unwrap();
}

const MANIFEST: &str = "format: reviv-recording/1
source: mine
camera: {file: camera.npz, key: poses, rate: 30, direction: camera_to_world, axes: opencv}
";

#[cfg(target_os = "linux")]
#[test]
fn data_that_does_not_reach_stdout_is_an_error_of_the_machine() {
    let folder = tempfile::tempdir().unwrap();
    some_files(folder.path());
    for arguments in [
        &["--help"][..],
        &["--version"],
        &["help", "run"],
        &["list"],
        &["show", "uniform"],
        &["completions", "bash"],
        &["schema", "-o", "-"],
        &["compare", "--trajectory", "a.txt", "b.txt"],
        &["compare", "--json", "--trajectory", "a.txt", "b.txt"],
        &["gc", "--json"],
        &["data", "inspect", "recording"],
        &["data", "convert", "recording", "-o", "out"],
    ] {
        let full = std::fs::OpenOptions::new()
            .write(true)
            .open("/dev/full")
            .unwrap();
        let output = reviv(folder.path())
            .args(arguments)
            .stdout(full)
            .output()
            .unwrap();
        let said = said(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(
            said.contains("error: stdout: No space left"),
            "{arguments:?}: {said}"
        );
    }
}

#[cfg(unix)]
#[test]
fn names_that_are_not_utf_8_are_names() {
    use std::os::unix::ffi::OsStrExt;
    let folder = tempfile::tempdir().unwrap();
    let odd = |name: &[u8]| PathBuf::from(std::ffi::OsStr::from_bytes(name));
    some_files(folder.path());
    let at = |name: &[u8]| folder.path().join(odd(name));
    std::fs::rename(folder.path().join("recording"), at(b"r\xff")).unwrap();
    std::fs::rename(folder.path().join("a.txt"), at(b"a\xff.txt")).unwrap();
    tokenizer(&at(b"body\xff.safetensors"), str::to_owned, Form::F32);
    let run = |arguments: &[&[u8]]| {
        let arguments: Vec<PathBuf> = arguments.iter().map(|a| odd(a)).collect();
        reviv(folder.path()).args(arguments).output().unwrap()
    };
    for arguments in [
        &[&b"data"[..], b"inspect", b"r\xff", b"--json"][..],
        &[b"data", b"inspect", b"r\xff", b"-o", b"i\xff"],
        &[b"data", b"convert", b"r\xff", b"-o", b"o\xff", b"--json"],
        // It goes on with the folder, because the same name is the same question.
        &[b"data", b"convert", b"r\xff", b"-o", b"o\xff"],
        &[b"data", b"inspect", b"o\xff"],
        &[b"show", b"body\xff.safetensors"],
        &[b"show", b"body\xff.safetensors", b"--json"],
        &[
            b"import",
            b"body\xff.safetensors",
            b"-o",
            b"m\xff",
            b"--json",
        ],
        &[b"compare", b"--trajectory", b"a\xff.txt", b"b.txt"],
        &[b"gc", b"--runs", b"runs\xff", b"--json"],
    ] {
        let output = run(arguments);
        assert_eq!(
            output.status.code(),
            Some(0),
            "{arguments:?}: {}",
            said(&output)
        );
    }
    let json = run(&[b"show", b"body\xff.safetensors", b"--json"]);
    let json: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    assert_eq!(json["file"], "body\\xff.safetensors");
    std::fs::write(at(b"e\xff.yaml"), "experiment: nothing\n").unwrap();
    for arguments in [
        &[&b"check"[..], b"e\xff.yaml"][..],
        &[b"check", b"--json", b"e\xff.yaml"],
        &[b"run", b"e\xff.yaml"],
        &[b"plan", b"e\xff.yaml"],
        &[b"why", b"e\xff.yaml", b"stages"],
        &[b"view", b"nothing\xff"],
        &[b"verify", b"nothing\xff"],
        &[b"compare", b"nothing\xff"],
        &[b"show", b"nothing\xff"],
        &[b"reconstruct", b"r\xff", b"--model", b"m\xff"],
    ] {
        let output = run(arguments);
        assert_eq!(
            output.status.code(),
            Some(1),
            "{arguments:?}: {}",
            said(&output)
        );
    }
}

#[derive(Clone, Copy, Debug)]
enum Form {
    F32,
    F16,
    Bf16,
    F64,
}

/// Writes the tokenizer of the body with these names, in numbers of this form.
fn tokenizer(path: &Path, name: impl Fn(&str) -> String, form: Form) {
    let settings = VqSettings {
        codebook: 16,
        width: 24,
        depth: 1,
        compression: vec![2, 3],
        ..VqSettings::default()
    };
    let shape = Shape::Kinematic {
        samples: 60,
        joints: 21,
    };
    let model = VqVae::new(&Initialise::new(&Compute::cpu(), 3), &settings, &shape).unwrap();
    let mut header = serde_json::Map::new();
    let mut bytes: Vec<u8> = Vec::new();
    for (own, tensor) in model.weights().tensors {
        let Values::F32(values) = tensor.values else {
            continue;
        };
        let start = bytes.len();
        for v in values {
            match form {
                Form::F32 => bytes.extend(v.to_le_bytes()),
                Form::F64 => bytes.extend(f64::from(v).to_le_bytes()),
                Form::F16 => bytes.extend(half::f16::from_f32(v).to_le_bytes()),
                Form::Bf16 => bytes.extend(half::bf16::from_f32(v).to_le_bytes()),
            }
        }
        let dtype = format!("{form:?}").to_uppercase();
        let entry = serde_json::json!({
            "dtype": dtype, "shape": tensor.shape, "data_offsets": [start, bytes.len()],
        });
        header.insert(name(&own), entry);
    }
    let header = serde_json::Value::Object(header).to_string();
    let mut file = (header.len() as u64).to_le_bytes().to_vec();
    file.extend(header.as_bytes());
    file.extend(bytes);
    std::fs::write(path, file).unwrap();
}

#[test]
fn tables_in_halves_agree_within_what_halves_can_tell() {
    let folder = tempfile::tempdir().unwrap();
    for form in [Form::F16, Form::Bf16, Form::F64] {
        let path = folder.path().join(format!("body_{form:?}.safetensors"));
        tokenizer(&path, str::to_owned, form);
        let output = folder.path().join(format!("{form:?}"));
        let report = import(&[path], &output, &ImportOptions::default());
        assert!(report.is_ok(), "{form:?}: {}", report.unwrap_err());
    }
    // A table that is off by more than its type can be is another table.
    let path = folder.path().join("body.safetensors");
    tokenizer(&path, str::to_owned, Form::F16);
    let mut bytes = std::fs::read(&path).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let offset = header["encoder.position_embeddings"]["data_offsets"][0]
        .as_u64()
        .unwrap() as usize;
    let at = 8 + length + offset;
    let value = half::f16::from_le_bytes([bytes[at], bytes[at + 1]]).to_f32();
    bytes[at..at + 2].copy_from_slice(&half::f16::from_f32(value + 2e-3).to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    let output = folder.path().join("off");
    let error = import(&[path], &output, &ImportOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("body.safetensors") && error.contains("position table"),
        "{error}"
    );
}

#[test]
fn wrappers_around_names_are_taken_off_and_said() {
    let folder = tempfile::tempdir().unwrap();
    for (index, (prefix, note)) in [
        ("module.", "`module.`"),
        ("_orig_mod.", "`_orig_mod.`"),
        ("module._orig_mod.", "`_orig_mod.`, `module.`"),
        ("state_dict.model.", "`state_dict.`, `model.`"),
        ("ema.", "`ema.`"),
    ]
    .into_iter()
    .enumerate()
    {
        let path = folder.path().join(format!("body{index}.safetensors"));
        tokenizer(&path, |name| format!("{prefix}{name}"), Form::F32);
        let output = folder.path().join(format!("out{index}"));
        let report = import(&[path], &output, &ImportOptions::default()).unwrap();
        let notices = report.notices.join("\n");
        assert!(notices.contains(note), "{prefix}: {notices}");
        let manifest = std::fs::read_to_string(output.join("manifest.json")).unwrap();
        assert!(manifest.contains("\"wrappers\""), "{manifest}");
    }
    // Layers that were compiled one by one.
    let path = folder.path().join("body_layers.safetensors");
    let name = |name: &str| name.replace("encoder.blocks.", "encoder._orig_mod.blocks.");
    tokenizer(&path, name, Form::F32);
    let output = folder.path().join("layers");
    import(&[path], &output, &ImportOptions::default()).unwrap();
    // Two copies under two names are not one model.
    let path = folder.path().join("body_two.safetensors");
    let name = |name: &str| {
        let front = if name.starts_with("encoder") {
            "model"
        } else {
            "ema"
        };
        format!("{front}.{name}")
    };
    tokenizer(&path, name, Form::F32);
    let output = folder.path().join("two");
    let error = import(&[path], &output, &ImportOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("body_two") && error.contains("no transformer"),
        "{error}"
    );
}

#[test]
fn weights_that_were_cut_off_are_called_so_with_their_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.safetensors");
    tokenizer(&path, str::to_owned, Form::F32);
    let whole = std::fs::read(&path).unwrap();
    let mut torch = Vec::new();
    crate::torch::save(
        &mut torch,
        &[crate::torch::Saved {
            name: "w".to_owned(),
            shape: vec![600],
            alias_of: None,
            values: Box::new(|| vec![1.0; 600]),
        }],
        &[],
    );
    for whole in [&whole, &torch] {
        for keep in [whole.len() - 1, whole.len() / 2, 60, 9] {
            std::fs::write(&path, &whole[..keep]).unwrap();
            let error = Checkpoint::open(&path).unwrap_err().to_string();
            assert!(error.contains("cut.safetensors"), "{keep}: {error}");
            assert!(error.contains("cut off"), "{keep}: {error}");
        }
    }
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 12345\n";
    std::fs::write(&path, pointer).unwrap();
    let error = Checkpoint::open(&path).unwrap_err().to_string();
    assert!(
        error.contains("Git LFS pointer") && error.contains("git lfs pull"),
        "{error}"
    );
}

fn transposed(m: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[c][r]))
}

type Change = fn([[f64; 4]; 4]) -> [[f64; 4]; 4];

#[test]
fn matrices_that_are_no_poses_are_refused_by_what_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording");
    let changes: [(Change, &str); 4] = [
        (transposed, "the fourth row of the pose is not 0 0 0 1"),
        (
            |mut m| {
                m[3] = [0.0, 0.0, 0.0, 2.0];
                m
            },
            "fourth row",
        ),
        (
            |m| {
                std::array::from_fn(|r| {
                    std::array::from_fn(|c| m[r][c] * if r < 3 { 100.0 } else { 1.0 })
                })
            },
            "scaled by 100",
        ),
        (
            |mut m| {
                m[0].iter_mut().for_each(|v| *v = -*v);
                m
            },
            "mirrored",
        ),
    ];
    for (change, part) in changes {
        recording(&path, change);
        let error = neutral::open(&path).unwrap_err().to_string();
        assert!(
            error.contains("camera.npz") && error.contains(part),
            "{part}: {error}"
        );
    }
}

#[test]
fn a_recording_names_files_of_its_own_folder_only() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording");
    recording(&path, |pose| pose);
    std::fs::copy(path.join("camera.npz"), folder.path().join("camera.npz")).unwrap();
    for file in ["../camera.npz", "/etc/passwd", "a/../../camera.npz"] {
        let manifest = MANIFEST.replace("file: camera.npz", &format!("file: {file}"));
        std::fs::write(path.join("recording.yaml"), manifest).unwrap();
        let error = neutral::open(&path).unwrap_err().to_string();
        assert!(
            error.contains("recording.yaml") && error.contains("outside"),
            "{error}"
        );
    }
    for (from, to) in [
        ("source: mine", "source: ../../evil"),
        ("source: mine", "name: a/b"),
    ] {
        std::fs::write(path.join("recording.yaml"), MANIFEST.replace(from, to)).unwrap();
        let error = neutral::open(&path).unwrap_err().to_string();
        assert!(error.contains("no name of a folder"), "{error}");
    }
    // As an editor may have saved it.
    for manifest in [
        format!("\u{feff}{}", MANIFEST.replace('\n', "\r\n")),
        MANIFEST.replace("source: ", "source:\u{a0}"),
        MANIFEST.replace('\n', "\r"),
    ] {
        std::fs::write(path.join("recording.yaml"), &manifest).unwrap();
        assert!(
            neutral::source(folder.path(), CutSettings::default()).is_ok(),
            "{manifest:?}"
        );
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_device_without_an_end_is_no_array() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("endless.npy");
    std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
    let error = npy::read(&path).unwrap_err().to_string();
    assert!(
        error.contains("endless.npy") && error.contains("device"),
        "{error}"
    );
    let array = NpyArray::from(&ndarray::arr1(&[1.0f32]));
    npy::write(&folder.path().join("real.npy"), &array).unwrap();
    std::os::unix::fs::symlink("real.npy", folder.path().join("link.npy")).unwrap();
    assert_eq!(npy::read(&folder.path().join("link.npy")).unwrap(), array);
}

#[test]
fn pruning_waits_for_a_run_that_begins_and_keeps_what_it_found() {
    use crate::run::{artifacts, cell, experiment, run};
    use reviv::run::Cache;
    use reviv::run::lock::{Lock, Mode};
    use std::time::Duration;
    let folder = tempfile::tempdir().unwrap();
    let runs = folder.path().join("runs");
    let asked = experiment(vec![cell("", 0, serde_json::json!({"steps": 25}), 1.0)]);
    let first = run(&asked, &runs);
    let made = artifacts(&Cache::of(&runs));
    // The run's directory is gone: its artifacts may go, but for a run that begins just now and finds them.
    std::fs::remove_dir_all(first.run.path()).unwrap();
    let begins = Lock::take(&runs.join(".lock-gc"), Mode::Shared).unwrap();
    let (there, done) = std::sync::mpsc::channel();
    let pruner = {
        let runs = runs.clone();
        std::thread::spawn(move || {
            let pruned = prune(&runs, Options::default()).unwrap();
            there.send(()).unwrap();
            pruned
        })
    };
    assert!(
        done.recv_timeout(Duration::from_millis(300)).is_err(),
        "it did not wait"
    );
    assert_eq!(artifacts(&Cache::of(&runs)), made);
    // The run writes what it refers to, and lets go.
    let second = run(&asked, &runs);
    assert_eq!(second.made, 0);
    drop(begins);
    let pruned = pruner.join().unwrap();
    assert!(pruned.paths.is_empty(), "{:?}", pruned.paths);
    assert_eq!(artifacts(&Cache::of(&runs)), made);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn no_damage_makes_the_reader_of_old_torch_files_panic(at in 0usize..700, value in any::<u8>(), cut in 0usize..900) {
        let mut bytes = legacy();
        let at = at % bytes.len();
        bytes[at] = value;
        bytes.truncate(cut);
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        if let Ok(mut checkpoint) = Checkpoint::open(file.path()) {
            for index in 0..checkpoint.entries().len() {
                let _ = checkpoint.values(index);
            }
        }
    }
}

/// `torch.save({"model": {"w": torch.arange(6.).reshape(2, 3)}}, f, _use_new_zipfile_serialization=False)`, put together by hand.
fn legacy() -> Vec<u8> {
    let mut out = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.".to_vec();
    out.extend(b"\x80\x02M\xe9\x03.");
    out.extend(
        b"\x80\x02}(X\x10\x00\x00\x00protocol_versionM\xe9\x03X\x0d\x00\x00\x00little_endian\x88u.",
    );
    let tensor = [
        &b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x06NtQ"[..],
        b"K\x00K\x02K\x03\x86K\x03K\x01\x86\x89ccollections\nOrderedDict\n)RtR",
    ]
    .concat();
    out.extend(b"\x80\x02}X\x05\x00\x00\x00model}X\x01\x00\x00\x00w");
    out.extend(tensor);
    out.extend(b"ss.");
    out.extend(b"\x80\x02]X\x01\x00\x00\x000a.");
    out.extend(6u64.to_le_bytes());
    out.extend((0..6).flat_map(|v| (v as f32).to_le_bytes()));
    out
}

#[test]
fn torch_files_from_before_the_archive_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("old.pth");
    std::fs::write(&path, legacy()).unwrap();
    let mut checkpoint = Checkpoint::open(&path).unwrap();
    assert_eq!(checkpoint.entries()[0].name, "w");
    assert_eq!(
        checkpoint.values(0).unwrap(),
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    );
    let whole = legacy();
    for keep in [whole.len() - 1, whole.len() - 20, 200, 30] {
        std::fs::write(&path, &whole[..keep]).unwrap();
        let error = Checkpoint::open(&path).unwrap_err().to_string();
        assert!(
            error.contains("old.pth") && error.contains("cut off"),
            "{keep}: {error}"
        );
    }
}
