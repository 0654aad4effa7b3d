//! A scene: primitives with materials, the light, the things that can be picked up, and where a person can stand.

use super::primitive::{Primitive, Shape};
use super::texture::{Material, Pattern};
use super::vector::{V3, v3};
use nalgebra::{Isometry3, Point2, Point3};

/// A furnished room and everything in it that does not move by itself.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Width, depth and height of the room, metres; a corner is the origin.
    pub size: V3,
    /// Floor, ceiling, then the walls at y = 0, x = width, y = depth, x = 0.
    pub walls: [Material; 6],
    /// What primitives look like; they name one by its index here.
    pub materials: Vec<Material>,
    /// Everything that does not move, the walls aside; metres, in the room's axes.
    pub primitives: Vec<Primitive>,
    /// What can be picked up; plans and spots name one by its index here.
    pub objects: Vec<Object>,
    /// Where a person can stand; at least one in a room that was built.
    pub spots: Vec<Spot>,
    /// Things worth a look: pictures, plants, lamps, windows.
    pub landmarks: Vec<Point3<f64>>,
    /// Footprints on the floor that nobody walks through.
    pub obstacles: Vec<Rect>,
    /// The ceiling lamp.
    pub lamp: V3,
    /// Linear light of the lamp by channel, about 1.
    pub lamp_colour: V3,
    /// Linear light that comes from everywhere, by channel; less at night.
    pub ambient: V3,
}

/// An upright rectangle on the floor, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rect {
    /// The corner with the smallest x and y.
    pub low: Point2<f64>,
    /// The corner with the largest x and y.
    pub high: Point2<f64>,
}

/// A place from which objects are in reach.
#[derive(Debug, Clone, PartialEq)]
pub struct Spot {
    /// Where the person stands on the floor, metres.
    pub stand: Point2<f64>,
    /// Radians; 0 looks along x.
    pub heading: f64,
    /// Indices of the objects in reach.
    pub objects: Vec<usize>,
}

/// Something that can be picked up. Its origin is its middle.
#[derive(Debug, Clone)]
pub struct Object {
    /// Where it stands or lies.
    pub rest: Isometry3<f64>,
    /// Of the part that is grasped, metres.
    pub radius: f64,
    /// Taken from above rather than from the side.
    pub from_above: bool,
    /// In object coordinates.
    pub primitives: Vec<Primitive>,
}

impl Scene {
    /// Adds a material and gives its number.
    pub fn material(&mut self, material: Material) -> u16 {
        self.materials.push(material);
        (self.materials.len() - 1) as u16
    }

    /// Adds a solid, shadow-throwing primitive.
    pub fn add(&mut self, shape: Shape, material: u16) {
        self.primitives.push(Primitive::new(shape, material));
    }

    /// Whether a person of `margin` metres around can go straight from `a` to `b`.
    pub fn is_free(&self, a: &Point2<f64>, b: &Point2<f64>, margin: f64) -> bool {
        let steps = ((b - a).norm() / 0.05).ceil().max(1.0) as usize;
        (0..=steps).all(|i| {
            let p = a + (b - a) * (i as f64 / steps as f64);
            let inside = |low: f64, high: f64, v: f64| v > low - margin && v < high + margin;
            let in_room = (margin..f64::from(self.size.x) - margin).contains(&p.x)
                && (margin..f64::from(self.size.y) - margin).contains(&p.y);
            in_room
                && !self
                    .obstacles
                    .iter()
                    .any(|o| inside(o.low.x, o.high.x, p.x) && inside(o.low.y, o.high.y, p.y))
        })
    }
}

impl Primitive {
    /// Solid, visible and shadow-throwing.
    pub fn new(shape: Shape, material: u16) -> Self {
        Self {
            shape,
            material,
            visible: true,
            casts: true,
        }
    }

    /// The same primitive moved by a rigid transform.
    pub fn moved(&self, T: &Isometry3<f64>) -> Self {
        let r = T.rotation.to_rotation_matrix();
        let m = r.matrix().map(|v| v as f32);
        let t = V3::from(T.translation.vector);
        let turn = |v: V3| {
            v3(
                m[(0, 0)] * v.x + m[(0, 1)] * v.y + m[(0, 2)] * v.z,
                m[(1, 0)] * v.x + m[(1, 1)] * v.y + m[(1, 2)] * v.z,
                m[(2, 0)] * v.x + m[(2, 1)] * v.y + m[(2, 2)] * v.z,
            )
        };
        let place = |v: V3| turn(v) + t;
        let shape = match self.shape {
            Shape::Sphere { centre, radius } => Shape::Sphere {
                centre: place(centre),
                radius,
            },
            Shape::Block { centre, half, axes } => Shape::Block {
                centre: place(centre),
                half,
                axes: axes.map(turn),
            },
            Shape::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => Shape::Limb {
                a: place(a),
                b: place(b),
                radius_a,
                radius_b,
            },
            Shape::Can {
                base,
                axis,
                height,
                radius,
            } => Shape::Can {
                base: place(base),
                axis: turn(axis),
                height,
                radius,
            },
        };
        Self { shape, ..*self }
    }
}

/// A colour from hue (turns), saturation and value, in linear light.
pub fn hsv(hue: f32, saturation: f32, value: f32) -> V3 {
    let channel = |shift: f32| {
        let k = (hue + shift).rem_euclid(1.0) * 6.0;
        let ramp = (k - 3.0).abs() - 1.0;
        let srgb = value * (1.0 - saturation * (1.0 - ramp.clamp(0.0, 1.0)));
        srgb.powf(2.2)
    };
    v3(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0))
}

/// A patterned material of two or three colours.
pub fn patterned(
    pattern: Pattern,
    colours: [V3; 3],
    scale: f32,
    gloss: f32,
    seed: u32,
) -> Material {
    Material {
        pattern,
        colours,
        scale,
        gloss,
        glow: 0.0,
        seed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hues_are_where_they_belong() {
        assert!(hsv(0.0, 1.0, 1.0).x > 0.99 && hsv(0.0, 1.0, 1.0).y < 0.01);
        assert!(hsv(1.0 / 3.0, 1.0, 1.0).y > 0.99 && hsv(1.0 / 3.0, 1.0, 1.0).z < 0.01);
        assert!(hsv(2.0 / 3.0, 1.0, 1.0).z > 0.99);
        assert_eq!(hsv(0.4, 0.0, 1.0), V3::splat(1.0));
    }
}
