//! How to stand, and where the wrist goes, for an object to be grasped.

use super::Reach;
use crate::world::hand;
use crate::world::scene::Object;
use crate::world::wearer::{self, Side, TrunkPose, Wearer, sign, yaw_pitch};
use nalgebra::{Point2, Point3, UnitQuaternion, Vector3};

/// How to stand and where to put the wrist for an object.
pub(super) struct Aim {
    pub(super) reach: Reach,
    pub(super) crouch: f64,
    pub(super) lean: f64,
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
pub(super) fn aim(
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
