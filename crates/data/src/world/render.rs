//! The ray caster: colour and z-depth of a scene from the head camera, one ray per pixel and more at edges.

use super::bins::{Bins, Cube, View};
use super::primitive::{Hit, Primitive};
use super::scene::Scene;
use super::texture::Material;
use super::vector::{V3, v3};
use crate::clip::Intrinsics;
use nalgebra::{Isometry3, Vector3};

/// What a pixel belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The room and everything in it that does not move.
    Room,
    /// Something that can be picked up, held or not.
    Object,
    /// The left arm, from shoulder to finger tips.
    LeftArm,
    /// The right arm, from shoulder to finger tips.
    RightArm,
    /// The rest of the wearer.
    Body,
}

/// A moving primitive.
#[derive(Debug, Clone, Copy)]
pub struct Moving {
    /// Its shape, material and place in the world.
    pub primitive: Primitive,
    /// What its pixels belong to.
    pub part: Part,
}

/// One rendered image.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// `[H, W, 3]`, sRGB.
    pub rgb: Vec<u8>,
    /// `[H, W]`, metres along the optical axis through the pixel's centre.
    pub depth: Vec<f32>,
    /// `[H, W]`, what the pixel's centre shows.
    pub parts: Vec<Part>,
}

/// A scene prepared for rendering many frames.
pub struct Renderer<'a> {
    scene: &'a Scene,
    shadows: Cube,
    gamma: Vec<u8>,
}

/// What one ray found.
struct Sample {
    colour: V3,
    z: f32,
    /// Unique per surface.
    surface: u32,
    part: Part,
}

/// Tiles across the image, as far as they are not below two pixels: rays of a tile share candidates.
const TILES: u32 = 64;
const SHADOW_TILES: u32 = 24;
const GAMMA_STEPS: usize = 4096;

impl View {
    /// The view of a camera at `T_world_camera`.
    pub fn of_camera(T_world_camera: &Isometry3<f64>, k: &Intrinsics) -> Self {
        let axis = |v: Vector3<f64>| V3::from(T_world_camera.rotation * v);
        Self {
            eye: T_world_camera.translation.vector.into(),
            right: axis(Vector3::x()),
            down: axis(Vector3::y()),
            forward: axis(Vector3::z()),
            fx: k.fx as f32,
            fy: k.fy as f32,
            cx: k.cx as f32,
            cy: k.cy as f32,
            width: k.width,
            height: k.height,
        }
    }
}

struct Pass<'a> {
    renderer: &'a Renderer<'a>,
    view: View,
    moving: Vec<Primitive>,
    parts: Vec<Part>,
    fixed_bins: Bins,
    moving_bins: Bins,
    moving_shadows: Cube,
    pixel: f32,
}

impl<'a> Renderer<'a> {
    /// Prepares the shadows of everything that does not move.
    pub fn new(scene: &'a Scene) -> Self {
        let gamma = (0..=GAMMA_STEPS)
            .map(|i| {
                let linear = i as f32 / GAMMA_STEPS as f32;
                let srgb = if linear <= 0.003_130_8 {
                    12.92 * linear
                } else {
                    1.055 * linear.powf(1.0 / 2.4) - 0.055
                };
                (srgb * 255.0 + 0.5) as u8
            })
            .collect();
        Self {
            scene,
            shadows: Cube::new(scene.lamp, SHADOW_TILES, &scene.primitives),
            gamma,
        }
    }

    /// Renders what the camera sees.
    pub fn frame(
        &self,
        T_world_camera: &Isometry3<f64>,
        intrinsics: &Intrinsics,
        moving: &[Moving],
        antialias: bool,
    ) -> Frame {
        let view = View::of_camera(T_world_camera, intrinsics);
        let primitives: Vec<Primitive> = moving.iter().map(|m| m.primitive).collect();
        let tile = (view.width.max(view.height) / TILES).max(2);
        let pass = Pass {
            renderer: self,
            view,
            parts: moving.iter().map(|m| m.part).collect(),
            fixed_bins: Bins::new(&view, tile, &self.scene.primitives, |p| p.visible),
            moving_bins: Bins::new(&view, tile, &primitives, |p| p.visible),
            moving_shadows: Cube::new(self.scene.lamp, SHADOW_TILES, &primitives),
            moving: primitives,
            pixel: 1.0 / view.fx,
        };
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        let mut colours = vec![V3::ZERO; width * height];
        let mut depth = vec![0.0; width * height];
        let mut surfaces = vec![0u32; width * height];
        let mut parts = vec![Part::Room; width * height];
        for y in 0..height {
            for x in 0..width {
                let sample = pass.cast(x as f32, y as f32);
                let i = y * width + x;
                colours[i] = sample.colour;
                depth[i] = sample.z;
                surfaces[i] = sample.surface;
                parts[i] = sample.part;
            }
        }
        if antialias {
            pass.smooth_edges(width, height, &surfaces, &mut colours);
        }
        let mut rgb = Vec::with_capacity(width * height * 3);
        for c in &colours {
            rgb.extend([c.x, c.y, c.z].map(|v| self.display(v)));
        }
        Frame {
            width,
            height,
            rgb,
            depth,
            parts,
        }
    }

    /// Linear light to a display level: highlights are compressed, not clipped.
    fn display(&self, linear: f32) -> u8 {
        let toned = linear * (1.0 + linear * 0.16) / (1.0 + linear * 0.5);
        let step = (toned.clamp(0.0, 1.0) * GAMMA_STEPS as f32) as usize;
        self.gamma[step]
    }
}

impl Pass<'_> {
    /// Pixels on the outline of a surface get four rays more.
    fn smooth_edges(&self, width: usize, height: usize, surfaces: &[u32], colours: &mut [V3]) {
        for y in 0..height {
            for x in 0..width {
                let i = y * width + x;
                let own = surfaces[i];
                let differs = (x > 0 && surfaces[i - 1] != own)
                    || (x + 1 < width && surfaces[i + 1] != own)
                    || (y > 0 && surfaces[i - width] != own)
                    || (y + 1 < height && surfaces[i + width] != own);
                if differs {
                    let mut sum = colours[i];
                    for (dx, dy) in [
                        (-0.375, -0.125),
                        (0.125, -0.375),
                        (0.375, 0.125),
                        (-0.125, 0.375),
                    ] {
                        sum += self.cast(x as f32 + dx, y as f32 + dy).colour;
                    }
                    colours[i] = sum * 0.2;
                }
            }
        }
    }

    fn cast(&self, x: f32, y: f32) -> Sample {
        let view = &self.view;
        let scene = self.renderer.scene;
        let ray = view.forward
            + view.right * ((x - view.cx) / view.fx)
            + view.down * ((y - view.cy) / view.fy);
        let length = ray.norm();
        let ray = ray * (1.0 / length);
        let (mut t, wall) = leave_room(view.eye, ray, scene.size);
        let mut found: Option<(bool, u16)> = None;
        let (px, py) = ((x + 0.5).max(0.0), (y + 0.5).max(0.0));
        for (bins, primitives, moves) in [
            (&self.moving_bins, self.moving.as_slice(), true),
            (&self.fixed_bins, scene.primitives.as_slice(), false),
        ] {
            for (near, i) in bins.at(px, py) {
                if *near > t {
                    break;
                }
                if let Some(hit) = primitives[*i as usize].shape.enter(view.eye, ray, t) {
                    t = hit;
                    found = Some((moves, *i));
                }
            }
        }
        let point = view.eye + ray * t;
        let (hit, material, surface, part) = match found {
            None => (
                wall_surface(t, point, wall, scene.size),
                &scene.walls[wall],
                wall as u32,
                Part::Room,
            ),
            Some((moves, i)) => {
                let primitive = if moves {
                    &self.moving[i as usize]
                } else {
                    &scene.primitives[i as usize]
                };
                let hit = primitive.shape.surface(t, point);
                // The faces of a box are surfaces of their own.
                let face =
                    (hit.normal.x * 2.6 + 3.0) as u32 + 8 * (hit.normal.y * 2.6 + 3.0) as u32;
                let is_block = matches!(primitive.shape, super::primitive::Shape::Block { .. });
                let surface = 8
                    + u32::from(i) * 128
                    + if is_block { face } else { 0 }
                    + (u32::from(moves) << 24);
                let part = if moves {
                    self.parts[i as usize]
                } else {
                    Part::Room
                };
                (
                    hit,
                    &scene.materials[primitive.material as usize],
                    surface,
                    part,
                )
            }
        };
        let colour = self.shade(&hit, material, point, ray);
        Sample {
            colour,
            z: t / length,
            surface,
            part,
        }
    }

    fn shade(&self, hit: &Hit, material: &Material, point: V3, ray: V3) -> V3 {
        let scene = self.renderer.scene;
        let slant = (-hit.normal.dot(ray)).max(0.15);
        let albedo = material.colour(hit.texture, hit.t * self.pixel / slant);
        let to_lamp = scene.lamp - point;
        let distance = to_lamp.norm();
        let to_lamp = to_lamp * (1.0 / distance);
        let facing = hit.normal.dot(to_lamp);
        let mut light = scene.ambient * (0.75 + 0.25 * hit.normal.z) * occlusion(point, scene.size);
        let mut shine = 0.0;
        if facing > 0.0 {
            let limit = distance - 0.012;
            let dark = self
                .renderer
                .shadows
                .blocks(&scene.primitives, -to_lamp, limit)
                || self.moving_shadows.blocks(&self.moving, -to_lamp, limit);
            if !dark {
                light += scene.lamp_colour * (facing * 1.9 / (1.0 + 0.28 * distance * distance));
                if material.gloss > 0.0 {
                    let half = (to_lamp - ray).normalized();
                    let aligned = half.dot(hit.normal).max(0.0);
                    let aligned = aligned * aligned;
                    let aligned = aligned * aligned * aligned * aligned;
                    shine = material.gloss * 0.6 * aligned * aligned * aligned * aligned;
                }
            }
        }
        albedo.scaled(light) + scene.lamp_colour * shine + albedo * material.glow
    }
}

/// Darker where walls meet.
fn occlusion(p: V3, size: V3) -> f32 {
    let along = |v: f32, size: f32| {
        let d = v.min(size - v).max(0.0);
        (d + 0.06) / (d + 0.16)
    };
    0.35 + 0.65 * along(p.x, size.x) * along(p.y, size.y) * along(p.z, size.z)
}

/// Where a ray from inside leaves the room, and through which wall.
#[inline]
fn leave_room(eye: V3, ray: V3, size: V3) -> (f32, usize) {
    let exit = |o: f32, d: f32, size: f32| {
        let d = if d.abs() < 1e-9 { 1e-9 } else { d };
        ((if d > 0.0 { size - o } else { -o }) / d, d > 0.0)
    };
    let ((tx, px), (ty, py), (tz, pz)) = (
        exit(eye.x, ray.x, size.x),
        exit(eye.y, ray.y, size.y),
        exit(eye.z, ray.z, size.z),
    );
    if tz <= tx && tz <= ty {
        (tz, usize::from(pz))
    } else if ty <= tx {
        (ty, if py { 4 } else { 2 })
    } else {
        (tx, if px { 3 } else { 5 })
    }
}

fn wall_surface(t: f32, p: V3, wall: usize, size: V3) -> Hit {
    let (normal, texture) = match wall {
        0 => (V3::Z, v3(p.x, p.y, 1.0)),
        1 => (-V3::Z, v3(p.x, p.y, 1.0)),
        2 => (V3::Y, v3(p.x, p.z, 1.0)),
        3 => (-V3::X, v3(p.y, p.z, 1.0)),
        4 => (-V3::Y, v3(size.x - p.x, p.z, 1.0)),
        _ => (V3::X, v3(size.y - p.y, p.z, 1.0)),
    };
    Hit { t, normal, texture }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_leave_through_the_wall_they_point_at() {
        let (eye, size) = (v3(1.0, 2.0, 1.5), v3(4.0, 5.0, 2.5));
        for (ray, t, wall) in [
            (V3::X, 3.0, 3),
            (-V3::X, 1.0, 5),
            (V3::Y, 3.0, 4),
            (-V3::Y, 2.0, 2),
            (V3::Z, 1.0, 1),
            (-V3::Z, 1.5, 0),
        ] {
            assert_eq!(leave_room(eye, ray, size), (t, wall));
            let normal = wall_surface(t, eye + ray * t, wall, size).normal;
            assert!(normal.dot(ray) < -0.99);
        }
    }
}
