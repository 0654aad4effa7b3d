//! Furnished rooms: a size, a style, furniture along the walls, the middle left free to walk.

use super::furniture;
use super::primitive::Shape;
use super::scene::{Scene, Spot, hsv, patterned};
use super::texture::{Material, Pattern};
use super::vector::{V3, v3};
use super::wall::{Style, Wall};
use crate::random::StreamRng;
use nalgebra::Point2;
use rand::RngExt;

/// A random room in which one can stand somewhere and reach for something.
pub fn build(rng: &mut StreamRng) -> Scene {
    let mut scene = attempt(rng);
    for _ in 0..20 {
        // Furniture of the next wall may stand where one would have stood.
        let obstructed = scene.clone();
        scene
            .spots
            .retain(|spot| obstructed.is_free(&spot.stand, &spot.stand, 0.08));
        if !scene.spots.is_empty() {
            return scene;
        }
        scene = attempt(rng);
    }
    // In an unusable room nothing is in the way: the furniture stays to be looked at, and one walks through it.
    scene.obstacles.clear();
    scene.spots.truncate(0);
    scene.spots.push(Spot {
        stand: Point2::new(f64::from(scene.size.x) / 2.0, f64::from(scene.size.y) / 2.0),
        heading: 0.0,
        objects: Vec::new(),
    });
    scene
}

fn attempt(rng: &mut StreamRng) -> Scene {
    let size = v3(
        rng.random_range(3.9..6.2),
        rng.random_range(3.9..6.2),
        rng.random_range(2.35..2.9),
    );
    let hue = rng.random::<f32>();
    let night = rng.random_bool(0.25);
    let mut scene = Scene {
        size,
        walls: surfaces(rng, hue),
        materials: Vec::new(),
        primitives: Vec::new(),
        objects: Vec::new(),
        spots: Vec::new(),
        landmarks: Vec::new(),
        obstacles: Vec::new(),
        lamp: v3(
            size.x * rng.random_range(0.35..0.65),
            size.y * rng.random_range(0.35..0.65),
            size.z - 0.32,
        ),
        lamp_colour: hsv(0.1, rng.random_range(0.05..0.3), 1.0) * rng.random_range(1.0..1.4),
        ambient: if night {
            v3(0.20, 0.21, 0.27)
        } else {
            v3(0.36, 0.37, 0.39)
        },
    };
    let style = style(&mut scene, rng, hue);
    let walls = walls(size);
    let door = rng.random_range(0..4);
    for (i, wall) in walls.iter().enumerate() {
        skirting(&mut scene, wall, &style);
        furnish(&mut scene, rng, wall, &style, i == door);
    }
    rug(&mut scene, rng, hue);
    lamp(&mut scene);
    scene
}

fn walls(size: V3) -> [Wall; 4] {
    let wall = |origin, along, inward, length, corner: f32| Wall {
        origin,
        along,
        inward,
        length,
        from: corner,
        to: length - corner,
    };
    [
        wall(V3::ZERO, V3::X, V3::Y, size.x, 0.05),
        wall(v3(size.x, 0.0, 0.0), V3::Y, -V3::X, size.y, 1.0),
        wall(v3(size.x, size.y, 0.0), -V3::X, -V3::Y, size.x, 0.05),
        wall(v3(0.0, size.y, 0.0), -V3::Y, V3::X, size.y, 1.0),
    ]
}

fn surfaces(rng: &mut StreamRng, hue: f32) -> [Material; 6] {
    let seed = rng.random::<u32>();
    let light = |rng: &mut StreamRng, s: f32| {
        hsv(
            hue + rng.random_range(-0.06..0.06),
            s,
            rng.random_range(0.75..0.95),
        )
    };
    let dark = V3::splat(0.05);
    let wood_hue = rng.random_range(0.05..0.10);
    let floor = match rng.random_range(0..4) {
        0 | 1 => {
            let value = rng.random_range(0.45..0.8);
            let colours = [
                hsv(wood_hue, 0.5, value),
                hsv(wood_hue, 0.55, value * 0.8),
                hsv(wood_hue, 0.6, 0.2),
            ];
            patterned(
                Pattern::Planks,
                colours,
                rng.random_range(0.11..0.18),
                0.25,
                seed,
            )
        }
        2 => {
            let other = hsv(hue + 0.5, 0.25, rng.random_range(0.35..0.7));
            patterned(
                Pattern::Tiles,
                [light(rng, 0.1), other, dark],
                rng.random_range(0.28..0.5),
                0.5,
                seed,
            )
        }
        _ => {
            let value = rng.random_range(0.45..0.75);
            let colours = [hsv(hue, 0.35, value), hsv(hue, 0.4, value * 0.7), dark];
            patterned(Pattern::Carpet, colours, 0.22, 0.0, seed)
        }
    };
    let ceiling = Material::plain(V3::splat(0.8));
    let saturation = rng.random_range(0.05..0.35);
    let main = light(rng, saturation);
    let wall = |rng: &mut StreamRng| match rng.random_range(0..5) {
        0 => {
            let colours = [main, main * 0.8, hsv(hue + 0.3, 0.4, 0.8)];
            patterned(
                Pattern::Wallpaper,
                colours,
                rng.random_range(0.25..0.45),
                0.0,
                seed,
            )
        }
        1 => {
            let colours = [hsv(0.03, 0.55, 0.6), hsv(0.05, 0.5, 0.45), V3::splat(0.5)];
            patterned(Pattern::Bricks, colours, 0.24, 0.0, seed)
        }
        2 => patterned(Pattern::Carpet, [main, main * 0.9, dark], 0.6, 0.0, seed),
        _ => Material::plain(main),
    };
    [floor, ceiling, wall(rng), wall(rng), wall(rng), wall(rng)]
}

fn style(scene: &mut Scene, rng: &mut StreamRng, hue: f32) -> Style {
    let seed = rng.random::<u32>();
    let wood_value = rng.random_range(0.35..0.8);
    let wood_hue = rng.random_range(0.05..0.1);
    let wood = patterned(
        Pattern::Wood,
        [
            hsv(wood_hue, 0.55, wood_value),
            hsv(wood_hue, 0.6, wood_value * 0.75),
            V3::ZERO,
        ],
        0.16,
        0.2,
        seed,
    );
    let cloth_hue = hue + rng.random_range(0.2..0.8);
    let cloth = patterned(
        Pattern::Fabric,
        [
            hsv(cloth_hue, 0.5, 0.7),
            hsv(cloth_hue, 0.55, 0.5),
            V3::ZERO,
        ],
        0.1,
        0.0,
        seed,
    );
    let accent = patterned(
        Pattern::Stripes,
        [
            hsv(hue + 0.5, 0.7, 0.85),
            V3::splat(0.8),
            hsv(hue + 0.1, 0.6, 0.6),
        ],
        0.09,
        0.0,
        seed,
    );
    Style {
        wood: scene.material(wood),
        paint: scene.material(Material {
            gloss: 0.2,
            ..Material::plain(hsv(
                hue + 0.05,
                rng.random_range(0.0..0.3),
                rng.random_range(0.6..0.95),
            ))
        }),
        cloth: scene.material(cloth),
        accent: scene.material(accent),
        metal: scene.material(Material {
            gloss: 0.9,
            ..Material::plain(V3::splat(0.12))
        }),
    }
}

fn skirting(scene: &mut Scene, wall: &Wall, style: &Style) {
    let shape = wall.block(v3(0.0, 0.0, 0.0), v3(wall.length, 0.015, 0.08));
    scene.add(shape, style.paint);
}

/// Places furniture along one wall and hangs something over what is low.
fn furnish(scene: &mut Scene, rng: &mut StreamRng, wall: &Wall, style: &Style, has_door: bool) {
    let mut u = wall.from + rng.random_range(0.0..0.4);
    let mut door_due = has_door;
    while u < wall.to - 0.4 {
        let room_left = wall.to - u;
        let (width, top) = if door_due && room_left > 1.0 {
            door_due = false;
            furniture::door(scene, wall, style, u + 0.1);
            (1.1, f32::INFINITY)
        } else {
            furniture::random(scene, rng, wall, style, u, room_left)
        };
        if top < 1.25 {
            furniture::hang(scene, rng, wall, style, u, width, top);
        }
        u += width + rng.random_range(0.08..0.5);
    }
}

fn rug(scene: &mut Scene, rng: &mut StreamRng, hue: f32) {
    if rng.random_bool(0.35) {
        return;
    }
    let (w, d) = (rng.random_range(0.7..1.1f32), rng.random_range(0.6..1.0f32));
    let colours = [
        hsv(hue + 0.55, 0.6, rng.random_range(0.4..0.8)),
        hsv(hue + 0.65, 0.5, 0.8),
        hsv(hue + 0.1, 0.5, 0.35),
    ];
    let material = scene.material(patterned(Pattern::Rug, colours, 0.22, 0.0, 0));
    let centre = v3(scene.size.x / 2.0, scene.size.y / 2.0, 0.003);
    let angle = rng.random_range(-0.3..0.3f32);
    let (s, c) = angle.sin_cos();
    let axes = [v3(c, s, 0.0), v3(-s, c, 0.0), V3::Z];
    let half = v3(w, d, 0.003);
    scene.add(Shape::Block { centre, half, axes }, material);
}

fn lamp(scene: &mut Scene) {
    let glow = scene.material(Material {
        glow: 1.2,
        ..Material::plain(scene.lamp_colour * 0.8)
    });
    let cord = scene.material(Material::plain(V3::splat(0.05)));
    let mut shade = super::primitive::Primitive::new(
        Shape::Sphere {
            centre: scene.lamp,
            radius: 0.13,
        },
        glow,
    );
    shade.casts = false;
    scene.primitives.push(shade);
    let mut wire = super::primitive::Primitive::new(
        Shape::Limb {
            a: scene.lamp + V3::Z * 0.12,
            b: v3(scene.lamp.x, scene.lamp.y, scene.size.z),
            radius_a: 0.008,
            radius_b: 0.008,
        },
        cord,
    );
    wire.casts = false;
    scene.primitives.push(wire);
    scene.landmarks.push(scene.lamp.into());
}

/// A point in the free middle of the room.
pub fn free_point(scene: &Scene, rng: &mut StreamRng) -> Point2<f64> {
    let (w, d) = (f64::from(scene.size.x), f64::from(scene.size.y));
    let mut best = Point2::new(w / 2.0, d / 2.0);
    for _ in 0..20 {
        let p = Point2::new(
            w * rng.random_range(0.25..0.75),
            d * rng.random_range(0.25..0.75),
        );
        if scene.is_free(&p, &p, 0.3) {
            best = p;
            break;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rooms_are_furnished_and_leave_room_to_stand() {
        for sample in 0..40 {
            let scene = build(&mut crate::random::stream(5, "test.room", 0, sample));
            assert!(scene.primitives.len() > 20, "{}", scene.primitives.len());
            assert!(!scene.spots.is_empty(), "{sample}");
            assert!(
                scene.spots.iter().any(|s| !s.objects.is_empty()),
                "{sample}"
            );
            for spot in &scene.spots {
                assert!(
                    scene.is_free(&spot.stand, &spot.stand, 0.05),
                    "{sample} {spot:?}"
                );
            }
            for primitive in &scene.primitives {
                let (centre, radius) = primitive.shape.bound();
                assert!(centre.x > -0.1 && centre.x < scene.size.x + 0.1 && radius < 8.0);
                assert!((primitive.material as usize) < scene.materials.len());
            }
        }
    }
}
