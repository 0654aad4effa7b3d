//! What furniture stands at: a wall as a frame, and the colours of the room.

use super::primitive::Shape;
use super::vector::V3;

/// The colours and materials a room keeps to.
#[derive(Debug, Clone, Copy)]
pub struct Style {
    pub wood: u16,
    pub paint: u16,
    pub cloth: u16,
    pub accent: u16,
    pub metal: u16,
}

/// A wall as a frame: `u` along it, `v` into the room.
#[derive(Debug, Clone, Copy)]
pub struct Wall {
    pub origin: V3,
    pub along: V3,
    pub inward: V3,
    pub length: f32,
    /// The part of `u` that is free of the neighbouring walls' furniture.
    pub from: f32,
    pub to: f32,
}

impl Wall {
    /// A point in the room.
    pub fn at(&self, u: f32, v: f32, z: f32) -> V3 {
        self.origin + self.along * u + self.inward * v + V3::Z * z
    }

    /// A box between two corners in wall coordinates.
    pub fn block(&self, low: V3, high: V3) -> Shape {
        let middle = low.lerp(high, 0.5);
        let half = (high - low) * 0.5;
        Shape::Block {
            centre: self.at(middle.x, middle.y, middle.z),
            half,
            axes: [self.along, self.inward, V3::Z],
        }
    }
}
