//! What belongs to the wall: doors and pictures.

use crate::random::StreamRng;
use crate::world::primitive::Shape;
use crate::world::scene::{Scene, hsv, patterned};
use crate::world::texture::{Material, Pattern};
use crate::world::vector::{V3, v3};
use crate::world::wall::{Style, Wall};
use nalgebra::Point3;
use rand::RngExt;

/// A door with a frame and a handle.
pub fn door(scene: &mut Scene, wall: &Wall, style: &Style, u: f32) {
    scene.add(
        wall.block(v3(u - 0.06, 0.0, 0.0), v3(u + 0.96, 0.02, 2.1)),
        style.wood,
    );
    scene.add(
        wall.block(v3(u, 0.0, 0.0), v3(u + 0.9, 0.035, 2.03)),
        style.paint,
    );
    for z in [0.3, 1.15] {
        scene.add(
            wall.block(v3(u + 0.12, 0.03, z), v3(u + 0.78, 0.042, z + 0.65)),
            style.paint,
        );
    }
    let handle = Shape::Limb {
        a: wall.at(u + 0.82, 0.07, 1.03),
        b: wall.at(u + 0.70, 0.07, 1.03),
        radius_a: 0.011,
        radius_b: 0.011,
    };
    scene.add(handle, style.metal);
    scene.landmarks.push(wall.at(u + 0.8, 0.07, 1.03).into());
}

/// A window or pictures on the wall above something low.
pub fn hang(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    w: f32,
    top: f32,
) {
    let base = top.max(0.85) + 0.28;
    let space = scene.size.z - 0.25 - base;
    if w < 0.5 || space < 0.4 {
        return;
    }
    if w > 0.9 && rng.random_bool(0.4) {
        let (h, half) = (space.min(1.1), (w * 0.42).min(0.7));
        let middle = u + w / 2.0;
        let outdoors = Material {
            glow: 0.75,
            ..patterned(
                Pattern::Outdoors,
                [
                    hsv(0.58, 0.55, 0.95),
                    hsv(0.3, 0.4, 0.55),
                    hsv(0.33, 0.6, 0.3),
                ],
                1.0,
                0.0,
                rng.random_range(0..1000),
            )
        };
        let glass = scene.material(outdoors);
        let (low, high) = (
            v3(middle - half, 0.0, base),
            v3(middle + half, 0.02, base + h),
        );
        scene.add(
            wall.block(low - v3(0.06, 0.0, 0.06), high + v3(0.06, 0.02, 0.06)),
            style.paint,
        );
        scene.add(
            wall.block(low + v3(0.0, 0.03, 0.0), high + v3(0.0, 0.022, 0.0)),
            glass,
        );
        let bar = |a: V3, b: V3| wall.block(a, b);
        scene.add(
            bar(
                v3(middle - 0.02, 0.03, base),
                v3(middle + 0.02, 0.055, base + h),
            ),
            style.paint,
        );
        scene.add(
            bar(
                v3(middle - half, 0.03, base + h * 0.6),
                v3(middle + half, 0.055, base + h * 0.6 + 0.03),
            ),
            style.paint,
        );
        scene
            .landmarks
            .push(wall.at(middle, 0.03, base + h / 2.0).into());
        return;
    }
    let count = if w > 1.1 { rng.random_range(1..3) } else { 1 };
    for i in 0..count {
        let half = v3(
            rng.random_range(0.15..0.28),
            0.0,
            rng.random_range(0.14..0.28f32).min(space / 2.0),
        );
        let at = u + w * (i as f32 + 0.5) / count as f32;
        let z = base + half.z + rng.random_range(0.0..0.15);
        let colours = [
            hsv(
                rng.random(),
                rng.random_range(0.1..0.6),
                rng.random_range(0.5..0.95),
            ),
            hsv(rng.random(), 0.75, 0.85),
            hsv(rng.random(), 0.7, 0.4),
        ];
        let art = scene.material(patterned(
            Pattern::Picture,
            colours,
            2.0 * half.z,
            0.1,
            rng.random(),
        ));
        let frame = if rng.random_bool(0.5) {
            style.wood
        } else {
            style.metal
        };
        let box_of = |grow: f32, v: f32| {
            wall.block(
                v3(at - half.x - grow, 0.0, z - half.z - grow),
                v3(at + half.x + grow, v, z + half.z + grow),
            )
        };
        scene.add(box_of(0.025, 0.022), frame);
        scene.add(box_of(0.0, 0.025), art);
        let point: Point3<f64> = wall.at(at, 0.03, z).into();
        scene.landmarks.push(point);
    }
}
