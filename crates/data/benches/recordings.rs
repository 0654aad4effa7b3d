//! Speed of reading recordings: `cargo bench --bench recordings`.
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
use std::process::Command;

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

/// Seconds of the kitchen video that are decoded frame by frame.
const SECONDS: &str = "2";
const CODECS: [(&str, &str); 4] = [
    ("h264", "-c:v copy"),
    (
        "hevc",
        "-c:v libx265 -preset ultrafast -x265-params log-level=error",
    ),
    (
        "vp9",
        "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -b:v 8M",
    ),
    ("mjpeg", "-c:v mjpeg -q:v 3"),
];

/// The kitchen video in another codec, made once.
fn coded(codec: &str) -> Option<PathBuf> {
    let source = shared("video/ego_kitchen_1080p30_4s.mp4").filter(|_| ffmpeg::available())?;
    let (_, arguments) = CODECS.iter().find(|(name, _)| *name == codec)?;
    let path = std::env::temp_dir().join(format!("reviv_bench_{codec}_{SECONDS}s.mp4"));
    if path.is_file() {
        return Some(path);
    }
    let done = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-t", SECONDS, "-i"])
        .arg(source)
        .args(["-map", "0:v:0"])
        .args(arguments.split(' '))
        .arg("-y")
        .arg(&path)
        .status();
    done.is_ok_and(|status| status.success()).then_some(path)
}

/// Every frame as RGB: items per second are frames per second.
fn every_frame(bencher: divan::Bencher<'_, '_>, codec: &str, decoder: DecoderChoice) {
    let Some(path) = coded(codec) else { return };
    let video = Video::open_with(&path, &VideoSettings::by(decoder)).expect("the video opens");
    let count = video.info().frames;
    bencher
        .counter(divan::counter::ItemsCount::new(count))
        .bench(|| {
            let frames = video.frames(0..count).expect("the video is read");
            assert_eq!(frames.flatten().count(), count);
        });
}

/// What `ffmpeg` takes for the same frames by itself.
fn every_frame_by_ffmpeg(bencher: divan::Bencher<'_, '_>, codec: &str, threads: &str) {
    let Some(path) = coded(codec) else { return };
    let count = Video::open(&path).expect("the video opens").info().frames;
    bencher
        .counter(divan::counter::ItemsCount::new(count))
        .bench(|| {
            let done = Command::new("ffmpeg")
                .args(["-nostdin", "-v", "error", "-threads", threads, "-i"])
                .arg(&path)
                .args(["-fps_mode", "passthrough", "-pix_fmt", "rgb24"])
                .args(["-f", "rawvideo", "-y", "/dev/null"])
                .status();
            assert!(done.is_ok_and(|status| status.success()));
        });
}

#[divan::bench(sample_count = 3, sample_size = 1)]
fn frames_h264_embedded_one_thread(bencher: divan::Bencher<'_, '_>) {
    every_frame(bencher, "h264", DecoderChoice::Embedded);
}

#[divan::bench(sample_count = 3, sample_size = 1)]
fn frames_h264_ffmpeg_alone_one_thread(bencher: divan::Bencher<'_, '_>) {
    every_frame_by_ffmpeg(bencher, "h264", "1");
}

#[divan::bench(sample_count = 3, sample_size = 1, args = ["h264", "hevc", "vp9", "mjpeg"])]
fn frames_through_ffmpeg(bencher: divan::Bencher<'_, '_>, codec: &str) {
    every_frame(bencher, codec, DecoderChoice::Ffmpeg);
}

#[divan::bench(sample_count = 3, sample_size = 1, args = ["h264", "hevc", "vp9", "mjpeg"])]
fn frames_ffmpeg_alone(bencher: divan::Bencher<'_, '_>, codec: &str) {
    every_frame_by_ffmpeg(bencher, codec, "0");
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
