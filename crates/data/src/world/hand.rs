//! Hands of 21 joints that open, close, point and grasp.
//!
//! Hand axes: x along the fingers, y out of the palm, z towards the thumb. A left hand is the mirror image of a right hand.

use super::wearer::{RIGHT, Side};
use crate::geometry::skeleton::JOINTS;
use nalgebra::{Isometry3, Point3, Rotation3, Unit, Vector3};

/// How far each finger is bent; angles in radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fingers {
    /// Index, middle, ring, pinky: bend at the knuckle.
    pub knuckle: [f64; 4],
    /// Index, middle, ring, pinky: bend at the middle joint; the last joint follows.
    pub middle: [f64; 4],
    /// Fanning of the fingers.
    pub spread: f64,
    /// Thumb: 0 beside the palm, 1 opposite the fingers.
    pub opposition: f64,
    /// Thumb: bend of both outer joints.
    pub thumb: f64,
}

impl Fingers {
    /// Hanging beside the body: every finger slightly bent.
    pub const RELAXED: Self = Self {
        knuckle: [0.30, 0.35, 0.40, 0.45],
        middle: [0.40, 0.45, 0.50, 0.50],
        spread: 0.05,
        opposition: 0.35,
        thumb: 0.25,
    };
    /// Flat, with the fingers spread.
    pub const OPEN: Self = Self {
        knuckle: [0.02; 4],
        middle: [0.06; 4],
        spread: 0.16,
        opposition: 0.15,
        thumb: 0.0,
    };
    /// Closed, with the thumb before the fingers.
    pub const FIST: Self = Self {
        knuckle: [1.35; 4],
        middle: [1.60; 4],
        spread: 0.0,
        opposition: 0.75,
        thumb: 0.85,
    };
    /// The index finger straight, the others closed.
    pub const POINT: Self = Self {
        knuckle: [0.05, 1.25, 1.35, 1.35],
        middle: [0.05, 1.50, 1.55, 1.55],
        spread: 0.0,
        opposition: 0.7,
        thumb: 0.7,
    };

    /// Around something of that radius, metres.
    pub fn grasp(radius: f64) -> Self {
        let tight = (1.0 - (radius - 0.01) / 0.05).clamp(0.0, 1.0);
        Self {
            knuckle: [0.55, 0.60, 0.65, 0.70].map(|a| a + 0.45 * tight),
            middle: [0.55, 0.60, 0.60, 0.65].map(|a| a + 0.65 * tight),
            spread: 0.08 * (1.0 - tight),
            opposition: 0.85,
            thumb: 0.15 + 0.4 * tight,
        }
    }

    /// Opened a little wider than the grasp it prepares.
    #[must_use]
    pub fn before(grasp: &Self) -> Self {
        grasp.blend(&Self::OPEN, 0.6)
    }

    /// Between two poses; `t` 0 is `self`.
    #[must_use]
    pub fn blend(&self, other: &Self, t: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * t;
        Self {
            knuckle: std::array::from_fn(|i| mix(self.knuckle[i], other.knuckle[i])),
            middle: std::array::from_fn(|i| mix(self.middle[i], other.middle[i])),
            spread: mix(self.spread, other.spread),
            opposition: mix(self.opposition, other.opposition),
            thumb: mix(self.thumb, other.thumb),
        }
    }
}

/// One finger of a hand of scale 1: knuckle in hand axes, three bones, share of the fan.
struct Finger {
    knuckle: [f64; 3],
    bones: [f64; 3],
    fan: f64,
    /// First joint and tip in the release's order.
    first: usize,
    tip: usize,
}

/// Index, middle, ring, pinky.
const FINGERS: [Finger; 4] = [
    Finger {
        knuckle: [0.090, 0.000, 0.024],
        bones: [0.042, 0.026, 0.022],
        fan: 1.0,
        first: 1,
        tip: 17,
    },
    Finger {
        knuckle: [0.088, -0.002, 0.002],
        bones: [0.046, 0.030, 0.024],
        fan: 0.2,
        first: 4,
        tip: 18,
    },
    Finger {
        knuckle: [0.082, 0.000, -0.018],
        bones: [0.042, 0.028, 0.023],
        fan: -0.6,
        first: 10,
        tip: 19,
    },
    Finger {
        knuckle: [0.073, 0.003, -0.036],
        bones: [0.033, 0.020, 0.020],
        fan: -1.5,
        first: 7,
        tip: 20,
    },
];
const THUMB_BASE: [f64; 3] = [0.026, 0.010, 0.026];
const THUMB_BONES: [f64; 3] = [0.042, 0.032, 0.027];

/// Where something of `radius` sits in the hand that holds it, in hand axes of a right hand.
pub fn hold_point(scale: f64, radius: f64) -> Vector3<f64> {
    Vector3::new(0.085 * scale, 0.012 * scale + radius, 0.012 * scale)
}

/// The 21 joints of a hand in the world, in the order of [`crate::geometry::skeleton::HAND`].
///
/// `T_world_hand` has its origin at the wrist. For a left hand its y still points out of the palm and its z towards the thumb,
/// which makes it a left-handed use of the same axes: z is mirrored here.
pub fn joints(
    T_world_hand: &Isometry3<f64>,
    fingers: &Fingers,
    scale: f64,
    side: Side,
) -> [Point3<f64>; JOINTS] {
    let mut local = [Vector3::zeros(); JOINTS];
    for (i, finger) in FINGERS.iter().enumerate() {
        let fan = Rotation3::from_axis_angle(&Vector3::y_axis(), -fingers.spread * finger.fan);
        let mut at = Vector3::from(finger.knuckle) * scale;
        let mut bend = fingers.knuckle[i];
        local[finger.first] = at;
        for (k, bone) in finger.bones.iter().enumerate() {
            let direction = fan * Vector3::new(bend.cos(), bend.sin(), 0.0);
            at += direction * (bone * scale);
            local[if k == 2 {
                finger.tip
            } else {
                finger.first + k + 1
            }] = at;
            bend += fingers.middle[i] * if k == 0 { 1.0 } else { 0.65 };
        }
    }
    thumb(fingers, scale, &mut local);
    local.map(|p| {
        let z = if side == RIGHT { p.z } else { -p.z };
        T_world_hand * Point3::new(p.x, p.y, z)
    })
}

fn thumb(fingers: &Fingers, scale: f64, local: &mut [Vector3<f64>; JOINTS]) {
    let open = Vector3::new(0.62, 0.20, 0.76);
    let opposed = Vector3::new(0.58, 0.78, 0.22);
    let mut direction = open.lerp(&opposed, fingers.opposition).normalize();
    // Bends towards the fingers: about the axis across the thumb.
    let axis = Unit::new_normalize(direction.cross(&Vector3::new(0.55, 0.35, -0.75)));
    let bend = Rotation3::from_axis_angle(&axis, fingers.thumb);
    let mut at = Vector3::from(THUMB_BASE) * scale;
    local[13] = at;
    for (k, bone) in THUMB_BONES.iter().enumerate() {
        at += direction * (bone * scale);
        local[[14, 15, 16][k]] = at;
        direction = bend * direction;
    }
}

/// The rotation of a hand whose fingers point along `fingers` and whose palm faces `palm` as nearly as possible.
pub fn orientation(fingers: &Vector3<f64>, palm: &Vector3<f64>) -> Rotation3<f64> {
    let x = fingers.try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let y = palm - x * x.dot(palm);
    let y = y
        .try_normalize(1e-6)
        .unwrap_or_else(|| x.cross(&Vector3::new(0.3, 0.5, 0.8)).normalize());
    let z = x.cross(&y);
    // Right: fingers forward, palm to the left, thumb up. For the left hand `joints` mirrors z.
    Rotation3::from_matrix_unchecked(nalgebra::Matrix3::from_columns(&[x, y, z]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::skeleton::HAND;
    use crate::world::wearer::LEFT;

    fn lengths(joints: &[Point3<f64>; JOINTS]) -> Vec<f64> {
        HAND.bones()
            .map(|(a, b)| (joints[a] - joints[b]).norm())
            .collect()
    }

    #[test]
    fn bones_keep_their_length_in_every_grip() {
        let T = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(0.4, -1.0, 2.0));
        let rest = lengths(&joints(&T, &Fingers::OPEN, 1.05, RIGHT));
        for grip in [
            Fingers::RELAXED,
            Fingers::FIST,
            Fingers::POINT,
            Fingers::grasp(0.03),
        ] {
            for side in [LEFT, RIGHT] {
                let found = lengths(&joints(&T, &grip, 1.05, side));
                for (a, b) in rest.iter().zip(&found) {
                    assert!((a - b).abs() < 1e-9);
                }
            }
        }
    }

    #[test]
    fn a_fist_is_shorter_than_an_open_hand_and_the_thumb_is_on_its_side() {
        let T = Isometry3::identity();
        let open = joints(&T, &Fingers::OPEN, 1.0, RIGHT);
        let fist = joints(&T, &Fingers::FIST, 1.0, RIGHT);
        assert!(open[18].x > 0.17 && fist[18].x < 0.12);
        assert!(open[13].z > 0.0 && joints(&T, &Fingers::OPEN, 1.0, LEFT)[13].z < 0.0);
        assert!(fist[18].y > 0.0, "fingers bend towards the palm");
    }

    #[test]
    fn a_grasp_closes_around_its_object() {
        for radius in [0.02, 0.03, 0.04] {
            let hand = joints(&Isometry3::identity(), &Fingers::grasp(radius), 1.0, RIGHT);
            let centre = Point3::from(hold_point(1.0, radius));
            for tip in [16, 17, 18, 19] {
                let gap = (hand[tip] - centre).norm() - radius;
                assert!(gap.abs() < 0.045, "{radius} {tip} {gap}");
            }
        }
    }
}
