//! The wearer: stature and proportions, and the pose that follows from where pelvis, head, wrists and feet are.
//!
//! Body axes are x forward, y left, z up. Every bone keeps its length by construction: the spine is forward kinematics, arms
//! and legs are two-bone inverse kinematics, which moves the elbow or knee and never stretches a bone.

use crate::geometry::skeleton::JOINTS;
use crate::random::StreamRng;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;

/// Left is 0, right is 1, everywhere in the world.
pub type Side = usize;
/// The index of the left side.
pub const LEFT: Side = 0;
/// The index of the right side.
pub const RIGHT: Side = 1;

/// +1 on the left, -1 on the right: the sign of y in body axes.
pub const fn sign(side: Side) -> f64 {
    if side == LEFT { 1.0 } else { -1.0 }
}

/// Lengths of one person, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct Wearer {
    /// From the floor to the top of the head, standing.
    pub stature: f64,
    /// Hip in the pelvis frame, left side.
    pub hip: Vector3<f64>,
    /// Hip to knee.
    pub thigh: f64,
    /// Knee to ankle.
    pub shin: f64,
    /// Ankle in the frame of the foot, which has its origin at the toe joint.
    pub ankle: Vector3<f64>,
    /// Height of the toe joint of a foot flat on the floor.
    pub toe_height: f64,
    /// Pelvis to spine1, spine1 to spine2, spine2 to spine3, spine3 to neck, neck to head.
    pub spine: [f64; 5],
    /// Collar in the chest frame at spine3, left side.
    pub collar: Vector3<f64>,
    /// Shoulder in the chest frame at the collar, left side.
    pub shoulder: Vector3<f64>,
    /// Shoulder to elbow.
    pub upper_arm: f64,
    /// Elbow to wrist.
    pub forearm: f64,
    /// Size of the hand relative to a hand of 0.19 m.
    pub hand_scale: f64,
    /// The glasses: camera in the head frame at the head joint.
    pub T_head_camera: Isometry3<f64>,
    /// Half the distance of the feet when standing.
    pub stance: f64,
}

impl Wearer {
    /// A person between 1.50 m and 1.95 m with proportions of their own.
    pub fn random(rng: &mut StreamRng) -> Self {
        let stature = rng.random_range(1.50..1.95);
        let s: f64 = stature / 1.75;
        let legs: f64 = s * rng.random_range(0.96..1.04);
        let arms = s * rng.random_range(0.95..1.06);
        let wide = s * rng.random_range(0.92..1.08);
        // The trunk makes up for longer or shorter legs, so that the stature is what it says.
        let trunk = (0.585 * s - (legs - s) * 0.965).max(0.45 * s) / 0.585;
        let tilt = rng.random_range(8f64..18.0).to_radians();
        let camera_axes = Rotation3::from_matrix_unchecked(Matrix3::new(
            0.0, 0.0, 1.0, //
            -1.0, 0.0, 0.0, //
            0.0, -1.0, 0.0,
        ));
        let down = Rotation3::from_axis_angle(&Vector3::y_axis(), tilt);
        Self {
            stature,
            hip: Vector3::new(0.0, 0.09 * wide, -0.08 * legs),
            thigh: 0.40 * legs,
            shin: 0.41 * legs,
            ankle: Vector3::new(-0.13, 0.0, 0.055) * legs,
            toe_height: 0.022 * legs,
            spine: [0.11, 0.13, 0.055, 0.20, 0.09].map(|l| l * trunk),
            collar: Vector3::new(0.0, 0.075 * wide, 0.11 * trunk),
            shoulder: Vector3::new(-0.01 * wide, 0.11 * wide, 0.03 * trunk),
            upper_arm: 0.27 * arms,
            forearm: 0.255 * arms,
            hand_scale: arms * rng.random_range(0.96..1.05),
            T_head_camera: Isometry3::from_parts(
                Translation3::new(0.105 * s, 0.0, 0.08 * s),
                UnitQuaternion::from_rotation_matrix(&(down * camera_axes)),
            ),
            stance: 0.10 * wide,
        }
    }

    /// Height of the pelvis over the floor when standing relaxed.
    pub fn standing_height(&self) -> f64 {
        self.toe_height + self.ankle.z + 0.985 * (self.thigh + self.shin) - self.hip.z
    }

    /// The longest a leg gets; the last half percent is left to the knee.
    pub fn leg_reach(&self) -> f64 {
        0.995 * (self.thigh + self.shin)
    }

    /// Ankle over a toe joint, for a foot of that heading whose heel is lifted by `lift` radians.
    pub fn ankle_over(&self, toe: &Point3<f64>, yaw: f64, lift: f64) -> Point3<f64> {
        toe + yaw_pitch(yaw, lift) * self.ankle
    }
}

/// Heading, then pitch: positive pitch tips x down.
pub fn yaw_pitch(yaw: f64, pitch: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), yaw)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), pitch)
}

/// What drives the trunk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrunkPose {
    /// The pelvis joint in the world, metres.
    pub pelvis: Point3<f64>,
    /// Where the body faces: radians from x, positive to the left.
    pub heading: f64,
    /// Forward bend of the chest, radians.
    pub lean: f64,
    /// Turn of the chest relative to the pelvis, radians, positive to the left.
    pub twist: f64,
    /// The head's rotation in the world.
    pub head: UnitQuaternion<f64>,
}

/// The trunk's joints and frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trunk {
    /// At the pelvis joint, body axes.
    pub T_world_pelvis: Isometry3<f64>,
    /// At spine3, body axes.
    pub T_world_chest: Isometry3<f64>,
    /// At the head joint, body axes: x where the face points.
    pub T_world_head: Isometry3<f64>,
    /// In the world, metres.
    pub spine1: Point3<f64>,
    /// In the world, metres.
    pub spine2: Point3<f64>,
    /// In the world, metres.
    pub neck: Point3<f64>,
    /// Left and right, in the world, metres.
    pub hips: [Point3<f64>; 2],
    /// Left and right, in the world, metres.
    pub collars: [Point3<f64>; 2],
    /// Left and right, in the world, metres.
    pub shoulders: [Point3<f64>; 2],
}

/// Forward kinematics from the pelvis to the head and the shoulders.
pub fn trunk(wearer: &Wearer, pose: &TrunkPose) -> Trunk {
    let turn = |share: f64| {
        let twist = pose.twist * share.powi(2);
        UnitQuaternion::from_rotation_matrix(&yaw_pitch(pose.heading + twist, pose.lean * share))
    };
    let up = |q: &UnitQuaternion<f64>, length: f64| q * Vector3::new(0.0, 0.0, length);
    let pelvis_rotation = turn(0.25);
    let chest_rotation = turn(1.0);
    let spine1 = pose.pelvis + up(&pelvis_rotation, wearer.spine[0]);
    let spine2 = spine1 + up(&turn(0.5), wearer.spine[1]);
    let spine3 = spine2 + up(&turn(0.75), wearer.spine[2]);
    let neck = spine3 + up(&chest_rotation, wearer.spine[3]);
    let neck_rotation = chest_rotation.slerp(&pose.head, 0.5);
    let head = neck + up(&neck_rotation, wearer.spine[4]);
    let T_world_pelvis = Isometry3::from_parts(pose.pelvis.into(), pelvis_rotation);
    let T_world_chest = Isometry3::from_parts(spine3.into(), chest_rotation);
    let mirrored = |v: &Vector3<f64>, side| Vector3::new(v.x, v.y * sign(side), v.z);
    let collar = |side| T_world_chest * Point3::from(mirrored(&wearer.collar, side));
    let shoulder = |side| collar(side) + chest_rotation * mirrored(&wearer.shoulder, side);
    Trunk {
        T_world_pelvis,
        T_world_chest,
        T_world_head: Isometry3::from_parts(head.into(), pose.head),
        spine1,
        spine2,
        neck,
        hips: [LEFT, RIGHT].map(|side| T_world_pelvis * Point3::from(mirrored(&wearer.hip, side))),
        collars: [collar(LEFT), collar(RIGHT)],
        shoulders: [shoulder(LEFT), shoulder(RIGHT)],
    }
}

/// The middle joint and the end of a two-bone chain that reaches for `target` and bends towards `pole`.
///
/// A target out of reach is approached along its direction; both bones keep their length.
pub fn two_bones(
    root: &Point3<f64>,
    target: &Point3<f64>,
    first: f64,
    second: f64,
    pole: &Vector3<f64>,
) -> (Point3<f64>, Point3<f64>) {
    let offset = target - root;
    let along = offset.try_normalize(1e-9).unwrap_or(-Vector3::z());
    let reach = offset.norm().clamp(
        (first - second).abs() + 0.15 * first,
        0.9985 * (first + second),
    );
    let bend = pole - along * along.dot(pole);
    let bend = bend
        .try_normalize(1e-6)
        .unwrap_or_else(|| along.cross(&Vector3::y()).normalize());
    let to_middle = (first * first - second * second + reach * reach) / (2.0 * reach);
    let height = (first * first - to_middle * to_middle).max(0.0).sqrt();
    (
        root + along * to_middle + bend * height,
        root + along * reach,
    )
}

/// A whole pose in the world.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyPose {
    /// Pelvis, spine, head, hips and shoulders.
    pub trunk: Trunk,
    /// Left and right, metres.
    pub knees: [Point3<f64>; 2],
    /// Left and right, metres.
    pub ankles: [Point3<f64>; 2],
    /// The toe joints, left and right, metres.
    pub toes: [Point3<f64>; 2],
    /// Left and right, metres.
    pub elbows: [Point3<f64>; 2],
    /// Left and right, metres; short of their targets where these are out of reach.
    pub wrists: [Point3<f64>; 2],
}

/// Arms and legs for a trunk, wrist targets and feet (toe joint, heading, heel lift).
pub fn body(
    wearer: &Wearer,
    trunk: &Trunk,
    wrist_targets: &[Point3<f64>; 2],
    feet: &[(Point3<f64>, f64, f64); 2],
) -> BodyPose {
    let arm = |side: Side| {
        let pole = trunk.T_world_chest.rotation * Vector3::new(-0.8, 0.35 * sign(side), -0.45);
        two_bones(
            &trunk.shoulders[side],
            &wrist_targets[side],
            wearer.upper_arm,
            wearer.forearm,
            &pole,
        )
    };
    let leg = |side: Side| {
        let (toe, yaw, lift) = &feet[side];
        let ankle = wearer.ankle_over(toe, *yaw, *lift);
        let forward = yaw_pitch(*yaw, 0.0) * Vector3::x();
        let hips = trunk.T_world_pelvis.rotation * Vector3::x();
        let out = trunk.T_world_pelvis.rotation * Vector3::new(0.0, 0.15 * sign(side), 0.0);
        let pole = forward + hips + out;
        let hip = &trunk.hips[side];
        let (knee, reached) = two_bones(hip, &ankle, wearer.thigh, wearer.shin, &pole);
        // The foot is rigid: where the leg is too short, it comes along.
        (knee, reached, toe + (reached - ankle))
    };
    let (arms, legs) = ([arm(LEFT), arm(RIGHT)], [leg(LEFT), leg(RIGHT)]);
    BodyPose {
        trunk: *trunk,
        knees: legs.map(|l| l.0),
        ankles: legs.map(|l| l.1),
        toes: legs.map(|l| l.2),
        elbows: arms.map(|a| a.0),
        wrists: arms.map(|a| a.1),
    }
}

impl BodyPose {
    /// The 21 joints in the order of [`crate::geometry::skeleton::BODY`].
    pub fn joints(&self) -> [Point3<f64>; JOINTS] {
        let t = &self.trunk;
        let [l, r] = [LEFT, RIGHT];
        [
            t.T_world_pelvis.translation.vector.into(),
            t.hips[l],
            t.hips[r],
            self.knees[l],
            self.knees[r],
            t.spine2,
            self.ankles[l],
            self.ankles[r],
            t.T_world_chest.translation.vector.into(),
            self.toes[l],
            self.toes[r],
            t.neck,
            t.collars[l],
            t.collars[r],
            t.T_world_head.translation.vector.into(),
            t.shoulders[l],
            t.shoulders[r],
            self.elbows[l],
            self.elbows[r],
            self.wrists[l],
            self.wrists[r],
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_bones_keep_their_length_wherever_they_are_sent() {
        let root = Point3::new(0.0, 0.0, 1.4);
        for i in 0..200 {
            let a = f64::from(i);
            let target =
                root + Vector3::new(a.sin(), (a * 1.7).cos(), (a * 0.3).sin()) * (a * 0.006);
            let (mid, end) = two_bones(&root, &target, 0.27, 0.25, &-Vector3::x());
            assert!(((mid - root).norm() - 0.27).abs() < 1e-9);
            assert!(((end - mid).norm() - 0.25).abs() < 1e-9);
            let reach = (target - root).norm();
            if (0.08..0.51).contains(&reach) {
                assert!((end - target).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn people_are_as_tall_as_they_say_and_stand_upright() {
        for sample in 0..50 {
            let wearer = Wearer::random(&mut crate::random::stream(0, "test.wearer", 0, sample));
            let pose = TrunkPose {
                pelvis: Point3::new(0.0, 0.0, wearer.standing_height()),
                heading: 0.3,
                lean: 0.0,
                twist: 0.0,
                head: UnitQuaternion::identity(),
            };
            let trunk = trunk(&wearer, &pose);
            let top = trunk.T_world_head.translation.z + 0.2 * wearer.stature / 1.75;
            assert!(
                (top - wearer.stature).abs() < 0.04,
                "{top} {}",
                wearer.stature
            );
            let eyes = trunk.T_world_head * wearer.T_head_camera;
            let forward = eyes.rotation * Vector3::z();
            assert!(forward.x > 0.9 && forward.z < -0.1);
            assert!(eyes.translation.z / wearer.stature > 0.90);
        }
    }
}
