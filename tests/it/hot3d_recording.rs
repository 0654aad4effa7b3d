//! A HOT3D recording of our own with its `recording.vrs`: pictures on the glasses' clock, everything else on the timecode, brought
//! together.

use crate::readers_bad::{calibration_lines, hand};
use crate::recordings_bad::{CONFIGURATION_LAYOUT, LAYOUT};
use crate::vrs_writer::{CONFIGURATION, DATA, VrsWriter};
use reviv::datasets::recording::CutSettings;
use reviv::datasets::{ClipSource, hot3d};
use std::fmt::Write as _;
use std::path::Path;

const RGB: (i32, u16) = (214, 1);
const TIMECODE: (i32, u16) = (285, 2);
/// Timecode minus device time, nanoseconds.
const APART: i64 = 56_000_000_000_000;
/// Device time of the first picture.
const START: i64 = 1_000_000_000;
const SIDE: u32 = 704;
const TIMECODE_LAYOUT: &str = r#"{"data_layout":[{"name":"monotonic_timestamp_ns","type":"DataPieceValue<int64_t>","offset":0},
    {"name":"real_timestamp_ns","type":"DataPieceValue<int64_t>","offset":8}]}"#;

/// Stored pictures with a white left edge: turned clockwise, it is on top.
fn jpeg() -> Vec<u8> {
    let pixels: Vec<u8> = (0..SIDE * SIDE)
        .flat_map(|i| {
            if i % SIDE < SIDE / 4 {
                [255; 3]
            } else {
                [40, 60, 80]
            }
        })
        .collect();
    let mut bytes = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
    let side = u16::try_from(SIDE).unwrap();
    encoder
        .encode(&pixels, side, side, jpeg_encoder::ColorType::Rgb)
        .unwrap();
    bytes
}

fn vrs() -> Vec<u8> {
    let mut writer = VrsWriter::default();
    writer.file_tag("hardware_version", "DVT-S");
    writer.stream(
        RGB,
        &[
            ("RF:Data:2", "data_layout/size=16+image/jpg"),
            ("DL:Data:2:0", LAYOUT),
            ("RF:Configuration:2", "data_layout"),
            ("DL:Configuration:2:0", CONFIGURATION_LAYOUT),
        ],
    );
    writer.stream(
        TIMECODE,
        &[
            ("RF:Data:2", "data_layout"),
            ("DL:Data:2:0", TIMECODE_LAYOUT),
        ],
    );
    let mut configuration = Vec::new();
    for value in [SIDE, SIDE, 3 * SIDE, 11, 0, 5] {
        configuration.extend(value.to_le_bytes());
    }
    configuration.extend(b"214-1");
    writer.record(RGB, CONFIGURATION, 5e-324, &configuration, 0);
    let jpeg = jpeg();
    for k in 0..62_i64 {
        let time = START + k * 33_333_333;
        let seconds = time as f64 / 1e9;
        let clocks = [time.to_le_bytes(), (time + APART).to_le_bytes()].concat();
        writer.record(TIMECODE, DATA, seconds, &clocks, 0);
        let colour = [&k.to_le_bytes()[..], &time.to_le_bytes(), &jpeg].concat();
        writer.record(RGB, DATA, seconds, &colour, 1);
    }
    writer.finish(true, true)
}

/// A head that moves along x with 0.3 m/s, and a left hand that does not move.
fn recording(folder: &Path) {
    std::fs::write(folder.join("recording.vrs"), vrs()).unwrap();
    let metadata = r#"{"headset": "Aria", "recording_name": "own"}"#;
    std::fs::write(folder.join("metadata.json"), metadata).unwrap();
    let mut poses = String::from(
        "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z\n",
    );
    let (profile, line) = hand();
    let line = line.lines().next().unwrap().to_owned();
    let mut hands = String::new();
    for k in 0..62_i64 {
        let time = START + APART + k * 33_333_333;
        writeln!(poses, "1,{time},{},0,0,1,0,0,0", k as f64 * 0.01).unwrap();
        writeln!(
            hands,
            "{}",
            line.replace("\"timestamp_ns\":5", &format!("\"timestamp_ns\":{time}"))
        )
        .unwrap();
    }
    std::fs::write(folder.join("headset_trajectory.csv"), poses).unwrap();
    std::fs::write(folder.join("umetrack_hand_user_profile.json"), profile).unwrap();
    std::fs::write(folder.join("umetrack_hand_pose_trajectory.jsonl"), hands).unwrap();
    let slam = folder.join("mps/slam");
    std::fs::create_dir_all(&slam).unwrap();
    std::fs::write(slam.join("online_calibration.jsonl"), calibration_lines()).unwrap();
}

#[test]
fn pictures_of_a_recording_vrs_meet_poses_and_hands_on_one_clock() {
    let folder = tempfile::tempdir().unwrap();
    recording(folder.path());
    let settings = CutSettings {
        side: 32,
        ..CutSettings::default()
    };
    let source = hot3d::aria(folder.path(), settings).unwrap();
    assert_eq!(source.len(), 1);
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    assert_eq!(clip.id, "hot3d_aria/own/000000");
    let rgb = &clip.rgb().unwrap().frames;
    assert_eq!(rgb.dim(), (16, 32, 32, 3));
    assert!(
        rgb[[5, 3, 16, 0]] > 240 && rgb[[5, 20, 16, 0]] < 60,
        "not turned upright"
    );
    let camera = clip.camera().unwrap();
    for k in [0, 15, 45] {
        assert!(camera.valid[k]);
        let position = camera.T_world_camera[k].translation.vector;
        let wanted = [k as f64 * 0.01, 0.01, -0.01];
        assert!(
            (position - nalgebra::Vector3::from(wanted)).norm() < 1e-4,
            "{k}: {position}"
        );
    }
    // The head goes by, so the hand goes the other way: 0.01 m per sample along stored x, which is upright -y.
    let hand = clip.left_hand().unwrap();
    assert!(hand.valid[[0, 0]] && hand.valid[[45, 0]]);
    let moved: Vec<f32> = (0..3)
        .map(|c| hand.joints[[45, 0, c]] - hand.joints[[0, 0, c]])
        .collect();
    let length = moved.iter().map(|v| v * v).sum::<f32>().sqrt();
    assert!(
        (length - 0.45).abs() < 1e-3 && moved[1].abs() > 0.44,
        "{moved:?}"
    );
}
