//! Containers, codecs, edit lists, orientations, colours and rates, each file made by `ffmpeg` with a number in the pixels of
//! every frame. What comes out has to be what `ffmpeg -fps_mode passthrough` shows, bit for bit, whichever decoder reads it and
//! wherever reading starts.

use crate::mp4_edit::{self, Edit};
use reviv::video::{DecoderChoice, Video, VideoSettings, ffmpeg};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const SIZE: [usize; 2] = [64, 48];
const FRAMES: usize = 50;

/// A luma of eight cells with the number on top, and below it all chroma there is.
fn raw() -> Vec<u8> {
    let [width, height] = SIZE;
    let mut bytes = Vec::new();
    for frame in 0..FRAMES {
        for y in 0..height {
            for x in 0..width {
                let bit = frame >> (7 - x / 8) & 1 == 1;
                bytes.push(match (y < 16, bit) {
                    (true, true) => 235,
                    (true, false) => 16,
                    (false, _) => (60 + 2 * x + frame) as u8,
                });
            }
        }
        for plane in 0..2 {
            for y in 0..height / 2 {
                for x in 0..width / 2 {
                    bytes.push(match (y < 8, plane) {
                        (true, _) => 128,
                        (_, 0) => (16 + 7 * x) as u8,
                        _ => (20 + 13 * (y - 8) + frame) as u8,
                    });
                }
            }
        }
    }
    bytes
}

struct Place {
    folder: tempfile::TempDir,
    failures: Vec<String>,
    checked: usize,
}

impl Place {
    fn new() -> Option<Self> {
        if !ffmpeg::available() {
            crate::skipped::skipped("no ffmpeg on the PATH");
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("raw.yuv"), raw()).unwrap();
        Some(Place {
            folder,
            failures: Vec::new(),
            checked: 0,
        })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Encodes the numbered frames; none where this `ffmpeg` cannot.
    fn make(&self, name: &str, arguments: &str) -> Option<PathBuf> {
        let path = self.path(name);
        let done = Command::new("ffmpeg")
            .args([
                "-nostdin", "-v", "error", "-f", "rawvideo", "-pix_fmt", "yuv420p",
            ])
            .args(["-s", "64x48", "-r", "25", "-i"])
            .arg(self.path("raw.yuv"))
            .args(arguments.split_whitespace())
            .args(["-threads", "1", "-y"])
            .arg(&path)
            .stdin(Stdio::null())
            .status();
        if done.is_ok_and(|status| status.success()) {
            return Some(path);
        }
        eprintln!("left out: this ffmpeg does not make {name}");
        None
    }

    /// Another file from one that was made, without encoding again.
    fn copy(&self, name: &str, from: &Path, arguments: &str) -> PathBuf {
        let path = self.path(name);
        let done = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-i"])
            .arg(from)
            .args(["-c", "copy"])
            .args(arguments.split_whitespace())
            .arg("-y")
            .arg(&path)
            .status();
        assert!(done.unwrap().success(), "{name}");
        path
    }

    fn edited(&self, name: &str, from: &Path, edit: impl FnOnce(Vec<u8>) -> Vec<u8>) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, edit(std::fs::read(from).unwrap())).unwrap();
        path
    }

    /// Reads by this decoder and by `ffmpeg`'s own command line, and keeps what differs.
    fn check(&mut self, path: &Path, decoder: DecoderChoice, by: &str) {
        self.checked += 1;
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if let Err(reason) = compare(path, decoder, by) {
            self.failures
                .push(format!("{name} by {decoder:?}: {reason}"));
        }
    }

    /// By both decoders.
    fn check_both(&mut self, path: &Path) {
        self.check(path, DecoderChoice::Embedded, "embedded H.264");
        self.check(path, DecoderChoice::Ffmpeg, "ffmpeg");
    }

    fn finish(self) {
        let failed = self.failures.len();
        assert_eq!(
            failed,
            0,
            "of {}:\n{}",
            self.checked,
            self.failures.join("\n")
        );
    }
}

/// All frames as `ffmpeg` shows them, one after the other.
fn shown(path: &Path) -> Vec<u8> {
    let output = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(path)
        .args([
            "-map",
            "0:V:0",
            "-fps_mode",
            "passthrough",
            "-f",
            "rawvideo",
        ])
        .args(["-pix_fmt", "rgb24", "-"])
        .output()
        .unwrap();
    output.stdout
}

fn compare(path: &Path, decoder: DecoderChoice, by: &str) -> Result<(), String> {
    let video = Video::open_with(path, &VideoSettings::by(decoder)).map_err(|e| e.to_string())?;
    let info = video.info();
    if info.decoder != by {
        return Err(format!("read by {}", info.read_by()));
    }
    let bytes = shown(path);
    let size = info.width as usize * info.height as usize * 3;
    let count = bytes.len() / size;
    if count == 0 || !bytes.len().is_multiple_of(size) || info.frames != count {
        return Err(format!(
            "{} frames of {} x {}, and ffmpeg gives {} bytes ({count} frames)",
            info.frames,
            info.width,
            info.height,
            bytes.len()
        ));
    }
    for chosen in [
        (0..count).collect::<Vec<_>>(),
        (count / 2..count).collect(),
        (1..count).step_by(4).collect(),
        vec![count - 1],
    ] {
        let frames = video.chosen(chosen.clone()).map_err(|e| e.to_string())?;
        let mut seen = Vec::new();
        for frame in frames {
            let frame = frame.map_err(|e| e.to_string())?;
            let right = &bytes[frame.index * size..][..size];
            if frame.image.data != right {
                let at = (0..size).find(|at| frame.image.data[*at] != right[*at]);
                let at = at.unwrap_or(0);
                return Err(format!(
                    "frame {}, byte {at}: {:?} instead of {:?}",
                    frame.index,
                    &frame.image.data[at / 3 * 3..][..3],
                    &right[at / 3 * 3..][..3]
                ));
            }
            seen.push(frame.index);
        }
        if seen != chosen {
            return Err(format!("frames {seen:?} instead of {chosen:?}"));
        }
    }
    Ok(())
}

/// The number of a frame.
fn number(image: &reviv::video::image::Image) -> usize {
    (0..8).fold(0, |number, cell| {
        let at = 3 * (4 * image.width + (2 * cell + 1) * image.width / 16) as usize;
        number << 1 | usize::from(image.data[at] > 127)
    })
}

const X264: &str = "-c:v libx264 -preset veryfast -crf 12 -g 12 -bf 2";

#[test]
fn containers_and_codecs_give_what_ffmpeg_shows() {
    let Some(mut place) = Place::new() else {
        return;
    };
    for (name, arguments) in [
        ("h264.mp4", X264),
        ("h264.mov", X264),
        (
            "open_gop.mp4",
            "-c:v libx264 -crf 12 -g 12 -bf 3 -x264-params open-gop=1",
        ),
        (
            "fragmented.mp4",
            "-c:v libx264 -crf 12 -g 12 -movflags frag_keyframe+empty_moov",
        ),
        (
            "fragmented_dash.mp4",
            "-c:v libx264 -crf 12 -g 12 -movflags dash+frag_every_frame",
        ),
        ("intra.mp4", "-c:v libx264 -crf 12 -g 1"),
        ("one_gop.mp4", "-c:v libx264 -crf 12 -g 250"),
        (
            "tick_is_frame.mov",
            "-c:v libx264 -crf 12 -g 12 -video_track_timescale 25",
        ),
        ("ntsc.mp4", "-r 30000/1001 -c:v libx264 -crf 12 -g 12"),
        (
            "full_range.mp4",
            "-vf scale=out_range=full -c:v libx264 -crf 12 -pix_fmt yuvj420p",
        ),
        (
            "varying.mp4",
            "-vf setpts='if(lt(N,20),N,20+(N-20)*3)/25/TB' -fps_mode vfr -enc_time_base 1/1000 -c:v libx264 -crf 12 -g 12",
        ),
        (
            "avc3.mp4",
            "-c:v libx264 -crf 12 -g 12 -tag:v avc3 -bsf:v dump_extra",
        ),
        (
            "slices.mp4",
            "-c:v libx264 -crf 12 -g 12 -x264-params slices=3",
        ),
    ] {
        if let Some(path) = place.make(name, arguments) {
            place.check_both(&path);
        }
    }
    for (name, arguments) in [
        ("h264.mkv", X264),
        ("h264.ts", X264),
        ("h264.avi", "-c:v libx264 -crf 12 -g 12 -bf 0"),
        ("h264.flv", X264),
        ("raw.h264", X264),
        ("lossless.mp4", "-c:v libx264 -qp 0 -g 12"),
        ("ten_bits.mp4", "-c:v libx264 -pix_fmt yuv420p10le -g 12"),
        ("four_four_four.mp4", "-c:v libx264 -pix_fmt yuv444p -g 12"),
        ("grey.mp4", "-c:v libx264 -pix_fmt gray -g 12"),
        (
            "interlaced.mp4",
            "-c:v libx264 -flags +ilme+ildct -x264-params tff=1 -g 12",
        ),
        (
            "hevc.mp4",
            "-c:v libx265 -x265-params log-level=error:keyint=12",
        ),
        (
            "hevc_open.mp4",
            "-c:v libx265 -x265-params log-level=error:keyint=12:open-gop=1",
        ),
        (
            "hevc.mkv",
            "-c:v libx265 -x265-params log-level=error:keyint=12",
        ),
        (
            "hevc.ts",
            "-c:v libx265 -x265-params log-level=error:keyint=12",
        ),
        (
            "raw.hevc",
            "-c:v libx265 -x265-params log-level=error:keyint=12",
        ),
        (
            "vp8.webm",
            "-c:v libvpx -g 12 -auto-alt-ref 1 -lag-in-frames 10",
        ),
        ("vp9.webm", "-c:v libvpx-vp9 -g 12 -cpu-used 5"),
        ("mjpeg.avi", "-c:v mjpeg -q:v 2"),
        ("mjpeg.mov", "-c:v mjpeg -q:v 2"),
        ("mpeg4.avi", "-c:v mpeg4 -q:v 2 -bf 2 -g 12 -vtag XVID"),
        ("mpeg4.mp4", "-c:v mpeg4 -q:v 2 -bf 2 -g 12"),
        ("mpeg2.mpg", "-c:v mpeg2video -q:v 2 -bf 2 -g 12"),
        ("mpeg2.ts", "-c:v mpeg2video -q:v 2 -bf 2 -g 12"),
        ("mpeg2.vob", "-c:v mpeg2video -q:v 2 -bf 2 -g 12"),
        ("prores.mov", "-c:v prores"),
        ("ffv1.mkv", "-c:v ffv1"),
        (
            "varying.mkv",
            "-vf setpts='if(lt(N,20),N,20+(N-20)*3)/25/TB' -fps_mode vfr -enc_time_base 1/1000 -c:v ffv1",
        ),
        ("picture.gif", "-c:v gif"),
    ] {
        if let Some(path) = place.make(name, arguments) {
            place.check(&path, DecoderChoice::Auto, "ffmpeg");
        }
    }
    place.finish();
}

#[test]
fn widths_and_heights_beside_blocks_of_eight_are_converted_alike() {
    let Some(mut place) = Place::new() else {
        return;
    };
    for (width, height) in [
        (2, 2),
        (6, 4),
        (18, 10),
        (42, 30),
        (62, 46),
        (86, 34),
        (170, 20),
        (342, 50),
    ] {
        let arguments = format!("-vf scale={width}:{height} -c:v libx264 -crf 12 -g 12");
        if let Some(path) = place.make(&format!("{width}x{height}.mp4"), &arguments) {
            place.check(&path, DecoderChoice::Embedded, "embedded H.264");
        }
    }
    place.finish();
}

#[test]
fn edit_lists_show_what_ffmpeg_shows() {
    let Some(mut place) = Place::new() else {
        return;
    };
    let bases = [
        ("h264", place.make("base.mp4", X264)),
        (
            "hevc",
            place.make(
                "base_hevc.mp4",
                "-c:v libx265 -x265-params log-level=error:keyint=12",
            ),
        ),
    ];
    // Not here: a gap in the middle, during which `ffmpeg` shows frames from the start of the media, and a segment of no length,
    // of which it shows nothing (`odd_videos` has both).
    // Ticks of the movie are milliseconds; the media has 512 a frame, and starts at 1024.
    let one = 0x0001_0000;
    let at = |frame: i64| 1024 + 512 * frame;
    let lists: &[(&str, Vec<Edit>)] = &[
        ("whole", vec![(2000, at(0), one)]),
        ("end", vec![(1000, at(0), one)]),
        ("start", vec![(1000, at(13), one)]),
        ("start_between", vec![(1000, at(13) + 200, one)]),
        ("end_between", vec![(1013, at(0), one)]),
        ("empty_first", vec![(500, -1, one), (2000, at(0), one)]),
        ("two", vec![(400, at(0), one), (400, at(30), one)]),
        ("two_near", vec![(400, at(0), one), (400, at(14), one)]),
        (
            "three",
            vec![(200, at(2), one), (200, at(20), one), (400, at(37), one)],
        ),
        ("beyond_the_end", vec![(9000, at(40), one)]),
    ];
    for (codec, base) in bases {
        let Some(base) = base else { continue };
        let scale = mp4_edit::media_timescale(&std::fs::read(&base).unwrap());
        for (name, edits) in lists {
            let edits: Vec<Edit> = edits
                .iter()
                .map(|&(duration, time, rate)| {
                    let time = if time < 0 {
                        time
                    } else {
                        time * i64::from(scale) / 12_800
                    };
                    (duration, time, rate)
                })
                .collect();
            let name = format!("{codec}_{name}.mp4");
            let path = place.edited(&name, &base, |bytes| mp4_edit::with_edits(bytes, &edits));
            if codec == "h264" {
                place.check_both(&path);
            } else {
                place.check(&path, DecoderChoice::Auto, "ffmpeg");
            }
        }
        // Another speed is left to ffmpeg, which shows every frame once.
        let fast: Vec<Edit> = vec![(1000, i64::from(scale) / 12_800 * 1024, 2 * one)];
        let path = place.edited(&format!("{codec}_fast.mp4"), &base, |bytes| {
            mp4_edit::with_edits(bytes, &fast)
        });
        place.check(&path, DecoderChoice::Auto, "ffmpeg");
    }
    place.finish();
}

/// Segments that go back in the media or repeat it: the numbers of the frames say what is right.
#[test]
fn segments_that_go_back_are_shown_in_the_order_of_the_edit_list() {
    let Some(place) = Place::new() else {
        return;
    };
    let Some(base) = place.make("base.mp4", X264) else {
        return;
    };
    let at = |frame: i64| 1024 + 512 * frame;
    let edits = [
        (400, at(30), 1 << 16),
        (400, at(2), 1 << 16),
        (200, at(30), 1 << 16),
    ];
    let path = place.edited("back.mp4", &base, |bytes| {
        mp4_edit::with_edits(bytes, &edits)
    });
    let video = Video::open_with(&path, &VideoSettings::by(DecoderChoice::Embedded)).unwrap();
    let numbers: Vec<usize> = video
        .frames(0..1000)
        .unwrap()
        .map(|frame| number(&frame.unwrap().image))
        .collect();
    let right: Vec<usize> = (30..40).chain(2..12).chain(30..35).collect();
    assert_eq!(numbers, right);
    assert_eq!(video.info().fps, 25.0);
    let middle: Vec<usize> = video
        .chosen(vec![8, 12, 21])
        .unwrap()
        .map(|frame| number(&frame.unwrap().image))
        .collect();
    assert_eq!(middle, [38, 4, 31]);
}

#[test]
fn orientations_are_those_of_ffmpeg() {
    let Some(mut place) = Place::new() else {
        return;
    };
    let Some(base) = place.make("base.mp4", X264) else {
        return;
    };
    let one = 1 << 16;
    for (name, matrix) in [
        ("upright", [one, 0, 0, one]),
        ("clockwise", [0, one, -one, 0]),
        ("half", [-one, 0, 0, -one]),
        ("counterclockwise", [0, -one, one, 0]),
        ("mirrored", [-one, 0, 0, one]),
        ("flipped", [one, 0, 0, -one]),
        ("transposed", [0, one, one, 0]),
        ("transversed", [0, -one, -one, 0]),
        ("nothing", [0, 0, 0, 0]),
        ("twice_as_large", [2 * one, 0, 0, 2 * one]),
    ] {
        let path = place.edited(&format!("{name}.mp4"), &base, |bytes| {
            mp4_edit::with_matrix(bytes, *b"trak", matrix)
        });
        place.check_both(&path);
        // The movie's own matrix turns all its tracks.
        let path = place.edited(&format!("{name}_movie.mp4"), &path, |bytes| {
            mp4_edit::with_matrix(bytes, *b"mvhd", [0, one, -one, 0])
        });
        place.check_both(&path);
    }
    let path = place.edited("slanted.mp4", &base, |bytes| {
        mp4_edit::with_matrix(bytes, *b"trak", [56_756, 32_768, -32_768, 56_756])
    });
    place.check(&path, DecoderChoice::Auto, "ffmpeg");
    place.finish();
}

#[test]
fn colours_are_those_of_the_stream_then_of_the_container() {
    let Some(mut place) = Place::new() else {
        return;
    };
    let Some(base) = place.make("base.mp4", X264) else {
        return;
    };
    for matrix in 0..=14_u8 {
        for full in [false, true] {
            let name = format!("colr_{matrix}_{full}.mp4");
            let colr = mp4_edit::nclx(matrix.into(), full);
            let path = place.edited(&name, &base, |bytes| mp4_edit::with_entry_box(bytes, &colr));
            place.check(&path, DecoderChoice::Embedded, "embedded H.264");
            let range = u8::from(full);
            let path = place.copy(
                &format!("vui_{matrix}_{full}.mp4"),
                &base,
                &format!("-bsf:v h264_metadata=matrix_coefficients={matrix}:video_full_range_flag={range}"),
            );
            place.check(&path, DecoderChoice::Embedded, "embedded H.264");
        }
    }
    // Both: the stream counts.
    let stream = place.copy(
        "stream.mp4",
        &base,
        "-bsf:v h264_metadata=matrix_coefficients=6",
    );
    let colr = mp4_edit::nclx(1, true);
    let path = place.edited("both.mp4", &stream, |bytes| {
        mp4_edit::with_entry_box(bytes, &colr)
    });
    place.check(&path, DecoderChoice::Embedded, "embedded H.264");
    let colr = mp4_edit::nclc(9);
    let path = place.edited("nclc.mp4", &base, |bytes| {
        mp4_edit::with_entry_box(bytes, &colr)
    });
    place.check(&path, DecoderChoice::Embedded, "embedded H.264");
    place.finish();
}

#[test]
fn pixels_that_are_not_square_become_so() {
    let Some(place) = Place::new() else {
        return;
    };
    let Some(base) = place.make("base.mp4", X264) else {
        return;
    };
    let wide = place.edited("pasp.mp4", &base, |bytes| {
        mp4_edit::with_entry_box(bytes, &mp4_edit::pasp(4, 3))
    });
    let high = place.edited("high.mp4", &base, |bytes| {
        mp4_edit::with_entry_box(bytes, &mp4_edit::pasp(3, 4))
    });
    let stream = place.copy(
        "vui.mp4",
        &base,
        "-bsf:v h264_metadata=sample_aspect_ratio=3/2",
    );
    let stream = place.edited("vui_only.mp4", &stream, mp4_edit::without_shapes);
    let turned = place.edited("turned.mp4", &wide, |bytes| {
        mp4_edit::with_matrix(bytes, *b"trak", [0, 1 << 16, -(1 << 16), 0])
    });
    for (path, size) in [
        (&wide, (85, 48)),
        (&high, (64, 64)),
        (&stream, (96, 48)),
        (&turned, (48, 85)),
    ] {
        for decoder in [DecoderChoice::Embedded, DecoderChoice::Ffmpeg] {
            let video = Video::open_with(path, &VideoSettings::by(decoder)).unwrap();
            let info = video.info();
            let name = path.display();
            assert_eq!((info.width, info.height), size, "{name} by {decoder:?}");
            let frame = video.frames(7..8).unwrap().next().unwrap().unwrap();
            assert_eq!((frame.image.width, frame.image.height), size, "{name}");
            if size.0 > size.1 {
                assert_eq!(number(&frame.image), 7, "{name}");
            }
        }
    }
}

#[test]
fn the_track_that_players_show_is_read() {
    let Some(mut place) = Place::new() else {
        return;
    };
    let Some(base) = place.make("base.mp4", X264) else {
        return;
    };
    let Some(other) = place.make("other.mp4", "-vf negate -c:v libx264 -crf 12 -g 12") else {
        return;
    };
    let both = place.path("both.mp4");
    let done = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(&other)
        .arg("-i")
        .arg(&base)
        .args(["-map", "0:v", "-map", "1:v", "-c", "copy", "-y"])
        .arg(&both)
        .status();
    assert!(done.unwrap().success());
    let number_by = |path: &Path, decoder| {
        let video = Video::open_with(path, &VideoSettings::by(decoder)).unwrap();
        number(&video.frames(5..6).unwrap().next().unwrap().unwrap().image)
    };
    // The first track is switched off: the second one is shown.
    let off = place.edited("off.mp4", &both, |bytes| {
        mp4_edit::with_track_flags(bytes, &[2, 3])
    });
    let first = place.edited("first.mp4", &both, |bytes| {
        mp4_edit::with_track_flags(bytes, &[3, 3])
    });
    for decoder in [DecoderChoice::Embedded, DecoderChoice::Ffmpeg] {
        assert_eq!(number_by(&off, decoder), 5, "{decoder:?}");
        assert_eq!(number_by(&first, decoder), 255 - 5, "{decoder:?}");
    }
    // A single track that is switched off is better than none.
    let alone = place.edited("alone.mp4", &base, |bytes| {
        mp4_edit::with_track_flags(bytes, &[0])
    });
    place.check_both(&alone);
    // What a camera appends.
    for (name, trailer) in [
        (
            "trailer.mp4",
            [0xff, 0xff, 0xff, 0xf0, b'j', b'u', b'n', b'k'].repeat(13),
        ),
        ("zeros.mp4", vec![0; 1000]),
        ("small.mp4", vec![0, 0, 0, 3, 1, 2, 3, 4, 5, 6]),
    ] {
        let path = place.edited(name, &base, |bytes| [bytes, trailer].concat());
        place.check_both(&path);
    }
    place.finish();
}
