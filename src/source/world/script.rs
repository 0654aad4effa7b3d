//! What the wearer does: a plan of walks, reaches, crouches, looks and gestures, written before anything moves.
//!
//! Gaze leads: eyes go to a thing before the hand or the feet do, as in everyday tasks.

use super::hand::{self, Fingers};
use super::room;
use super::scene::{Object, Scene, Spot};
use super::track::Key;
use super::wearer::{self, LEFT, RIGHT, Side, TrunkPose, Wearer, sign, yaw_pitch};
use crate::geometry::rotation::wrap_angle;
use crate::random::StreamRng;
use nalgebra::{Point2, Point3, UnitQuaternion, Vector3};
use rand::RngExt;

/// Where a wrist goes. Palm and fingers are directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reach {
    /// Beside the body, swinging with the steps.
    Rest,
    /// A point of the world.
    World {
        wrist: Point3<f64>,
        palm: Vector3<f64>,
        fingers: Vector3<f64>,
    },
    /// Before the chest: an offset and directions in the heading's axes (x forward, y left, z up).
    Chest {
        offset: Vector3<f64>,
        palm: Vector3<f64>,
        fingers: Vector3<f64>,
    },
}

/// What the eyes are on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Look {
    Point(Point3<f64>),
    Object(usize),
    Hand(Side),
    /// Where one is going: radians left of and below the heading.
    Ahead(f64, f64),
}

/// A fixation begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fixation {
    pub start: f64,
    pub look: Look,
}

/// An object is in a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hold {
    pub side: Side,
    pub object: usize,
    pub start: f64,
    pub end: f64,
}

/// Everything that is going to happen.
#[derive(Debug, Clone)]
pub struct Plan {
    pub seconds: f64,
    pub start: Point2<f64>,
    pub start_heading: f64,
    /// Straight walks; constant speed between the times, smoothed later.
    pub walks: Vec<Key<Point2<f64>>>,
    pub headings: Vec<Key<f64>>,
    pub lean: Vec<Key<f64>>,
    pub crouch: Vec<Key<f64>>,
    pub reaches: [Vec<Key<Reach>>; 2],
    pub fingers: [Vec<Key<Fingers>>; 2],
    pub gaze: Vec<Fixation>,
    /// Start and end of blinks.
    pub blinks: Vec<(f64, f64)>,
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

impl Writer<'_> {
    fn next_activity(&mut self, rng: &mut StreamRng) {
        let free_hand = self.carried.iter().any(Option::is_none);
        let before = self.plan.gaze.len();
        let in_reach = self
            .spot
            .is_some_and(|s| !self.scene.spots[s].objects.is_empty());
        match rng.random_range(0..100) {
            0..=47 if in_reach && free_hand => self.manipulate(rng),
            48..=52 => self.look_around(rng),
            53..=61 if self.carried == [None, None] => self.gesture(rng),
            62..=66 => self.crouch_down(rng),
            _ => self.walk(rng),
        }
        self.glances(rng, before);
        self.now += rng.random_range(0.0..0.35);
    }

    /// Eyes never rest for long: short looks aside and back wherever the activity since fixation `from` left them on one thing.
    fn glances(&mut self, rng: &mut StreamRng, from: usize) {
        let (earlier, new) = self.plan.gaze.split_at(from);
        let latest = earlier.iter().max_by(|a, b| a.start.total_cmp(&b.start));
        // The latest fixation goes on into this activity.
        let mut since: Vec<Fixation> = latest.into_iter().chain(new).copied().collect();
        since.sort_by(|a, b| a.start.total_cmp(&b.start));
        for (i, fixation) in since.iter().enumerate() {
            let end = since.get(i + 1).map_or(self.now, |next| next.start);
            let mut t = fixation.start.max(0.0) + rng.random_range(0.45..0.8);
            while t < end - 0.5 {
                let aside = Look::Ahead(rng.random_range(-0.3..0.3), rng.random_range(0.1..0.6));
                let back = t + rng.random_range(0.2..0.35);
                self.look(t, aside);
                self.look(back, fixation.look);
                t = back + rng.random_range(0.5..1.1);
            }
        }
    }

    fn look(&mut self, start: f64, look: Look) {
        self.plan.gaze.push(Fixation { start, look });
    }

    fn reach(&mut self, side: Side, start: f64, end: f64, value: Reach) {
        self.plan.reaches[side].push(Key { start, end, value });
    }

    fn grip(&mut self, side: Side, start: f64, end: f64, value: Fingers) {
        self.plan.fingers[side].push(Key { start, end, value });
    }

    fn turn(&mut self, start: f64, end: f64, to: f64) {
        self.heading += wrap_angle(to - self.heading);
        let value = self.heading;
        self.plan.headings.push(Key { start, end, value });
    }

    /// To another spot or somewhere in the room, round the furniture where need be.
    fn walk(&mut self, rng: &mut StreamRng) {
        let scene = self.scene;
        let mut target = None;
        for _ in 0..30 {
            let (stand, spot) = if rng.random_bool(0.75) {
                let s = rng.random_range(0..scene.spots.len());
                (scene.spots[s].stand, Some(s))
            } else {
                (room::free_point(scene, rng), None)
            };
            if (stand - self.at).norm() < 0.7 {
                continue;
            }
            if scene.is_free(&self.at, &stand, 0.12) {
                target = Some((vec![stand], spot));
                break;
            }
            let via = room::free_point(scene, rng);
            let long_enough = (via - self.at).norm() > 0.5 && (stand - via).norm() > 0.5;
            if long_enough
                && scene.is_free(&self.at, &via, 0.12)
                && scene.is_free(&via, &stand, 0.12)
            {
                target = Some((vec![via, stand], spot));
                break;
            }
        }
        let Some((legs, spot)) = target else {
            self.look_around(rng);
            return;
        };
        let speed = rng.random_range(0.65..1.15);
        let goal = *legs.last().expect("a walk has at least one leg");
        for (i, leg) in legs.iter().enumerate() {
            self.walk_straight(rng, *leg, speed, i == 0);
        }
        self.spot = spot;
        if let Some(Spot {
            heading, objects, ..
        }) = spot.map(|s| &scene.spots[s])
        {
            let turn = wrap_angle(heading - self.heading).abs();
            let end = self.now + (0.25 + turn * 0.28).max(0.3);
            if let Some(object) = objects.first() {
                self.look(self.now - rng.random_range(0.5..0.9), Look::Object(*object));
            }
            self.turn(self.now - 0.3, end, *heading);
            self.now = end;
        }
        self.at = goal;
    }

    fn walk_straight(&mut self, rng: &mut StreamRng, to: Point2<f64>, speed: f64, first: bool) {
        let way = to - self.at;
        let course = way.y.atan2(way.x);
        let turn = wrap_angle(course - self.heading).abs();
        // The eyes go where the feet will: somewhere along the way, then ahead.
        let ahead = self.at + way * rng.random_range(0.6..1.0);
        let height = rng.random_range(0.2..1.3);
        self.look(
            self.now - 0.15,
            Look::Point(Point3::new(ahead.x, ahead.y, height)),
        );
        let turn_time = 0.25 + turn * 0.36;
        let start = self.now
            + if first {
                (turn_time - 0.35).max(0.0)
            } else {
                0.0
            };
        self.turn(self.now, self.now + turn_time, course);
        let end = start + way.norm() / speed;
        self.plan.walks.push(Key {
            start,
            end,
            value: to,
        });
        let mut t = self.now + turn_time + rng.random_range(0.2..0.5);
        while t < end - 0.7 {
            let look = if rng.random_bool(0.4) {
                self.something(rng)
            } else {
                Look::Ahead(rng.random_range(-0.25..0.25), rng.random_range(0.05..0.5))
            };
            self.look(t, look);
            t += rng.random_range(0.35..0.9);
        }
        self.at = to;
        self.now = end;
    }

    /// Something worth a look that is not behind one's back.
    fn something(&self, rng: &mut StreamRng) -> Look {
        for _ in 0..12 {
            let scene = self.scene;
            let look = if rng.random_bool(0.5) && !scene.objects.is_empty() {
                Look::Object(rng.random_range(0..scene.objects.len()))
            } else {
                Look::Point(scene.landmarks[rng.random_range(0..scene.landmarks.len())])
            };
            let point = match look {
                Look::Object(i) => Point3::from(scene.objects[i].rest.translation.vector),
                Look::Point(p) => p,
                _ => continue,
            };
            let bearing = (point.y - self.at.y).atan2(point.x - self.at.x);
            if wrap_angle(bearing - self.heading).abs() < 1.1 {
                return look;
            }
        }
        Look::Ahead(rng.random_range(-0.4..0.4), rng.random_range(-0.1..0.5))
    }

    fn look_around(&mut self, rng: &mut StreamRng) {
        let end = self.now + rng.random_range(1.2..2.6);
        if rng.random_bool(0.6) {
            let to = self.heading + rng.random_range(-1.6..1.6);
            let start = self.now + rng.random_range(0.2..0.5);
            self.turn(start, start + 0.9, to);
            self.spot = None;
        }
        let mut t = self.now;
        while t < end {
            let look = self.something(rng);
            self.look(t, look);
            t += rng.random_range(0.25..0.8);
        }
        self.now = end;
    }

    fn crouch_down(&mut self, rng: &mut StreamRng) {
        let depth = rng.random_range(0.2..0.42);
        let lean = rng.random_range(0.2..0.5);
        let down = self.now + rng.random_range(0.7..1.0);
        let up = down + rng.random_range(0.3..1.0);
        let end = up + rng.random_range(0.7..1.0);
        let keys = [(self.now, down, depth, lean), (up, end, 0.0, 0.05)];
        for (start, end, crouch, lean) in keys {
            self.plan.crouch.push(Key {
                start,
                end,
                value: crouch,
            });
            self.plan.lean.push(Key {
                start,
                end,
                value: lean,
            });
        }
        self.look(
            self.now - 0.1,
            Look::Ahead(rng.random_range(-0.3..0.3), rng.random_range(0.5..0.9)),
        );
        let something = self.something(rng);
        self.look(down + 0.1, something);
        self.look(up + 0.3, Look::Ahead(0.0, 0.15));
        self.now = end;
    }

    /// Looks at the own hands: they open, close, point.
    fn gesture(&mut self, rng: &mut StreamRng) {
        let end = self.now + rng.random_range(1.8..3.0);
        let both = rng.random_bool(0.6);
        let only = rng.random_range(0..2usize);
        for side in [LEFT, RIGHT] {
            if !both && side != only {
                continue;
            }
            let offset = Vector3::new(
                rng.random_range(0.26..0.40),
                sign(side) * rng.random_range(0.03..0.18),
                rng.random_range(-0.12..0.10),
            );
            let up = rng.random_bool(0.5);
            let palm = Vector3::new(
                -0.5,
                -sign(side) * rng.random_range(0.2..1.0),
                if up { 0.8 } else { -0.3 },
            );
            let reach = Reach::Chest {
                offset,
                palm,
                fingers: Vector3::new(0.6, -sign(side) * 0.3, rng.random_range(0.2..1.0)),
            };
            let start = self.now + rng.random_range(0.0..0.2);
            self.reach(side, start, start + rng.random_range(0.6..0.8), reach);
            let mut t = start + 0.4;
            while t < end - 0.2 {
                let grips = [
                    Fingers::OPEN,
                    Fingers::FIST,
                    Fingers::POINT,
                    Fingers::grasp(0.03),
                ];
                let grip = grips[rng.random_range(0..4)];
                let length = rng.random_range(0.25..0.5);
                self.grip(side, t, t + length, grip);
                t += length + rng.random_range(0.05..0.3);
            }
            self.reach(side, end, end + 0.7, Reach::Rest);
            self.grip(side, end, end + 0.5, Fingers::RELAXED);
        }
        let first = if both { rng.random_range(0..2) } else { only };
        self.look(self.now, Look::Hand(first));
        if both {
            self.look(self.now + rng.random_range(0.8..1.4), Look::Hand(1 - first));
        }
        self.look(end + 0.1, Look::Ahead(0.0, 0.2));
        self.now = end + rng.random_range(0.2..0.6);
    }

    /// Reaches for an object, takes it, looks at it, puts it back or carries it along.
    fn manipulate(&mut self, rng: &mut StreamRng) {
        let Some(spot) = self.spot.map(|s| &self.scene.spots[s]) else {
            return;
        };
        let object = spot.objects[rng.random_range(0..spot.objects.len())];
        if self.carried.contains(&Some(object)) {
            self.look_around(rng);
            return;
        }
        let thing = &self.scene.objects[object];
        let place = Point3::from(thing.rest.translation.vector);
        let left_of = yaw_pitch(self.heading, 0.0).inverse()
            * (place.coords - Vector3::new(self.at.x, self.at.y, 0.0));
        let mut side = if left_of.y + rng.random_range(-0.08..0.08) > 0.0 {
            LEFT
        } else {
            RIGHT
        };
        if self.carried[side].is_some() {
            side = 1 - side;
        }
        let aim = aim(self.wearer, &self.at, self.heading, thing, &place, side);
        let grasp = Fingers::grasp(thing.radius);
        // Eyes first, then trunk and hand.
        let start = self.now + rng.random_range(0.12..0.3);
        self.look(self.now, Look::Object(object));
        let reached = start + rng.random_range(0.65..0.95);
        let above = match aim.reach {
            Reach::World {
                wrist,
                palm,
                fingers,
            } => Reach::World {
                wrist: wrist + Vector3::new(0.0, 0.0, 0.09)
                    - yaw_pitch(self.heading, 0.0) * Vector3::new(0.05, 0.0, 0.0),
                palm,
                fingers,
            },
            other => other,
        };
        let pre = start + 0.62 * (reached - start);
        self.bend(start, reached, aim.crouch, aim.lean);
        self.reach(side, start, pre + 0.12, above);
        self.reach(side, pre, reached, aim.reach);
        self.grip(side, start, pre, Fingers::before(&grasp));
        let held = reached + rng.random_range(0.15..0.28);
        self.grip(side, reached - 0.05, held, grasp);
        // Up before the chest.
        let lifted = held + rng.random_range(0.6..0.85);
        let offset = Vector3::new(
            rng.random_range(0.28..0.40),
            sign(side) * rng.random_range(0.0..0.16),
            rng.random_range(-0.12..0.08),
        );
        let inspect = Reach::Chest {
            offset,
            palm: Vector3::new(-0.2, -sign(side), rng.random_range(-0.2..0.5)),
            fingers: Vector3::new(0.8, -sign(side) * 0.3, rng.random_range(0.0..0.7)),
        };
        self.reach(side, held, lifted, inspect);
        self.bend(held + 0.1, lifted + 0.2, 0.0, 0.06);
        let mut t = lifted;
        for _ in 0..rng.random_range(0..3) {
            let turned = Reach::Chest {
                offset: offset
                    + Vector3::new(
                        rng.random_range(-0.05..0.05),
                        rng.random_range(-0.08..0.08),
                        rng.random_range(-0.06..0.08),
                    ),
                palm: Vector3::new(
                    rng.random_range(-0.6..0.3),
                    -sign(side),
                    rng.random_range(-0.8..0.8),
                ),
                fingers: Vector3::new(
                    0.8,
                    -sign(side) * rng.random_range(-0.3..0.5),
                    rng.random_range(-0.2..0.9),
                ),
            };
            let length = rng.random_range(0.4..0.7);
            self.reach(side, t, t + length, turned);
            t += length;
        }
        if rng.random_bool(0.35) && self.carried[1 - side].is_none() {
            self.touch(rng, side, &offset, lifted - 0.2, t);
        }
        if rng.random_bool(0.4) {
            let look = self.something(rng);
            self.look(lifted + rng.random_range(0.2..0.6), look);
        }
        let mut hold = Hold {
            side,
            object,
            start: held - 0.04,
            end: f64::INFINITY,
        };
        if rng.random_bool(0.15) {
            self.carried[side] = Some(object);
            self.now = t;
        } else {
            // The eyes return to the place first.
            self.look(t - 0.15, Look::Point(place));
            let back = t + rng.random_range(0.65..0.9);
            self.bend(t, back, aim.crouch, aim.lean);
            self.reach(side, t, back, aim.reach);
            let free = back + rng.random_range(0.15..0.25);
            hold.end = back + 0.06;
            self.grip(side, back + 0.05, free, Fingers::before(&grasp));
            self.reach(side, free - 0.05, free + 0.25, above);
            self.reach(side, free + 0.1, free + 0.8, Reach::Rest);
            self.grip(side, free + 0.2, free + 0.7, Fingers::RELAXED);
            self.bend(free, free + 0.7, 0.0, 0.04);
            let look = self.something(rng);
            self.look(free + rng.random_range(0.0..0.3), look);
            self.now = free + rng.random_range(0.3..0.7);
        }
        self.plan.holds.push(hold);
    }

    /// The other hand comes to touch what is held.
    fn touch(
        &mut self,
        rng: &mut StreamRng,
        holder: Side,
        offset: &Vector3<f64>,
        start: f64,
        end: f64,
    ) {
        let side = 1 - holder;
        let near = Vector3::new(
            offset.x - 0.05,
            sign(side) * 0.10 + offset.y * 0.3,
            offset.z + 0.02,
        );
        let reach = Reach::Chest {
            offset: near,
            palm: Vector3::new(-0.2, -sign(side), 0.2),
            fingers: Vector3::new(0.6, -sign(side) * 0.8, 0.3),
        };
        self.reach(side, start, start + 0.6, reach);
        let grip = if rng.random_bool(0.5) {
            Fingers::POINT
        } else {
            Fingers::grasp(0.04)
        };
        self.grip(side, start + 0.1, start + 0.5, grip);
        let end = end.max(start + 0.9);
        self.reach(side, end, end + 0.7, Reach::Rest);
        self.grip(side, end, end + 0.5, Fingers::RELAXED);
    }

    fn bend(&mut self, start: f64, end: f64, crouch: f64, lean: f64) {
        self.plan.crouch.push(Key {
            start,
            end,
            value: crouch,
        });
        self.plan.lean.push(Key {
            start,
            end,
            value: lean,
        });
    }
}

/// How to stand and where to put the wrist for an object.
struct Aim {
    reach: Reach,
    crouch: f64,
    lean: f64,
}

/// Where the pelvis goes for a stand point, heading, crouch and lean: back a little, so that one does not fall over.
pub fn pelvis_over(
    wearer: &Wearer,
    at: &Point2<f64>,
    heading: f64,
    crouch: f64,
    lean: f64,
) -> Point3<f64> {
    let back = 0.10 * lean.sin() + 0.22 * crouch;
    let (s, c) = heading.sin_cos();
    Point3::new(
        at.x - back * c,
        at.y - back * s,
        wearer.standing_height() - crouch * wearer.stature / 1.75,
    )
}

/// Bends as little as needed for the wrist to come where the object is grasped.
fn aim(
    wearer: &Wearer,
    at: &Point2<f64>,
    heading: f64,
    object: &Object,
    place: &Point3<f64>,
    side: Side,
) -> Aim {
    let axes = yaw_pitch(heading, 0.0);
    let (palm, fingers) = if object.from_above {
        (
            axes * Vector3::new(0.25, -0.25 * sign(side), -1.0),
            axes * Vector3::new(0.9, 0.0, -0.5),
        )
    } else {
        (
            axes * Vector3::new(0.1, -sign(side), -0.1),
            axes * Vector3::new(1.0, -0.2 * sign(side), 0.0),
        )
    };
    let arm = wearer.upper_arm + wearer.forearm;
    let mut best: Option<(f64, Aim)> = None;
    for crouch_step in 0..=9 {
        for lean_step in 0..=10 {
            let (crouch, lean) = (f64::from(crouch_step) * 0.05, f64::from(lean_step) * 0.09);
            let pose = TrunkPose {
                pelvis: pelvis_over(wearer, at, heading, crouch, lean),
                heading,
                lean,
                twist: 0.0,
                head: UnitQuaternion::from_rotation_matrix(&yaw_pitch(heading, 0.5)),
            };
            let trunk = wearer::trunk(wearer, &pose);
            let shoulder = trunk.shoulders[side];
            let pole = trunk.T_world_chest.rotation * Vector3::new(-0.8, 0.35 * sign(side), -0.45);
            let mut wrist = place - fingers.normalize() * (0.1 * wearer.hand_scale);
            for _ in 0..5 {
                let (elbow, end) =
                    wearer::two_bones(&shoulder, &wrist, wearer.upper_arm, wearer.forearm, &pole);
                let turn = hand_axes(&(end - elbow), &fingers, &palm);
                let mut hold = hand::hold_point(wearer.hand_scale, object.radius);
                hold.z *= -sign(side);
                wrist = place - turn * hold;
            }
            let distance = (wrist - shoulder).norm();
            let cost = 1.4 * crouch + lean + 8.0 * (distance / arm - 0.93).max(0.0);
            if best.as_ref().is_none_or(|(c, _)| cost < *c) {
                let reach = Reach::World {
                    wrist,
                    palm,
                    fingers,
                };
                best = Some((
                    cost,
                    Aim {
                        reach,
                        crouch,
                        lean,
                    },
                ));
            }
        }
    }
    best.expect("at least one posture was tried").1
}

/// The hand's rotation: fingers between the forearm's direction and the wanted one, so that the wrist bends like a wrist.
pub fn hand_axes(
    forearm: &Vector3<f64>,
    fingers: &Vector3<f64>,
    palm: &Vector3<f64>,
) -> nalgebra::Rotation3<f64> {
    let along = forearm.try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let wanted = fingers.try_normalize(1e-9).unwrap_or(along);
    // Never further than about 50 degrees from the forearm.
    let share = 0.75 * (1.0 + along.dot(&wanted)).clamp(0.0, 1.0);
    hand::orientation(&(along + wanted * share), palm)
}

#[cfg(test)]
mod tests {
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
