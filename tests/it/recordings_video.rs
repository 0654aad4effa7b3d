//! Videos: the embedded decoder against ffmpeg's pixels, seeking, frame choice, what is beyond it, damage.

use crate::shared;
use reviv::formats::ReadError;
use reviv::video::image::Image;
use reviv::video::{DecoderChoice, Video, VideoSettings, embedded, ffmpeg, mp4};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// CRC-32 of every decoded 4:2:0 picture, made once with ffmpeg 5.1.9: `ffmpeg -i ego_kitchen_1080p30_4s.mp4 -f rawvideo
/// -pix_fmt yuv420p`, cut into frames of 1920 * 1080 * 3 / 2 bytes.
const KITCHEN_PLANES: &str = include_str!("../data/ego_kitchen_1080p30_4s.yuv.crc32");
/// The same with `-pix_fmt rgb24` and 1920 * 1080 * 3 bytes.
const KITCHEN_RGB: &str = include_str!("../data/ego_kitchen_1080p30_4s.rgb.crc32");

fn golden(text: &str) -> Vec<u32> {
    text.split_whitespace()
        .map(|crc| u32::from_str_radix(crc, 16).unwrap())
        .collect()
}

fn crc32(parts: &[&[u8]]) -> u32 {
    let mut crc = flate2::Crc::new();
    for part in parts {
        crc.update(part);
    }
    crc.sum()
}

fn kitchen() -> Option<PathBuf> {
    Some(shared::folder()?.join("data/video/ego_kitchen_1080p30_4s.mp4"))
}

fn planes(path: &Path, frames: Vec<usize>) -> Vec<(usize, u32)> {
    let track = mp4::read(path).unwrap();
    let (index, _) = embedded::Index::new(path, track).unwrap().unwrap();
    embedded::Wanted::new(Arc::new(index), &frames)
        .unwrap()
        .map(|frame| {
            let (frame, picture, _) = frame.unwrap();
            (frame, crc32(&[&picture.y, &picture.u, &picture.v]))
        })
        .collect()
}

#[test]
fn decoded_planes_of_the_kitchen_are_ffmpegs_bit_for_bit() {
    let Some(path) = kitchen() else { return };
    let golden = golden(KITCHEN_PLANES);
    let found = planes(&path, (0..121).collect());
    assert_eq!(found.len(), 121);
    for (frame, crc) in found {
        assert_eq!(crc, golden[frame], "frame {frame}");
    }
}

/// Skipping pictures that nothing refers to, and starting in the middle, change no pixel of what is wanted.
#[test]
fn chosen_frames_have_the_pixels_of_all_frames_and_ffmpegs_colours() {
    let Some(path) = kitchen() else { return };
    let golden = golden(KITCHEN_RGB);
    let video = Video::open(&path).unwrap();
    assert_eq!(
        (
            video.info().width,
            video.info().height,
            video.info().fps,
            video.info().frames
        ),
        (1920, 1080, 30.0, 121)
    );
    for frame in video.chosen(vec![4, 8, 11, 19, 100, 120]).unwrap() {
        let frame = frame.unwrap();
        assert_eq!(
            crc32(&[&frame.image.data]),
            golden[frame.index],
            "frame {}",
            frame.index
        );
        assert!((frame.seconds - frame.index as f64 / 30.0).abs() < 1e-9);
    }
}

#[test]
fn four_four_four_goes_through_ffmpeg_and_equals_its_pngs() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let path = shared.join("data/egom2p_examples/rgb2dep_h2o.mp4");
    let refused = Video::open_with(
        &path,
        &VideoSettings {
            decoder: DecoderChoice::Embedded,
            ..VideoSettings::default()
        },
    );
    let Err(ReadError::Unsupported { reason, .. }) = refused else {
        panic!("4:4:4 must be refused by the embedded decoder: {refused:?}")
    };
    assert!(reason.contains("4:4:4"), "{reason}");
    if !ffmpeg::available() {
        crate::skipped::skipped("no ffmpeg on the PATH");
        return;
    }
    let clip = Video::open(&path)
        .unwrap()
        .load_clip(0, 8.0, 16, 256)
        .unwrap();
    let folder = Video::open_with(
        shared.join("data/egom2p_examples/h2o_rgb_png"),
        &VideoSettings {
            folder_fps: 8.0,
            ..VideoSettings::default()
        },
    )
    .unwrap()
    .load_clip(0, 8.0, 16, 256)
    .unwrap();
    assert_eq!(clip.frames, folder.frames);
}

/// The same clip through the embedded decoder and through ffmpeg.
#[test]
fn both_decoders_give_the_same_clip() {
    let Some(path) = kitchen() else { return };
    if !ffmpeg::available() {
        crate::skipped::skipped("no ffmpeg on the PATH");
        return;
    }
    let settings = VideoSettings {
        decoder: DecoderChoice::Ffmpeg,
        ..VideoSettings::default()
    };
    let ours = Video::open(&path)
        .unwrap()
        .load_clip(31, 8.0, 4, 256)
        .unwrap();
    let theirs = Video::open_with(&path, &settings)
        .unwrap()
        .load_clip(31, 8.0, 4, 256)
        .unwrap();
    assert_eq!(ours.frames.dim(), (4, 256, 256, 3));
    let differ = ours
        .frames
        .iter()
        .zip(&theirs.frames)
        .filter(|(a, b)| a.abs_diff(**b) > 1)
        .count();
    assert_eq!(differ, 0);
}

#[test]
fn a_clip_is_the_area_resized_centre_square() {
    let folder = tempfile::tempdir().unwrap();
    // 12 x 8, left third red, the rest blue: the centre 8 x 8 has its first two columns red.
    for name in ["f2.png", "f10.png", "f1.png"] {
        let mut image = Image::filled(12, 8, [0, 0, 255]);
        for (index, pixel) in image.data.chunks_exact_mut(3).enumerate() {
            if index % 12 < 4 {
                pixel.copy_from_slice(&[if name == "f10.png" { 100 } else { 255 }, 0, 0]);
            }
        }
        let picture = ndarray::Array3::from_shape_vec((8, 12, 3), image.data).unwrap();
        reviv::formats::png::write(
            &folder.path().join(name),
            &reviv::formats::png::Picture::Rgb8(picture),
        )
        .unwrap();
    }
    let video = Video::open(folder.path()).unwrap();
    assert_eq!(
        (video.info().frames, video.info().decoder),
        (3, "folder of pictures")
    );
    let clip = video.load_clip(0, 30.0, 5, 4).unwrap();
    assert_eq!(clip.frames.dim(), (5, 4, 4, 3));
    let pixel =
        |t: usize, x: usize| -> Vec<u8> { (0..3).map(|c| clip.frames[[t, 1, x, c]]).collect() };
    assert_eq!(pixel(0, 0), [255, 0, 0]);
    assert_eq!(pixel(0, 1), [0, 0, 255]);
    // f10 comes last, and is repeated beyond the end.
    assert_eq!([pixel(2, 0)[0], pixel(3, 0)[0], pixel(4, 0)[0]], [100; 3]);
    assert!(video.load_clip(3, 30.0, 1, 4).is_err());
}

fn own(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/data")
        .join(name)
}

/// CRC-32 over the RGB bytes of all frames, made once with ffmpeg 5.1.9 (`-vsync passthrough -f rawvideo -pix_fmt rgb24`).
#[test]
fn own_videos_have_ffmpegs_pixels_whatever_the_container_does() {
    for (name, frames, size, golden) in [
        ("synthetic_30fps.mp4", 75, (96, 64), 0x722c_5ab5),
        ("synthetic_fragmented.mp4", 75, (96, 64), 0x722c_5ab5),
        ("synthetic_rotated.mp4", 17, (64, 96), 0xf755_4f43),
        ("synthetic_variable.mp4", 43, (96, 64), 0xdc79_4fd6),
    ] {
        let video = Video::open(own(name)).unwrap();
        let info = video.info();
        assert_eq!(
            (info.frames, (info.width, info.height)),
            (frames, size),
            "{name}"
        );
        assert_eq!(info.decoder, "embedded H.264");
        let mut crc = flate2::Crc::new();
        for (index, frame) in video.frames(0..frames).unwrap().enumerate() {
            let frame = frame.unwrap();
            assert_eq!(frame.index, index);
            crc.update(&frame.image.data);
        }
        assert_eq!(crc.sum(), golden, "{name}");
    }
}

#[test]
fn every_start_gives_the_frames_that_playing_from_the_beginning_gives() {
    let video = Video::open(own("synthetic_30fps.mp4")).unwrap();
    let all: Vec<Image> = video
        .frames(0..75)
        .unwrap()
        .map(|frame| frame.unwrap().image)
        .collect();
    for start in [1, 7, 24, 25, 26, 49, 50, 63, 74] {
        let found = video.frames(start..start + 3).unwrap();
        let mut count = 0;
        for frame in found {
            let frame = frame.unwrap();
            assert_eq!(
                frame.image, all[frame.index],
                "start {start}, frame {}",
                frame.index
            );
            count += 1;
        }
        assert_eq!(count, 3.min(75 - start));
    }
    let clip = video.load_clip(10, 8.0, 16, 64).unwrap();
    for (k, frame) in [
        10, 14, 18, 21, 25, 29, 32, 36, 40, 44, 48, 51, 55, 59, 62, 66,
    ]
    .into_iter()
    .enumerate()
    {
        let square = all[frame].square(64);
        let found: Vec<u8> = clip
            .frames
            .index_axis(ndarray::Axis(0), k)
            .iter()
            .copied()
            .collect();
        assert_eq!(found, square.data, "clip frame {k}");
    }
}

/// Groups of pictures are decoded side by side and come in their order, with the pixels of one thread.
#[test]
fn squares_do_not_depend_on_the_number_of_threads() {
    let mut videos = vec![own("synthetic_30fps.mp4"), own("synthetic_rotated.mp4")];
    videos.extend(kitchen());
    for path in videos {
        let video = Video::open(&path).unwrap();
        let frames: Vec<usize> = (0..video.info().frames).step_by(3).collect();
        let read = |threads: usize| -> Vec<(usize, Image)> {
            let squares = video.squares(frames.clone(), 48, threads).unwrap();
            squares.map(Result::unwrap).collect()
        };
        let one = read(1);
        assert_eq!(
            one.iter().map(|(frame, _)| *frame).collect::<Vec<_>>(),
            frames
        );
        for threads in [2, 5] {
            assert!(read(threads) == one, "{} on {threads}", path.display());
        }
        // Whoever leaves early leaves nothing behind that waits for ever.
        assert!(
            video
                .squares(frames.clone(), 48, 3)
                .unwrap()
                .next()
                .unwrap()
                .is_ok()
        );
    }
}

/// So many frames with gaps cannot be named one by one on a command line.
#[test]
fn thousands_of_chosen_frames_come_through_ffmpeg() {
    if !ffmpeg::available() {
        crate::skipped::skipped("no ffmpeg on the PATH");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.mkv");
    let made = std::process::Command::new("ffmpeg")
        .args(["-v", "error", "-f", "lavfi", "-i"])
        .arg("testsrc=size=32x32:rate=30,trim=end_frame=2400")
        .args(["-c:v", "ffv1"])
        .arg(&path)
        .status();
    if !made.is_ok_and(|status| status.success()) {
        crate::skipped::skipped("this ffmpeg makes no video");
        return;
    }
    let video = Video::open(&path).unwrap();
    let read = |frames: Vec<usize>| -> Vec<_> {
        let frames = video.chosen(frames).unwrap();
        frames.map(|frame| frame.unwrap()).collect()
    };
    let sparse: Vec<usize> = (1..2400).step_by(2).collect();
    let many = read(sparse.clone());
    assert_eq!(
        many.iter().map(|frame| frame.index).collect::<Vec<_>>(),
        sparse
    );
    // The same frames as when few are named.
    let few = read(vec![1, 1201, 2399]);
    for (found, at) in few.iter().zip([0, 600, 1199]) {
        assert!(*found == many[at], "frame {}", found.index);
    }
    assert!(many[0].image != many[600].image);
}

#[test]
fn a_video_of_variable_rate_is_chosen_from_by_time() {
    let video = Video::open(own("synthetic_variable.mp4")).unwrap();
    assert!(video.info().variable_rate);
    // 20 frames in the first 0.63 s, then one every 0.1 s.
    let chosen = video.schedule().clip(0, 8.0, 16);
    for (k, frame) in chosen.iter().enumerate() {
        let wanted = k as f64 / 8.0;
        assert!(
            (video.schedule().seconds(*frame) - wanted).abs() <= 0.051,
            "{k}: frame {frame}"
        );
    }
}

#[test]
fn jpeg_pictures_are_read() {
    let bytes = std::fs::read(own("tiny.jpg")).unwrap();
    let image = Image::from_bytes(&bytes).unwrap();
    assert_eq!((image.width, image.height), (24, 16));
    assert!(image.data.iter().any(|v| *v > 200) && image.data.iter().any(|v| *v < 60));
}

/// Stretches that follow each other are read by one decoder that stands between them; whatever the order in which they are asked
/// for, and by how many threads, each has the pixels that a video opened for it alone gives.
#[test]
fn reading_on_gives_the_pixels_of_starting_again() {
    for name in [
        "synthetic_30fps.mp4",
        "synthetic_fragmented.mp4",
        "synthetic_variable.mp4",
    ] {
        let path = own(name);
        let decoders = [DecoderChoice::Embedded, DecoderChoice::Ffmpeg];
        for decoder in decoders
            .into_iter()
            .take(1 + usize::from(ffmpeg::available()))
        {
            let settings = VideoSettings::by(decoder);
            let open = || Video::open_with(&path, &settings).unwrap();
            let read = |video: &Video, frames: &[usize]| -> Vec<u32> {
                let chosen = video.chosen(frames.to_vec()).unwrap();
                chosen
                    .map(|frame| crc32(&[&frame.unwrap().image.data]))
                    .collect()
            };
            let count = open().info().frames;
            let stretches: Vec<Vec<usize>> = [
                (0, 9, 1),
                (9, 17, 2),
                (17, 25, 1),
                (20, 30, 3),
                (3, 12, 2),
                (12, 31, 5),
            ]
            .into_iter()
            .map(|(from, to, step)| (from..to).step_by(step).filter(|f| *f < count).collect())
            .collect();
            let alone: Vec<Vec<u32>> = stretches.iter().map(|s| read(&open(), s)).collect();
            let video = open();
            // Every start of `ffmpeg` takes its time.
            let turns = if decoder == DecoderChoice::Ffmpeg {
                1
            } else {
                3
            };
            for turn in 0..turns {
                for (stretch, alone) in stretches.iter().zip(&alone) {
                    assert!(
                        read(&video, stretch) == *alone,
                        "{name}, {decoder:?}, turn {turn}, {stretch:?}"
                    );
                }
            }
            // Left in the middle, a reader leaves its decoder there.
            let mut some = video.chosen(stretches[0].clone()).unwrap();
            some.next();
            drop(some);
            assert!(
                read(&video, &stretches[1]) == alone[1],
                "{name}, {decoder:?}"
            );
            std::thread::scope(|scope| {
                for shift in 0..turns {
                    let (video, stretches, alone) = (&video, &stretches, &alone);
                    scope.spawn(move || {
                        for at in 0..stretches.len() {
                            let at = (at + 2 * shift) % stretches.len();
                            assert!(read(video, &stretches[at]) == alone[at]);
                        }
                    });
                }
            });
        }
    }
}
