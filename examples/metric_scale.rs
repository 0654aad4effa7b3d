//! How often the floor fit calls depth metric, and how well: `cargo run --release --example metric_scale [CLIPS]`.
//!
//! Clips of the built-in world, whose true depth is known, go through the fit as a perfect model would decode them (8-bit inverse depth
//! between the clip's own extremes) and with errors of 3 % that are smooth over the picture. Then the floor is taken away from them:
//! hidden, or replaced by a desk, a wall, constant or random depth, or black and random pictures, from which a model would only guess.
#![allow(clippy::print_stdout)]

use ndarray::{Array3, Array4};
use rand::RngExt;
use reviv::World;
use reviv::clip::depth_video::{DepthCoding, from_model, to_model};
use reviv::clip::{Clip, JointTrack};
use reviv::geometry::rigid::Rigid;
use reviv::geometry::skeleton::BODY;
use reviv::reconstruction::cloud::ray;
use reviv::reconstruction::floor::{FloorFit, View, fit_floor, floor_height};
use reviv::reconstruction::scale::{DepthFit, DepthSpace, ScaleRefusal};
use std::collections::BTreeMap;
use std::error::Error;
use std::fmt::Write as _;

/// The bounds of the fit were chosen on clips up to 60 000.
const FIRST: u64 = 60_000;
/// Height of a desk over the floor, metres.
const DESK: f64 = 0.75;

/// What is done to a clip before it is fitted.
#[derive(Clone, Copy, PartialEq)]
enum Case {
    AsItIs,
    Noisy,
    /// Nothing is known of what is lower than 0.3 m.
    Hidden,
    /// A desk as far as one sees.
    Desk,
    /// A wall a metre ahead of the first camera.
    Wall,
    Constant,
    Random,
    Black,
    Noise,
}

const WITHOUT: [(Case, &str); 7] = [
    (Case::Hidden, "floor and all below 0.3 m hidden"),
    (Case::Desk, "desk as far as one sees"),
    (Case::Wall, "wall a metre ahead"),
    (Case::Constant, "one depth everywhere"),
    (Case::Random, "random depth"),
    (Case::Black, "black pictures, true depth"),
    (Case::Noise, "random pictures, true depth"),
];

#[derive(Default)]
struct Row {
    clips: usize,
    errors: Vec<f64>,
    refusals: BTreeMap<String, usize>,
}

impl Row {
    fn add(&mut self, outcome: &Outcome) {
        self.clips += 1;
        match &outcome.fit {
            Ok(fit) => self.errors.push(outcome.error(fit)),
            Err(refusal) => {
                let name = format!("{refusal:?}");
                let name = name.split([' ', '{']).next().unwrap_or_default();
                *self.refusals.entry(name.to_owned()).or_default() += 1;
            }
        }
    }

    fn line(&self, name: &str) -> String {
        let share = |n: usize| 100.0 * n as f64 / self.clips.max(1) as f64;
        let within = self.errors.iter().filter(|e| e.abs() <= 0.05).count();
        let mut sizes: Vec<f64> = self.errors.iter().map(|e| e.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let median = sizes
            .get(sizes.len() / 2)
            .map_or("-".to_owned(), |e| format!("{:.1} %", 100.0 * e));
        format!(
            "| {name} | {} | {:.1} % | {:.1} % | {median} |",
            self.clips,
            share(self.errors.len()),
            share(within)
        )
    }
}

/// A fit, and what it was of.
struct Outcome {
    fit: Result<DepthFit, ScaleRefusal>,
    decoded: Array3<f32>,
    truth: Array3<f32>,
}

impl Outcome {
    /// The share by which the fitted depth is too large: the median over the true points.
    fn error(&self, fit: &DepthFit) -> f64 {
        let both = self.decoded.iter().zip(&self.truth);
        let known = both.filter(|(a, b)| a.is_finite() && b.is_finite());
        let mut ratios: Vec<f64> = known.map(|(a, b)| f64::from(fit.apply(*a) / b)).collect();
        ratios.sort_by(f64::total_cmp);
        ratios.get(ratios.len() / 2).map_or(f64::NAN, |r| r - 1.0)
    }
}

/// The joints of a hand that are known at a sample.
fn joints(track: Option<&JointTrack>, sample: usize) -> Vec<[f32; 3]> {
    let Some(track) = track else {
        return Vec::new();
    };
    (0..track.joints.shape()[1])
        .filter(|&joint| track.valid[[sample, joint]])
        .map(|joint| [0, 1, 2].map(|axis| track.joints[[sample, joint, axis]]))
        .collect()
}

fn camera_of(clip: &Clip, frame: usize) -> Rigid {
    let poses = &clip
        .camera()
        .expect("a clip of the world has a camera")
        .T_world_camera;
    poses[sample_of(frame).min(poses.len() - 1)]
}

/// The motion sample at a frame of the video.
fn sample_of(frame: usize) -> usize {
    (frame as f64 * 3.75).round_ties_even() as usize
}

/// `depth` with every cell given its height over the floor and its ray's fall per metre of depth.
fn map_depth(clip: &Clip, f: impl Fn(usize, f64, f64, f64) -> f64) -> Array3<f32> {
    let metres = &clip.depth().expect("a clip of the world has depth").metres;
    let camera = clip.camera().expect("a clip of the world has a camera");
    let lens = camera.intrinsics.expect("the world knows its lens");
    let (_, rows, columns) = metres.dim();
    Array3::from_shape_fn(metres.dim(), |(t, row, column)| {
        let pose = camera_of(clip, t);
        let [x, y] = ray(&lens, [rows, columns], row, column);
        let rise = (pose.rotation * nalgebra::Vector3::new(x, y, 1.0)).z;
        let depth = f64::from(metres[[t, row, column]]);
        f(t, depth, rise, pose.translation.z) as f32
    })
}

/// Shares of the pixels on the floor, and how far the floor reaches: its farthest distance over its nearest (tenth percentiles).
fn floor_in_view(clip: &Clip) -> (f64, f64) {
    let on_floor = map_depth(clip, |_, depth, rise, height| {
        if (height + rise * depth).abs() < 0.03 {
            depth
        } else {
            f64::NAN
        }
    });
    let mut depths: Vec<f32> = on_floor.iter().copied().filter(|d| d.is_finite()).collect();
    depths.sort_by(f32::total_cmp);
    let at = |q: f64| {
        depths
            .get((depths.len() as f64 * q) as usize)
            .copied()
            .unwrap_or(1.0)
    };
    (
        depths.len() as f64 / on_floor.len() as f64,
        f64::from(at(0.9) / at(0.1)),
    )
}

fn fit(clip: &Clip, case: Case, index: u64) -> Result<Outcome, Box<dyn Error>> {
    let mut random = reviv::random::stream(1, "metric_scale", 0, index);
    let plain = |_: usize, depth: f64, _: f64, _: f64| depth;
    let first = camera_of(clip, 0);
    let ahead = (first.rotation * nalgebra::Vector3::z()).xy().normalize();
    let truth = match case {
        Case::Desk => map_depth(clip, |_, depth, rise, height| {
            let desk = (DESK - height) / rise;
            if rise < 0.0 && desk > 0.0 {
                depth.min(desk)
            } else {
                depth
            }
        }),
        Case::Wall => {
            let camera = clip.camera().ok_or("no camera")?;
            let lens = camera.intrinsics.ok_or("no lens")?;
            let metres = &clip.depth().ok_or("no depth")?.metres;
            let (_, rows, columns) = metres.dim();
            Array3::from_shape_fn(metres.dim(), |(t, row, column)| {
                let pose = camera_of(clip, t);
                let [x, y] = ray(&lens, [rows, columns], row, column);
                let along = (pose.rotation * nalgebra::Vector3::new(x, y, 1.0))
                    .xy()
                    .dot(&ahead);
                let gone = (pose.translation.vector - first.translation.vector)
                    .xy()
                    .dot(&ahead);
                ((1.0 - gone) / along.max(0.05)).clamp(0.1, 10.0) as f32
            })
        }
        _ => map_depth(clip, plain),
    };
    let coding = DepthCoding::relative();
    let cells: Vec<f64> = (0..truth.shape()[0] * 64)
        .map(|_| random.random_range(-0.052..0.052))
        .collect();
    let size = truth.shape()[1];
    let shown = match case {
        Case::Noisy => Array3::from_shape_fn(truth.dim(), |(t, row, column)| {
            let cell = t * 64 + row * 8 / size * 8 + column * 8 / size;
            truth[[t, row, column]] * (cells[cell].exp() as f32)
        }),
        Case::Constant => Array3::from_elem(truth.dim(), 1.5),
        Case::Random => Array3::from_shape_simple_fn(truth.dim(), || random.random_range(0.3..4.0)),
        _ => truth.clone(),
    };
    let (levels, _) = coding.encode(&shown);
    let mut decoded = from_model(
        &to_model(&levels),
        clip.depth().ok_or("no depth")?.rate,
        &coding,
    )
    .metres;
    if case == Case::Hidden {
        let low = map_depth(clip, |_, depth, rise, height| height + rise * depth);
        ndarray::Zip::from(&mut decoded)
            .and(&low)
            .for_each(|d, &h| {
                if h < 0.3 {
                    *d = f32::NAN;
                }
            });
    }
    let frames = &clip.rgb().ok_or("no video")?.frames;
    let pictures: Array4<u8> = match case {
        Case::Black => Array4::zeros(frames.dim()),
        Case::Noise => Array4::from_shape_simple_fn(frames.dim(), || random.random()),
        _ => frames.clone(),
    };
    let camera = clip.camera().ok_or("no camera")?;
    let lens = camera.intrinsics.ok_or("no lens")?;
    let views: Vec<View<'_>> = (0..truth.shape()[0])
        .map(|t| View {
            depth: decoded.index_axis(ndarray::Axis(0), t),
            T_world_camera: camera_of(clip, t),
            hands: [clip.left_hand(), clip.right_hand()]
                .into_iter()
                .flat_map(|hand| joints(hand, sample_of(t)))
                .collect(),
            picture: Some(pictures.index_axis(ndarray::Axis(0), t)),
            second: t as f64 / 8.0,
        })
        .collect();
    // The body stands in the frame of the first camera.
    let up = camera.T_world_camera[0].translation.z;
    let body = &clip.body().ok_or("no body")?.joints;
    let feet = ["left_foot", "right_foot"].map(|name| BODY.joint(name));
    let feet = feet.into_iter().flatten();
    let heights: Vec<f64> = feet
        .flat_map(|joint| (0..60).map(move |sample| (sample, joint)))
        .map(|(sample, joint)| f64::from(body[[sample, joint, 2]]) + up)
        .collect();
    let settings = FloorFit::default();
    let fit = floor_height(&heights, settings.rule)
        .and_then(|floor| fit_floor(&views, &lens, floor, DepthSpace::Disparity, &settings));
    drop(views);
    Ok(Outcome {
        fit,
        decoded,
        truth,
    })
}

pub fn run(clips: u64) -> Result<String, Box<dyn Error>> {
    let world = World::small();
    let mut rows: BTreeMap<(usize, String), Row> = BTreeMap::new();
    for index in 0..clips {
        let clip = world.clip(FIRST + index);
        let (share, reach) = floor_in_view(&clip);
        let kind = if share >= 0.15 && reach >= 1.5 {
            (
                0,
                "floor well visible (15 % of the picture, far end 1.5 times as far as the near end)",
            )
        } else if share >= 0.005 {
            (2, "some floor visible")
        } else {
            (4, "no floor visible (under 0.5 % of the picture)")
        };
        let mut add = |(order, name): (usize, &str), case| -> Result<(), Box<dyn Error>> {
            let outcome = fit(&clip, case, index)?;
            rows.entry((order, name.to_owned()))
                .or_default()
                .add(&outcome);
            Ok(())
        };
        add(kind, Case::AsItIs)?;
        add(
            (kind.0 + 1, &format!("{}, depth off by 3 %", kind.1)),
            Case::Noisy,
        )?;
        for (place, (case, name)) in WITHOUT.into_iter().enumerate() {
            add((6 + place, name), case)?;
        }
    }
    let mut text = String::from(
        "| clips | number | called metric | metric and within 5 % | median error |\n|---|---|---|---|---|\n",
    );
    for ((_, name), row) in &rows {
        writeln!(text, "{}", row.line(name))?;
    }
    text.push_str("\nRefusals:\n");
    for ((_, name), row) in &rows {
        for (why, count) in &row.refusals {
            writeln!(text, "* {name}: {count} x {why}")?;
        }
    }
    Ok(text)
}

#[allow(dead_code, reason = "the tests call `run`")]
fn main() -> Result<(), Box<dyn Error>> {
    let clips = std::env::args().nth(1).map_or(Ok(500), |n| n.parse())?;
    print!("{}", run(clips)?);
    Ok(())
}
