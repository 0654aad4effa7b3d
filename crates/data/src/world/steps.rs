//! Footsteps: which foot stands where, planned from the path so that a standing foot never slides.

use super::track::{Curve, GRID_RATE, minimum_jerk};
use super::wearer::{LEFT, RIGHT, Side, Wearer, sign};
use crate::geometry::rotation::wrap_angle;
use nalgebra::{Point2, Point3};

/// The path of the wearer over the floor.
#[derive(Debug, Clone)]
pub struct Path {
    /// Place along the room's x over time, metres.
    pub x: Curve,
    /// Place along the room's y over time, metres.
    pub y: Curve,
    /// Where the body faces over time: radians from x, positive to the left, not wrapped.
    pub heading: Curve,
}

impl Path {
    /// Where on the floor.
    pub fn at(&self, t: f64) -> Point2<f64> {
        Point2::new(self.x.at(t), self.y.at(t))
    }
}

/// One foot in the air.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Step {
    start: f64,
    end: f64,
    from: (Point2<f64>, f64),
    to: (Point2<f64>, f64),
}

/// All steps of both feet.
#[derive(Debug, Clone)]
pub struct Steps {
    initial: [(Point2<f64>, f64); 2],
    swings: [Vec<Step>; 2],
    toe_height: f64,
}

/// A foot at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Foot {
    /// The toe joint in the world, metres.
    pub toe: Point3<f64>,
    /// Where the foot points: radians from x, positive to the left.
    pub yaw: f64,
    /// How far through its swing, `None` when it stands.
    pub swing: Option<f64>,
}

/// Seconds a foot is in the air.
const SWING: f64 = 0.38;

impl Steps {
    /// Steps that follow `path` for `seconds`.
    pub fn plan(wearer: &Wearer, path: &Path, seconds: f64) -> Self {
        let place = |side: Side, t: f64| {
            let (p, heading) = (path.at(t), path.heading.at(t));
            let (s, c) = heading.sin_cos();
            let (forward, left) = (0.10 * wearer.stature / 1.75, wearer.stance * sign(side));
            let at = Point2::new(p.x + forward * c - left * s, p.y + forward * s + left * c);
            (at, heading - 0.12 * -sign(side))
        };
        let initial = [place(LEFT, 0.0), place(RIGHT, 0.0)];
        let mut planted = initial;
        let mut free_at = [0.0f64; 2];
        let mut steps: [Vec<Step>; 2] = [Vec::new(), Vec::new()];
        for i in 0..(seconds * GRID_RATE) as usize {
            let t = i as f64 / GRID_RATE;
            // One foot at a time; both stand for a moment between steps.
            if free_at.iter().any(|free| t < *free + 0.05) {
                continue;
            }
            let ahead = path.at(t + 0.45);
            let walking = (ahead - path.at(t)).norm() / 0.45 > 0.25;
            let error = |side: Side| {
                let (at, yaw) = place(side, t + 0.12);
                let (p, planted_yaw) = planted[side];
                (at - p).norm() + 0.35 * wrap_angle(yaw - planted_yaw).abs()
            };
            let side = if error(LEFT) > error(RIGHT) {
                LEFT
            } else {
                RIGHT
            };
            let limit = if walking { 0.16 } else { 0.10 };
            if error(side) < limit {
                continue;
            }
            let end = t + SWING;
            // The foot lands ahead of the body by half of what the body covers while it will stand.
            let to = place(side, end + if walking { 0.20 } else { 0.35 });
            steps[side].push(Step {
                start: t,
                end,
                from: planted[side],
                to,
            });
            planted[side] = to;
            free_at[side] = end;
        }
        Self {
            initial,
            swings: steps,
            toe_height: wearer.toe_height,
        }
    }

    /// Where a foot is.
    pub fn at(&self, side: Side, t: f64) -> Foot {
        let last = self.swings[side].partition_point(|s| s.start <= t);
        let flat = |(p, yaw): (Point2<f64>, f64)| Foot {
            toe: Point3::new(p.x, p.y, self.toe_height),
            yaw,
            swing: None,
        };
        let Some(step) = last.checked_sub(1).map(|i| &self.swings[side][i]) else {
            return flat(self.initial[side]);
        };
        if t >= step.end {
            return flat(step.to);
        }
        let u = (t - step.start) / (step.end - step.start);
        let s = minimum_jerk(u);
        let way = step.to.0 - step.from.0;
        let p = step.from.0 + way * s;
        let rise = (0.04 + 0.06 * way.norm().min(0.7)) * 16.0 * (u * (1.0 - u)).powi(2);
        Foot {
            toe: Point3::new(p.x, p.y, self.toe_height + rise),
            yaw: step.from.1 + wrap_angle(step.to.1 - step.from.1) * s,
            swing: Some(u),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn standing_feet_stand_still_and_walking_feet_keep_up() {
        let wearer = Wearer::random(&mut crate::random::stream(0, "test.steps", 0, 0));
        let walk = |t: f64| (t - 1.0).clamp(0.0, 3.0) * 1.1;
        let path = Path {
            x: Curve::sample(6.0, walk).smoothed(0.12),
            y: Curve::sample(6.0, |_| 0.0),
            heading: Curve::sample(6.0, |t| 0.2 * t),
        };
        let steps = Steps::plan(&wearer, &path, 6.0);
        for side in [LEFT, RIGHT] {
            let mut moves = 0;
            for i in 1..720 {
                let (a, b) = (
                    steps.at(side, f64::from(i - 1) / 120.0),
                    steps.at(side, f64::from(i) / 120.0),
                );
                if a.swing.is_none() && b.swing.is_none() {
                    assert_eq!(a.toe, b.toe);
                } else {
                    moves += 1;
                }
                assert!((b.toe - a.toe).norm() < 0.06, "no jumps");
                let offset = (b.toe.xy() - path.at(f64::from(i) / 120.0)).norm();
                assert!(offset < 0.75, "{offset} at {i}");
            }
            assert!(moves > 60);
        }
    }
}
