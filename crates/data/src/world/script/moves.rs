//! Walks, turns, bends, and where the eyes go meanwhile.

use super::{Fixation, Look, Reach, Writer};
use crate::geometry::rotation::wrap_angle;
use crate::random::StreamRng;
use crate::world::hand::Fingers;
use crate::world::room;
use crate::world::scene::Spot;
use crate::world::track::Key;
use crate::world::wearer::Side;
use nalgebra::{Point2, Point3};
use rand::RngExt;

impl Writer<'_> {
    pub(super) fn next_activity(&mut self, rng: &mut StreamRng) {
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
    pub(super) fn glances(&mut self, rng: &mut StreamRng, from: usize) {
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

    pub(super) fn look(&mut self, start: f64, look: Look) {
        self.plan.gaze.push(Fixation { start, look });
    }

    pub(super) fn reach(&mut self, side: Side, start: f64, end: f64, value: Reach) {
        self.plan.reaches[side].push(Key { start, end, value });
    }

    pub(super) fn grip(&mut self, side: Side, start: f64, end: f64, value: Fingers) {
        self.plan.fingers[side].push(Key { start, end, value });
    }

    pub(super) fn turn(&mut self, start: f64, end: f64, to: f64) {
        self.heading += wrap_angle(to - self.heading);
        let value = self.heading;
        self.plan.headings.push(Key { start, end, value });
    }

    /// To another spot or somewhere in the room, round the furniture where need be.
    pub(super) fn walk(&mut self, rng: &mut StreamRng) {
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

    pub(super) fn walk_straight(
        &mut self,
        rng: &mut StreamRng,
        to: Point2<f64>,
        speed: f64,
        first: bool,
    ) {
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
    pub(super) fn something(&self, rng: &mut StreamRng) -> Look {
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

    pub(super) fn look_around(&mut self, rng: &mut StreamRng) {
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

    pub(super) fn bend(&mut self, start: f64, end: f64, crouch: f64, lean: f64) {
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
