//! Where the wearer was: the camera's path of some clips from above and from the side, with the body at three moments, on a grid
//! of metres.

use super::canvas::{Canvas, Colour, LETTER, LINE, viridis};
use super::contact::{LEFT, RIGHT};
use crate::clip::frames::gravity_frame_of;
use crate::clip::{CameraTrack, Clip, JointTrack};
use crate::geometry::rigid::level_camera;
use crate::geometry::skeleton::BODY;
use nalgebra::{Isometry3, Point3, Vector3};

/// Side of one drawing.
const SIDE: usize = 400;
const MARGIN: usize = 12;

const PAPER: Colour = [250, 250, 248];
const INK: Colour = [40, 40, 45];
const GRID: Colour = [222, 222, 218];
const FAINT: Colour = [130, 130, 135];
const BONE: Colour = [150, 150, 158];

/// Two drawings per clip: from above, and from the right. Clips without a camera and a body are left out.
pub fn paths(clips: &[Clip]) -> Canvas {
    let shown: Vec<&Clip> = clips
        .iter()
        .filter(|clip| clip.camera().is_some() || clip.body().is_some())
        .collect();
    let row = LINE * 2 + SIDE + MARGIN;
    let width = 3 * MARGIN + 2 * SIDE;
    let height = MARGIN + LINE + row * shown.len();
    let mut canvas = Canvas::new(width, height, PAPER);
    if shown.is_empty() {
        canvas.text(MARGIN, MARGIN, "no clip has a camera or a body", INK);
        return canvas;
    }
    let mut y = MARGIN;
    for clip in shown {
        draw(&mut canvas, clip, y);
        y += row;
    }
    canvas.text(
        MARGIN,
        y,
        "camera: dark at the start, yellow at the end. ticks point where it looks. body at 0, 1 and 2 s",
        FAINT,
    );
    canvas
}

/// Where the camera is, and where it looks.
type Look = (Point3<f64>, Vector3<f64>);

/// Camera positions and directions in the gravity frame of the first camera: x right, y forward, z up.
fn camera_in_level_frame(camera: &CameraTrack) -> (Vec<Option<Look>>, bool) {
    let level = gravity_frame_of(camera).ok();
    let first = camera.valid.iter().position(|v| *v).unwrap_or(0);
    let T_level_world = level.unwrap_or_else(|| {
        // Gravity is not known: the first picture is taken as upright.
        let T_world_first = camera
            .T_world_camera
            .get(first)
            .copied()
            .unwrap_or_default();
        level_camera() * T_world_first.inverse()
    });
    let of = |(pose, valid): (&Isometry3<f64>, &bool)| {
        let pose = T_level_world * pose;
        valid.then(|| (pose.translation.vector.into(), pose * Vector3::z()))
    };
    let all = camera.T_world_camera.iter().zip(&camera.valid);
    (all.map(of).collect(), level.is_some())
}

fn joint(track: &JointTrack, sample: usize, joint: usize) -> Option<Point3<f64>> {
    let at = |c: usize| f64::from(track.joints[(sample, joint, c)]);
    (*track.valid.get((sample, joint))?).then(|| Point3::new(at(0), at(1), at(2)))
}

/// Horizontal and vertical of a drawing, metres.
type Projection = fn(&Point3<f64>) -> [f64; 2];

fn draw(canvas: &mut Canvas, clip: &Clip, y: usize) {
    let camera = clip.camera();
    let (path, level) = camera.map(camera_in_level_frame).unwrap_or_default();
    let positions: Vec<Point3<f64>> = path.iter().flatten().map(|(p, _)| *p).collect();
    let length: f64 = positions
        .windows(2)
        .map(|pair| (pair[1] - pair[0]).norm())
        .sum();
    let mut title = format!("{}   camera {length:.2} m", clip.id);
    if camera.is_some() && !level {
        title += "   gravity not known: first picture taken as upright";
    }
    canvas.text(MARGIN, y, &title, INK);
    let y = y + LINE;
    // The body's frame is the level frame only where gravity is known; without it there is no body.
    let body = clip.body();
    let mut everything = positions.clone();
    if let Some(body) = body {
        let samples = body.joints.shape()[0];
        let points = (0..samples).flat_map(|t| (0..21).filter_map(move |j| joint(body, t, j)));
        everything.extend(points);
    }
    let views: [(&str, Projection); 2] = [
        ("from above: x right, y forward", |p| [p.x, p.y]),
        ("from the right: y forward, z up", |p| [p.y, p.z]),
    ];
    for (k, (words, project)) in views.into_iter().enumerate() {
        let x = MARGIN + k * (SIDE + MARGIN);
        canvas.text(x, y, words, FAINT);
        let frame = Frame::around(&everything, project, [x as f64, (y + LINE) as f64]);
        frame.grid(canvas);
        if let Some(body) = body {
            let last = body.joints.shape()[0].saturating_sub(1);
            for sample in [0, last / 2, last] {
                for (a, b) in BODY.bones() {
                    if let (Some(a), Some(b)) = (joint(body, sample, a), joint(body, sample, b)) {
                        canvas.line(frame.at(&a), frame.at(&b), 1.6, BONE);
                    }
                }
            }
            for (name, colour) in [("left_wrist", LEFT), ("right_wrist", RIGHT)] {
                let Some(wrist) = BODY.joint(name) else {
                    continue;
                };
                for sample in 0..last {
                    if let (Some(a), Some(b)) =
                        (joint(body, sample, wrist), joint(body, sample + 1, wrist))
                    {
                        canvas.line(frame.at(&a), frame.at(&b), 1.4, colour);
                    }
                }
            }
        }
        let count = path.len().max(2);
        for (sample, pair) in path.windows(2).enumerate() {
            if let [Some((a, looks)), Some((b, _))] = pair {
                let colour = viridis(sample as f64 / (count - 1) as f64);
                canvas.line(frame.at(a), frame.at(b), 3.0, colour);
                if sample % 10 == 0 {
                    let tip = a + looks * (24.0 / frame.scale);
                    canvas.line(frame.at(a), frame.at(&tip), 1.2, colour);
                }
            }
        }
    }
}

/// How metres become pixels in one drawing.
struct Frame {
    project: Projection,
    /// Metres in the middle of the drawing, and its top left pixel.
    middle: [f64; 2],
    origin: [f64; 2],
    /// Pixels per metre.
    scale: f64,
}

impl Frame {
    /// All points with a margin; at least half a metre.
    fn around(points: &[Point3<f64>], project: Projection, origin: [f64; 2]) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for point in points.iter().map(project) {
            for k in 0..2 {
                if point[k].is_finite() {
                    low[k] = low[k].min(point[k]);
                    high[k] = high[k].max(point[k]);
                }
            }
        }
        if low[0] > high[0] || low[1] > high[1] {
            (low, high) = ([-0.25; 2], [0.25; 2]);
        }
        let extent = (high[0] - low[0]).max(high[1] - low[1]).clamp(0.5, 1e6);
        Frame {
            project,
            middle: [0, 1].map(|k| f64::midpoint(low[k], high[k])),
            origin,
            scale: SIDE as f64 / (extent * 1.15),
        }
    }

    fn at(&self, point: &Point3<f64>) -> [f64; 2] {
        self.pixel((self.project)(point))
    }

    fn pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let half = SIDE as f64 / 2.0;
        [
            self.origin[0] + half + (x - self.middle[0]) * self.scale,
            self.origin[1] + half - (y - self.middle[1]) * self.scale,
        ]
    }

    /// Lines at every metre (or ten, or a tenth), with their numbers.
    fn grid(&self, canvas: &mut Canvas) {
        let extent = SIDE as f64 / self.scale;
        let step = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .find(|step| extent / step <= 8.0)
            .unwrap_or_else(|| 10_f64.powf((extent / 8.0).log10().ceil()));
        let side = SIDE as f64;
        for k in 0..2 {
            let low = self.middle[k] - extent / 2.0;
            let first = (low / step).ceil() as i64;
            for line in first..first + 10 {
                let value = line as f64 * step;
                if value > low + extent {
                    break;
                }
                let mut along = self.middle;
                along[k] = value;
                let pixel = self.pixel(along);
                let (mut a, mut b) = (self.origin, [self.origin[0] + side, self.origin[1] + side]);
                (a[k], b[k]) = (pixel[k], pixel[k]);
                canvas.line(a, b, if line == 0 { 2.0 } else { 1.0 }, GRID);
                let text = format!("{value:.1}");
                let place = if k == 0 {
                    [pixel[0] + 2.0, self.origin[1] + side - 12.0]
                } else {
                    [self.origin[0] + 2.0, pixel[1] + 2.0]
                };
                let fits = place[0] + (text.len() * LETTER) as f64 <= self.origin[0] + side;
                if fits && place[1] + 10.0 <= self.origin[1] + side {
                    canvas.text(place[0] as usize, place[1].max(0.0) as usize, &text, FAINT);
                }
            }
        }
        let unit = format!("grid {step} m");
        let x = self.origin[0] + side - (unit.len() * LETTER) as f64;
        canvas.text(x as usize, self.origin[1] as usize + 2, &unit, FAINT);
    }
}
