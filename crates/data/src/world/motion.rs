//! From a plan to motion: path, feet, pelvis, head and eyes as continuous functions of time.

use super::hand;
use super::scene::Scene;
use super::script::{self, Look, Plan, Reach, hand_axes, pelvis_over};
use super::steps::{Path, Steps};
use super::track::{Curve, GRID_RATE, Mix, value_at};
use super::wearer::{self, BodyPose, LEFT, RIGHT, Side, Trunk, TrunkPose, Wearer, sign, yaw_pitch};
use crate::geometry::rotation::wrap_angle;
use crate::random::StreamRng;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rand::RngExt;

/// The eyes turn this far from the camera's axis at most, radians.
const EYE_LIMIT: f64 = 0.58;

/// Everything about the wearer's motion that was decided, as functions of time.
#[derive(Debug, Clone)]
pub struct Motion {
    /// The wearer's measures.
    pub wearer: Wearer,
    /// What the wearer does, and when.
    pub plan: Plan,
    path: Path,
    steps: Steps,
    lean: Curve,
    crouch: Curve,
    sway: Curve,
    height: Curve,
    head_yaw: Curve,
    head_pitch: Curve,
    /// Slow wandering of the head: amplitudes and phases.
    wander: [f64; 6],
    /// Share of a turn of gaze that the head takes.
    head_share: f64,
}

/// The wearer at one moment.
#[derive(Debug, Clone)]
pub struct Posture {
    /// Every joint of the body in the world.
    pub body: BodyPose,
    /// Frames at the wrists: see [`hand`].
    pub T_world_hand: [Isometry3<f64>; 2],
    /// The head camera in the world: `OpenCV` axes, metres.
    pub T_world_camera: Isometry3<f64>,
}

#[derive(Debug, Clone, Copy)]
struct Target {
    wrist: Point3<f64>,
    palm: Vector3<f64>,
    fingers: Vector3<f64>,
}

impl Mix for Target {
    fn mix(&self, other: &Self, t: f64) -> Self {
        Self {
            wrist: self.wrist.mix(&other.wrist, t),
            palm: self.palm.mix(&other.palm, t),
            fingers: self.fingers.mix(&other.fingers, t),
        }
    }
}

impl Motion {
    /// Simulates the plan.
    pub fn new(scene: &Scene, wearer: Wearer, plan: Plan, rng: &mut StreamRng) -> Self {
        let seconds = plan.seconds + 1.0;
        let linear = |axis: usize| {
            Curve::sample(seconds, |t| {
                plan.walks
                    .iter()
                    .take_while(|k| k.start <= t)
                    .fold(plan.start[axis], |v, k| {
                        let u = ((t - k.start) / (k.end - k.start)).clamp(0.0, 1.0);
                        v + (k.value[axis] - v) * u
                    })
            })
            .smoothed(0.12)
        };
        let path = Path {
            x: linear(0),
            y: linear(1),
            heading: Curve::sample(seconds, |t| value_at(&plan.headings, plan.start_heading, t)),
        };
        let steps = Steps::plan(&wearer, &path, seconds);
        let sway = Curve::sample(seconds, |t| {
            let lifted = |side| f64::from(u8::from(steps.at(side, t).swing.is_some()));
            // Towards the foot that stands.
            0.04 * (lifted(RIGHT) - lifted(LEFT))
        })
        .smoothed(0.10);
        let amplitude = rng.random_range(0.01..0.04);
        let mut motion = Self {
            lean: Curve::sample(seconds, |t| value_at(&plan.lean, 0.04, t)),
            crouch: Curve::sample(seconds, |t| value_at(&plan.crouch, 0.0, t)),
            sway,
            height: Curve(vec![wearer.standing_height(); 2]),
            head_yaw: Curve(vec![plan.start_heading; 2]),
            head_pitch: Curve(vec![0.2; 2]),
            wander: [
                amplitude,
                rng.random_range(0.3..0.8),
                rng.random_range(0.0..6.0),
                amplitude * 0.8,
                rng.random_range(0.3..0.8),
                rng.random_range(0.0..6.0),
            ],
            head_share: rng.random_range(0.62..0.85),
            path,
            steps,
            wearer,
            plan,
        };
        motion.height = motion.pelvis_height(seconds);
        motion.simulate_head(scene, seconds);
        motion
    }

    /// Standing height less crouch and stride, never higher than both legs reach.
    fn pelvis_height(&self, seconds: f64) -> Curve {
        let allowed = Curve::sample(seconds, |t| {
            let trunk = self.trunk(t, 0.0, &UnitQuaternion::identity());
            let pelvis = trunk.T_world_pelvis.translation.vector;
            let (left, right) = (self.steps.at(LEFT, t), self.steps.at(RIGHT, t));
            let spread = (left.toe.xy() - right.toe.xy()).norm() - 2.0 * self.wearer.stance;
            let mut height = pelvis.z - 0.05 * spread.max(0.0).powi(2) / 0.8;
            for (side, foot) in [left, right].iter().enumerate() {
                let reach = self.wearer.leg_reach();
                let highest = (0..=4)
                    .map(|i| {
                        let ankle =
                            self.wearer
                                .ankle_over(&foot.toe, foot.yaw, 0.17 * f64::from(i));
                        let offset = ankle - trunk.hips[side];
                        let level = offset.xy().norm_squared();
                        ankle.z + (reach * reach - level).max(0.0).sqrt()
                            - (trunk.hips[side].z - pelvis.z)
                    })
                    .fold(f64::NEG_INFINITY, f64::max);
                height = height.min(highest);
            }
            height
        });
        // The lowest over the filter's support, so that the smooth curve stays within reach.
        allowed.lowest_within(0.19).smoothed(0.06)
    }

    fn trunk(&self, t: f64, head_yaw: f64, head: &UnitQuaternion<f64>) -> Trunk {
        let heading = self.path.heading.at(t);
        let (lean, crouch) = (self.lean.at(t), self.crouch.at(t));
        let mut pelvis = pelvis_over(&self.wearer, &self.path.at(t), heading, crouch, lean);
        let (s, c) = heading.sin_cos();
        let sway = self.sway.at(t);
        pelvis += Vector3::new(-s * sway, c * sway, 0.0);
        if self.height.0.len() > 2 {
            pelvis.z = self.height.at(t);
        }
        let twist = 0.35 * wrap_angle(head_yaw - heading).clamp(-1.0, 1.0);
        let pose = TrunkPose {
            pelvis,
            heading,
            lean,
            twist,
            head: *head,
        };
        wearer::trunk(&self.wearer, &pose)
    }

    /// Where a hand wants to be.
    fn target(&self, side: Side, t: f64, trunk: &Trunk) -> Target {
        let heading = self.path.heading.at(t);
        let axes = yaw_pitch(heading, 0.0);
        let forward = axes * Vector3::x();
        let other = self.steps.at(1 - side, t).toe;
        let own = self.steps.at(side, t).toe;
        // Arms swing against the legs.
        let swing = 0.55 * (other - own).dot(&forward);
        let arm = 0.965 * (self.wearer.upper_arm + self.wearer.forearm);
        let resting = |shoulder: &Point3<f64>| {
            let down =
                Vector3::new(swing.sin() + 0.05, 0.16 * sign(side), -swing.cos()).normalize();
            Target {
                wrist: shoulder + axes * down * arm,
                palm: axes * Vector3::new(-0.15, -sign(side), 0.0),
                fingers: axes * Vector3::new(0.15 + swing.sin(), 0.0, -1.0),
            }
        };
        let chest = Point3::from(trunk.T_world_chest.translation.vector);
        let evaluate = |reach: &Reach| match reach {
            Reach::Rest => resting(&trunk.shoulders[side]),
            Reach::World {
                wrist,
                palm,
                fingers,
            } => Target {
                wrist: *wrist,
                palm: *palm,
                fingers: *fingers,
            },
            Reach::Chest {
                offset,
                palm,
                fingers,
            } => Target {
                wrist: chest + axes * (offset * (self.wearer.stature / 1.75)),
                palm: axes * palm,
                fingers: axes * fingers,
            },
        };
        self.plan.reaches[side]
            .iter()
            .take_while(|k| k.start <= t)
            .fold(evaluate(&Reach::Rest), |value, key| {
                value.mix(&evaluate(&key.value), key.progress(t))
            })
    }

    fn head_rotation(&self, t: f64, yaw: f64, pitch: f64) -> UnitQuaternion<f64> {
        let [a, fa, pa, b, fb, pb] = self.wander;
        let yaw = yaw + a * (std::f64::consts::TAU * fa * t + pa).sin();
        let pitch = pitch + b * (std::f64::consts::TAU * fb * t + pb).sin();
        let roll = -0.5 * self.sway.at(t);
        let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), roll);
        UnitQuaternion::from_rotation_matrix(&yaw_pitch(yaw, pitch)) * tilt
    }

    fn posture_with(&self, t: f64, yaw: f64, pitch: f64) -> Posture {
        let head = self.head_rotation(t, yaw, pitch);
        let trunk = self.trunk(t, yaw, &head);
        let targets = [self.target(LEFT, t, &trunk), self.target(RIGHT, t, &trunk)];
        let feet = [LEFT, RIGHT].map(|side| {
            let foot = self.steps.at(side, t);
            let lift = self.heel_lift(&trunk, side, t);
            (foot.toe, foot.yaw, lift)
        });
        let body = wearer::body(&self.wearer, &trunk, &targets.map(|t| t.wrist), &feet);
        let T_world_hand = [LEFT, RIGHT].map(|side| {
            let forearm = body.wrists[side] - body.elbows[side];
            let turn = hand_axes(&forearm, &targets[side].fingers, &targets[side].palm);
            Isometry3::from_parts(
                body.wrists[side].into(),
                UnitQuaternion::from_rotation_matrix(&turn),
            )
        });
        Posture {
            T_world_camera: trunk.T_world_head * self.wearer.T_head_camera,
            body,
            T_world_hand,
        }
    }

    /// The heel comes up as far as the leg needs, and in the first half of a swing.
    fn heel_lift(&self, trunk: &Trunk, side: Side, t: f64) -> f64 {
        let foot = self.steps.at(side, t);
        let free = foot
            .swing
            .map_or(0.0, |u| 0.9 * (u * (1.0 - u)).powi(2) * 16.0 * (1.0 - u));
        let excess = |lift: f64| {
            let ankle = self.wearer.ankle_over(&foot.toe, foot.yaw, lift);
            (ankle - trunk.hips[side]).norm() - self.wearer.leg_reach()
        };
        if excess(free) <= 0.0 {
            return free;
        }
        // The nearest that reaches, more or less lifted; a foot too far for any keeps its lift.
        for i in 1..=24 {
            for way in [0.05, -0.05] {
                let [near, far] = [i - 1, i].map(|i| free + way * f64::from(i));
                if far < 0.0 || excess(far) > 0.0 {
                    continue;
                }
                let (mut short, mut enough) = (near, far);
                for _ in 0..20 {
                    let middle = f64::midpoint(short, enough);
                    if excess(middle) <= 0.0 {
                        enough = middle;
                    } else {
                        short = middle;
                    }
                }
                return enough;
            }
        }
        free
    }

    /// The head follows the eyes: later, slower, and not all the way.
    fn simulate_head(&mut self, scene: &Scene, seconds: f64) {
        let steps = (seconds * GRID_RATE).ceil() as usize + 1;
        let dt = 1.0 / GRID_RATE;
        let (mut yaw, mut pitch) = (self.plan.start_heading, 0.25);
        let (mut yaw_speed, mut pitch_speed) = (0.0, 0.0);
        let (mut yaws, mut pitches) = (Vec::with_capacity(steps), Vec::with_capacity(steps));
        let settle = (GRID_RATE * 1.5) as usize;
        for i in 0..steps + settle {
            // The first second and a half only settles the head at its starting posture.
            let t = i.saturating_sub(settle) as f64 * dt;
            let posture = self.posture_with(t, yaw, pitch);
            let eye = Point3::from(posture.T_world_camera.translation.vector);
            let look = self.look_at(t - 0.07);
            let direction = self.look_direction(scene, look, t, &eye, &posture, None);
            let heading = self.path.heading.at(t);
            let off = wrap_angle(direction.y.atan2(direction.x) - heading);
            let down = (-direction.z).atan2(direction.xy().norm());
            let wanted_yaw = heading + (self.head_share * off).clamp(-1.15, 1.15);
            // Leaning forward already tips the head.
            let wanted_pitch = (0.62 * down).clamp(-0.5, 0.95).max(0.25 * self.lean.at(t));
            let follow = |angle: &mut f64, speed: &mut f64, wanted: f64, omega: f64| {
                let pull = omega * omega * (wanted - *angle) - 2.0 * omega * *speed;
                *speed += pull * dt;
                *angle += *speed * dt;
            };
            follow(&mut yaw, &mut yaw_speed, wanted_yaw, 8.5);
            follow(&mut pitch, &mut pitch_speed, wanted_pitch, 8.0);
            if i >= settle {
                yaws.push(yaw);
                pitches.push(pitch);
            }
        }
        self.head_yaw = Curve(yaws).smoothed(0.025);
        self.head_pitch = Curve(pitches).smoothed(0.025);
    }

    /// The posture at a time.
    pub fn posture(&self, t: f64) -> Posture {
        self.posture_with(t, self.head_yaw.at(t), self.head_pitch.at(t))
    }

    /// How the fingers are bent.
    pub fn fingers(&self, side: Side, t: f64) -> hand::Fingers {
        value_at(&self.plan.fingers[side], hand::Fingers::RELAXED, t)
    }

    fn look_index(&self, t: f64) -> usize {
        self.plan.gaze.partition_point(|f| f.start <= t).max(1) - 1
    }

    fn look_at(&self, t: f64) -> Look {
        self.plan.gaze[self.look_index(t)].look
    }

    fn look_direction(
        &self,
        scene: &Scene,
        look: Look,
        t: f64,
        eye: &Point3<f64>,
        posture: &Posture,
        objects: Option<&[Isometry3<f64>]>,
    ) -> Vector3<f64> {
        let in_hand = |side: Side, radius: f64| {
            let mut hold = hand::hold_point(self.wearer.hand_scale, radius);
            hold.z *= -sign(side);
            posture.T_world_hand[side] * Point3::from(hold)
        };
        let point = match look {
            Look::Ahead(yaw, down) => {
                return yaw_pitch(self.path.heading.at(t) + yaw, down) * Vector3::x();
            }
            Look::Point(point) => point,
            Look::Hand(side) => in_hand(side, 0.02),
            Look::Object(i) => {
                let rest = scene.objects[i].rest;
                let holder = |h: &&script::Hold| h.object == i && (h.start..h.end).contains(&t);
                match (objects, self.plan.holds.iter().find(holder)) {
                    (Some(poses), _) => poses[i].translation.vector.into(),
                    (None, Some(hold)) => in_hand(hold.side, scene.objects[i].radius),
                    (None, None) => rest.translation.vector.into(),
                }
            }
        };
        (point - eye).try_normalize(1e-6).unwrap_or_else(Vector3::x)
    }

    /// The direction of gaze in the world, with saccades, and `None` during a blink.
    ///
    /// `objects` are the poses of all objects at that time.
    pub fn gaze(
        &self,
        scene: &Scene,
        t: f64,
        posture: &Posture,
        objects: &[Isometry3<f64>],
    ) -> Option<Vector3<f64>> {
        if self
            .plan
            .blinks
            .iter()
            .any(|(start, end)| (*start..*end).contains(&t))
        {
            return None;
        }
        let eye = Point3::from(posture.T_world_camera.translation.vector);
        let index = self.look_index(t);
        let fixation = &self.plan.gaze[index];
        let mut direction =
            self.look_direction(scene, fixation.look, t, &eye, posture, Some(objects));
        if index > 0 {
            let before = self.plan.gaze[index - 1].look;
            let from = self.look_direction(scene, before, t, &eye, posture, Some(objects));
            let angle = from.angle(&direction);
            // The main sequence: larger saccades take longer.
            let length = 0.022 + 0.13 * angle;
            let u = (t - fixation.start) / length;
            if u < 1.0 {
                let mixed = from.lerp(&direction, super::track::minimum_jerk(u));
                direction = mixed.try_normalize(1e-6).unwrap_or(direction);
            }
        }
        let drift = |f: f64, p: f64| 0.004 * (f * t + p + index as f64).sin();
        direction += Vector3::new(drift(7.0, 0.0), drift(9.0, 2.0), drift(8.0, 4.0));
        // Within the eyes' range.
        let axis = posture.T_world_camera.rotation * Vector3::z();
        let angle = axis.angle(&direction);
        if angle > EYE_LIMIT {
            let sideways = (direction - axis * axis.dot(&direction)).try_normalize(1e-9)?;
            direction = axis * EYE_LIMIT.cos() + sideways * EYE_LIMIT.sin();
        }
        Some(direction.normalize())
    }

    /// The holds of the plan, in order.
    pub fn holds(&self) -> &[script::Hold] {
        &self.plan.holds
    }
}
