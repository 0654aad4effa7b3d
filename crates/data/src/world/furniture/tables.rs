//! Tables and what stands on them.

use super::{obstacle, stock};
use crate::random::StreamRng;
use crate::world::primitive::Shape;
use crate::world::scene::{Scene, hsv, patterned};
use crate::world::texture::{Material, Pattern};
use crate::world::vector::{V3, v3};
use crate::world::wall::{Style, Wall};
use rand::RngExt;

pub(super) fn table(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    w: f32,
    low: bool,
) -> (f32, f32) {
    let depth = if low {
        0.5
    } else {
        rng.random_range(0.55..0.72)
    };
    let height = if low {
        rng.random_range(0.38..0.48)
    } else {
        rng.random_range(0.71..0.77)
    };
    let top = if rng.random_bool(0.7) {
        style.wood
    } else {
        style.paint
    };
    scene.add(
        wall.block(v3(u, 0.02, height - 0.035), v3(u + w, depth, height)),
        top,
    );
    for (du, dv) in [
        (0.05, 0.07),
        (w - 0.05, 0.07),
        (0.05, depth - 0.05),
        (w - 0.05, depth - 0.05),
    ] {
        let leg = Shape::Limb {
            a: wall.at(u + du, dv, 0.0),
            b: wall.at(u + du, dv, height - 0.04),
            radius_a: 0.02,
            radius_b: 0.028,
        };
        scene.add(leg, style.metal);
    }
    obstacle(scene, wall, u, u + w, depth);
    if !low && w > 1.1 && rng.random_bool(0.5) {
        {
            let middle = u + w * rng.random_range(0.3..0.7);
            computer(scene, rng, wall, style, middle, height);
        };
    }
    stock(
        scene,
        rng,
        wall,
        [u + 0.08, u + w - 0.08],
        depth,
        depth - 0.3,
        height,
    );
    (w, height)
}

/// A screen that glows, with a keyboard.
pub(super) fn computer(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    height: f32,
) {
    let picture = scene.material(Material {
        glow: 0.5,
        ..patterned(
            Pattern::Picture,
            [
                hsv(rng.random(), 0.6, 0.7),
                hsv(rng.random(), 0.7, 0.9),
                V3::splat(0.8),
            ],
            0.45,
            0.3,
            rng.random(),
        )
    });
    scene.add(
        wall.block(
            v3(u - 0.26, 0.10, height + 0.10),
            v3(u + 0.26, 0.125, height + 0.42),
        ),
        style.metal,
    );
    scene.add(
        wall.block(
            v3(u - 0.245, 0.12, height + 0.115),
            v3(u + 0.245, 0.128, height + 0.405),
        ),
        picture,
    );
    scene.add(
        wall.block(
            v3(u - 0.03, 0.08, height),
            v3(u + 0.03, 0.12, height + 0.12),
        ),
        style.metal,
    );
    scene.landmarks.push(wall.at(u, 0.13, height + 0.26).into());
}
