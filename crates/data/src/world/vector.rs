//! Three `f32` numbers: the ray caster's own vector, small enough to stay in registers.

use nalgebra::{Point3, Vector3};
use std::ops::{Add, AddAssign, Mul, Neg, Sub};

/// A point, direction or colour.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct V3 {
    /// Along x, or red.
    pub x: f32,
    /// Along y, or green.
    pub y: f32,
    /// Along z, or blue.
    pub z: f32,
}

/// A [`V3`] from its components.
pub const fn v3(x: f32, y: f32, z: f32) -> V3 {
    V3 { x, y, z }
}

impl V3 {
    /// The origin, or black.
    pub const ZERO: Self = v3(0.0, 0.0, 0.0);
    /// Of unit length along x.
    pub const X: Self = v3(1.0, 0.0, 0.0);
    /// Of unit length along y.
    pub const Y: Self = v3(0.0, 1.0, 0.0);
    /// Of unit length along z.
    pub const Z: Self = v3(0.0, 0.0, 1.0);

    /// Three equal components.
    pub const fn splat(v: f32) -> Self {
        v3(v, v, v)
    }
    /// The dot product.
    #[inline]
    pub fn dot(self, o: Self) -> f32 {
        self.x * o.x + self.y * o.y + self.z * o.z
    }
    /// The cross product, by the right-hand rule.
    #[inline]
    #[must_use]
    pub fn cross(self, o: Self) -> Self {
        v3(
            self.y * o.z - self.z * o.y,
            self.z * o.x - self.x * o.z,
            self.x * o.y - self.y * o.x,
        )
    }
    /// The Euclidean length.
    #[inline]
    pub fn norm(self) -> f32 {
        self.dot(self).sqrt()
    }
    /// The same direction at unit length; zero stays zero.
    #[inline]
    #[must_use]
    pub fn normalized(self) -> Self {
        self * (1.0 / self.norm().max(1e-12))
    }
    /// From `self` at 0 to `o` at 1, linearly; `t` may lie outside.
    #[inline]
    #[must_use]
    pub fn lerp(self, o: Self, t: f32) -> Self {
        self + (o - self) * t
    }
    /// Component by component, as light times albedo.
    #[inline]
    #[must_use]
    pub fn scaled(self, o: Self) -> Self {
        v3(self.x * o.x, self.y * o.y, self.z * o.z)
    }
    /// The magnitude of each component.
    #[inline]
    #[must_use]
    pub fn abs(self) -> Self {
        v3(self.x.abs(), self.y.abs(), self.z.abs())
    }
}

impl Add for V3 {
    type Output = Self;
    #[inline]
    fn add(self, o: Self) -> Self {
        v3(self.x + o.x, self.y + o.y, self.z + o.z)
    }
}
impl AddAssign for V3 {
    #[inline]
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}
impl Sub for V3 {
    type Output = Self;
    #[inline]
    fn sub(self, o: Self) -> Self {
        v3(self.x - o.x, self.y - o.y, self.z - o.z)
    }
}
impl Mul<f32> for V3 {
    type Output = Self;
    #[inline]
    fn mul(self, s: f32) -> Self {
        v3(self.x * s, self.y * s, self.z * s)
    }
}
impl Neg for V3 {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        v3(-self.x, -self.y, -self.z)
    }
}
impl From<Vector3<f64>> for V3 {
    fn from(v: Vector3<f64>) -> Self {
        v3(v.x as f32, v.y as f32, v.z as f32)
    }
}
impl From<Point3<f64>> for V3 {
    fn from(p: Point3<f64>) -> Self {
        p.coords.into()
    }
}
impl From<V3> for Point3<f64> {
    fn from(v: V3) -> Self {
        Self::new(v.x.into(), v.y.into(), v.z.into())
    }
}
