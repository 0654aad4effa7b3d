//! A video of known geometry goes through stitching, the floor fit and every export.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use ndarray::{Array2, Array3, Array4, Ix3};
use reviv::clip::{
    CAMERA, CameraTrack, Clip, DEPTH, Depth, GAZE, GazeTrack, Intrinsics, JointTrack, LEFT_HAND,
};
use reviv::formats::npz::Npz;
use reviv::geometry::rigid::Rigid;
use reviv::geometry::rigid::level_camera;
use reviv::geometry::skeleton::{BODY, JOINTS};
use reviv::reconstruction::ReconstructionInfo;
use reviv::reconstruction::cloud::ray;
use reviv::reconstruction::floor::FloorFit;
use reviv::reconstruction::folder::{Builder, first_camera};
use reviv::reconstruction::frame_buffer::DepthFrames;
use reviv::reconstruction::predictions::ScaleStatus;
use reviv::reconstruction::stitch::gravity_to_world;
use reviv::reconstruction::windows::{samples_of, windows};
use std::collections::BTreeMap;

const LENS: Intrinsics = Intrinsics {
    fx: 16.0,
    fy: 16.0,
    cx: 15.5,
    cy: 15.5,
    width: 32,
    height: 32,
};
const EYE: f64 = 1.55;

/// Somebody walks forward in a curve and looks 30 degrees down. World z is up, the floor is at -EYE.
fn camera(sample: f64) -> Rigid {
    let t = sample / 30.0;
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.2 * t.sin());
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -30_f64.to_radians());
    Isometry3::from_parts(
        Vector3::new(0.1 * t, 0.5 * t, 0.02 * (6.0 * t).sin()).into(),
        yaw * level_camera().rotation * down,
    )
}

/// What a perfect but scale-free model would decode for a window: depth is off by a factor and a shift.
fn decoded(start: usize, wrong: [f64; 2]) -> Clip {
    let mut clip = Clip::empty("walk", "test");
    let first = camera(start as f64);
    let poses: Vec<Rigid> = (0..60).map(|i| camera((start + i) as f64)).collect();
    clip.set(
        CAMERA,
        CameraTrack {
            rate: 30.0,
            T_world_camera: poses.iter().map(|p| first.inv_mul(p)).collect(),
            valid: vec![true; 60],
            up_world: None,
            intrinsics: None,
        },
    );
    clip.set(
        GAZE,
        GazeTrack {
            rate: 30.0,
            points: Array2::from_elem((60, 2), 0.5),
            valid: ndarray::Array1::from_shape_fn(60, |t| t % 7 != 0),
        },
    );
    let from_world = gravity_to_world(&first).inverse();
    let feet = [
        BODY.joint("left_foot").unwrap(),
        BODY.joint("right_foot").unwrap(),
    ];
    clip.set(
        reviv::clip::BODY,
        JointTrack {
            rate: 30.0,
            joints: Array3::from_shape_fn((60, JOINTS, 3), |(t, j, k)| {
                let at = poses[t].translation.vector;
                let z = if feet.contains(&j) {
                    -EYE
                } else {
                    at.z - 0.06 * j as f64
                };
                let lean = Vector3::new(0.1 * (j as f64).sin(), 0.02 * j as f64, 0.0);
                (from_world * Point3::from(Vector3::new(at.x, at.y, z) + lean))[k] as f32
            }),
            valid: Array2::from_elem((60, JOINTS), true),
        },
    );
    clip.set(
        LEFT_HAND,
        JointTrack {
            rate: 30.0,
            joints: Array3::from_shape_fn((60, JOINTS, 3), |(_, j, k)| {
                [
                    -0.1 + 0.01 * (j % 5) as f32,
                    0.2,
                    0.4 + 0.02 * (j / 5) as f32,
                ][k]
            }),
            valid: Array2::from_elem((60, JOINTS), true),
        },
    );
    clip.set(
        DEPTH,
        Depth {
            rate: 8.0,
            metres: Array3::from_shape_fn((16, 32, 32), |(f, row, column)| {
                let pose = camera(start as f64 + 3.75 * f as f64);
                let [x, y] = ray(&LENS, [32, 32], row, column);
                let turned = pose.rotation * Vector3::new(x, y, 1.0);
                let floor = if turned.z < 0.0 {
                    (-EYE - pose.translation.z) / turned.z
                } else {
                    f64::INFINITY
                };
                let wall = (6.0 - pose.translation.y) / turned.y.max(1e-3);
                // The hand is in the picture where its joints are.
                let on_hand = (x + 0.19).abs() < 0.13 && (y - 0.46).abs() < 0.12;
                let depth = if on_hand { 0.44 } else { floor.min(wall) };
                ((depth - wrong[1]) / wrong[0]) as f32
            }),
        },
    );
    clip
}

fn setting(seconds: f64) -> ReconstructionInfo {
    ReconstructionInfo {
        start: 0.0,
        title: "walk".into(),
        video_rate: 8.0,
        frames: (seconds * 8.0).ceil() as usize,
        samples: samples_of(seconds),
        intrinsics: LENS,
        first: first_camera(&camera(0.0)),
        floor_fit: FloorFit::default(),
        anchor: None,
        assumptions: Vec::new(),
        badges: Vec::new(),
        truth: None,
    }
}

fn build(
    seconds: f64,
    setting: ReconstructionInfo,
    path: &std::path::Path,
) -> reviv::reconstruction::folder::Manifest {
    let depth = DepthFrames::on_disk(path.parent().unwrap()).unwrap();
    let mut builder = Builder::new(setting, depth);
    for window in windows(seconds, 0.5).unwrap() {
        let rgb = Array4::from_shape_fn((16, 32, 32, 3), |(f, y, x, c)| {
            (f * 9 + y * 5 + x * 3 + c * 50) as u8
        });
        // Every window has a scale of its own, as relative depth has.
        let wrong = [2.0 + window.index as f64, 0.1 * window.index as f64];
        let certainty = BTreeMap::from([("body".to_owned(), vec![0.5; 60])]);
        builder
            .push(
                &window,
                rgb.view(),
                &decoded(window.start, wrong),
                &certainty,
            )
            .unwrap();
    }
    builder.finish().unwrap().write(path).unwrap()
}

#[test]
fn a_walk_becomes_metric_and_every_file_is_there() {
    let directory = tempfile::tempdir().unwrap();
    let manifest = build(5.3, setting(5.3), directory.path());
    assert_eq!(
        manifest.scale,
        ScaleStatus::Metric {
            by: "floor fit".into()
        },
        "{:?}",
        manifest.refused
    );
    let depth = Npz::read(&directory.path().join("depth.npz")).unwrap();
    let metres = depth.get("metres").unwrap().to_dim::<f32, Ix3>().unwrap();
    assert_eq!(metres.shape(), [43, 32, 32]);
    let mut worst = 0.0_f32;
    for (frame, truth) in
        [0, 16, 30, 42].map(|f| (f, decoded((f as f64 * 3.75) as usize, [1.0, 0.0])))
    {
        let near = truth.depth().unwrap().metres[[0, 31, 16]];
        worst = worst.max((metres[[frame, 31, 16]] - near).abs() / near);
    }
    assert!(worst < 0.03, "{worst}");
    for file in [
        "body.bvh",
        "body.npz",
        "camera.npz",
        "camera.tum",
        "colmap/images.txt",
        "depth.npz",
        "gaze.csv",
        "hands.npz",
        "left_hand.bvh",
        "manifest.json",
        "points.ply",
        "scene.glb",
        "view.html",
    ] {
        assert!(
            manifest.files.iter().any(|f| f == file),
            "{file} is not in the manifest"
        );
        assert!(
            directory.path().join(file).is_file(),
            "{file} is not in the folder"
        );
    }
    let camera_file = Npz::read(&directory.path().join("camera.npz")).unwrap();
    assert_eq!(
        camera_file.get("T_world_camera").unwrap().shape,
        [159, 4, 4]
    );
    assert!(
        manifest
            .seams
            .iter()
            .all(|s| s.camera_m.unwrap() < 1e-6 && s.body_m.unwrap() < 1e-4)
    );
    assert!((manifest.certainty["body"] - 0.5).abs() < 1e-6);
}

#[test]
fn an_anchor_depth_makes_it_metric_and_its_absence_of_floor_does_not() {
    let directory = tempfile::tempdir().unwrap();
    let truth = decoded(0, [1.0, 0.0]).take(DEPTH).unwrap().metres;
    let anchor = Array3::from_shape_fn((16, 32, 32), |(f, y, x)| truth[[f, y, x]]);
    let anchored = ReconstructionInfo {
        anchor: Some(anchor.clone()),
        ..setting(2.0)
    };
    let manifest = build(2.0, anchored, &directory.path().join("anchored"));
    assert_eq!(
        manifest.scale,
        ScaleStatus::Metric {
            by: "anchor depth".into()
        }
    );
    assert!((manifest.fit.unwrap().scale - 2.0).abs() < 1e-3);

    let unknown = ReconstructionInfo {
        anchor: Some(anchor.mapv(|_| f32::NAN)),
        ..setting(2.0)
    };
    let manifest = build(2.0, unknown, &directory.path().join("unknown"));
    assert_eq!(manifest.scale, ScaleStatus::Relative);
    assert!(manifest.refused.unwrap().contains("depth points"));
    let depth = Npz::read(&directory.path().join("unknown/depth.npz")).unwrap();
    assert!(depth.get("relative").is_ok() && depth.get("metres").is_err());
}
