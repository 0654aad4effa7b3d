//! Things to pick up: mugs, balls, boxes, bottles, ducks, blocks, fruit. Bright, because eyes go to them.

use super::primitive::{Primitive, Shape};
use super::scene::{Object, Scene, hsv, patterned};
use super::texture::{Material, Pattern};
use super::vector::{V3, v3};
use crate::random::StreamRng;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;

/// Adds a random object that stands on `foot` (its lowest point) and gives its number.
pub fn place(scene: &mut Scene, rng: &mut StreamRng, foot: &Point3<f64>) -> usize {
    let hue = rng.random::<f32>();
    let seed = rng.random::<u32>();
    let bright = hsv(
        hue,
        rng.random_range(0.65..0.95),
        rng.random_range(0.75..0.98),
    );
    let accent = hsv(hue + 0.45, 0.7, 0.9);
    let white = V3::splat(0.85);
    let shiny = Material {
        gloss: 0.6,
        ..Material::plain(bright)
    };
    let first = scene.material(shiny);
    let second = scene.material(Material {
        gloss: 0.3,
        ..Material::plain(accent)
    });
    let pattern = [Pattern::Dots, Pattern::Stripes, Pattern::Checker][rng.random_range(0..3)];
    let third = scene.material(patterned(
        pattern,
        [bright, white, accent],
        0.035,
        0.3,
        seed,
    ));
    let can = |base: V3, height: f32, radius: f32, material| {
        Primitive::new(
            Shape::Can {
                base,
                axis: V3::Z,
                height,
                radius,
            },
            material,
        )
    };
    let ball = |centre: V3, radius: f32, material| {
        Primitive::new(Shape::Sphere { centre, radius }, material)
    };
    let kind = rng.random_range(0..7);
    let (primitives, radius, half_height, from_above) = match kind {
        // A mug with a handle.
        0 => {
            let (r, h) = (
                rng.random_range(0.034..0.042f32),
                rng.random_range(0.08..0.10f32),
            );
            let inside = scene.material(Material::plain(bright * 0.25));
            let handle = |a: V3, b: V3| {
                Primitive::new(
                    Shape::Limb {
                        a,
                        b,
                        radius_a: 0.006,
                        radius_b: 0.006,
                    },
                    first,
                )
            };
            let (top, low) = (v3(r, 0.0, h * 0.3), v3(r, 0.0, -h * 0.25));
            let (out_top, out_low) = (top + v3(0.024, 0.0, -0.004), low + v3(0.024, 0.0, 0.004));
            let parts = vec![
                can(v3(0.0, 0.0, -h / 2.0), h, r, third),
                can(v3(0.0, 0.0, h / 2.0 - 0.001), 0.002, r * 0.86, inside),
                handle(top, out_top),
                handle(out_top, out_low),
                handle(out_low, low),
            ];
            (parts, r, h / 2.0, false)
        }
        // A ball or an apple.
        1 => {
            let r = rng.random_range(0.03..0.05f32);
            (vec![ball(V3::ZERO, r, third)], r, r, true)
        }
        2 => {
            let r = rng.random_range(0.032..0.042f32);
            let stalk = Shape::Limb {
                a: v3(0.0, 0.0, r * 0.8),
                b: v3(0.008, 0.0, r * 1.25),
                radius_a: 0.003,
                radius_b: 0.003,
            };
            let fruit = scene.material(Material {
                gloss: 0.5,
                ..Material::plain(hsv(
                    [0.0, 0.03, 0.11, 0.25][rng.random_range(0..4)],
                    0.85,
                    0.9,
                ))
            });
            (
                vec![ball(V3::ZERO, r, fruit), Primitive::new(stalk, second)],
                r,
                r,
                true,
            )
        }
        // A box: tea, cereal, a toy block.
        3 => {
            let half = v3(
                rng.random_range(0.025..0.04),
                rng.random_range(0.02..0.035),
                rng.random_range(0.04..0.08),
            );
            let parts = vec![
                Primitive::new(Shape::block(V3::ZERO, half), first),
                Primitive::new(
                    Shape::block(
                        v3(0.0, 0.0, half.z * 0.3),
                        v3(half.x + 0.0008, half.y + 0.0008, half.z * 0.3),
                    ),
                    third,
                ),
            ];
            (parts, half.y, half.z, false)
        }
        // A bottle.
        4 => {
            let (r, h) = (
                rng.random_range(0.03..0.038f32),
                rng.random_range(0.18..0.24f32),
            );
            let parts = vec![
                can(v3(0.0, 0.0, -h / 2.0), h * 0.68, r, first),
                can(v3(0.0, 0.0, -h * 0.34), h * 0.3, r * 1.02, third),
                Primitive::new(
                    Shape::Limb {
                        a: v3(0.0, 0.0, h * 0.16),
                        b: v3(0.0, 0.0, h * 0.34),
                        radius_a: r * 0.96,
                        radius_b: r * 0.38,
                    },
                    first,
                ),
                can(v3(0.0, 0.0, h * 0.36), h * 0.14, r * 0.42, second),
            ];
            (parts, r, h / 2.0, false)
        }
        // A rubber duck.
        5 => {
            let yellow = scene.material(Material {
                gloss: 0.5,
                ..Material::plain(hsv(0.14, 0.9, 0.98))
            });
            let beak = scene.material(Material::plain(hsv(0.05, 0.95, 0.95)));
            let eye = scene.material(Material::plain(V3::splat(0.01)));
            let s = rng.random_range(0.9..1.2f32);
            let limb = |a: V3, b: V3, ra: f32, rb: f32, m| {
                Primitive::new(
                    Shape::Limb {
                        a: a * s,
                        b: b * s,
                        radius_a: ra * s,
                        radius_b: rb * s,
                    },
                    m,
                )
            };
            let parts = vec![
                limb(
                    v3(-0.02, 0.0, -0.012),
                    v3(0.018, 0.0, -0.014),
                    0.030,
                    0.032,
                    yellow,
                ),
                limb(
                    v3(-0.04, 0.0, 0.0),
                    v3(-0.058, 0.0, 0.018),
                    0.016,
                    0.006,
                    yellow,
                ),
                ball(v3(0.022, 0.0, 0.034) * s, 0.025 * s, yellow),
                limb(
                    v3(0.042, 0.0, 0.032),
                    v3(0.056, 0.0, 0.029),
                    0.010,
                    0.005,
                    beak,
                ),
                ball(v3(0.040, 0.013, 0.042) * s, 0.005 * s, eye),
                ball(v3(0.040, -0.013, 0.042) * s, 0.005 * s, eye),
            ];
            (parts, 0.032 * s, 0.046 * s, true)
        }
        // A pile of two toy blocks glued together.
        _ => {
            let r = rng.random_range(0.022..0.03f32);
            let parts = vec![
                Primitive::new(Shape::block(v3(0.0, 0.0, -r), V3::splat(r)), first),
                Primitive::new(
                    Shape::block(v3(0.004, -0.003, r * 0.9), V3::splat(r * 0.9)),
                    second,
                ),
            ];
            (parts, r, 2.0 * r, false)
        }
    };
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), rng.random_range(-3.1..3.1));
    let middle = foot + Vector3::new(0.0, 0.0, f64::from(half_height));
    scene.objects.push(Object {
        rest: Isometry3::from_parts(Translation3::from(middle.coords), turn),
        radius: f64::from(radius),
        from_above,
        primitives,
    });
    scene.objects.len() - 1
}
