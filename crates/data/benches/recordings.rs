//! Speed of reading recordings: `cargo bench --bench recordings`; frames per second beside `ffmpeg`'s are in `video`.
//!
//! Uses `$REVIV_SHARED/data/video/ego_kitchen_1080p30_4s.mp4` and the ADT sample where they are, else only the small video of
//! the tests. Aim: a 2 s clip of 1080p30 in at most 1.3 s with the embedded decoder, 0.8 s with `ffmpeg`; shards at
//! 200 MB/s or more.

use reviv_data::clip::store::ClipSet;
use reviv_data::datasets::aria::vrs::Vrs;
use reviv_data::datasets::convert::{ConvertSettings, Share, convert};
use reviv_data::datasets::recording::CutSettings;
use reviv_data::datasets::shards::TarSink;
use reviv_data::datasets::{ClipSource, mps};
use reviv_data::video::{DecoderChoice, Video, VideoSettings, ffmpeg};
use reviv_data::world::{World, WorldClips, WorldSettings};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn main() {
    divan::main();
}

fn shared(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("REVIV_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"),
        PathBuf::from,
    );
    let path = root.join("data").join(name);
    path.exists().then_some(path)
}

fn clip(bencher: divan::Bencher<'_, '_>, path: &Path, decoder: DecoderChoice, side: u32) {
    let settings = VideoSettings {
        decoder,
        ..VideoSettings::default()
    };
    let video = Video::open_with(path, &settings).expect("the video opens");
    bencher.bench(|| video.load_clip(0, 8.0, 16, side).expect("the clip is read"));
}

#[divan::bench(sample_count = 5, sample_size = 1)]
fn clip_1080p30_embedded(bencher: divan::Bencher<'_, '_>) {
    if let Some(path) = shared("video/ego_kitchen_1080p30_4s.mp4") {
        clip(bencher, &path, DecoderChoice::Embedded, 256);
    }
}

#[divan::bench(sample_count = 5, sample_size = 1)]
fn clip_1080p30_ffmpeg(bencher: divan::Bencher<'_, '_>) {
    if let Some(path) = shared("video/ego_kitchen_1080p30_4s.mp4").filter(|_| ffmpeg::available()) {
        clip(bencher, &path, DecoderChoice::Ffmpeg, 256);
    }
}

/// What `reconstruct` reads of four seconds: 8 frames a second as squares of 256, on all cores.
#[divan::bench(sample_count = 3, sample_size = 1)]
fn squares_1080p30_embedded(bencher: divan::Bencher<'_, '_>) {
    let Some(path) = shared("video/ego_kitchen_1080p30_4s.mp4") else {
        return;
    };
    let video = Video::open(&path).expect("the video opens");
    let frames = video.schedule().clip(0, 8.0, 32);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    bencher.bench(|| {
        let squares = video.squares(frames.clone(), 256, threads);
        squares.expect("the video is read").count()
    });
}

#[divan::bench(sample_count = 20)]
fn clip_small(bencher: divan::Bencher<'_, '_>) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/synthetic_30fps.mp4");
    clip(bencher, &path, DecoderChoice::Embedded, 64);
}

#[divan::bench(sample_count = 20)]
fn vrs_index(bencher: divan::Bencher<'_, '_>) {
    if let Some(path) = shared("adt_sample/video.vrs") {
        bencher.bench(|| Vrs::open(&path).expect("the recording opens"));
    }
}

#[divan::bench(sample_count = 10)]
fn mps_clip(bencher: divan::Bencher<'_, '_>) {
    if let Some(path) = shared("mps_sample") {
        let source = mps::source(&path, CutSettings::default()).expect("the recording opens");
        bencher.bench(|| source.clip(1).expect("the clip is made"));
    }
}

/// Shards of twelve world clips at the paper's size: bytes per second through the reader, clip by clip.
#[divan::bench(sample_count = 10)]
fn shards_stream(bencher: divan::Bencher<'_, '_>) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let world = WorldClips::new(World::new(WorldSettings::default(), 0), 0..12);
    let sink = TarSink::new(folder.path(), &folder.path().join(".finished")).expect("a sink");
    let settings = ConvertSettings {
        clips_per_shard: 4,
        ..ConvertSettings::default()
    };
    convert(&world, &sink, &settings, Share::WHOLE, &mut |_| {
        ControlFlow::Continue(())
    })
    .expect("clips are made");
    let bytes: u64 = tars(folder.path()).iter().sum();
    let set = ClipSet::open(folder.path()).expect("the shards open");
    bencher
        .counter(divan::counter::BytesCount::new(bytes))
        .bench(|| {
            for index in 0..set.len() {
                std::hint::black_box(set.clip(index).expect("the clip is read"));
            }
        });
}

fn tars(folder: &Path) -> Vec<u64> {
    let mut sizes = Vec::new();
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let entry = entry.expect("an entry");
        if entry.path().is_dir() {
            sizes.extend(tars(&entry.path()));
        } else {
            sizes.push(entry.metadata().expect("a size").len());
        }
    }
    sizes
}
