//! The page is opened in headless Chromium where it is installed: it must draw, move with time, and raise no error.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use ndarray::{Array2, Array3};
use reviv::clip::Intrinsics;
use reviv::geometry::rigid::level_camera;
use reviv::geometry::skeleton::{BODY, HAND, JOINTS, Skeleton};
use reviv::reconstruction::cloud::lift;
use reviv::view::scene::Tone;
use reviv::view::{
    Badge, Certainty, DepthGrids, Drawing, Fact, Part, Scene, Track, VideoFrames, write_page,
};
use std::process::Command;

/// Four seconds of a figure that walks forward through a corridor, with a truth beside the prediction.
fn scene() -> Scene {
    let (samples, frames, side) = (120, 32, 64);
    let lens = Intrinsics {
        fx: 32.0,
        fy: 32.0,
        cx: 31.5,
        cy: 31.5,
        width: 64,
        height: 64,
    };
    let pose = |t: f64| {
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.2 * (1.5 * t).sin());
        Isometry3::from_parts(
            Vector3::new(0.0, 0.6 * t, 0.0).into(),
            yaw * level_camera().rotation,
        )
    };
    let mut video = VideoFrames::new(8.0);
    let mut metres = Array3::zeros((frames, 32, 32));
    let mut cloud = Vec::new();
    for frame in 0..frames {
        let rgb = Array3::from_shape_fn((side, side, 3), |(y, x, c)| {
            ((x * 3 + y * 2 + frame * 4 + c * 60) % 256) as u8
        });
        video.push(rgb.view()).unwrap();
        let depth = Array2::from_shape_fn((32, 32), |(y, x)| {
            let (u, v) = ((x as f32 - 15.5) / 16.0, (y as f32 - 15.5) / 16.0);
            (1.5 / u.abs().max(v.abs()).max(0.2)).min(5.0)
        });
        cloud.extend(lift(
            depth.view(),
            rgb.view(),
            &lens,
            &pose(frame as f64 / 8.0),
            2,
        ));
        metres
            .index_axis_mut(ndarray::Axis(0), frame)
            .assign(&depth);
    }
    let track = |name: &str, truth: bool, off: f32| {
        let camera = Array2::from_shape_fn((samples, 7), |(s, k)| {
            let pose = pose(s as f64 / 30.0);
            let (p, q) = (pose.translation.vector, pose.rotation.coords);
            [p.x, p.y, p.z, q.x, q.y, q.z, q.w][k] as f32
        });
        let gaze = Array2::from_shape_fn((samples, 2), |(s, k)| {
            0.5 + off + 0.2 * (s as f32 * 0.05 + k as f32).sin()
        });
        let body = Array2::from_shape_fn((samples, 3 * JOINTS), |(s, i)| match i % 3 {
            0 => off + 0.2 * ((i / 3) as f32 * 1.3).sin(),
            1 => s as f32 * 0.02,
            _ => -0.08 * (i / 3) as f32,
        });
        let hand = Array2::from_shape_fn((samples, 3 * JOINTS), |(s, i)| match i % 3 {
            0 => off - 0.2 + 0.01 * (i / 3) as f32,
            1 => 0.4 + s as f32 * 0.02,
            _ => -0.2 - 0.005 * ((i / 3) * (i / 3) % 11) as f32,
        });
        let pulse = Array2::from_shape_fn((samples, 2), |(s, k)| (s as f32 * 0.1 + k as f32).sin());
        let joints = |skeleton: &Skeleton, radius, in_image| Drawing::Joints {
            bones: skeleton.bones().map(|(a, b)| (a, b, radius)).collect(),
            in_image,
        };
        let plot = Drawing::Plot {
            channels: vec!["left".into(), "</script>".into()],
            units: vec!["1".into()],
        };
        Track {
            name: name.into(),
            truth,
            parts: vec![
                Part::new("camera", "camera", Drawing::Camera, camera.clone()),
                Part::new("gaze", "gaze", Drawing::ImagePoint, gaze),
                Part::new("left_hand", "hands", joints(&HAND, 0.008, true), hand),
                Part::new("body", "body", joints(&BODY, 0.035, false), body),
                Part::new("cup", "cup", Drawing::Pose, camera),
                Part::new("contact", "contact", plot, pulse),
            ],
        }
    };
    Scene {
        title: "A corridor </script><b>".into(),
        badges: vec![
            Badge {
                text: "metric by floor fit".into(),
                tone: Tone::Good,
            },
            Badge {
                text: "made up".into(),
                tone: Tone::Warn,
            },
        ],
        facts: vec![Fact {
            label: "World".into(),
            value: "z up, metres".into(),
        }],
        rate: 30.0,
        samples,
        intrinsics: lens,
        video: Some(video),
        depth: Some(DepthGrids { metres }),
        cloud,
        floor: Some(-1.6),
        tracks: vec![track("prediction", false, 0.0), track("truth", true, 0.05)],
        certainty: vec![Certainty {
            name: "body".into(),
            values: (0..60).map(|i| i as f32 / 60.0).collect(),
        }],
    }
}

#[test]
fn the_page_is_one_file_and_keeps_hostile_text_inside() {
    let mut scene = scene();
    scene.certainty[0].name = "a\"><script>b".into();
    let mut page = Vec::new();
    write_page(&scene, &mut page).unwrap();
    let page = String::from_utf8(page).unwrap();
    assert!(!page.contains("><script>b"));
    assert!(page.contains("id=\"blob-certainty-a&quot;&gt;&lt;script&gt;b\""));
    assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("src="));
    assert!(!page.contains("</script><b>"));
    assert!(!page.contains("{{"));
}

#[test]
fn lengths_that_disagree_are_refused() {
    let mut wrong = scene();
    wrong.tracks[0].parts[1].values = Array2::zeros((7, 2));
    let error = write_page(&wrong, &mut Vec::new()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "prediction gaze has 7 entries, the timeline has 120"
    );
}

#[test]
fn the_page_draws_moves_and_raises_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("view.html");
    write_page(&scene(), &mut std::fs::File::create(&file).unwrap()).unwrap();
    let Some(result) = self_test(&file, folder.path()) else {
        return;
    };
    assert_eq!(result["errors"].as_array().unwrap().len(), 0, "{result}");
    assert_eq!(result["webgl"], true, "{result}");
    assert_eq!(result["gl"], 0, "{result}");
    assert!(
        result["drawn"].as_u64().unwrap() > 500,
        "the body is not drawn: {result}"
    );
    assert!(
        result["moved"].as_u64().unwrap() > 500,
        "time does not move the body: {result}"
    );
    assert!(
        result["full"].as_u64() > result["drawn"].as_u64(),
        "no points: {result}"
    );
}

/// Opens `#selftest` and reads what the page wrote about itself; `None`, said on stderr, without Chromium.
fn self_test(page: &std::path::Path, profile: &std::path::Path) -> Option<serde_json::Value> {
    let run = |binary: &str| {
        Command::new(binary)
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-quic",
                "--no-first-run",
            ])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
            ])
            .args([
                "--use-gl=angle",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
            ])
            .args([
                "--window-size=1200,800",
                "--virtual-time-budget=20000",
                "--dump-dom",
            ])
            .arg(format!(
                "--user-data-dir={}",
                profile.join("profile").display()
            ))
            .arg(format!("file://{}#selftest", page.display()))
            .output()
    };
    let Some(output) = ["chromium", "chromium-browser", "google-chrome"]
        .iter()
        .find_map(|b| run(b).ok())
    else {
        crate::skipped::skipped("no Chromium on the PATH");
        return None;
    };
    let dom = String::from_utf8_lossy(&output.stdout).into_owned();
    let text = dom
        .split("id=\"selftest\">")
        .nth(1)
        .and_then(|rest| rest.split("</pre>").next());
    let text = text.unwrap_or_else(|| {
        panic!(
            "no self-test in the page: {}",
            String::from_utf8_lossy(&output.stderr)
        )
    });
    Some(serde_json::from_str(text).expect("the page writes JSON"))
}
