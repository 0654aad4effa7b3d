//! Videos: the embedded decoder against ffmpeg's pixels, seeking, frame choice, rotation, damage.

use crate::shared;
use reviv::source::video::{DecoderChoice, Video, VideoSettings, embedded, ffmpeg, h264, mp4};
use std::path::Path;
use std::sync::Arc;

/// CRC-32 of every decoded 4:2:0 picture, made once with ffmpeg 5.1.9: `ffmpeg -i ego_kitchen_1080p30_4s.mp4 -f rawvideo
/// -pix_fmt yuv420p`, cut into frames of 1920 * 1080 * 3 / 2 bytes.
const KITCHEN: &str = include_str!("../data/ego_kitchen_1080p30_4s.yuv.crc32");

fn crc32(parts: &[&[u8]]) -> u32 {
    let mut crc = flate2::Crc::new();
    for part in parts {
        crc.update(part);
    }
    crc.sum()
}

fn planes(path: &Path, frames: Vec<usize>) -> Vec<(usize, u32)> {
    let track = mp4::read(path).unwrap();
    let configuration =
        h264::Configuration::parse(track.avc_configuration.as_ref().unwrap()).unwrap();
    let (index, _) = embedded::Index::new(path, track, configuration).unwrap();
    embedded::Wanted::new(Arc::new(index), frames)
        .unwrap()
        .map(|frame| {
            let (frame, picture) = frame.unwrap();
            (frame, crc32(&[&picture.y, &picture.u, &picture.v]))
        })
        .collect()
}

#[test]
fn decoded_planes_of_the_kitchen_are_ffmpegs_bit_for_bit() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let path = shared.join("data/video/ego_kitchen_1080p30_4s.mp4");
    let golden: Vec<u32> = KITCHEN
        .split_whitespace()
        .map(|crc| u32::from_str_radix(crc, 16).unwrap())
        .collect();
    let chosen = vec![0, 4, 8, 11, 15, 60, 61, 120];
    for (frame, crc) in planes(&path, chosen) {
        assert_eq!(crc, golden[frame], "frame {frame}");
    }
}

#[test]
fn dev() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let path = shared.join("data/video/ego_kitchen_1080p30_4s.mp4");
    let video = Video::open(&path).unwrap();
    eprintln!("{:?}", video.info());
    let gen2 = Video::open(shared.join("data/video/aria_gen2_outdoor_10fps_2p4s.mp4")).unwrap();
    eprintln!("{:?}", gen2.info());
    let t = std::time::Instant::now();
    let clip = video.load_clip(0, 8.0, 16, 256).unwrap();
    eprintln!("load_clip {:?} {:?}", t.elapsed(), clip.frames.shape());
    let ff = Video::open_with(
        &path,
        &VideoSettings {
            decoder: DecoderChoice::Ffmpeg,
            ..Default::default()
        },
    )
    .unwrap();
    eprintln!("{:?}", ff.info());
    let t = std::time::Instant::now();
    let clip2 = ff.load_clip(0, 8.0, 16, 256).unwrap();
    eprintln!(
        "ffmpeg load_clip {:?} {:?}",
        t.elapsed(),
        clip.frames.shape()
    );
    let mut hist = [0usize; 6];
    for (a, b) in clip.frames.iter().zip(clip2.frames.iter()) {
        hist[(a.abs_diff(*b) as usize).min(5)] += 1;
    }
    eprintln!("clip differences {hist:?}");
    let a = video.chosen(vec![60]).unwrap().next().unwrap().unwrap();
    let b = ff.chosen(vec![60]).unwrap().next().unwrap().unwrap();
    assert_eq!(a.index, b.index);
    let mut hist = [0usize; 6];
    for (a, b) in a.image.data.iter().zip(b.image.data.iter()) {
        hist[(a.abs_diff(*b) as usize).min(5)] += 1;
    }
    eprintln!("frame differences {hist:?}");
    for name in ["rgb2dep_h2o", "dep2rgb_holo"] {
        let v = Video::open(shared.join(format!("data/egom2p_examples/{name}.mp4")));
        eprintln!("{:?}", v.map(|v| v.info().clone()));
    }
}
