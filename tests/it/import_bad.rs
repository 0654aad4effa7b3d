//! Files that are not what they seem: refused with a reason, in bounded time and memory.

use crate::torch::{self, Argument};
use proptest::prelude::*;
use reviv::import::{Checkpoint, ImportOptions};
use std::io::Write;

/// A torch archive with this pickle and one storage of 24 bytes.
fn archive(pickle: &[u8]) -> Vec<u8> {
    let mut zip = reviv::formats::zip::ZipWriter::new(Vec::new());
    zip.add("a/data.pkl", pickle).unwrap();
    zip.add("a/data/0", &[0; 24]).unwrap();
    zip.finish().unwrap()
}

fn open(bytes: &[u8]) -> Result<Checkpoint, String> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    Checkpoint::open(file.path()).map_err(|e| e.to_string())
}

#[test]
fn hostile_archives_are_refused_with_a_reason() {
    let one = |opcodes: Vec<u8>| torch::pickle(&[("w".to_owned(), opcodes)], &[]);
    let good = one(torch::tensor(0, 6, &[2, 3], &[3, 1]));
    assert!(open(&archive(&good)).is_ok());
    assert!(open(&archive(&one(torch::tensor(0, 6, &[3, 2], &[1, 3])))).is_ok());
    let two = torch::pickle(
        &[
            ("a".to_owned(), torch::tensor(0, 6, &[6], &[1])),
            ("b".to_owned(), torch::tensor(0, 6, &[2, 3], &[3, 1])),
        ],
        &[],
    );
    for (pickle, part) in [
        (
            b"cos\nsystem\n(X\x04\x00\x00\x00truetR.".to_vec(),
            "os.system",
        ),
        (b"cbuiltins\nexec\n.".to_vec(), "builtins.exec"),
        (one(torch::tensor(0, 7, &[7], &[1])), "do not fit"),
        (one(torch::tensor(1, 6, &[6], &[1])), "missing"),
        (
            one(torch::tensor(0, 6, &[1 << 20, 1 << 20], &[0, 0])),
            "over a storage",
        ),
        (
            one(torch::tensor(0, 6, &[2, 3], &[2, 1])),
            "overlaps itself",
        ),
        (
            one(torch::tensor(0, 6, &[2, 3], &[4, 1])),
            "leaves its storage",
        ),
        (b"\x80\x02K\x01.".to_vec(), "neither a dictionary"),
        (b"\x80\x02}.".to_vec(), "no dictionary of tensors"),
    ] {
        let error = open(&archive(&pickle)).unwrap_err();
        assert!(error.contains(part), "{part}: {error}");
    }
    // What overlaps can be looked at, not imported: twice as much would be written as there is.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("two.pth");
    std::fs::write(&path, archive(&two)).unwrap();
    assert_eq!(Checkpoint::open(&path).unwrap().entries().len(), 2);
    let error = reviv::import::import(
        &[path],
        &folder.path().join("out"),
        &ImportOptions::default(),
    );
    assert!(error.unwrap_err().to_string().contains("overlap"));
    assert!(
        open(b"hello, this is no checkpoint")
            .unwrap_err()
            .contains("neither")
    );
    assert!(
        open(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.")
            .unwrap_err()
            .contains("cut off in its version")
    );
    let whole = archive(&good);
    for end in 0..whole.len() {
        assert!(open(&whole[..end]).is_err(), "{end}");
    }
}

/// An archive whose only member, `a/data.pkl`, is deflated.
fn deflated(pickle: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(pickle).unwrap();
    let data = encoder.finish().unwrap();
    let mut crc = flate2::Crc::new();
    crc.update(pickle);
    let name = b"a/data.pkl";
    let mut fields = Vec::new();
    for value in [20u16, 0, 8, 0, 0] {
        fields.extend(value.to_le_bytes());
    }
    for value in [
        crc.sum(),
        data.len() as u32,
        pickle.len() as u32,
        name.len() as u32,
    ] {
        fields.extend(value.to_le_bytes());
    }
    let mut out = [b"PK\x03\x04", &fields[..], name, &data].concat();
    let directory = out.len() as u32;
    out.extend([b"PK\x01\x02\x14\x00", &fields[..], &[0; 14], name].concat());
    let size = out.len() as u32 - directory;
    out.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
    out.extend(size.to_le_bytes());
    out.extend(directory.to_le_bytes());
    out.extend([0, 0]);
    out
}

fn text(value: &[u8]) -> Vec<u8> {
    [b"X", &(value.len() as u32).to_le_bytes()[..], value].concat()
}

/// Twenty-five levels, each of which holds the one below twice: 2^25 leaves, in a few hundred bytes. `open` starts a level,
/// `close` ends it; between them stand two pairs of key and value.
fn doubling(innermost: &[u8], open: &[u8], close: &[u8]) -> Vec<u8> {
    let mut out = innermost.to_vec();
    out.extend(b"q\x00");
    for level in 0..25u8 {
        out.push(b'0');
        out.extend(open);
        for key in [b"a", b"b"] {
            out.extend(text(key));
            out.extend([b'h', level]);
        }
        out.extend(close);
        out.extend([b'q', level + 1]);
    }
    out
}

/// Small files that ask for much: name, bytes, and a part of the reason they are refused for.
fn bombs() -> Vec<(&'static str, Vec<u8>, &'static str)> {
    let module = b"c__torch__.m\nM\n)\x81}(";
    let tensor = torch::tensor(0, 6, &[2, 3], &[3, 1]);
    let leaf = [&module[..], &text(b"w"), &tensor, b"ub"].concat();
    let modules = [&b"\x80\x02"[..], &doubling(&leaf, module, b"ub"), b"."].concat();
    let maps = doubling(b"}", b"}(", b"u");
    let model = [&text(b"model")[..], b"}(", &text(b"w"), &tensor, b"u"].concat();
    let arguments = [
        b"\x80\x02",
        &maps[..],
        b"0}(",
        &model,
        &text(b"args"),
        &[b'h', 25],
        b"u.",
    ];
    let itself = [
        b"\x80\x02c__torch__.m\nM\n)\x81q\x00}(",
        &text(b"a")[..],
        b"h\x00ub.",
    ];
    // One text of a megabyte under which a thousand tensors are kept, and one in a thousand arguments.
    let long = [&text(&vec![b'n'; 1 << 20])[..], b"q\x00"].concat();
    let names = [b"h\x00h\x01".repeat(1000)].concat();
    let keys = [
        b"\x80\x02",
        &long[..],
        b"0",
        &tensor,
        b"q\x010}(",
        &names,
        b"u.",
    ]
    .concat();
    let list = [
        b"\x80\x02",
        &long[..],
        b"0}(",
        &model,
        &text(b"args"),
        b"](",
        &b"h\x00".repeat(1000),
        b"eu.",
    ];
    // A hundred thousand pairs whose keys are not text.
    let pairs = [
        b"\x80\x02Nq\x000}(",
        &model[..],
        &text(b"args"),
        b"}(",
        &b"h\x00".repeat(200_000),
        b"uu.",
    ];
    let mut deep = b"\x80\x02".to_vec();
    deep.extend(b"}(X\x01\x00\x00\x00a".repeat(100_000));
    deep.extend(b"N");
    deep.extend(b"u".repeat(100_000));
    deep.push(b'.');
    vec![
        ("inflates", deflated(&vec![0; 200 << 20]), "accepted here"),
        ("objects", deflated(&[b'N'; 10 << 20]), "objects"),
        ("deep", deflated(&deep), "no dictionary of tensors"),
        ("modules", archive(&modules), "nodes"),
        ("itself", archive(&itself.concat()), "deep"),
        (
            "arguments",
            archive(&arguments.concat()),
            "nested too deeply",
        ),
        ("names", archive(&keys), "name of 1048576 bytes"),
        ("texts", archive(&list.concat()), "too large"),
        ("pairs", archive(&pairs.concat()), "too large"),
    ]
}

#[test]
fn bombs_are_refused_in_a_gigabyte_and_in_seconds() {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes, part) in bombs() {
        assert!(bytes.len() < 2 << 20, "{name}: {} bytes", bytes.len());
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let start = std::time::Instant::now();
        let mut command = if cfg!(target_os = "linux") {
            let mut shell = std::process::Command::new("sh");
            shell.args(["-c", "ulimit -v 1000000; exec \"$0\" \"$@\""]);
            shell.arg(env!("CARGO_BIN_EXE_reviv"));
            shell
        } else {
            std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
        };
        let output = command.arg("show").arg(&path).output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {error}");
        assert!(error.contains(part), "{name}: {error}");
        assert!(start.elapsed().as_secs() < 20, "{name}");
    }
}

#[test]
fn absurd_headers_of_safetensors_are_refused() {
    let file = |header: &str, values: usize| {
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend(vec![0; values]);
        bytes
    };
    let entry = |shape: &str, from: u64, to: u64| {
        format!(r#"{{"w":{{"dtype":"F32","shape":{shape},"data_offsets":[{from},{to}]}}}}"#)
    };
    assert!(open(&file(&entry("[2,3]", 0, 24), 24)).is_ok());
    let empty = entry("[0,1099511627776,1099511627776]", 0, 0);
    assert!(open(&file(&empty, 0)).is_ok());
    let mixed = r#"{"mean":{"dtype":"F32","shape":[6],"data_offsets":[0,24]},"step":{"dtype":"I64","shape":[1],"data_offsets":[24,32]}}"#;
    assert!(open(&file(mixed, 32)).is_ok());
    for (header, values, part) in [
        (entry("[2,3]", 0, 24), 20, "cut off"),
        (entry("[4294967296,4294967296]", 0, 24), 24, "not valid"),
        (entry("[2,3]", 0, 20), 24, "not valid"),
        (entry("[2,3]", 24, 0), 24, "not valid"),
        (entry("[2,-3]", 0, 24), 24, "not valid"),
        (entry("[2,3]", 1, 25), 25, "not valid"),
        (entry("[1,1,1,1,1,1,1,1,6]", 0, 24), 24, "not valid"),
        (r#"{"w":7}"#.to_owned(), 24, "not valid"),
        (r#"{"w":"#.repeat(1000), 24, "not JSON"),
        (
            r#"{"a":{"dtype":"F32","shape":[6],"data_offsets":[0,24]},"b":{"dtype":"F32","shape":[5],"data_offsets":[4,24]}}"#.to_owned(),
            24,
            "overlap",
        ),
    ] {
        let error = open(&file(&header, values)).unwrap_err();
        assert!(error.contains(part), "{header}: {error}");
    }
    let mut long = file(&entry("[2,3]", 0, 24), 24);
    long[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(open(&long).is_err());
}

fn read_all(bytes: &[u8]) {
    if let Ok(mut checkpoint) = open(bytes) {
        for index in 0..checkpoint.entries().len() {
            let _ = checkpoint.values(index);
        }
    }
}

/// Pieces of a TorchScript pickle: modules, parameters, references to each of them, and what does not belong there.
fn modules() -> impl Strategy<Value = Vec<u8>> {
    let pieces: Vec<Vec<u8>> = vec![
        b"c__torch__.m\nM\n)\x81".to_vec(),
        b"}(".to_vec(),
        text(b"w"),
        text(b"encoder"),
        text(b"\xc3\xa9."),
        torch::tensor(0, 6, &[2, 3], &[3, 1]),
        torch::tensor(0, 6, &[3], &[2]),
        torch::tensor(0, 7, &[7], &[1]),
        b"ctorch.jit._pickle\nbuild_intlist\n](K\x01K\x02e\x85R".to_vec(),
        b"ub".to_vec(),
        b"u".to_vec(),
        b"b".to_vec(),
        b"q\x00".to_vec(),
        b"h\x00".to_vec(),
        b"q\x01".to_vec(),
        b"h\x01".to_vec(),
        b"\x89".to_vec(),
        b"N".to_vec(),
        b"0".to_vec(),
    ];
    proptest::collection::vec(proptest::sample::select(pieces), 0..60).prop_map(|pieces| {
        [
            &b"\x80\x02c__torch__.m\nM\n)\x81}("[..],
            &pieces.concat(),
            b"ub.",
        ]
        .concat()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_damage_to_a_checkpoint_makes_the_reader_panic(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
        script in any::<bool>(),
    ) {
        let tensor = torch::tensor(0, 6, &[3, 2], &[1, 3]);
        let mut bytes = archive(&if script {
            torch::script(&[("encoder", "w", tensor)])
        } else {
            torch::pickle(&[("w".to_owned(), tensor)], &[("model", Argument::Text("x".into()))])
        });
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        read_all(&bytes);
    }

    #[test]
    fn no_tree_of_torchscript_modules_makes_the_reader_panic(pickle in modules()) {
        read_all(&archive(&pickle));
    }

    #[test]
    fn no_damage_to_safetensors_makes_the_reader_panic(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut weights = reviv::engine::Weights::default();
        weights.insert_f32("w", vec![1.0; 6], &[2, 3]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        weights.write(&path).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        read_all(&bytes);
    }
}
