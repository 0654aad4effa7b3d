//! The shapes everything in the world is made of, and where a ray meets them.

use super::vector::{V3, v3};

/// A solid shape. Directions are unit length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    Sphere {
        centre: V3,
        radius: f32,
    },
    /// A box with its own axes.
    Block {
        centre: V3,
        half: V3,
        axes: [V3; 3],
    },
    /// The hull of two spheres: limbs, fingers, legs of furniture.
    Limb {
        a: V3,
        b: V3,
        radius_a: f32,
        radius_b: f32,
    },
    /// An upright or tilted cylinder with flat ends.
    Can {
        base: V3,
        axis: V3,
        height: f32,
        radius: f32,
    },
}

/// A shape with its material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Primitive {
    pub shape: Shape,
    pub material: u16,
    /// Seen by the camera.
    pub visible: bool,
    /// Throws a shadow.
    pub casts: bool,
}

/// Where a ray meets a surface.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Along the (unit) ray, metres.
    pub t: f32,
    pub normal: V3,
    /// Texture coordinates, metres in the shape's own frame.
    pub texture: V3,
}

impl Shape {
    /// A box with axes along the world's.
    pub fn block(centre: V3, half: V3) -> Self {
        Self::Block {
            centre,
            half,
            axes: [V3::X, V3::Y, V3::Z],
        }
    }

    /// Centre and radius of a sphere around the shape.
    pub fn bound(&self) -> (V3, f32) {
        match *self {
            Self::Sphere { centre, radius } => (centre, radius),
            Self::Block { centre, half, .. } => (centre, half.norm()),
            Self::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => (
                a.lerp(b, 0.5),
                (b - a).norm() / 2.0 + radius_a.max(radius_b),
            ),
            Self::Can {
                base,
                axis,
                height,
                radius,
            } => (
                base + axis * (height / 2.0),
                (height * height / 4.0 + radius * radius).sqrt(),
            ),
        }
    }

    /// Spheres or points whose convex hull holds the shape; returns how many of the eight are used.
    pub fn hull(&self, out: &mut [(V3, f32); 8]) -> usize {
        match *self {
            Self::Sphere { centre, radius } => {
                out[0] = (centre, radius);
                1
            }
            Self::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => {
                out[0] = (a, radius_a);
                out[1] = (b, radius_b);
                2
            }
            Self::Can {
                base,
                axis,
                height,
                radius,
            } => {
                out[0] = (base, radius);
                out[1] = (base + axis * height, radius);
                2
            }
            Self::Block { centre, half, axes } => {
                for (i, corner) in out.iter_mut().enumerate() {
                    let sign = |bit: usize| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
                    let offset = axes[0] * (half.x * sign(0))
                        + axes[1] * (half.y * sign(1))
                        + axes[2] * (half.z * sign(2));
                    *corner = (centre + offset, 0.0);
                }
                8
            }
        }
    }

    /// The nearest `t` in (0, `limit`) at which the unit ray enters the shape.
    #[inline]
    pub fn enter(&self, origin: V3, ray: V3, limit: f32) -> Option<f32> {
        let t = match *self {
            Self::Sphere { centre, radius } => sphere(origin - centre, ray, radius)?,
            Self::Block { centre, half, axes } => block(origin - centre, ray, half, &axes)?,
            Self::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => {
                // From a point near the shape: f32 keeps its digits for the small numbers.
                let shift = (a - origin).dot(ray);
                limb(origin + ray * shift, ray, a, b, radius_a, radius_b)? + shift
            }
            Self::Can {
                base,
                axis,
                height,
                radius,
            } => {
                let shift = (base - origin).dot(ray);
                can(origin + ray * shift - base, ray, axis, height, radius)? + shift
            }
        };
        (t > 1e-4 && t < limit).then_some(t)
    }

    /// The surface at a point found by [`Shape::enter`].
    pub fn surface(&self, t: f32, point: V3) -> Hit {
        match *self {
            Self::Sphere { centre, radius } => {
                let d = point - centre;
                Hit {
                    t,
                    normal: d * (1.0 / radius),
                    texture: d,
                }
            }
            Self::Block { centre, half, axes } => {
                let d = point - centre;
                let local = v3(d.dot(axes[0]), d.dot(axes[1]), d.dot(axes[2]));
                let depth = half - local.abs();
                // The third texture coordinate is the distance from the edge of the face.
                let (axis, sign, texture) = if depth.x <= depth.y && depth.x <= depth.z {
                    let edge = depth.y.min(depth.z);
                    (axes[0], local.x, v3(local.y, local.z, edge))
                } else if depth.y <= depth.z {
                    let edge = depth.x.min(depth.z);
                    (axes[1], local.y, v3(local.x, local.z, edge))
                } else {
                    (axes[2], local.z, v3(local.x, local.y, depth.x.min(depth.y)))
                };
                Hit {
                    t,
                    normal: axis * sign.signum(),
                    texture,
                }
            }
            Self::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => {
                let ba = b - a;
                let length2 = ba.dot(ba).max(1e-12);
                let along = ((point - a).dot(ba) / length2).clamp(0.0, 1.0);
                // The axis point whose sphere touches the surface there lies further down the taper.
                let slope = (radius_a - radius_b) / length2.sqrt();
                let radial = (point - a - ba * along).norm();
                let centre = (along
                    - slope * radial / length2.sqrt() / (1.0 - slope * slope).max(0.1))
                .clamp(0.0, 1.0);
                Hit {
                    t,
                    normal: (point - a - ba * centre).normalized(),
                    texture: v3(along * length2.sqrt(), radial, along),
                }
            }
            Self::Can {
                base,
                axis,
                height,
                radius,
            } => {
                let d = point - base;
                let along = d.dot(axis);
                let out = d - axis * along;
                let side = (radius - out.norm()).abs() < along.abs().min((height - along).abs());
                let normal = if side {
                    out * (1.0 / radius)
                } else if along > height / 2.0 {
                    axis
                } else {
                    -axis
                };
                Hit {
                    t,
                    normal,
                    texture: if side {
                        v3(along, 0.0, along / height)
                    } else {
                        out
                    },
                }
            }
        }
    }
}

#[inline]
fn sphere(o: V3, ray: V3, radius: f32) -> Option<f32> {
    let b = o.dot(ray);
    // The squared distance of the ray from the centre, without cancellation.
    let off = o - ray * b;
    let h = radius * radius - off.dot(off);
    (h > 0.0).then(|| -b - h.sqrt())
}

#[inline]
fn block(o: V3, ray: V3, half: V3, axes: &[V3; 3]) -> Option<f32> {
    let mut near = f32::NEG_INFINITY;
    let mut far = f32::INFINITY;
    for (axis, half) in axes.iter().zip([half.x, half.y, half.z]) {
        let (p, d) = (o.dot(*axis), ray.dot(*axis));
        let inverse = 1.0 / if d.abs() < 1e-9 { 1e-9 } else { d };
        let (t1, t2) = ((-half - p) * inverse, (half - p) * inverse);
        near = near.max(t1.min(t2));
        far = far.min(t1.max(t2));
    }
    (near <= far && near > 0.0).then_some(near)
}

/// Spheres of radius `ra + s (rb - ra)` around `a + s (b - a)`: the cone between them, then the two ends.
#[inline]
fn limb(o: V3, ray: V3, a: V3, b: V3, ra: f32, rb: f32) -> Option<f32> {
    let (axis, oa, ob) = (b - a, o - a, o - b);
    let taper = ra - rb;
    let (length2, along_o, along_r) = (axis.dot(axis), axis.dot(oa), axis.dot(ray));
    let (oa_r, oa2) = (oa.dot(ray), oa.dot(oa));
    let open = length2 - taper * taper;
    if open > 0.0 {
        let k2 = open - along_r * along_r;
        let k1 = open * oa_r - along_o * along_r + along_r * taper * ra;
        let k0 = open * oa2 - along_o * along_o + 2.0 * along_o * taper * ra - length2 * ra * ra;
        let h = k1 * k1 - k0 * k2;
        if h < 0.0 {
            return None;
        }
        if k2.abs() > 1e-12 {
            let t = (-h.sqrt() - k1) / k2;
            let y = along_o - ra * taper + t * along_r;
            if y > 0.0 && y < open {
                return Some(t);
            }
        }
    }
    match (sphere(oa, ray, ra), sphere(ob, ray, rb)) {
        (Some(s), Some(t)) => Some(s.min(t)),
        (s, t) => s.or(t),
    }
}

#[inline]
fn can(o: V3, ray: V3, axis: V3, height: f32, radius: f32) -> Option<f32> {
    let (along_o, along_r) = (o.dot(axis), ray.dot(axis));
    let (flat_o, flat_r) = (o - axis * along_o, ray - axis * along_r);
    let k2 = flat_r.dot(flat_r);
    let k1 = flat_o.dot(flat_r);
    let k0 = flat_o.dot(flat_o) - radius * radius;
    if k2 > 1e-12 {
        let h = k1 * k1 - k2 * k0;
        if h < 0.0 {
            return None;
        }
        let t = (-k1 - h.sqrt()) / k2;
        let y = along_o + t * along_r;
        if y > 0.0 && y < height {
            return Some(t);
        }
    } else if k0 > 0.0 {
        return None;
    }
    // Through the end that faces the ray.
    let end = if along_r < 0.0 { height } else { 0.0 };
    if along_r.abs() < 1e-9 {
        return None;
    }
    let t = (end - along_o) / along_r;
    let p = flat_o + flat_r * t;
    (p.dot(p) < radius * radius).then_some(t)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes() -> [Shape; 4] {
        [
            Shape::Sphere {
                centre: v3(0.1, 2.0, -0.1),
                radius: 0.3,
            },
            Shape::Block {
                centre: v3(0.0, 2.0, 0.0),
                half: v3(0.2, 0.1, 0.3),
                axes: [v3(0.8, 0.6, 0.0), v3(-0.6, 0.8, 0.0), V3::Z],
            },
            Shape::Limb {
                a: v3(-0.2, 2.0, 0.0),
                b: v3(0.2, 2.2, 0.1),
                radius_a: 0.1,
                radius_b: 0.04,
            },
            Shape::Can {
                base: v3(0.0, 2.0, -0.2),
                axis: V3::Z,
                height: 0.4,
                radius: 0.15,
            },
        ]
    }

    /// How far outside the shape a point is, by a definition that shares no code with the intersection.
    fn distance(shape: &Shape, p: V3) -> f32 {
        match *shape {
            Shape::Sphere { centre, radius } => (p - centre).norm() - radius,
            Shape::Block { centre, half, axes } => {
                let d = p - centre;
                (0..3)
                    .map(|k| d.dot(axes[k]).abs() - [half.x, half.y, half.z][k])
                    .fold(f32::NEG_INFINITY, f32::max)
            }
            Shape::Limb {
                a,
                b,
                radius_a,
                radius_b,
            } => (0..=4000)
                .map(|i| {
                    let s = i as f32 / 4000.0;
                    (p - a.lerp(b, s)).norm() - (radius_a + s * (radius_b - radius_a))
                })
                .fold(f32::INFINITY, f32::min),
            Shape::Can {
                base,
                axis,
                height,
                radius,
            } => {
                let d = p - base;
                let y = d.dot(axis);
                ((d - axis * y).norm() - radius).max(-y).max(y - height)
            }
        }
    }

    #[test]
    fn rays_stop_on_the_surface_and_normals_face_them() {
        let mut hits = [0; 4];
        for i in 0..40 {
            for j in 0..40 {
                let ray = v3(i as f32 / 80.0 - 0.25, 1.0, j as f32 / 80.0 - 0.25).normalized();
                for (k, shape) in shapes().iter().enumerate() {
                    let Some(t) = shape.enter(V3::ZERO, ray, 10.0) else {
                        continue;
                    };
                    hits[k] += 1;
                    let point = ray * t;
                    assert!(
                        distance(shape, point).abs() < 2e-4,
                        "{shape:?} {}",
                        distance(shape, point)
                    );
                    let hit = shape.surface(t, point);
                    assert!((hit.normal.norm() - 1.0).abs() < 1e-2);
                    assert!(hit.normal.dot(ray) < 0.02, "{shape:?} {:?}", hit.normal);
                    assert!(
                        distance(shape, point + hit.normal * 0.01) > 0.005,
                        "{shape:?}"
                    );
                }
            }
        }
        assert!(hits.iter().all(|h| *h > 40), "{hits:?}");
    }

    #[test]
    fn rays_that_miss_pass_at_a_distance() {
        for (k, shape) in shapes().iter().enumerate() {
            let ray = v3(0.5, 1.0, 0.5).normalized();
            assert!(shape.enter(V3::ZERO, ray, 10.0).is_none(), "{k}");
            assert!(
                shape.enter(V3::ZERO, V3::Y, 0.5).is_none(),
                "beyond the limit {k}"
            );
            assert!(shape.enter(V3::ZERO, -V3::Y, 10.0).is_none(), "behind {k}");
        }
    }

    #[test]
    fn hulls_and_bounds_hold_the_shape() {
        for shape in shapes() {
            let (centre, radius) = shape.bound();
            let mut hull = [(V3::ZERO, 0.0); 8];
            let count = shape.hull(&mut hull);
            for (corner, r) in &hull[..count] {
                if !matches!(shape, Shape::Can { .. }) {
                    assert!((*corner - centre).norm() + r <= radius + 1e-5);
                }
            }
        }
    }
}
