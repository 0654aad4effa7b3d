//! A released checkpoint of full size: the 256 base model (1.6 GB, synthesised here with random weights) is imported, with
//! small tokenizers, and decodes a clip end to end.
//!
//! `cargo bench --bench import [-- FOLDER]` prints the time against plain copying of the same file, and the peak of resident
//! memory against the largest tensor plus 200 MB. Needs 6 GB of disk in FOLDER (default: the system's temporary folder).
#![allow(clippy::unwrap_used)] // A bench that cannot go on should stop where it is.

#[path = "../tests/it/released.rs"]
mod released;
#[path = "../tests/it/torch.rs"]
#[allow(dead_code)] // Tests use the rest.
mod torch;

use reviv::decoding::DecodingSettings;
use reviv::engine::Compute;
use reviv::import::{Checkpoint, ImportOptions, import};
use reviv::mget::Size;
use reviv::model::{GenerationRequest, Model};
use reviv::world::{World, WorldSettings};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if let [_, child, from, to] = arguments.as_slice()
        && child == "--import"
    {
        return child_import(Path::new(from), Path::new(to));
    }
    let chosen = arguments.iter().skip(1).find(|a| !a.starts_with("--"));
    let root = chosen.map_or_else(std::env::temp_dir, PathBuf::from);
    let temporary = tempfile::tempdir_in(root).unwrap();
    let released = temporary.path().join("reviv_500b");
    std::fs::create_dir(&released).unwrap();
    let size = Size {
        width: 768,
        heads: 12,
        encoder_depth: 12,
        decoder_depth: 12,
        hidden: 2048,
    };
    let spec = released::spec(size, [5, 32, 32], [256, 512, 1024, 1024]);
    assert_eq!(spec.parameter_count(), 401_931_264);
    let main = released.join("reviv_main.pth");
    let start = Instant::now();
    released::main_model(&main, &spec, "fm_base_12e_12d_swiglu_nobias");
    let bytes = std::fs::metadata(&main).unwrap().len();
    println!(
        "synthesised {:.2} GB in {:.1} s",
        bytes as f64 / 1e9,
        start.elapsed().as_secs_f64()
    );
    let largest = {
        let checkpoint = Checkpoint::open(&main).unwrap();
        assert_eq!(checkpoint.entries().len(), 359);
        checkpoint
            .entries()
            .iter()
            .map(reviv::import::Entry::bytes)
            .max()
            .unwrap()
    };

    // Copying and importing, alternately, so that both find the file in the same state.
    let mut copies = Vec::new();
    let mut imports = Vec::new();
    let mut peak = 0;
    for round in 0..3 {
        let copy = temporary.path().join("copy");
        let start = Instant::now();
        std::fs::copy(&main, &copy).unwrap();
        File::open(&copy).unwrap().sync_all().unwrap();
        copies.push(start.elapsed().as_secs_f64());
        std::fs::remove_file(&copy).unwrap();
        let folder = temporary.path().join(format!("imported-{round}"));
        let output = Command::new(std::env::current_exe().unwrap())
            .arg("--import")
            .args([&main, &folder])
            .output()
            .unwrap();
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        let text = String::from_utf8(output.stdout).unwrap();
        let mut words = text.split_whitespace();
        imports.push(words.next().unwrap().parse::<f64>().unwrap());
        peak = peak.max(words.next().unwrap().parse::<u64>().unwrap());
        std::fs::remove_dir_all(&folder).unwrap();
    }
    copies.sort_by(f64::total_cmp);
    imports.sort_by(f64::total_cmp);
    let rate = |seconds: f64| bytes as f64 / 1e6 / seconds;
    println!("copy   {:.2} s ({:.0} MB/s)", copies[1], rate(copies[1]));
    println!("import {:.2} s ({:.0} MB/s)", imports[1], rate(imports[1]));
    let limit = largest + 200_000_000;
    println!(
        "peak of resident memory {:.0} MB, at most {:.0} MB: {}",
        peak as f64 / 1e6,
        limit as f64 / 1e6,
        if peak <= limit { "ok" } else { "TOO MUCH" }
    );

    let small = released::Small {
        width: 48,
        depth: 2,
        channels: 8,
    };
    released::tokenizers(&released, &spec, small);
    let folder = temporary.path().join("model");
    let files = [released.clone(), released::video(&released)];
    let report = import(&files, &folder, &ImportOptions::default()).unwrap();
    assert!(report.notices.is_empty(), "{:?}", report.notices);
    for part in &report.parts {
        println!(
            "{}: {} of {} entries written",
            part.name, part.written, part.entries
        );
    }
    decode(&folder);
}

/// Imports in a process of its own, which tells its time and its peak of memory.
fn child_import(from: &Path, to: &Path) {
    let start = Instant::now();
    let report = import(&[from.to_owned()], to, &ImportOptions::default()).unwrap();
    let seconds = start.elapsed().as_secs_f64();
    assert_eq!(
        (report.parts[0].entries, report.parts[0].written),
        (359, 256)
    );
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = peak.and_then(|peak| peak.split_whitespace().next()?.parse::<u64>().ok());
    println!("{seconds} {}", kilobytes.unwrap_or(0) * 1024);
}

/// The shipped entry `fast`: one pass for most targets.
fn fast() -> DecodingSettings {
    let text = include_str!("../registry/decoding/fast.yaml");
    let mut entry: serde_json::Value = serde_saphyr::from_str(text).unwrap();
    let map = entry.as_object_mut().unwrap();
    map.remove("decoding");
    map.remove("about");
    serde_json::from_value(entry).unwrap()
}

/// A clip of the built-in world through the imported model: RGB and raw video in, everything but depth out.
fn decode(folder: &Path) {
    let world = World::new(WorldSettings::default(), 7);
    let clip = world.clip(0);
    let start = Instant::now();
    let model = Model::open(folder, &Compute::cpu()).unwrap();
    println!("opened in {:.1} s", start.elapsed().as_secs_f64());
    let inputs = ["rgb".to_owned()];
    let targets = ["body", "camera", "gaze", "left_hand", "right_hand"].map(str::to_owned);
    let wish = GenerationRequest {
        inputs: &inputs,
        targets: &targets,
        decoding: &fast(),
        seed: 0,
    };
    let start = Instant::now();
    let made = model.predict(&[clip], &[0], &wish).unwrap();
    for (name, certainty) in &made[0].certainty {
        println!("{name}: {} samples", certainty.len());
    }
    assert!(made[0].clip.body().is_some() && made[0].clip.camera().is_some());
    println!("decoded a clip in {:.1} s", start.elapsed().as_secs_f64());
}
