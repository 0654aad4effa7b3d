//! What stands on the floor: sofas, plants, lamps, toys.

use super::{obstacle, stock};
use crate::random::StreamRng;
use crate::world::primitive::Shape;
use crate::world::scene::{Scene, hsv, patterned};
use crate::world::texture::{Material, Pattern};
use crate::world::vector::{V3, v3};
use crate::world::wall::{Style, Wall};
use rand::RngExt;

pub(super) fn sofa(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
) -> (f32, f32) {
    let (w, depth) = (1.6, 0.82);
    let cloth = style.cloth;
    scene.add(wall.block(v3(u, 0.05, 0.08), v3(u + w, depth, 0.40)), cloth);
    scene.add(wall.block(v3(u, 0.05, 0.40), v3(u + w, 0.28, 0.84)), cloth);
    for arm in [u, u + w - 0.16] {
        scene.add(
            wall.block(v3(arm, 0.05, 0.40), v3(arm + 0.16, depth, 0.60)),
            cloth,
        );
    }
    for i in 0..2 {
        let x = u + 0.2 + 0.61 * i as f32;
        scene.add(
            wall.block(v3(x, 0.26, 0.40), v3(x + 0.59, depth + 0.02, 0.49)),
            cloth,
        );
    }
    let at = wall.at(u + rng.random_range(0.35..1.2), 0.38, 0.66);
    // A cushion that leans on the back: its axes are made orthogonal.
    let (sin, cos) = rng.random_range(-0.5..0.5f32).sin_cos();
    let across = wall.along * cos + V3::Z * sin;
    let out = wall.inward * 0.94 + V3::Z * 0.34;
    let out = (out - across * across.dot(out)).normalized();
    let cushion = Shape::Block {
        centre: at,
        half: v3(0.2, 0.06, 0.18),
        axes: [across, out, across.cross(out)],
    };
    scene.add(cushion, style.accent);
    scene.landmarks.push(at.into());
    obstacle(scene, wall, u, u + w, depth);
    (w, 0.86)
}

pub(super) fn plant(scene: &mut Scene, rng: &mut StreamRng, wall: &Wall, u: f32) -> (f32, f32) {
    let pot = scene.material(Material::plain(hsv(rng.random_range(0.0..0.08), 0.6, 0.7)));
    let green = hsv(
        rng.random_range(0.25..0.38),
        0.65,
        rng.random_range(0.35..0.6),
    );
    let leaf = scene.material(Material {
        gloss: 0.2,
        ..Material::plain(green)
    });
    let (x, y) = (u + 0.22, 0.25);
    let pot_shape = Shape::Can {
        base: wall.at(x, y, 0.0),
        axis: V3::Z,
        height: 0.3,
        radius: 0.15,
    };
    scene.add(pot_shape, pot);
    let height = rng.random_range(0.8..1.4);
    for i in 0..9 {
        let angle = i as f32 * 2.4;
        let out = rng.random_range(0.1..0.24);
        let z = 0.5 + (height - 0.5) * (i as f32 / 8.0);
        let tip = wall.at(
            x + out * angle.cos(),
            (y + out * angle.sin()).max(0.06),
            z + 0.12,
        );
        let shape = Shape::Limb {
            a: wall.at(x, y, 0.3 + (z - 0.3) * 0.6),
            b: tip,
            radius_a: 0.012,
            radius_b: rng.random_range(0.03..0.06),
        };
        scene.add(shape, leaf);
    }
    scene.landmarks.push(wall.at(x, y, height).into());
    obstacle(scene, wall, u + 0.05, u + 0.4, 0.42);
    (0.45, f32::INFINITY)
}

pub(super) fn floor_lamp(scene: &mut Scene, wall: &Wall, style: &Style, u: f32) -> (f32, f32) {
    let shade = scene.material(Material {
        glow: 0.8,
        ..Material::plain(hsv(0.12, 0.35, 0.95))
    });
    let (x, y) = (u + 0.2, 0.22);
    let can = |z: f32, height: f32, radius: f32| Shape::Can {
        base: wall.at(x, y, z),
        axis: V3::Z,
        height,
        radius,
    };
    scene.add(can(0.0, 0.03, 0.14), style.metal);
    scene.add(can(0.03, 1.4, 0.012), style.metal);
    scene.add(can(1.38, 0.26, 0.15), shade);
    scene.landmarks.push(wall.at(x, y, 1.5).into());
    obstacle(scene, wall, u + 0.06, u + 0.34, 0.36);
    (0.4, f32::INFINITY)
}

/// Things on the floor: one has to crouch for them.
pub(super) fn toys(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    u: f32,
    w: f32,
) -> (f32, f32) {
    let mat = scene.material(patterned(
        Pattern::Checker,
        [
            hsv(rng.random(), 0.5, 0.8),
            hsv(rng.random(), 0.5, 0.7),
            V3::ZERO,
        ],
        0.2,
        0.0,
        0,
    ));
    scene.add(wall.block(v3(u, 0.05, 0.0), v3(u + w, 0.75, 0.012)), mat);
    stock(scene, rng, wall, [u + 0.1, u + w - 0.1], 0.72, 0.2, 0.012);
    obstacle(scene, wall, u, u + w, 0.62);
    (w, 0.02)
}
