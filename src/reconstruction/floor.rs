//! Metric scale from the floor under the wearer's feet (Supp. D).
//!
//! The camera and the body are metric by their tokenizers; depth is relative. Along a ray that points down, body and camera say how
//! far the floor would be: `g`. Where the floor is seen, depth and `g` lie on one line, and everything else of the picture lies on one
//! side of it, for nothing is seen through a floor. So the fit is a line with one-sided outliers, and whether it says anything is
//! asked of the data: how many points carry it, how far they spread, whether windows of the video, the wearer's hands and the parallax
//! of the camera's path agree with it, and whether the picture shows anything at all. A model gives depth for black frames too.
//!
//! The literal text of the supplement (fit the points' heights to a constant) has the trivial optimum `scale = 0`; with the camera
//! fixed it has not.

pub use super::floor_view::View;
use super::parallax::other_scale;
use super::picture::shows_something;
use super::scale::{DepthFit, DepthSpace, ScaleRefusal};
use crate::clip::Intrinsics;
use crate::reconstruction::cloud::ray;
use nalgebra::Vector3;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Height of the floor from the feet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FloorRule {
    /// The mean of the lowest half of the foot joints (Supp. D).
    #[default]
    LowestHalf,
    /// The median of the foot joints less 0.2 m (the authors' release).
    ReleaseMedian,
}

/// Settings of the floor fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FloorFit {
    /// How the feet give the floor.
    pub rule: FloorRule,
    /// Share of the points, lowest first under the fit, that have to be floor.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub lowest: f64,
    /// Times the points of the floor are chosen again with the fitted depth.
    #[schemars(range(max = 20))]
    pub repeats: usize,
    /// Root mean square of the lowest points' heights over the floor beyond which there is no floor, metres.
    #[schemars(range(min = 0.0))]
    pub max_residual: f64,
    /// A lowest point this far from the fitted floor is an outlier, metres.
    #[schemars(range(min = 0.0))]
    pub outlier: f64,
    /// Share of outliers among the lowest points beyond which the fit is refused.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_outliers: f64,
    /// A point is on the floor when its depth is that of the floor up to this share.
    #[schemars(range(min = 0.001, max = 0.5))]
    pub tolerance: f64,
    /// Share of all points that have to be on the floor.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub support: f64,
    /// Spread (standard deviation of the logarithm) that the distances of the floor's points need: a floor at one distance says nothing
    /// of scale and shift.
    #[schemars(range(min = 0.0))]
    pub spread: f64,
    /// How many times their residual the floor's points have to spread.
    #[schemars(range(min = 0.0))]
    pub information: f64,
    /// The fit may make depth so many times larger or smaller than it came, and no more.
    #[schemars(range(min = 1.0))]
    pub max_scale: f64,
    /// The largest shift: metres, or 1/m where inverse depth is fitted.
    #[schemars(range(min = 0.0))]
    pub max_shift: f64,
    /// How far, as a share of depth, stretches of one second may be from the fit of the whole.
    #[schemars(range(min = 0.0))]
    pub agreement: f64,
}

impl Default for FloorFit {
    fn default() -> Self {
        Self {
            rule: FloorRule::LowestHalf,
            lowest: 0.05,
            repeats: 5,
            max_residual: 0.1,
            outlier: 0.3,
            max_outliers: 0.1,
            tolerance: 0.03,
            support: 0.1,
            spread: 0.12,
            information: 4.0,
            max_scale: 5.0,
            max_shift: 2.0,
            agreement: 0.08,
        }
    }
}

/// Height of the floor from foot joints of both feet and all samples, metres.
///
/// # Errors
/// With fewer than two finite heights.
pub fn floor_height(feet: &[f64], rule: FloorRule) -> Result<f64, ScaleRefusal> {
    let mut heights: Vec<f64> = feet.iter().copied().filter(|z| z.is_finite()).collect();
    if heights.len() < 2 {
        return Err(ScaleRefusal::NoFeet {
            found: heights.len(),
        });
    }
    heights.sort_by(f64::total_cmp);
    Ok(match rule {
        FloorRule::LowestHalf => {
            let half = &heights[..heights.len().div_ceil(2)];
            half.iter().sum::<f64>() / half.len() as f64
        }
        FloorRule::ReleaseMedian => {
            let (low, high) = (heights[(heights.len() - 1) / 2], heights[heights.len() / 2]);
            f64::midpoint(low, high) - 0.2
        }
    })
}

/// Fits depth to the floor at height `floor` with the camera held fixed, in the space where the depth is affine.
///
/// # Errors
/// A [`ScaleRefusal`] when no floor is seen, when what is seen of it does not say the scale, or when something else contradicts it.
pub fn fit_floor(
    views: &[View<'_>],
    intrinsics: &Intrinsics,
    floor: f64,
    space: DepthSpace,
    settings: &FloorFit,
) -> Result<DepthFit, ScaleRefusal> {
    shows_something(views)?;
    let cloud = Cloud::new(views, intrinsics, floor, space);
    if cloud.total < 100 {
        return Err(ScaleRefusal::TooFewPoints { found: cloud.total });
    }
    if (cloud.points.len() as f64) < settings.support * cloud.total as f64 {
        return Err(ScaleRefusal::NotBelow);
    }
    let line = cloud.line(&cloud.points, settings)?;
    let on_floor: Vec<&Point> = cloud
        .points
        .iter()
        .filter(|p| line.error(p).abs() <= settings.tolerance)
        .collect();
    let support = on_floor.len() as f64 / cloud.total as f64;
    if support < settings.support {
        return Err(ScaleRefusal::NoFloor { support });
    }
    let (residual, outliers) = cloud.lowest(&line, settings);
    if residual > settings.max_residual || outliers > settings.max_outliers {
        return Err(ScaleRefusal::Outliers { share: outliers });
    }
    informed(&on_floor, &line, settings)?;
    let fit = DepthFit {
        space,
        scale: line.scale,
        shift: line.shift,
        residual,
        points: on_floor.len(),
        outliers,
    };
    bounded(&fit, &cloud, settings)?;
    cloud.windows_agree(&line, settings)?;
    hands_agree(views, intrinsics, &fit)?;
    if let Some(factor) = other_scale(views, intrinsics, &fit) {
        return Err(ScaleRefusal::Parallax { factor });
    }
    Ok(fit)
}

/// A ray that points down.
#[derive(Debug, Clone, Copy)]
struct Point {
    /// Depth as it came, or its inverse.
    x: f64,
    /// Distance of the floor along the ray, metres, or its inverse.
    y: f64,
    /// Height of the camera over the floor, metres.
    height: f64,
    second: usize,
}

#[derive(Debug, Clone, Copy)]
struct Line {
    space: DepthSpace,
    scale: f64,
    shift: f64,
}

impl Line {
    /// Share by which a point is farther than the floor on its ray; negative in front of the floor.
    fn error(&self, point: &Point) -> f64 {
        let value = self.scale * point.x + self.shift;
        match self.space {
            DepthSpace::Depth => value / point.y - 1.0,
            DepthSpace::Disparity if value > 0.0 => point.y / value - 1.0,
            DepthSpace::Disparity => f64::INFINITY,
        }
    }
}

struct Cloud {
    /// Rays that point down.
    points: Vec<Point>,
    /// Points with a depth, wherever they are.
    total: usize,
    /// Depth as it came, of points all over the cloud.
    depths: Vec<f64>,
    space: DepthSpace,
}

/// Rays nearer to the horizontal say nothing of the floor.
const LEAST_FALL: f64 = 0.05;
/// A floor farther away is not measured, metres.
const FARTHEST: f64 = 8.0;
/// Points that a line is searched on.
const SEARCHED: usize = 6000;
/// Lines that are tried.
const TRIALS: u64 = 300;
/// Errors below it are those of the grid, not of the floor.
const SHARPEST: f64 = 0.005;

impl Cloud {
    fn new(views: &[View<'_>], intrinsics: &Intrinsics, floor: f64, space: DepthSpace) -> Self {
        let (mut points, mut depths, mut total) = (Vec::new(), Vec::new(), 0);
        for view in views {
            let grid = [view.depth.nrows(), view.depth.ncols()];
            let height = view.T_world_camera.translation.z - floor;
            for ((row, column), &depth) in view.depth.indexed_iter() {
                let depth = f64::from(depth);
                if !(depth.is_finite() && depth > 0.0) {
                    continue;
                }
                if total % 7 == 0 {
                    depths.push(depth);
                }
                total += 1;
                let [x, y] = ray(intrinsics, grid, row, column);
                let rise = (view.T_world_camera.rotation * Vector3::new(x, y, 1.0)).z;
                let distance = height / -rise;
                if rise < -LEAST_FALL && distance > 0.0 && distance < FARTHEST {
                    points.push(Point {
                        x: space.of(depth),
                        y: space.of(distance),
                        height,
                        second: view.second as usize,
                    });
                }
            }
        }
        depths.sort_by(f64::total_cmp);
        Self {
            points,
            total,
            depths,
            space,
        }
    }

    /// The line that most points lie on and few lie beyond.
    fn line(&self, points: &[Point], settings: &FloorFit) -> Result<Line, ScaleRefusal> {
        let degenerate = ScaleRefusal::Degenerate {
            spread: 0.0,
            residual: f64::NAN,
        };
        let step = points.len().div_ceil(SEARCHED).max(1);
        let some: Vec<Point> = points.iter().step_by(step).copied().collect();
        if some.len() < 2 {
            return Err(degenerate);
        }
        let mut random = crate::random::stream(0, "floor.lines", 0, 0);
        let mut best: Option<(f64, Line)> = None;
        for _ in 0..TRIALS {
            let [a, b] = [0, 1].map(|_| some[random.random_range(0..some.len())]);
            let apart = (a.y / b.y).ln().abs();
            let scale = (b.y - a.y) / (b.x - a.x);
            if apart < 0.1 || !scale.is_finite() || scale <= 0.0 {
                continue;
            }
            let line = Line {
                space: self.space,
                scale,
                shift: a.y - scale * a.x,
            };
            let score = score(&some, &line, settings.tolerance);
            if best.is_none_or(|(most, _)| score > most) {
                best = Some((score, line));
            }
        }
        let Some((_, mut line)) = best else {
            return Err(degenerate);
        };
        let mut tolerance = settings.tolerance;
        for _ in 0..=settings.repeats {
            line = self
                .least_squares(points, &line, tolerance)
                .ok_or(degenerate.clone())?;
            // What stands on the floor is near it too, so that it is held apart as far as the floor's own noise allows.
            tolerance = noise(&some, &line, tolerance).clamp(SHARPEST, settings.tolerance);
        }
        Ok(line)
    }

    /// Least squares of the relative error over the points near a line.
    fn least_squares(&self, points: &[Point], line: &Line, tolerance: f64) -> Option<Line> {
        let near = points.iter().filter(|p| line.error(p).abs() <= tolerance);
        let (mut xx, mut x1, mut one, mut xy, mut y1) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for point in near {
            let (x, unit) = (point.x / point.y, 1.0 / point.y);
            (xx, x1, one) = (xx + x * x, x1 + x * unit, one + unit * unit);
            (xy, y1) = (xy + x, y1 + unit);
        }
        let determinant = xx * one - x1 * x1;
        if determinant <= 1e-9 * xx * one {
            return None;
        }
        let scale = (xy * one - y1 * x1) / determinant;
        (scale > 0.0 && scale.is_finite()).then_some(Line {
            space: self.space,
            scale,
            shift: (y1 * xx - xy * x1) / determinant,
        })
    }

    /// Root mean square height over the floor of the lowest points, metres, and the share of them that is not on the floor.
    fn lowest(&self, line: &Line, settings: &FloorFit) -> (f64, f64) {
        // The height over the floor is the camera's height times the share by which a point is in front of it.
        let mut heights: Vec<f64> = self
            .points
            .iter()
            .map(|p| (-line.error(p) * p.height).max(-10.0))
            .collect();
        heights.sort_by(f64::total_cmp);
        let take = (self.total as f64 * settings.lowest).ceil() as usize;
        heights.truncate(take.clamp(1, heights.len().max(1)));
        let n = heights.len() as f64;
        let square: f64 = heights.iter().map(|h| h * h).sum();
        let outliers = heights.iter().filter(|h| h.abs() > settings.outlier);
        ((square / n).sqrt(), outliers.count() as f64 / n)
    }

    /// Seconds of the video that show a plane of their own give the same depth as the whole, most of them.
    fn windows_agree(&self, line: &Line, settings: &FloorFit) -> Result<(), ScaleRefusal> {
        let seconds = self.points.iter().map(|p| p.second).max().unwrap_or(0) + 1;
        let enough = settings.support * self.total as f64 / seconds as f64;
        let (mut asked, mut agreed, mut worst) = (0, 0, 0.0_f64);
        for second in 0..seconds {
            let own: Vec<Point> = self
                .points
                .iter()
                .filter(|p| p.second == second)
                .copied()
                .collect();
            let Ok(alone) = self.line(&own, settings) else {
                continue;
            };
            let near = own
                .iter()
                .filter(|p| alone.error(p).abs() <= settings.tolerance);
            let near: Vec<Point> = near.copied().collect();
            if (near.len() as f64) < enough || spread(&near) < settings.spread {
                continue;
            }
            asked += 1;
            // Compared where the cloud is, not at the floor, where both lines are right by construction.
            let apart = [0.25, 0.5, 0.75].map(|q| {
                let depth = self.depths[(self.depths.len() as f64 * q) as usize];
                (metric(&alone, depth) / metric(line, depth) - 1.0).abs()
            });
            let apart = apart.into_iter().fold(0.0, f64::max);
            worst = worst.max(apart);
            agreed += usize::from(apart <= settings.agreement);
        }
        if asked == 0 || agreed * 2 <= asked && agreed < asked {
            return Err(ScaleRefusal::Windows { apart: worst });
        }
        Ok(())
    }
}

/// Three times the median error of the points that are near a line.
fn noise(points: &[Point], line: &Line, tolerance: f64) -> f64 {
    let errors = points.iter().map(|p| line.error(p).abs());
    let mut near: Vec<f64> = errors.filter(|e| *e <= tolerance).collect();
    near.sort_by(f64::total_cmp);
    near.get(near.len() / 2).map_or(tolerance, |e| 3.0 * e)
}

fn score(points: &[Point], line: &Line, tolerance: f64) -> f64 {
    let of = |point: &Point| {
        let error = line.error(point);
        if error.abs() <= tolerance {
            1.0
        } else if error > tolerance {
            -1.5
        } else {
            0.0
        }
    };
    points.iter().map(of).sum()
}

fn metric(line: &Line, depth: f64) -> f64 {
    let value = line.scale * line.space.of(depth) + line.shift;
    line.space.of(value.max(1e-3))
}

/// Standard deviation of the logarithm of the floor's distances.
fn spread(points: &[Point]) -> f64 {
    let n = points.len().max(1) as f64;
    let logs = || points.iter().map(|p| p.y.ln());
    let mean = logs().sum::<f64>() / n;
    (logs().map(|l| (l - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Whether the floor's points say the scale.
fn informed(on_floor: &[&Point], line: &Line, settings: &FloorFit) -> Result<(), ScaleRefusal> {
    let points: Vec<Point> = on_floor.iter().map(|p| **p).collect();
    let spread = spread(&points);
    let square: f64 = points.iter().map(|p| line.error(p).powi(2)).sum();
    let residual = (square / points.len().max(1) as f64).sqrt();
    if spread < settings.spread || spread < settings.information * residual {
        return Err(ScaleRefusal::Degenerate { spread, residual });
    }
    Ok(())
}

/// Whether scale and shift are possible.
fn bounded(fit: &DepthFit, cloud: &Cloud, settings: &FloorFit) -> Result<(), ScaleRefusal> {
    let median = cloud.depths[cloud.depths.len() / 2];
    let factor = f64::from(fit.apply(median as f32)) / median;
    let possible = 1.0 / settings.max_scale..=settings.max_scale;
    if !possible.contains(&factor) || fit.shift.abs() > settings.max_shift {
        return Err(ScaleRefusal::Bounds {
            factor,
            shift: fit.shift,
        });
    }
    Ok(())
}

/// Whether the depth at the wearer's hands is that of the hands, where they are in view.
fn hands_agree(
    views: &[View<'_>],
    intrinsics: &Intrinsics,
    fit: &DepthFit,
) -> Result<(), ScaleRefusal> {
    let mut ratios = Vec::new();
    for view in views {
        let (rows, columns) = view.depth.dim();
        for [x, y, z] in view.hands.iter().map(|joint| joint.map(f64::from)) {
            if !(z > 0.1 && z < 1.2) {
                continue;
            }
            let cell = |at: f64, pixels: u32, cells: usize| {
                ((at + 0.5) / f64::from(pixels) * cells as f64).floor() as isize
            };
            let column = cell(
                intrinsics.fx * x / z + intrinsics.cx,
                intrinsics.width,
                columns,
            );
            let row = cell(
                intrinsics.fy * y / z + intrinsics.cy,
                intrinsics.height,
                rows,
            );
            let (Ok(row), Ok(column)) = (usize::try_from(row), usize::try_from(column)) else {
                continue;
            };
            let depth = view.depth.get([row, column]).copied();
            if let Some(depth) = depth.filter(|d| d.is_finite()) {
                ratios.push(f64::from(fit.apply(depth)) / z);
            }
        }
    }
    // A few joints at the edge of the picture are no evidence.
    if ratios.len() < 40 {
        return Ok(());
    }
    ratios.sort_by(f64::total_cmp);
    let factor = ratios[ratios.len() / 2];
    if (1.0 / 1.5..=1.5).contains(&factor) {
        Ok(())
    } else {
        Err(ScaleRefusal::Hands { factor })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::rigid::{Rigid, level_camera};
    use nalgebra::{Isometry3, UnitQuaternion};
    use ndarray::{Array2, Array3};

    const LENS: Intrinsics = Intrinsics {
        fx: 20.0,
        fy: 20.0,
        cx: 19.5,
        cy: 19.5,
        width: 40,
        height: 40,
    };
    const FLOOR: f64 = -1.5;

    /// What is seen in two seconds at 8 Hz by somebody who walks a metre and looks 30 degrees down.
    struct Scene {
        depth: Vec<Array2<f32>>,
        poses: Vec<Rigid>,
        pictures: Vec<Array3<u8>>,
        hands: Vec<[f32; 3]>,
    }

    /// A room with a wall four metres ahead, and a plane at height `plane` over the world's origin.
    fn room(plane: f64, coded: impl Fn(usize, f64) -> f64) -> Scene {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -30_f64.to_radians());
        let mut scene = Scene {
            depth: Vec::new(),
            poses: Vec::new(),
            pictures: Vec::new(),
            hands: Vec::new(),
        };
        for t in 0..16 {
            let walked = t as f64 / 16.0;
            let pose: Rigid = Isometry3::from_parts(
                Vector3::new(0.05 * walked, walked, 0.02 * (9.0 * walked).sin()).into(),
                level_camera().rotation * down,
            );
            let depth = Array2::from_shape_fn((40, 40), |(row, column)| {
                let [x, y] = ray(&LENS, [40, 40], row, column);
                let turned = pose.rotation * Vector3::new(x, y, 1.0);
                let below = if turned.z < 0.0 {
                    (plane - pose.translation.z) / turned.z
                } else {
                    f64::INFINITY
                };
                let wall = (4.0 - walked) / turned.y.max(1e-3);
                coded(t, below.min(wall)) as f32
            });
            scene.depth.push(depth);
            scene.poses.push(pose);
            let picture = Array3::from_shape_fn((40, 40, 3), |(y, x, _)| (y * 5 + x + t) as u8);
            scene.pictures.push(picture);
        }
        scene
    }

    impl Scene {
        fn fit(&self, space: DepthSpace, settings: &FloorFit) -> Result<DepthFit, ScaleRefusal> {
            let views: Vec<View<'_>> = (0..self.depth.len())
                .map(|t| View {
                    depth: self.depth[t].view(),
                    T_world_camera: self.poses[t],
                    hands: self.hands.clone(),
                    picture: Some(self.pictures[t].view()),
                    second: t as f64 / 8.0,
                })
                .collect();
            fit_floor(&views, &LENS, FLOOR, space, settings)
        }

        fn usual(&self) -> Result<DepthFit, ScaleRefusal> {
            self.fit(DepthSpace::Depth, &FloorFit::default())
        }
    }

    #[test]
    fn the_floor_gives_scale_and_shift_back() {
        for (scale, shift) in [(1.0, 0.0), (2.5, 0.0), (0.7, 0.4), (1.6, -0.3)] {
            let fit = room(FLOOR, |_, metres| (metres - shift) / scale).usual();
            let fit = fit.unwrap();
            assert!((fit.scale - scale).abs() < 1e-3, "{fit:?}");
            assert!((fit.shift - shift).abs() < 2e-3, "{fit:?}");
        }
        for (scale, shift) in [(1.0, 0.0), (0.6, 0.1), (1.4, -0.1)] {
            let coded = |_, metres: f64| scale / (1.0 / metres - shift);
            let fit = room(FLOOR, coded).fit(DepthSpace::Disparity, &FloorFit::default());
            let fit = fit.unwrap();
            assert!((fit.scale - scale).abs() < 1e-3, "{fit:?}");
            assert!((fit.apply(coded(0, 2.0) as f32) - 2.0).abs() < 5e-3);
        }
    }

    #[test]
    fn half_a_floor_of_things_that_stand_on_it_changes_nothing() {
        let mut scene = room(FLOOR, |_, metres| metres);
        for (frame, pose) in scene.depth.iter_mut().zip(&scene.poses) {
            for ((row, column), depth) in frame.indexed_iter_mut() {
                let [x, y] = ray(&LENS, [40, 40], row, column);
                let turned = pose.rotation * Vector3::new(x, y, 1.0);
                let top = (FLOOR + 0.25 - pose.translation.z) / turned.z;
                let at = pose.translation.vector + turned * top;
                let cell = (at.x / 0.4).floor() + (at.y / 0.4).floor();
                if turned.z < 0.0 && cell.rem_euclid(2.0) < 0.5 {
                    *depth = depth.min(top as f32);
                }
                *depth /= 1.3;
            }
        }
        let fit = scene.usual().unwrap();
        assert!((fit.apply(1.0 / 1.3) - 1.0).abs() < 0.02, "{fit:?}");
    }

    #[test]
    fn too_little_floor_in_the_cloud_is_no_floor() {
        let needs_more = FloorFit {
            support: 0.95,
            ..FloorFit::default()
        };
        let mostly = room(FLOOR, |_, metres| metres).fit(DepthSpace::Depth, &needs_more);
        assert!(
            matches!(
                mostly,
                Err(ScaleRefusal::NoFloor { .. } | ScaleRefusal::NotBelow)
            ),
            "{mostly:?}"
        );
        // A ceiling is looked at.
        let mut up = room(FLOOR, |_, metres| metres.min(4.0));
        for pose in &mut up.poses {
            pose.rotation = level_camera().rotation
                * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 60_f64.to_radians());
        }
        assert_eq!(up.usual(), Err(ScaleRefusal::NotBelow));
        assert!(matches!(
            fit_floor(&[], &LENS, FLOOR, DepthSpace::Depth, &FloorFit::default()),
            Err(ScaleRefusal::TooFewPoints { found: 0 })
        ));
        // Things of any height, of which no two are on one plane.
        let mut random = crate::random::stream(0, "floor.clutter", 0, 0);
        let mut clutter = room(FLOOR, |_, metres| metres);
        for frame in &mut clutter.depth {
            frame.mapv_inplace(|depth| depth * random.random_range(0.02_f32..1.0));
        }
        let strict = FloorFit {
            tolerance: 0.02,
            support: 0.1,
            ..FloorFit::default()
        };
        let clutter = clutter.fit(DepthSpace::Depth, &strict);
        assert!(
            matches!(clutter, Err(ScaleRefusal::NoFloor { .. })),
            "{clutter:?}"
        );
    }

    #[test]
    fn points_beyond_the_floor_are_outliers() {
        let mut scene = room(FLOOR, |_, metres| metres);
        for frame in &mut scene.depth {
            for ((row, _), depth) in frame.indexed_iter_mut() {
                if row % 5 == 0 {
                    *depth *= 1.6;
                }
            }
        }
        let found = scene.usual();
        assert!(
            matches!(found, Err(ScaleRefusal::Outliers { .. })),
            "{found:?}"
        );
    }

    #[test]
    fn a_floor_at_one_distance_or_depth_of_noise_says_no_scale() {
        let band = room(FLOOR, |_, metres| {
            if (1.9..2.1).contains(&metres) {
                metres
            } else {
                f64::NAN
            }
        });
        let found = band.usual();
        assert!(
            matches!(found, Err(ScaleRefusal::Degenerate { .. })),
            "{found:?}"
        );
        let flat = room(FLOOR, |_, _| 2.0).usual();
        assert!(
            matches!(flat, Err(ScaleRefusal::Degenerate { .. })),
            "{flat:?}"
        );
    }

    #[test]
    fn a_scale_that_no_depth_has_is_out_of_bounds() {
        for coded in [0.1, 8.0] {
            let found = room(FLOOR, |_, metres| metres * coded).usual();
            assert!(
                matches!(found, Err(ScaleRefusal::Bounds { .. })),
                "{found:?}"
            );
        }
        let shifted = room(FLOOR, |_, metres| metres + 2.5).usual();
        assert!(
            matches!(shifted, Err(ScaleRefusal::Bounds { .. })),
            "{shifted:?}"
        );
    }

    #[test]
    fn seconds_that_disagree_are_found() {
        let scene = room(FLOOR, |t, metres| if t < 8 { metres } else { metres * 0.7 });
        let found = scene.usual();
        assert!(
            matches!(found, Err(ScaleRefusal::Windows { .. })),
            "{found:?}"
        );
    }

    #[test]
    fn hands_that_are_nearer_than_their_depth_contradict_the_fit() {
        let mut scene = room(FLOOR, |_, metres| metres);
        // Where the fit has the floor at 1.7 m, the wearer's hand is at 0.5 m.
        scene.hands = vec![[0.0, 0.45, 0.5]; 21];
        let found = scene.usual();
        assert!(
            matches!(found, Err(ScaleRefusal::Hands { .. })),
            "{found:?}"
        );
        scene.hands = vec![[0.0, 0.5, 0.2]; 21];
        assert!(scene.usual().is_ok(), "out of the picture they say nothing");
    }

    #[test]
    fn a_desk_is_not_taken_for_the_floor_when_the_camera_moves() {
        // The desk is as good a plane as any: scale 2 and no shift. The path of the camera says that it is nearer.
        let found = room(-0.75, |_, metres| metres).usual();
        let Err(ScaleRefusal::Parallax { factor }) = found else {
            panic!("{found:?}");
        };
        assert!((0.4..0.74).contains(&factor), "{factor}");
    }

    #[test]
    fn black_frames_and_noise_have_no_metric_depth_whatever_a_model_makes_of_them() {
        let mut scene = room(FLOOR, |_, metres| metres);
        let mut random = crate::random::stream(0, "floor.noise", 0, 0);
        for picture in &mut scene.pictures {
            picture.mapv_inplace(|_| random.random());
        }
        assert_eq!(scene.usual(), Err(ScaleRefusal::Noise));
        scene
            .pictures
            .iter_mut()
            .for_each(|picture| picture.fill(3));
        assert_eq!(scene.usual(), Err(ScaleRefusal::Blank));
    }

    #[test]
    fn feet_give_the_floor_by_either_rule() {
        let feet = [-1.4, -1.5, -1.5, -1.0, f64::NAN];
        assert!((floor_height(&feet, FloorRule::LowestHalf).unwrap() + 1.5).abs() < 1e-12);
        assert!((floor_height(&feet, FloorRule::ReleaseMedian).unwrap() + 1.65).abs() < 1e-12);
        assert_eq!(
            floor_height(&[f64::NAN, 1.0], FloorRule::LowestHalf),
            Err(ScaleRefusal::NoFeet { found: 1 })
        );
    }
}
