//! Pictures that come through the pipe of `ffmpeg` as planes have the pixels that `ffmpeg` makes of them itself.

use reviv_data::video::{DecoderChoice, Video, VideoSettings, ffmpeg};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// What this `ffmpeg` makes of a test picture; none where it cannot.
fn made(folder: &Path, name: &str, frames: usize, arguments: &str) -> Option<PathBuf> {
    let path = folder.join(name);
    let source = format!("testsrc2=size=86x50:rate=25,trim=end_frame={frames}");
    let done = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", &source])
        .args(arguments.split_whitespace())
        .arg(&path)
        .status();
    done.is_ok_and(|status| status.success()).then_some(path)
}

fn shown(path: &Path) -> Vec<u8> {
    let output = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(path)
        .args(["-fps_mode", "passthrough", "-pix_fmt", "rgb24"])
        .args(["-f", "rawvideo", "-"])
        .stdin(Stdio::null())
        .output();
    output.expect("ffmpeg runs").stdout
}

/// All frames, then every third.
fn check(path: &Path) {
    let right = shown(path);
    let video = Video::open_with(path, &VideoSettings::by(DecoderChoice::Ffmpeg));
    let video = video.expect("the video opens");
    let info = video.info();
    let size = 3 * (info.width * info.height) as usize;
    assert_eq!(right.len(), size * info.frames, "{}", path.display());
    for step in [1, 3] {
        let chosen: Vec<usize> = (0..info.frames).step_by(step).collect();
        let mut seen = Vec::new();
        for frame in video.chosen(chosen.clone()).expect("the video is read") {
            let frame = frame.expect("a frame");
            let same = frame.image.data == right[frame.index * size..][..size];
            assert!(same, "{}, frame {}", path.display(), frame.index);
            seen.push(frame.index);
        }
        assert_eq!(seen, chosen);
    }
}

#[test]
fn planes_are_converted_as_ffmpeg_converts_them() {
    if !ffmpeg::available() {
        eprintln!("left out: no ffmpeg on the PATH");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut checked = 0;
    for (name, arguments) in [
        ("plain.mkv", "-pix_fmt yuv420p -c:v ffv1"),
        (
            "odd.mkv",
            "-vf scale=85:49,setsar=1 -pix_fmt yuv420p -c:v ffv1",
        ),
        (
            "odd_height.mkv",
            "-vf scale=86:49,setsar=1 -pix_fmt yuv420p -c:v ffv1",
        ),
        ("ten_bits.mkv", "-pix_fmt yuv420p10le -c:v ffv1"),
        ("half.mkv", "-pix_fmt yuv422p -c:v ffv1"),
        ("full.mov", "-pix_fmt yuvj420p -c:v mjpeg -q:v 2"),
        ("full_422.mov", "-pix_fmt yuvj422p -c:v mjpeg -q:v 2"),
        (
            "bt709.mkv",
            "-pix_fmt yuv420p -c:v libx264 -colorspace bt709 -color_range tv",
        ),
        (
            "bt2020.mkv",
            "-pix_fmt yuv420p -c:v libx264 -colorspace bt2020nc",
        ),
        (
            "smpte240m.mkv",
            "-pix_fmt yuv420p -c:v libx264 -colorspace smpte240m",
        ),
        ("fcc.mkv", "-pix_fmt yuv420p -c:v libx264 -colorspace fcc"),
        (
            "full_709.mkv",
            "-pix_fmt yuvj420p -c:v libx264 -colorspace bt709 -color_range pc",
        ),
        (
            "full_vp9.webm",
            "-pix_fmt yuv420p -c:v libvpx-vp9 -cpu-used 8 -color_range pc -colorspace bt709",
        ),
    ] {
        if let Some(path) = made(folder.path(), name, 20, arguments) {
            check(&path);
            checked += 1;
        }
    }
    assert!(checked > 0);
}

/// After more frames than are looked at when a file is opened.
#[test]
fn a_format_that_changes_on_the_way_loses_nothing() {
    if !ffmpeg::available() {
        eprintln!("left out: no ffmpeg on the PATH");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let part = |name: &str, frames: usize, format: &str| {
        let arguments = format!("-pix_fmt {format} -c:v mjpeg -q:v 2");
        made(folder.path(), name, frames, &arguments)
    };
    let parts = [
        part("first.mkv", 60, "yuvj420p"),
        part("second.mkv", 20, "yuvj444p"),
        part("third.mkv", 20, "yuvj420p"),
    ];
    if parts.contains(&None) {
        eprintln!("left out: this ffmpeg makes no video");
        return;
    }
    let list = folder.path().join("list.txt");
    std::fs::write(&list, "file first.mkv\nfile second.mkv\nfile third.mkv\n").unwrap();
    let path = folder.path().join("changing.mkv");
    let joined = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-f", "concat", "-i"])
        .arg(&list)
        .args(["-c", "copy"])
        .arg(&path)
        .status();
    assert!(joined.is_ok_and(|status| status.success()));
    check(&path);
}
