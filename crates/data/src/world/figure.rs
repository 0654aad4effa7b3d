//! The wearer as primitives: arms and hands that the camera sees, and a body that throws a shadow.

use super::motion::Posture;
use super::primitive::{Primitive, Shape};
use super::render::{Moving, Part};
use super::scene::{Scene, hsv, patterned};
use super::texture::{Material, Pattern};
use super::vector::V3;
use super::wearer::{LEFT, RIGHT, Side, Wearer};
use crate::geometry::skeleton::{HAND, JOINTS};
use crate::random::StreamRng;
use nalgebra::Point3;
use rand::RngExt;

/// What the wearer wears.
#[derive(Debug, Clone, Copy)]
pub struct Clothes {
    skin: u16,
    sleeve: u16,
    trousers: u16,
    shoes: u16,
    watch: u16,
    short_sleeves: bool,
    watch_side: Side,
}

impl Clothes {
    /// Random clothes; their materials are added to the scene.
    pub fn random(scene: &mut Scene, rng: &mut StreamRng) -> Self {
        // From light to dark, and a little redder or yellower.
        let tone = rng.random::<f32>();
        let skin = hsv(
            rng.random_range(0.035..0.075),
            0.30 + 0.30 * tone,
            0.95 - 0.58 * tone,
        );
        let cloth = hsv(
            rng.random(),
            rng.random_range(0.2..0.85),
            rng.random_range(0.3..0.95),
        );
        let second = hsv(
            rng.random(),
            rng.random_range(0.0..0.6),
            rng.random_range(0.4..0.95),
        );
        let sleeve = if rng.random_bool(0.5) {
            patterned(
                Pattern::Stripes,
                [cloth, second, cloth],
                rng.random_range(0.05..0.1),
                0.0,
                1,
            )
        } else {
            Material::plain(cloth)
        };
        Self {
            skin: scene.material(Material {
                gloss: 0.12,
                ..Material::plain(skin)
            }),
            sleeve: scene.material(sleeve),
            trousers: scene.material(Material::plain(hsv(
                rng.random_range(0.5..0.75),
                rng.random_range(0.1..0.6),
                rng.random_range(0.2..0.6),
            ))),
            shoes: scene.material(Material {
                gloss: 0.3,
                ..Material::plain(hsv(
                    rng.random(),
                    rng.random_range(0.0..0.7),
                    rng.random_range(0.2..0.9),
                ))
            }),
            watch: scene.material(Material {
                gloss: 0.8,
                ..Material::plain(V3::splat(0.03))
            }),
            short_sleeves: rng.random_bool(0.4),
            watch_side: if rng.random_bool(0.7) { LEFT } else { RIGHT },
        }
    }
}

/// The primitives of the wearer in a posture.
pub fn primitives(
    wearer: &Wearer,
    clothes: &Clothes,
    posture: &Posture,
    hands: &[[Point3<f64>; JOINTS]; 2],
    out: &mut Vec<Moving>,
) {
    let body = &posture.body;
    let s = (wearer.stature / 1.75) as f32;
    let limb = |a: Point3<f64>, b: Point3<f64>, radius_a: f32, radius_b: f32| Shape::Limb {
        a: a.into(),
        b: b.into(),
        radius_a,
        radius_b,
    };
    let mut add = |shape: Shape, material: u16, part: Part| {
        out.push(Moving {
            primitive: Primitive::new(shape, material),
            part,
        });
    };
    for side in [LEFT, RIGHT] {
        let part = if side == LEFT {
            Part::LeftArm
        } else {
            Part::RightArm
        };
        let (shoulder, elbow, wrist) = (
            body.trunk.shoulders[side],
            body.elbows[side],
            body.wrists[side],
        );
        let forearm = if clothes.short_sleeves {
            clothes.skin
        } else {
            clothes.sleeve
        };
        add(
            limb(shoulder, elbow, 0.052 * s, 0.043 * s),
            clothes.sleeve,
            part,
        );
        let cuff = elbow + (wrist - elbow) * 0.93;
        add(limb(elbow, cuff, 0.041 * s, 0.031 * s), forearm, part);
        add(limb(cuff, wrist, 0.027 * s, 0.025 * s), clothes.skin, part);
        if side == clothes.watch_side && clothes.short_sleeves {
            let at = elbow + (wrist - elbow) * 0.90;
            let band = elbow + (wrist - elbow) * 0.94;
            add(limb(at, band, 0.033 * s, 0.032 * s), clothes.watch, part);
        }
        palm_and_fingers(&hands[side], wearer.hand_scale as f32, |shape| {
            add(shape, clothes.skin, part);
        });
        let (hip, knee, ankle) = (body.trunk.hips[side], body.knees[side], body.ankles[side]);
        add(
            limb(hip, knee, 0.082 * s, 0.058 * s),
            clothes.trousers,
            Part::Body,
        );
        add(
            limb(knee, ankle, 0.058 * s, 0.042 * s),
            clothes.trousers,
            Part::Body,
        );
        let toe = body.toes[side];
        let tip = toe + (toe - ankle).xy().push(0.0).normalize() * (0.07 * wearer.stature / 1.75);
        let lifted = Point3::new(toe.x, toe.y, toe.z + 0.012);
        add(
            limb(ankle, lifted, 0.040 * s, 0.034 * s),
            clothes.shoes,
            Part::Body,
        );
        add(
            limb(
                lifted,
                tip + nalgebra::Vector3::z() * 0.008,
                0.034 * s,
                0.028 * s,
            ),
            clothes.shoes,
            Part::Body,
        );
    }
    let pelvis = Point3::from(body.trunk.T_world_pelvis.translation.vector);
    let chest = Point3::from(body.trunk.T_world_chest.translation.vector);
    add(
        limb(pelvis, body.trunk.spine2, 0.125 * s, 0.120 * s),
        clothes.sleeve,
        Part::Body,
    );
    add(
        limb(body.trunk.spine2, chest, 0.120 * s, 0.125 * s),
        clothes.sleeve,
        Part::Body,
    );
    let collars = &body.trunk.collars;
    add(
        limb(collars[LEFT], collars[RIGHT], 0.075 * s, 0.075 * s),
        clothes.sleeve,
        Part::Body,
    );
    for side in [LEFT, RIGHT] {
        add(
            limb(
                collars[side],
                body.trunk.shoulders[side],
                0.07 * s,
                0.055 * s,
            ),
            clothes.sleeve,
            Part::Body,
        );
        add(
            limb(chest, collars[side], 0.11 * s, 0.08 * s),
            clothes.sleeve,
            Part::Body,
        );
    }
    // The head holds the camera: only its shadow is seen.
    let head = Point3::from(body.trunk.T_world_head.translation.vector);
    let crown = body.trunk.T_world_head * Point3::new(0.01, 0.0, 0.10 * f64::from(s));
    let mut skull = Primitive::new(limb(head, crown, 0.085 * s, 0.095 * s), clothes.skin);
    skull.visible = false;
    out.push(Moving {
        primitive: skull,
        part: Part::Body,
    });
}

fn palm_and_fingers(hand: &[Point3<f64>; JOINTS], scale: f32, mut add: impl FnMut(Shape)) {
    let limb = |a: Point3<f64>, b: Point3<f64>, radius_a: f32, radius_b: f32| Shape::Limb {
        a: a.into(),
        b: b.into(),
        radius_a: radius_a * scale,
        radius_b: radius_b * scale,
    };
    for (parent, child) in HAND.bones() {
        let (a, b) = (hand[parent], hand[child]);
        let is_thumb = (13..=16).contains(&child);
        let shape = match (parent, child) {
            (0, 13) => limb(a, b, 0.023, 0.019),
            (0, _) => limb(a, b, 0.022, 0.0125),
            (13, 14) => limb(a, b, 0.019, 0.0125),
            _ if child >= 16 => limb(
                a,
                b,
                if is_thumb { 0.0115 } else { 0.0085 },
                if is_thumb { 0.0095 } else { 0.0072 },
            ),
            _ if is_thumb => limb(a, b, 0.0125, 0.0115),
            _ => limb(a, b, 0.0105, 0.009),
        };
        add(shape);
    }
    // The palm between the knuckles.
    for pair in [(1, 4), (4, 10), (10, 7)] {
        add(limb(hand[pair.0], hand[pair.1], 0.0125, 0.0125));
        let low = |joint: usize| hand[0] + (hand[joint] - hand[0]) * 0.55;
        add(limb(low(pair.0), low(pair.1), 0.0165, 0.0165));
    }
    add(limb(
        hand[13],
        hand[0] + (hand[1] - hand[0]) * 0.75,
        0.016,
        0.011,
    ));
}
