//! What hands do: reaching, carrying, touching, gestures; and crouching down.

use super::aim::aim;
use super::{Hold, Look, Reach, Writer};
use crate::random::StreamRng;
use crate::world::hand::Fingers;
use crate::world::wearer::{LEFT, RIGHT, Side, sign, yaw_pitch};
use nalgebra::{Point3, Vector3};
use rand::RngExt;

impl Writer<'_> {
    pub(super) fn crouch_down(&mut self, rng: &mut StreamRng) {
        let depth = rng.random_range(0.2..0.42);
        let lean = rng.random_range(0.2..0.5);
        let down = self.now + rng.random_range(0.7..1.0);
        let up = down + rng.random_range(0.3..1.0);
        let end = up + rng.random_range(0.7..1.0);
        let keys = [(self.now, down, depth, lean), (up, end, 0.0, 0.05)];
        for (start, end, crouch, lean) in keys {
            self.bend(start, end, crouch, lean);
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
    pub(super) fn gesture(&mut self, rng: &mut StreamRng) {
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
    pub(super) fn manipulate(&mut self, rng: &mut StreamRng) {
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
    pub(super) fn touch(
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
}
