//! Sideboards, shelves and books.

use super::{obstacle, stock};
use crate::random::StreamRng;
use crate::world::primitive::Shape;
use crate::world::scene::{Scene, hsv, patterned};
use crate::world::texture::Pattern;
use crate::world::vector::v3;
use crate::world::wall::{Style, Wall};
use rand::RngExt;

pub(super) fn sideboard(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    w: f32,
) -> (f32, f32) {
    let depth = rng.random_range(0.38..0.5);
    let height = rng.random_range(0.78..0.95);
    let body = if rng.random_bool(0.5) {
        style.wood
    } else {
        style.paint
    };
    scene.add(
        wall.block(v3(u, 0.0, 0.08), v3(u + w, depth - 0.02, height - 0.03)),
        body,
    );
    scene.add(
        wall.block(
            v3(u - 0.01, 0.0, height - 0.03),
            v3(u + w + 0.01, depth, height),
        ),
        style.wood,
    );
    let doors = (w / 0.45).floor().max(1.0) as usize;
    for i in 0..doors {
        let step = w / doors as f32;
        let x = u + step * i as f32;
        scene.add(
            wall.block(
                v3(x + 0.015, depth - 0.03, 0.11),
                v3(x + step - 0.015, depth - 0.005, height - 0.05),
            ),
            body,
        );
        let knob = Shape::Sphere {
            centre: wall.at(
                x + step * if i % 2 == 0 { 0.88 } else { 0.12 },
                depth,
                height * 0.6,
            ),
            radius: 0.016,
        };
        scene.add(knob, style.metal);
    }
    obstacle(scene, wall, u, u + w, depth);
    stock(
        scene,
        rng,
        wall,
        [u + 0.06, u + w - 0.06],
        depth,
        depth - 0.15,
        height,
    );
    (w, height)
}

pub(super) fn shelf(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    w: f32,
) -> (f32, f32) {
    let depth = rng.random_range(0.28..0.34);
    let height = rng.random_range(1.55..2.05f32);
    for side in [u, u + w - 0.025] {
        scene.add(
            wall.block(v3(side, 0.0, 0.0), v3(side + 0.025, depth, height)),
            style.wood,
        );
    }
    let shelves = (height / 0.37).floor() as usize;
    let spacing = (height - 0.1) / shelves as f32;
    let open = rng.random_range(2..shelves.clamp(3, 4));
    for i in 0..=shelves {
        let z = 0.06 + spacing * i as f32;
        scene.add(
            wall.block(v3(u, 0.0, z), v3(u + w, depth, z + 0.022)),
            style.wood,
        );
        if i == shelves {
            break;
        }
        if i == open {
            stock(
                scene,
                rng,
                wall,
                [u + 0.08, u + w - 0.08],
                depth,
                0.2,
                z + 0.022,
            );
        } else {
            books(
                scene,
                rng,
                wall,
                [u + 0.03, u + w - 0.03],
                depth,
                z + 0.022,
                spacing,
            );
        }
    }
    obstacle(scene, wall, u, u + w, depth);
    let row = wall.at(u + w / 2.0, depth, 0.06 + spacing * (shelves as f32 - 0.5));
    scene.landmarks.push(row.into());
    (w, height)
}

pub(super) fn books(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    u: [f32; 2],
    depth: f32,
    z: f32,
    spacing: f32,
) {
    let mut at = u[0];
    while at < u[1] - 0.1 {
        let run = rng.random_range(0.1..0.3f32).min(u[1] - at);
        let colours = [
            hsv(
                rng.random(),
                rng.random_range(0.3..0.8),
                rng.random_range(0.3..0.8),
            ),
            hsv(
                rng.random(),
                rng.random_range(0.3..0.8),
                rng.random_range(0.3..0.8),
            ),
            hsv(rng.random(), 0.4, 0.7),
        ];
        let material = patterned(
            Pattern::Stripes,
            colours,
            rng.random_range(0.05..0.11),
            0.1,
            0,
        );
        let material = scene.material(material);
        let top = z + (spacing - 0.05) * rng.random_range(0.6..0.95);
        let front = depth - rng.random_range(0.02..0.08);
        scene.add(
            wall.block(v3(at, 0.03, z), v3(at + run - 0.005, front, top)),
            material,
        );
        at += run + if rng.random_bool(0.2) { 0.1 } else { 0.0 };
    }
}
