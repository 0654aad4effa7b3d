//! Real samples against numbers that independent programs (projectaria-tools and own Python) found in them.
//!
//! Golden numbers come from `refs/` beside the samples; tolerances are 2 mm, 2 px and 1e-4 of normalised gaze.

use crate::shared;
use nalgebra::{Isometry3, Matrix4, Rotation3, UnitQuaternion, Vector3};
use reviv::clip::frames::gravity_frame;
use reviv::clip::{Clip, GAZE, RGB};
use reviv::datasets::recording::{CutSettings, Recording};
use reviv::datasets::{ClipSource, Outcome, adt, hot3d, mps};
use reviv::formats::npz::Npz;
use reviv::geometry::skeleton::HAND_FROM_COMMON;
use reviv::video::image::Turn;
use std::path::PathBuf;

fn data(name: &str) -> Option<PathBuf> {
    Some(shared::folder()?.join("data").join(name))
}

fn adt_reference() -> serde_json::Value {
    let path = data("refs/adt_frame0_ref.json").unwrap();
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn pose(rows: impl Fn(usize, usize) -> f64) -> Isometry3<f64> {
    let matrix = Matrix4::from_fn(&rows);
    let rotation = Rotation3::from_matrix(&matrix.fixed_view::<3, 3>(0, 0).into_owned());
    Isometry3::from_parts(
        Vector3::new(rows(0, 3), rows(1, 3), rows(2, 3)).into(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

fn short() -> CutSettings {
    CutSettings {
        pad_short: true,
        ..CutSettings::default()
    }
}

fn only_clip(source: &impl ClipSource) -> Clip {
    assert_eq!(source.len(), 1);
    source.clip(0).unwrap().into_clip().expect("not dropped")
}

fn frame_times(recording: &Recording) -> Vec<i64> {
    recording.colour.as_ref().unwrap().times().to_vec()
}

#[test]
fn adt_camera_gaze_depth_and_body_are_the_references() {
    let Some(folder) = data("adt_sample") else {
        return;
    };
    let reference = adt_reference();
    let frame = &reference["frames"][0];
    let recording = adt::open(&folder).unwrap();
    let times = frame_times(&recording);
    assert_eq!(times[0], frame["rgb_ts_ns"].as_i64().unwrap());
    assert_eq!(recording.up_world.unwrap().into_inner(), Vector3::y());

    let expected = pose(|r, c| frame["T_world_cam"][r][c].as_f64().unwrap());
    let found = recording.pose(times[0]).unwrap();
    assert!((found.translation.vector - expected.translation.vector).norm() < 2e-3);
    assert!(found.rotation.angle_to(&expected.rotation) < 1e-3);

    // Gaze at 1 m in frames 0, 1, 2.
    let settings = CutSettings::default();
    let golden = [(0.49252, 0.72880), (0.46849, 0.70529), (0.46989, 0.70432)];
    for (time, (u, v)) in times.iter().zip(golden) {
        let [found_u, found_v] = recording.gaze_at(*time, &settings).unwrap();
        assert!(
            (found_u - u).abs() < 1e-4 && (found_v - v).abs() < 1e-4,
            "{found_u} {found_v}"
        );
    }

    // Depth: time apart, median, and values of the upright picture.
    let offsets = recording.depth_offsets_ms();
    for (found, golden) in offsets.iter().zip([0.097, 0.086, -33.234]) {
        assert!((found.unwrap() - golden).abs() < 1e-3, "{offsets:?}");
    }
    let depth = recording.depth.as_ref().unwrap();
    for (index, median) in [1.884_f32, 1.873].into_iter().enumerate() {
        let metres = depth.read(index).unwrap();
        let mut valid: Vec<f32> = metres.iter().copied().filter(|d| d.is_finite()).collect();
        valid.sort_by(f32::total_cmp);
        assert!((valid[valid.len() / 2] - median).abs() < 1e-3);
    }
    let metres = depth.read(0).unwrap();
    let samples = frame["depth_upright_samples"].as_object().unwrap();
    assert!(samples.len() >= 25);
    for (place, millimetres) in samples {
        let (row, column) = place.split_once(',').unwrap();
        let (row, column): (f64, f64) = (row.parse().unwrap(), column.parse().unwrap());
        let (u, v) = Turn::CounterClockwise.pixel(column, row, 1408.0, 1408.0);
        let found = metres[[v as usize, u as usize]] * 1000.0;
        assert!(
            (f64::from(found) - millimetres.as_f64().unwrap()).abs() < 0.5,
            "{place}"
        );
    }

    // Body in the gravity frame of the first camera. Heights do not depend on the choice of heading.
    let body = recording.body.as_ref().unwrap().at(times[0]).unwrap();
    let gravity_from_world = gravity_frame(&found, &recording.up_world.unwrap()).unwrap();
    let reference =
        |k: usize, axis: usize| frame["body21_gravity_frame"][k][axis].as_f64().unwrap();
    // Ours and the reference's index (its list: pelvis .. neck, head, left arm, right arm, left leg, right leg).
    let pairs = [
        (0, 0),
        (1, 13),
        (2, 17),
        (3, 14),
        (4, 18),
        (5, 2),
        (6, 15),
        (7, 19),
        (9, 16),
        (10, 20),
        (11, 3),
        (12, 5),
        (13, 9),
        (14, 4),
        (15, 6),
        (16, 10),
        (17, 7),
        (18, 11),
        (19, 8),
        (20, 12),
    ];
    for (ours, theirs) in pairs {
        let point = gravity_from_world * body[ours].unwrap();
        assert!(
            (point.z - reference(theirs, 2)).abs() < 2e-3,
            "joint {ours}: {point}"
        );
        let radius = reference(theirs, 0).hypot(reference(theirs, 1));
        assert!(
            (point.x.hypot(point.y) - radius).abs() < 2e-3,
            "joint {ours}: {point}"
        );
    }
    let toe = gravity_from_world * body[9].unwrap();
    assert!((toe.z - -1.5065).abs() < 2e-3, "{toe}");
}

#[test]
fn the_adt_sample_makes_a_clip_without_the_frame_that_has_no_depth() {
    let Some(folder) = data("adt_sample") else {
        return;
    };
    assert_eq!(
        adt::source(&folder, CutSettings::default()).unwrap().len(),
        0
    );
    let source = adt::source(&folder, short()).unwrap();
    assert_eq!(
        source.modalities(),
        ["rgb", "depth", "camera", "gaze", "body"]
    );
    let clip = only_clip(&source);
    assert_eq!(
        (clip.id.as_str(), clip.source.as_str()),
        ("adt/adt_sample/000000", "adt")
    );
    let rgb = clip.rgb().unwrap();
    let depth = clip.depth().unwrap();
    assert_eq!(rgb.frames.dim(), (16, 256, 256, 3));
    assert_eq!(depth.metres.dim(), (16, 256, 256));
    // Tick 1 lies beyond the recording: the last frame that has depth (the second) is repeated from there on.
    let frame = |k: usize| rgb.frames.index_axis(ndarray::Axis(0), k);
    assert_ne!(frame(0), frame(1));
    assert_eq!(frame(1), frame(15));
    // The corners of the fisheye carry nothing; the table does.
    assert!(depth.metres[[0, 2, 2]].is_nan());
    assert!(
        (depth.metres[[0, 163, 91]] - 0.879).abs() < 0.05,
        "{}",
        depth.metres[[0, 163, 91]]
    );
    let camera = clip.camera().unwrap();
    let valid: Vec<usize> = (0..60).filter(|&k| camera.valid[k]).collect();
    assert_eq!(valid, [0, 1, 2, 3, 4, 5]);
    assert_eq!(camera.intrinsics, None);
    let gaze = clip.gaze().unwrap();
    assert!(gaze.valid[0] && !gaze.valid[30]);
    assert!((gaze.points[[0, 0]] - 0.49252).abs() < 1e-4);
    let body = clip.body().unwrap();
    assert!(body.valid.row(0).iter().all(|v| *v));
    assert!((body.joints[[0, 9, 2]] - -1.5065).abs() < 2e-3);
}

#[test]
fn an_undistorted_clip_has_pinhole_intrinsics_and_sees_the_same() {
    let Some(folder) = data("adt_sample") else {
        return;
    };
    let settings = CutSettings {
        undistort: Some(90.0),
        ..short()
    };
    let clip = only_clip(&adt::source(&folder, settings).unwrap());
    let intrinsics = clip.camera().unwrap().intrinsics.unwrap();
    assert!((intrinsics.fx - 128.0).abs() < 1e-9 && intrinsics.cx == 127.5);
    // The wearer looks at the same thing: the picture around the gaze point has the same mean colour in both views.
    let fisheye = only_clip(&adt::source(&folder, short()).unwrap());
    let mean = |clip: &Clip| -> [f64; 3] {
        let gaze = clip.gaze().unwrap();
        let (u, v) = (gaze.points[[0, 0]] * 256.0, gaze.points[[0, 1]] * 256.0);
        let rgb = clip.rgb().unwrap();
        std::array::from_fn(|c| {
            let mut sum = 0.0;
            for dy in -2..=2_i32 {
                for dx in -2..=2_i32 {
                    sum += f64::from(
                        rgb.frames[[0, (v as i32 + dy) as usize, (u as i32 + dx) as usize, c]],
                    );
                }
            }
            sum / 25.0
        })
    };
    let mut undistorted = fisheye.clone();
    undistorted.set(GAZE, clip.gaze().cloned());
    undistorted.set(RGB, clip.rgb().cloned());
    for (a, b) in mean(&fisheye).into_iter().zip(mean(&undistorted)) {
        assert!((a - b).abs() < 25.0, "{a} {b}");
    }
}

#[test]
fn hot3d_aria_poses_and_hands_are_the_references() {
    let Some(folder) = data("hot3d_aria/P0003_c701bd11") else {
        return;
    };
    let reference = Npz::read_some(
        &data("refs/hot3d_aria_first10_ref.npz").unwrap(),
        &["timestamps_ns", "T_world_cam", "hands_cam", "hands_uv_raw"],
    )
    .unwrap();
    let times: Vec<i64> = reference
        .get("timestamps_ns")
        .unwrap()
        .to::<i64>()
        .unwrap()
        .iter()
        .copied()
        .collect();
    let poses = reference.get("T_world_cam").unwrap().to::<f64>().unwrap();
    let hands = reference.get("hands_cam").unwrap().to::<f64>().unwrap();
    let raw_pixels = reference.get("hands_uv_raw").unwrap().to::<f64>().unwrap();
    let recording = hot3d::open(&folder).unwrap();
    for (k, time) in times.iter().enumerate() {
        let expected = pose(|r, c| poses[[k, r, c]]);
        let found = recording.pose(*time).unwrap();
        assert!(
            (found.translation.vector - expected.translation.vector).norm() < 2e-3,
            "frame {k}"
        );
        assert!(
            found.rotation.angle_to(&expected.rotation) < 1e-3,
            "frame {k}"
        );
        for side in 0..2 {
            let joints = recording.hands[side].as_ref().unwrap().at(*time).unwrap();
            for (ours, common) in HAND_FROM_COMMON.into_iter().enumerate() {
                let point = found.inverse() * joints[ours].unwrap();
                for axis in 0..3 {
                    let golden = hands[[k, side, common, axis]];
                    assert!(
                        (point[axis] - golden).abs() < 2e-3,
                        "frame {k} hand {side} joint {ours}: {point} {golden}"
                    );
                }
                // The pixel of the stored picture, through the lens.
                let camera = &recording.cameras[0].1.camera;
                let (u, v) = (
                    raw_pixels[[k, side, common, 0]],
                    raw_pixels[[k, side, common, 1]],
                );
                let stored = Vector3::new(point.y, -point.x, point.z);
                let pixel = camera.project(&stored).unwrap();
                assert!(
                    (pixel.x - u).hypot(pixel.y - v) < 2.0,
                    "frame {k} hand {side} joint {ours}: {pixel} {u} {v}"
                );
            }
        }
    }
    let wrist = |side: usize| {
        let point = recording.hands[side]
            .as_ref()
            .unwrap()
            .at(times[0])
            .unwrap()[0]
            .unwrap();
        (recording.pose(times[0]).unwrap().inverse() * point).z
    };
    assert!((wrist(0) - 0.2357).abs() < 2e-3, "{}", wrist(0));
    assert!((wrist(1) - 0.2718).abs() < 2e-3, "{}", wrist(1));

    let clip = only_clip(&hot3d::aria(&folder, short()).unwrap());
    assert!((clip.left_hand().unwrap().joints[[0, 0, 2]] - 0.2357).abs() < 2e-3);
    assert!((clip.right_hand().unwrap().joints[[0, 0, 2]] - 0.2718).abs() < 2e-3);
    assert!(clip.rgb().is_none() && clip.gaze().unwrap().valid[0]);
}

#[test]
fn hot3d_quest_opens_with_hands_in_view() {
    let Some(folder) = data("hot3d_quest_trimmed") else {
        return;
    };
    let source = hot3d::quest(&folder, short()).unwrap();
    assert_eq!(source.modalities(), ["camera", "left_hand", "right_hand"]);
    let clip = only_clip(&source);
    let camera = clip.camera().unwrap();
    assert_eq!(camera.up_world.unwrap().into_inner(), Vector3::y());
    // Box 0 of the sample: the left hand in camera 1201-1 covers x 439..640, y 544..764 of the stored picture.
    let lens = &hot3d::open(&folder.join("P0002_273c2819")).unwrap().cameras[0]
        .1
        .camera;
    let hand = clip.left_hand().unwrap();
    for joint in 0..21 {
        let p = |axis: usize| f64::from(hand.joints[[0, joint, axis]]);
        let pixel = lens.project(&Vector3::new(p(1), -p(0), p(2))).unwrap();
        assert!(
            (427.0..652.0).contains(&pixel.x) && (532.0..776.0).contains(&pixel.y),
            "joint {joint}: {pixel}"
        );
    }
}

#[test]
fn mps_gives_five_clips_with_the_reference_paths_and_gaze() {
    let Some(folder) = data("mps_sample") else {
        return;
    };
    let source = mps::source(&folder, CutSettings::default()).unwrap();
    assert_eq!(source.len(), 5);
    let lengths: Vec<f64> = (0..5)
        .map(|index| {
            let clip = source.clip(index).unwrap().into_clip().unwrap();
            let track = clip.camera().unwrap();
            assert!(track.valid.iter().all(|v| *v));
            track
                .T_world_camera
                .windows(2)
                .map(|pair| (pair[1].translation.vector - pair[0].translation.vector).norm())
                .sum()
        })
        .collect();
    for (found, golden) in lengths.iter().zip([1.533, 1.813, 1.641, 1.404, 0.894]) {
        assert!((found - golden).abs() < 2e-3, "{lengths:?}");
    }
    let reference = Npz::read(&data("refs/mps_window0_ref.npz").unwrap()).unwrap();
    let poses = reference.get("T_world_cam").unwrap().to::<f64>().unwrap();
    let gaze = reference
        .get("gaze_uv_upright_norm")
        .unwrap()
        .to::<f64>()
        .unwrap();
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    let track = clip.camera().unwrap();
    let eyes = clip.gaze().unwrap();
    for k in 0..60 {
        let expected = pose(|r, c| poses[[0, k, r, c]]);
        assert!(
            (track.T_world_camera[k].translation.vector - expected.translation.vector).norm()
                < 2e-3,
            "sample {k}"
        );
        for axis in 0..2 {
            assert!(
                (f64::from(eyes.points[[k, axis]]) - gaze[[0, k, axis]]).abs() < 1e-4,
                "sample {k}: {} {}",
                eyes.points[[k, axis]],
                gaze[[0, k, axis]]
            );
        }
    }
}

#[test]
fn every_gaze_table_of_the_samples_is_read() {
    let Some(root) = data("") else { return };
    for (name, rows) in [
        ("adt_sample/eyegaze.csv", 6),
        ("adt_sample/mps/eye_gaze/general_eye_gaze.csv", 6),
        ("mps_sample/eye_gaze/generalized_eye_gaze.csv", 123),
        ("mps_sample/eye_gaze_vergence/generalized_gaze.csv", 123),
        (
            "hot3d_aria/P0003_c701bd11/mps/eye_gaze/personalized_eye_gaze.csv",
            11,
        ),
    ] {
        assert_eq!(
            reviv::datasets::aria::gaze::read(&root.join(name))
                .unwrap()
                .times()
                .len(),
            rows,
            "{name}"
        );
    }
    let [left, right] = reviv::datasets::aria::hand_tracking::read(
        &root.join("mps_sample/hand_tracking/hand_tracking_results_v1.csv"),
    )
    .unwrap();
    assert!(!left.is_empty());
    assert!(left.times().len() + right.times().len() <= 16);
    assert!(matches!(
        mps::source(&root.join("mps_sample"), CutSettings::default())
            .unwrap()
            .clip(4)
            .unwrap(),
        Outcome::Clip(_)
    ));
}
