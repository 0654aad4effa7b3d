//! What the wearer does: a plan of walks, reaches, crouches, looks and gestures, written before anything moves.
//!
//! Gaze leads: eyes go to a thing before the hand or the feet do, as in everyday tasks.

mod activities;
mod aim;
mod moves;

pub use aim::{hand_axes, pelvis_over};

use super::hand::Fingers;
use super::scene::Scene;
use super::track::Key;
use super::wearer::{Side, Wearer};
use crate::random::StreamRng;
use nalgebra::{Point2, Point3, Vector3};
use rand::RngExt;

/// Where a wrist goes. Palm and fingers are directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reach {
    /// Beside the body, swinging with the steps.
    Rest,
    /// A point of the world.
    World {
        /// Where the wrist goes, metres.
        wrist: Point3<f64>,
        /// Where the palm faces.
        palm: Vector3<f64>,
        /// Where the fingers point.
        fingers: Vector3<f64>,
    },
    /// Before the chest: an offset and directions in the heading's axes (x forward, y left, z up).
    Chest {
        /// From the chest joint to the wrist, metres at a stature of 1.75 m.
        offset: Vector3<f64>,
        /// Where the palm faces.
        palm: Vector3<f64>,
        /// Where the fingers point.
        fingers: Vector3<f64>,
    },
}

/// What the eyes are on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Look {
    /// A point of the world, metres.
    Point(Point3<f64>),
    /// An object of the scene by its index, wherever it is.
    Object(usize),
    /// The wearer's own hand, and what may be in it.
    Hand(Side),
    /// Where one is going: radians left of and below the heading.
    Ahead(f64, f64),
}

/// A fixation begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fixation {
    /// Seconds, below 0 for the first one; it lasts until the next begins.
    pub start: f64,
    /// What the eyes are on from then.
    pub look: Look,
}

/// An object is in a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hold {
    /// The hand that has it.
    pub side: Side,
    /// Index of the object in the scene.
    pub object: usize,
    /// Seconds.
    pub start: f64,
    /// Seconds; infinite where the object is not put back.
    pub end: f64,
}

/// Everything that is going to happen.
#[derive(Debug, Clone)]
pub struct Plan {
    /// How long the plan is at least.
    pub seconds: f64,
    /// Where the wearer stands at first, metres on the floor.
    pub start: Point2<f64>,
    /// Where the wearer faces at first: radians from x, positive to the left.
    pub start_heading: f64,
    /// Straight walks; constant speed between the times, smoothed later.
    pub walks: Vec<Key<Point2<f64>>>,
    /// Turns of the body: radians from x, positive to the left, not wrapped.
    pub headings: Vec<Key<f64>>,
    /// Forward bends of the chest, radians.
    pub lean: Vec<Key<f64>>,
    /// How far the pelvis is lowered, metres at a stature of 1.75 m.
    pub crouch: Vec<Key<f64>>,
    /// Where the left and the right wrist go; each rests at first.
    pub reaches: [Vec<Key<Reach>>; 2],
    /// How the left and the right fingers are bent; they are relaxed at first.
    pub fingers: [Vec<Key<Fingers>>; 2],
    /// Where the eyes go, in the order of time.
    pub gaze: Vec<Fixation>,
    /// Start and end of blinks.
    pub blinks: Vec<(f64, f64)>,
    /// Which hand has which object, in the order they were planned.
    pub holds: Vec<Hold>,
}

impl super::track::Mix for Fingers {
    fn mix(&self, other: &Self, t: f64) -> Self {
        self.blend(other, t)
    }
}

/// Writes the plan of one episode of at least `seconds`.
///
/// A longer plan starts with the same seconds; `blinks` is a generator of its own for that reason.
pub fn write(
    scene: &Scene,
    wearer: &Wearer,
    rng: &mut StreamRng,
    blinks: &mut StreamRng,
    seconds: f64,
) -> Plan {
    let spot = rng.random_range(0..scene.spots.len());
    let at = &scene.spots[spot];
    let mut writer = Writer {
        scene,
        wearer,
        now: 0.0,
        at: at.stand,
        heading: at.heading,
        spot: Some(spot),
        carried: [None, None],
        plan: Plan {
            seconds,
            start: at.stand,
            start_heading: at.heading,
            walks: Vec::new(),
            headings: Vec::new(),
            lean: Vec::new(),
            crouch: Vec::new(),
            reaches: [Vec::new(), Vec::new()],
            fingers: [Vec::new(), Vec::new()],
            gaze: vec![Fixation {
                start: -1.0,
                look: Look::Ahead(0.0, 0.3),
            }],
            blinks: Vec::new(),
            holds: Vec::new(),
        },
    };
    while writer.now < seconds {
        writer.next_activity(rng);
    }
    let mut t = blinks.random_range(0.0..3.0);
    while t < seconds {
        let length = blinks.random_range(0.10..0.22);
        writer.plan.blinks.push((t, t + length));
        t += blinks.random_range(1.8..5.5);
    }
    writer.plan.gaze.sort_by(|a, b| a.start.total_cmp(&b.start));
    writer.plan
}

struct Writer<'a> {
    scene: &'a Scene,
    wearer: &'a Wearer,
    now: f64,
    at: Point2<f64>,
    heading: f64,
    spot: Option<usize>,
    carried: [Option<usize>; 2],
    plan: Plan,
}

#[cfg(test)]
mod tests {
    use super::super::room;
    use super::super::wearer::{LEFT, RIGHT};
    use super::*;

    #[test]
    fn plans_are_long_enough_ordered_and_varied() {
        let (mut holds, mut walks) = (0, 0);
        for sample in 0..60 {
            let mut rng = crate::random::stream(2, "test.script", 0, sample);
            let scene = room::build(&mut rng);
            let wearer = Wearer::random(&mut rng);
            let mut blinks = crate::random::stream(2, "test.blinks", 0, sample);
            let plan = write(&scene, &wearer, &mut rng, &mut blinks, 10.0);
            holds += plan.holds.len();
            walks += plan.walks.len();
            assert!(plan.gaze.len() > 8);
            assert!(plan.gaze.windows(2).all(|w| w[0].start <= w[1].start));
            for side in [LEFT, RIGHT] {
                for hold in plan.holds.iter().filter(|h| h.side == side) {
                    assert!(hold.end > hold.start);
                }
            }
            for walk in plan.walks {
                assert!(scene.is_free(&walk.value, &walk.value, 0.1));
            }
        }
        assert!(holds > 60 && walks > 60, "{holds} {walks}");
    }
}
