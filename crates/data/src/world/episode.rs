//! An episode: one wearer in one room for some seconds, seen at any time.

use super::figure::{self, Clothes};
use super::hand;
use super::motion::{Motion, Posture};
use super::render::{Frame, Moving, Part, Renderer};
use super::scene::Scene;
use super::script::{self, Hold};
use super::wearer::{LEFT, RIGHT, Wearer};
use super::{HandValidity, WorldSettings, room};
use crate::clip::frames::{self, WorldJoints};
use crate::clip::{
    BODY, CAMERA, CameraTrack, Clip, DEPTH, Depth, GAZE, GazeTrack, Intrinsics, JointTrack, Key,
    LEFT_HAND, RGB, RIGHT_HAND, Rgb, Signal, clock,
};
use crate::geometry::skeleton::JOINTS;
use crate::random::stream;
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use ndarray::{Array1, Array2, Array3, Array4};

/// Standard gravity, m/s².
const GRAVITY: f64 = 9.806_65;
/// Joints that must be in the image for a hand to count as visible.
const VISIBLE_JOINTS: usize = 5;

/// One wearer in one room.
pub struct Episode {
    scene: Scene,
    motion: Motion,
    clothes: Clothes,
    holds: Vec<(Hold, Isometry3<f64>)>,
    intrinsics: Intrinsics,
    settings: WorldSettings,
}

/// Everything exact at one time.
pub struct Moment {
    /// The wearer's joints and frames in the world.
    pub posture: Posture,
    /// Left and right, world coordinates.
    pub hands: [[Point3<f64>; JOINTS]; 2],
    /// `T_world_object`.
    pub objects: Vec<Isometry3<f64>>,
    /// Unit direction in the world; `None` during a blink.
    pub gaze: Option<Vector3<f64>>,
}

impl Episode {
    /// The episode of (seed, index); a longer one starts with the same seconds.
    pub fn new(settings: &WorldSettings, seed: u64, index: u64, seconds: f64) -> Self {
        let room_index = settings.rooms.map_or(index, |rooms| index % rooms);
        let mut scene = room::build(&mut stream(seed, "world.room", 0, room_index));
        let wearer = Wearer::random(&mut stream(seed, "world.wearer", 0, index));
        let clothes = Clothes::random(&mut scene, &mut stream(seed, "world.clothes", 0, index));
        let mut rng = stream(seed, "world.script", 0, index);
        let mut blinks = stream(seed, "world.blinks", 0, index);
        let plan = script::write(&scene, &wearer, &mut rng, &mut blinks, seconds);
        let mut rng = stream(seed, "world.motion", 0, index);
        let motion = Motion::new(&scene, wearer, plan, &mut rng);
        let mut episode = Self {
            scene,
            clothes,
            holds: Vec::new(),
            intrinsics: settings.intrinsics(),
            settings: settings.clone(),
            motion,
        };
        episode.holds = episode.resolve_holds();
        episode
    }

    /// What is taken keeps its place in the hand from the moment it is taken.
    fn resolve_holds(&self) -> Vec<(Hold, Isometry3<f64>)> {
        let holds = self.motion.holds().iter();
        holds
            .map(|hold| {
                let hand = self.motion.posture(hold.start).T_world_hand[hold.side];
                let rest = self.scene.objects[hold.object].rest;
                (*hold, hand.inv_mul(&rest))
            })
            .collect()
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The motion of the wearer.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// `T_world_object` of all objects.
    fn objects(&self, t: f64, posture: &Posture) -> Vec<Isometry3<f64>> {
        let mut poses: Vec<Isometry3<f64>> = self.scene.objects.iter().map(|o| o.rest).collect();
        for (hold, T_hand_object) in &self.holds {
            let pose = &mut poses[hold.object];
            if t >= hold.start && t < hold.end {
                *pose = posture.T_world_hand[hold.side] * T_hand_object;
            } else if t >= hold.end && t < hold.end + 0.15 {
                // Settles where it stood.
                let left = self.motion.posture(hold.end).T_world_hand[hold.side] * T_hand_object;
                let u = super::track::minimum_jerk((t - hold.end) / 0.15);
                *pose = crate::geometry::rigid::interpolate(&left, pose, u);
            }
        }
        poses
    }

    /// Everything at time `t`, seconds from the start of the episode.
    pub fn at(&self, t: f64) -> Moment {
        let posture = self.motion.posture(t);
        let objects = self.objects(t, &posture);
        let hands = [LEFT, RIGHT].map(|side| {
            let fingers = self.motion.fingers(side, t);
            let scale = self.motion.wearer.hand_scale;
            hand::joints(&posture.T_world_hand[side], &fingers, scale, side)
        });
        Moment {
            gaze: self.motion.gaze(&self.scene, t, &posture, &objects),
            posture,
            hands,
            objects,
        }
    }

    /// A renderer for frames of this episode.
    pub fn renderer(&self) -> Renderer<'_> {
        Renderer::new(&self.scene)
    }

    /// What the head camera sees at a moment.
    pub fn frame(&self, renderer: &Renderer, moment: &Moment) -> Frame {
        let mut moving = Vec::with_capacity(128);
        for (object, pose) in self.scene.objects.iter().zip(&moment.objects) {
            moving.extend(object.primitives.iter().map(|p| Moving {
                primitive: p.moved(pose),
                part: Part::Object,
            }));
        }
        figure::primitives(
            &self.motion.wearer,
            &self.clothes,
            &moment.posture,
            &moment.hands,
            &mut moving,
        );
        renderer.frame(
            &moment.posture.T_world_camera,
            &self.intrinsics,
            &moving,
            self.settings.antialias,
        )
    }

    /// Where a direction of gaze is in the image of a camera, in [0, 1]; `None` behind the camera.
    fn gaze_point(
        &self,
        T_world_camera: &Isometry3<f64>,
        direction: &Vector3<f64>,
    ) -> Option<[f64; 2]> {
        let d = T_world_camera.rotation.inverse() * direction;
        let k = &self.intrinsics;
        (d.z > 1e-3).then(|| {
            [
                (k.fx * d.x / d.z + k.cx + 0.5) / f64::from(k.width),
                (k.fy * d.y / d.z + k.cy + 0.5) / f64::from(k.height),
            ]
        })
    }

    /// Pixel coordinates of a world point; `None` behind the camera.
    pub fn project(
        &self,
        T_world_camera: &Isometry3<f64>,
        point: &Point3<f64>,
    ) -> Option<[f64; 3]> {
        let p = T_world_camera.inverse_transform_point(point);
        let k = &self.intrinsics;
        (p.z > 0.02).then(|| [k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy, p.z])
    }

    fn sees_hand(&self, T_world_camera: &Isometry3<f64>, hand: &[Point3<f64>; JOINTS]) -> bool {
        let k = &self.intrinsics;
        let inside = hand.iter().filter(|joint| {
            self.project(T_world_camera, joint)
                .is_some_and(|[x, y, _]| {
                    (-0.5..f64::from(k.width) - 0.5).contains(&x)
                        && (-0.5..f64::from(k.height) - 0.5).contains(&y)
                })
        });
        inside.count() >= VISIBLE_JOINTS
    }

    /// The two seconds that begin at `start`.
    pub fn clip(&self, id: &str, start: f64) -> Clip {
        let samples = clock::SIGNAL_SAMPLES;
        let rate = clock::SIGNAL_RATE;
        let moments: Vec<Moment> = (0..samples)
            .map(|i| self.at(start + i as f64 / rate))
            .collect();
        let camera = CameraTrack {
            rate,
            T_world_camera: moments.iter().map(|m| m.posture.T_world_camera).collect(),
            valid: vec![true; samples],
            up_world: Some(Unit::new_unchecked(Vector3::z())),
            intrinsics: Some(self.intrinsics),
        };
        let (rgb, depth) = self.video(&moments);
        let mut clip = Clip::empty(id, "world");
        clip.set(RGB, rgb);
        clip.set(DEPTH, depth);
        clip.set(GAZE, self.gaze_track(&moments));
        clip.set(LEFT_HAND, self.hand_track(&moments, LEFT, &camera));
        clip.set(RIGHT_HAND, self.hand_track(&moments, RIGHT, &camera));
        clip.set(BODY, body_track(&moments, &camera));
        clip.set(Key::new("head_imu"), self.head_imu(start));
        clip.set(CAMERA, camera);
        clip
    }

    fn video(&self, moments: &[Moment]) -> (Rgb, Depth) {
        let (count, size) = (self.settings.frames, self.settings.size as usize);
        let rate = self.settings.video_rate;
        let renderer = self.renderer();
        let mut colours = Vec::with_capacity(count * size * size * 3);
        let mut metres = Vec::with_capacity(count * size * size);
        for sample in clock::samples_of_frames(count, rate) {
            let frame = self.frame(&renderer, &moments[sample]);
            colours.extend_from_slice(&frame.rgb);
            metres.extend_from_slice(&frame.depth);
        }
        let sizes = "the renderer fills every pixel";
        let rgb = Array4::from_shape_vec((count, size, size, 3), colours).expect(sizes);
        let depth = Array3::from_shape_vec((count, size, size), metres).expect(sizes);
        (
            Rgb { rate, frames: rgb },
            Depth {
                rate,
                metres: depth,
            },
        )
    }

    fn gaze_track(&self, moments: &[Moment]) -> GazeTrack {
        let mut points = Array2::zeros((moments.len(), 2));
        let mut valid = Array1::from_elem(moments.len(), false);
        for (t, moment) in moments.iter().enumerate() {
            let camera = &moment.posture.T_world_camera;
            if let Some([x, y]) = moment.gaze.and_then(|d| self.gaze_point(camera, &d)) {
                points[[t, 0]] = x as f32;
                points[[t, 1]] = y as f32;
                valid[t] = true;
            }
        }
        GazeTrack {
            rate: clock::SIGNAL_RATE,
            points,
            valid,
        }
    }

    fn hand_track(&self, moments: &[Moment], side: usize, camera: &CameraTrack) -> JointTrack {
        let joints: WorldJoints = moments
            .iter()
            .map(|moment| {
                let hand = &moment.hands[side];
                let seen = self.settings.hands == HandValidity::Always
                    || self.sees_hand(&moment.posture.T_world_camera, hand);
                hand.iter().map(|p| seen.then_some(*p)).collect()
            })
            .collect();
        frames::joints_in_camera(&joints, camera).expect("there is one pose per moment")
    }

    /// Accelerometer (specific force) and gyroscope at the camera, in its axes: `ax ay az gx gy gz`.
    fn head_imu(&self, start: f64) -> Signal {
        // Two samples of the motion's grid: fine enough for a head.
        let h = 1.0 / 60.0;
        let samples = clock::SIGNAL_SAMPLES;
        let mut values = Array2::<f32>::zeros((samples, 6));
        for i in 0..samples {
            let t = start + i as f64 / clock::SIGNAL_RATE;
            let pose = |t: f64| self.motion.posture(t).T_world_camera;
            let (before, now, after) = (pose(t - h), pose(t), pose(t + h));
            let acceleration = (before.translation.vector + after.translation.vector
                - now.translation.vector * 2.0)
                / (h * h);
            let force = now.rotation.inverse() * (acceleration + Vector3::z() * GRAVITY);
            let turn = (before.rotation.inverse() * after.rotation).scaled_axis() / (2.0 * h);
            for k in 0..3 {
                values[[i, k]] = force[k] as f32;
                values[[i, 3 + k]] = turn[k] as f32;
            }
        }
        Signal {
            values: values.into_dyn(),
            valid: None,
        }
    }
}

fn body_track(moments: &[Moment], camera: &CameraTrack) -> Option<JointTrack> {
    let frame = frames::gravity_frame_of(camera).ok()?;
    let joints: WorldJoints = moments
        .iter()
        .map(|m| m.posture.body.joints().into_iter().map(Some).collect())
        .collect();
    Some(frames::joints_in_frame(&joints, camera.rate, &frame))
}
