//! Where the time of a conversion goes, per data set: `cargo bench -p reviv-data --bench sets`, on the samples in `$REVIV_SHARED/layouts`.
//!
//! On one thread, the clips of a recording one after the other; beside it, the decoding of the pictures of the same clips and nothing
//! else. The rest is resizing, signals and bookkeeping. Then the same clips again and again: what the process holds must not grow.

use reviv_data::datasets::aria::vrs::image::Pictures;
use reviv_data::datasets::aria::vrs::{StreamId, Vrs};
use reviv_data::datasets::open::{Dataset, OpenWith, open};
use reviv_data::datasets::recording::CutSettings;
use reviv_data::video::Video;
use reviv_data::video::grey16::Grey16Video;
use reviv_data::video::image::{Image, grey16_from_png};
use std::hint::black_box;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Turns over all clips; the best one counts.
const TURNS: usize = 3;
/// Turns while memory is watched.
const LONG: usize = 10;

fn main() {
    let root = std::env::var_os("REVIV_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"),
        PathBuf::from,
    );
    let root = root.join("layouts");
    if !root.is_dir() {
        println!("no samples in {}", root.display());
        return;
    }
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    one.expect("a thread").install(|| {
        println!("| set | clip, s | its pictures alone, s | share | memory after 1 and {LONG} turns, MiB |\n|---|--:|--:|--:|--:|");
        for kind in [
            Dataset::Nymeria,
            Dataset::EgoExo4d,
            Dataset::Holoassist,
            Dataset::Egogen,
            Dataset::Hot3dClips,
            Dataset::Arctic,
            Dataset::Taco,
            Dataset::H2o,
        ] {
            measure(&root, kind);
        }
    });
}

fn measure(root: &Path, kind: Dataset) {
    let folder = root.join(kind.name());
    let mano = root.join("fake_mano");
    let with = OpenWith {
        mano: Some(&mano),
        ..OpenWith::default()
    };
    let source =
        open(&folder, Some(kind), &CutSettings::default(), with).expect("the sample opens");
    let clips = source.len();
    let turn = || {
        for index in 0..clips {
            black_box(source.clip(index).expect("the clip is made"));
        }
    };
    let whole = best(&turn) / clips as f64;
    let decode = pictures(&folder, kind, clips);
    let alone = best(&decode) / clips as f64;
    let first = resident();
    for _ in 0..LONG {
        turn();
    }
    println!(
        "| {} | {whole:.3} | {alone:.3} | {:.0} % | {first:.0}, {:.0} |",
        kind.name(),
        100.0 * alone / whole,
        resident()
    );
}

fn best(work: &dyn Fn()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..TURNS {
        let start = Instant::now();
        work();
        best = best.min(start.elapsed().as_secs_f64());
    }
    best
}

/// MiB that the process holds.
fn resident() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib: f64 = line
        .and_then(|line| line.trim().trim_end_matches(" kB").parse().ok())
        .unwrap_or(f64::NAN);
    kib / 1024.0
}

/// The frames of so many clips of two seconds at `rate`, sixteen each.
fn frames(clips: usize, rate: f64) -> Vec<usize> {
    let all = (0..clips * 16).map(|k| (k as f64 * rate / 8.0).round() as usize);
    all.collect()
}

fn found(folder: &Path, name: &str) -> PathBuf {
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
            let path = entry.path();
            if path.ends_with(name) {
                return path;
            }
            if path.is_dir() {
                open.push(path);
            }
        }
    }
    panic!("no `{name}`");
}

fn video(path: PathBuf, frames: Vec<usize>) -> Box<dyn Fn()> {
    Box::new(move || {
        let video = Video::open(&path).expect("the video opens");
        let chosen = video.chosen(frames.clone()).expect("the video is read");
        for frame in chosen {
            black_box(frame.expect("a frame"));
        }
    })
}

fn files(folder: PathBuf, names: Vec<String>, decode: fn(&[u8])) -> Box<dyn Fn()> {
    Box::new(move || {
        for name in &names {
            decode(&std::fs::read(folder.join(name)).expect("a picture"));
        }
    })
}

fn colour(bytes: &[u8]) {
    black_box(Image::from_bytes(bytes).expect("a picture"));
}

fn depth(bytes: &[u8]) {
    black_box(grey16_from_png(bytes).expect("a depth map"));
}

/// Decodes the pictures of the clips, and nothing else.
fn pictures(folder: &Path, kind: Dataset, clips: usize) -> Box<dyn Fn()> {
    let at_30 = frames(clips, 30.0);
    match kind {
        Dataset::Nymeria => {
            let path = found(folder, "data.vrs");
            Box::new(move || {
                let vrs = Arc::new(Vrs::open(&path).expect("the recording opens"));
                let pictures = Pictures::new(vrs, StreamId::RGB).expect("pictures");
                for frame in at_30.iter().filter(|frame| **frame < pictures.len()) {
                    black_box(pictures.read(*frame).expect("a picture"));
                }
            })
        }
        Dataset::EgoExo4d => video(
            found(folder, "frame_aligned_videos/aria01_214-1.mp4"),
            at_30,
        ),
        Dataset::Holoassist => video(found(folder, "Video_pitchshift.mp4"), at_30),
        Dataset::Egogen => {
            let (one, other) = (
                found(folder, "scene0_00012.mp4"),
                found(folder, "scene0_00013.mp4"),
            );
            let (one, other) = (
                video(one, (0..32).collect()),
                video(other, (0..32).collect()),
            );
            Box::new(move || {
                one();
                other();
            })
        }
        Dataset::Hot3dClips => {
            let path = found(folder, "clip-000017.tar");
            let wanted: Vec<String> = at_30
                .iter()
                .map(|f| format!("{f:06}.image_214-1.jpg"))
                .collect();
            Box::new(move || {
                let mut tar = tar::Archive::new(std::fs::File::open(&path).expect("the tar opens"));
                for entry in tar.entries().expect("members") {
                    let mut entry = entry.expect("a member");
                    let name = entry.path().expect("a name").to_string_lossy().into_owned();
                    if wanted.contains(&name) {
                        let mut bytes = Vec::new();
                        entry.read_to_end(&mut bytes).expect("a picture");
                        colour(&bytes);
                    }
                }
            })
        }
        Dataset::Arctic => {
            let names = at_30.iter().map(|frame| format!("{:05}.jpg", frame + 3));
            files(found(folder, "box_grab_01/0"), names.collect(), colour)
        }
        Dataset::Taco => {
            let colour = video(found(folder, "color.mp4"), at_30.clone());
            let depth = found(folder, "egocentric_depth.avi");
            Box::new(move || {
                colour();
                let video = Grey16Video::open(&depth).expect("the depth opens");
                let read = video.read(&at_30, &mut |_, map| {
                    black_box(map);
                });
                read.expect("depth is read");
            })
        }
        _ => {
            let of = |kind: &str| found(folder, &format!("cam4/{kind}"));
            let names: Vec<String> = at_30
                .iter()
                .map(|frame| format!("{frame:06}.png"))
                .collect();
            let (one, other) = (
                files(of("rgb"), names.clone(), colour),
                files(of("depth"), names, depth),
            );
            Box::new(move || {
                one();
                other();
            })
        }
    }
}
