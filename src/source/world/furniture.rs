//! Furniture: desks, sideboards, shelves, sofas, low tables, plants, lamps, toys on the floor; doors, windows and pictures.
//!
//! Everything is built in wall coordinates: `u` along the wall, `v` into the room, `z` up.

use super::object;
use super::primitive::Shape;
use super::room::{Style, Wall};
use super::scene::{Rect, Scene, Spot, hsv, patterned};
use super::texture::{Material, Pattern};
use super::vector::{V3, v3};
use crate::random::StreamRng;
use nalgebra::{Point2, Point3};
use rand::RngExt;

/// Places something random at `u`; returns its width and the height above which the wall is free.
pub fn random(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    room_left: f32,
) -> (f32, f32) {
    let needs_spot = scene.spots.is_empty();
    let width =
        |rng: &mut StreamRng, low: f32, high: f32| rng.random_range(low..high).min(room_left);
    let pick = rng.random_range(0..100);
    if room_left < 0.7 || (pick < 8 && !needs_spot) {
        return if rng.random_bool(0.5) {
            plant(scene, rng, wall, u)
        } else {
            floor_lamp(scene, wall, style, u)
        };
    }
    if pick < 34 || needs_spot {
        let w = width(rng, 1.0, 1.6);
        table(scene, rng, wall, style, u, w, false)
    } else if pick < 54 {
        let w = width(rng, 0.9, 1.5);
        sideboard(scene, rng, wall, style, u, w)
    } else if pick < 74 {
        let w = width(rng, 0.7, 1.1);
        shelf(scene, rng, wall, style, u, w)
    } else if pick < 83 && room_left > 1.7 {
        sofa(scene, rng, wall, style, u)
    } else if pick < 92 {
        let w = width(rng, 0.8, 1.1);
        table(scene, rng, wall, style, u, w, true)
    } else {
        let w = width(rng, 0.8, 1.1);
        toys(scene, rng, wall, u, w)
    }
}

fn obstacle(scene: &mut Scene, wall: &Wall, u0: f32, u1: f32, v1: f32) {
    let (a, b) = (wall.at(u0, 0.0, 0.0), wall.at(u1, v1, 0.0));
    let point = |x: f32, y: f32| Point2::new(f64::from(x), f64::from(y));
    scene.obstacles.push(Rect {
        low: point(a.x.min(b.x), a.y.min(b.y)),
        high: point(a.x.max(b.x), a.y.max(b.y)),
    });
}

/// Somewhere to stand in front of `u`, with the objects of `us` in reach.
fn spot(scene: &mut Scene, wall: &Wall, u: f32, v: f32, objects: Vec<usize>) {
    let p = wall.at(u, v, 0.0);
    let stand = Point2::new(f64::from(p.x), f64::from(p.y));
    let heading = f64::from((-wall.inward.y).atan2(-wall.inward.x));
    scene.spots.push(Spot {
        stand,
        heading,
        objects,
    });
}

/// Objects on a surface at `height`, near its front edge, and a spot before each pair of them.
fn stock(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    u: [f32; 2],
    front: f32,
    depth: f32,
    height: f32,
) {
    let count = ((u[1] - u[0]) / 0.3).floor().clamp(1.0, 4.0) as usize;
    let step = (u[1] - u[0]) / count as f32;
    let mut indices = Vec::new();
    for i in 0..count {
        let at = u[0] + step * (i as f32 + rng.random_range(0.3..0.7));
        let v = front - rng.random_range(0.08..depth.min(0.24));
        let foot = wall.at(at, v, height);
        indices.push((at, object::place(scene, rng, &foot.into())));
    }
    for pair in indices.chunks(2) {
        let middle = pair.iter().map(|p| p.0).sum::<f32>() / pair.len() as f32;
        let objects = pair.iter().map(|p| p.1).collect();
        let stand = middle + rng.random_range(-0.12..0.12);
        let lowest = wall.from.max(0.35);
        let stand = stand.clamp(lowest, (wall.to.min(wall.length - 0.35)).max(lowest));
        spot(
            scene,
            wall,
            stand,
            front + rng.random_range(0.22..0.34),
            objects,
        );
    }
}

fn table(
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
fn computer(
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

fn sideboard(
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

fn shelf(
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

fn books(
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

fn sofa(scene: &mut Scene, rng: &mut StreamRng, wall: &Wall, style: &Style, u: f32) -> (f32, f32) {
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

fn plant(scene: &mut Scene, rng: &mut StreamRng, wall: &Wall, u: f32) -> (f32, f32) {
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

fn floor_lamp(scene: &mut Scene, wall: &Wall, style: &Style, u: f32) -> (f32, f32) {
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
fn toys(scene: &mut Scene, rng: &mut StreamRng, wall: &Wall, u: f32, w: f32) -> (f32, f32) {
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
