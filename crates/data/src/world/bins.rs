//! Which primitives a bundle of rays can meet: the image in square tiles, each with its candidates from near to far.
//!
//! The same structure serves the camera and, as the six faces of a cube, the lamp that throws shadows.

use super::primitive::{Primitive, Shape};
use super::vector::V3;

/// A pinhole view: a ray of pixel (x, y) is `forward + right (x - cx) / fx + down (y - cy) / fy`.
#[derive(Debug, Clone, Copy)]
pub struct View {
    pub eye: V3,
    pub right: V3,
    pub down: V3,
    pub forward: V3,
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub width: u32,
    pub height: u32,
}

/// Candidates per tile.
#[derive(Debug, Clone)]
pub struct Bins {
    columns: usize,
    tile: f32,
    starts: Vec<u32>,
    /// (distance at which the primitive can begin, its number), near to far within a tile.
    items: Vec<(f32, u16)>,
}

/// Nothing nearer than this is seen, metres.
const NEAR: f32 = 0.01;

impl Bins {
    /// Sorts the primitives that pass `keep` into tiles of `tile` pixels.
    pub fn new(
        view: &View,
        tile: u32,
        primitives: &[Primitive],
        keep: impl Fn(&Primitive) -> bool,
    ) -> Self {
        let columns = view.width.div_ceil(tile) as usize;
        let rows = view.height.div_ceil(tile) as usize;
        let mut rects: Vec<(f32, u16, [usize; 4])> = Vec::with_capacity(primitives.len());
        for (i, primitive) in primitives.iter().enumerate() {
            if !keep(primitive) {
                continue;
            }
            if let Some([x0, x1, y0, y1]) = rectangle(view, &primitive.shape) {
                let tile_of =
                    |v: f32, last: usize| ((v / tile as f32).floor().max(0.0) as usize).min(last);
                let rect = [
                    tile_of(x0, columns - 1),
                    tile_of(x1, columns - 1),
                    tile_of(y0, rows - 1),
                    tile_of(y1, rows - 1),
                ];
                let (centre, radius) = primitive.shape.bound();
                rects.push(((centre - view.eye).norm() - radius, i as u16, rect));
            }
        }
        rects.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut starts = vec![0u32; columns * rows + 1];
        for (_, _, [x0, x1, y0, y1]) in &rects {
            for y in *y0..=*y1 {
                for x in *x0..=*x1 {
                    starts[y * columns + x + 1] += 1;
                }
            }
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut fill: Vec<u32> = starts[..columns * rows].to_vec();
        let mut items = vec![(0.0, 0); starts[columns * rows] as usize];
        for (near, i, [x0, x1, y0, y1]) in &rects {
            for y in *y0..=*y1 {
                for x in *x0..=*x1 {
                    let at = &mut fill[y * columns + x];
                    items[*at as usize] = (*near, *i);
                    *at += 1;
                }
            }
        }
        Self {
            columns,
            tile: tile as f32,
            starts,
            items,
        }
    }

    /// The candidates at a pixel.
    #[inline]
    pub fn at(&self, x: f32, y: f32) -> &[(f32, u16)] {
        let column = ((x / self.tile) as usize).min(self.columns - 1);
        let rows = (self.starts.len() - 1) / self.columns;
        let row = ((y / self.tile) as usize).min(rows - 1);
        let tile = row * self.columns + column;
        &self.items[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// Pixel bounds `[x0, x1, y0, y1]` of a shape, or `None` where it cannot be seen. Never too small.
fn rectangle(view: &View, shape: &Shape) -> Option<[f32; 4]> {
    let mut hull = [(V3::ZERO, 0.0); 8];
    let count = shape.hull(&mut hull);
    let mut points = [(V3::ZERO, 0.0f32); 20];
    let mut used = 0;
    for (centre, radius) in &hull[..count] {
        let d = *centre - view.eye;
        let local = V3 {
            x: d.dot(view.right),
            y: d.dot(view.down),
            z: d.dot(view.forward),
        };
        points[used] = (local, *radius);
        used += 1;
    }
    let (left, right) = (-view.cx - 0.5, view.width as f32 - 0.5 - view.cx);
    let (top, bottom) = (-view.cy - 0.5, view.height as f32 - 0.5 - view.cy);
    let (left, right) = (left / view.fx, right / view.fx);
    let (top, bottom) = (top / view.fy, bottom / view.fy);
    // Entirely beyond one side of the frustum.
    let beyond = |f: &dyn Fn(V3) -> f32| points[..used].iter().all(|(p, r)| f(*p) > *r);
    let side = |m: f32| 1.0 / (1.0 + m * m).sqrt();
    if beyond(&|p| NEAR - p.z)
        || beyond(&|p| (left * p.z - p.x) * side(left))
        || beyond(&|p| (p.x - right * p.z) * side(right))
        || beyond(&|p| (top * p.z - p.y) * side(top))
        || beyond(&|p| (p.y - bottom * p.z) * side(bottom))
    {
        return None;
    }
    if matches!(shape, Shape::Block { .. }) {
        used = clip_block(&mut points);
    }
    let full = Some([0.0, view.width as f32, 0.0, view.height as f32]);
    let mut bounds = [
        f32::INFINITY,
        f32::NEG_INFINITY,
        f32::INFINITY,
        f32::NEG_INFINITY,
    ];
    for (p, r) in &points[..used] {
        if p.z - r < NEAR * 0.99 {
            return full;
        }
        let (x0, x1) = slopes(p.x, p.z, *r);
        let (y0, y1) = slopes(p.y, p.z, *r);
        bounds[0] = bounds[0].min(x0 * view.fx + view.cx);
        bounds[1] = bounds[1].max(x1 * view.fx + view.cx);
        bounds[2] = bounds[2].min(y0 * view.fy + view.cy);
        bounds[3] = bounds[3].max(y1 * view.fy + view.cy);
    }
    // Pixel i covers i - 0.5 to i + 0.5; tiles count from the left edge of pixel 0.
    let grown = [
        bounds[0] - 0.6,
        bounds[1] + 1.1,
        bounds[2] - 0.6,
        bounds[3] + 1.1,
    ];
    let seen = grown[1] >= 0.0
        && grown[0] <= view.width as f32
        && grown[3] >= 0.0
        && grown[2] <= view.height as f32;
    seen.then_some(grown)
}

/// Slopes x / z between which a disc of radius `r` around (x, z) is seen from the origin; z > r.
fn slopes(x: f32, z: f32, r: f32) -> (f32, f32) {
    if r == 0.0 {
        return (x / z, x / z);
    }
    let root = r * (x * x + z * z - r * r).max(0.0).sqrt();
    let below = z * z - r * r;
    ((x * z - root) / below, (x * z + root) / below)
}

/// The corners in front of the near plane and the points where edges cross it; the eight corners come in binary order.
fn clip_block(points: &mut [(V3, f32); 20]) -> usize {
    let corners: [V3; 8] = std::array::from_fn(|i| points[i].0);
    let mut used = 0;
    for (i, a) in corners.iter().enumerate() {
        if a.z >= NEAR {
            points[used] = (*a, 0.0);
            used += 1;
        }
        for bit in [1, 2, 4] {
            let j = i | bit;
            let b = corners[j];
            if j != i && (a.z < NEAR) != (b.z < NEAR) {
                let t = (NEAR - a.z) / (b.z - a.z);
                let mut p = a.lerp(b, t);
                p.z = NEAR;
                points[used] = (p, 0.0);
                used += 1;
            }
        }
    }
    used
}

/// The six faces around the lamp, each a square view of `size` tiles.
#[derive(Debug, Clone)]
pub struct Cube {
    faces: Vec<(View, Bins)>,
}

impl Cube {
    /// Sorts what throws shadows around `lamp`.
    pub fn new(lamp: V3, size: u32, primitives: &[Primitive]) -> Self {
        let axes = [
            (V3::X, V3::Y, V3::Z),
            (-V3::X, V3::Y, V3::Z),
            (V3::Y, V3::X, V3::Z),
            (-V3::Y, V3::X, V3::Z),
            (V3::Z, V3::X, V3::Y),
            (-V3::Z, V3::X, V3::Y),
        ];
        let half = size as f32 / 2.0;
        let faces = axes.map(|(forward, right, down)| {
            let view = View {
                eye: lamp,
                right,
                down,
                forward,
                fx: half,
                fy: half,
                cx: half - 0.5,
                cy: half - 0.5,
                width: size,
                height: size,
            };
            let bins = Bins::new(&view, 1, primitives, |p| p.casts);
            (view, bins)
        });
        Self {
            faces: faces.into_iter().collect(),
        }
    }

    /// Whether one of `primitives` (those the cube was built from) is between the lamp and a point `distance` away.
    #[inline]
    pub fn blocks(&self, primitives: &[Primitive], direction: V3, distance: f32) -> bool {
        let a = direction.abs();
        let face = if a.x >= a.y && a.x >= a.z {
            usize::from(direction.x < 0.0)
        } else if a.y >= a.z {
            2 + usize::from(direction.y < 0.0)
        } else {
            4 + usize::from(direction.z < 0.0)
        };
        let (view, bins) = &self.faces[face];
        let depth = 1.0 / direction.dot(view.forward);
        let x = direction.dot(view.right) * depth * view.fx + view.cx + 0.5;
        let y = direction.dot(view.down) * depth * view.fy + view.cy + 0.5;
        for (near, i) in bins.at(x.max(0.0), y.max(0.0)) {
            if *near > distance {
                return false;
            }
            let shape = &primitives[*i as usize].shape;
            if shape.enter(view.eye, direction, distance).is_some() {
                return true;
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::vector::v3;

    /// Bins must never lose a primitive that a ray meets.
    #[test]
    fn tiles_hold_everything_their_rays_meet() {
        let view = View {
            eye: v3(0.2, -0.1, 0.3),
            right: V3::X,
            down: -V3::Z,
            forward: V3::Y,
            fx: 30.0,
            fy: 30.0,
            cx: 31.5,
            cy: 31.5,
            width: 64,
            height: 64,
        };
        let r = |i: i32, k| super::super::texture::hash(i, k, 3);
        let primitives: Vec<Primitive> = (0..120)
            .map(|i| {
                let p = v3(
                    r(i, 0) * 4.0 - 2.0,
                    r(i, 1) * 4.0 - 1.0,
                    r(i, 2) * 4.0 - 2.0,
                );
                let q = p + v3(r(i, 3) - 0.5, r(i, 4) - 0.5, r(i, 5) - 0.5);
                let shape = match i % 4 {
                    0 => Shape::Sphere {
                        centre: p,
                        radius: 0.1 + 0.2 * r(i, 6),
                    },
                    1 => Shape::block(p, v3(0.05 + r(i, 6), 0.3 * r(i, 7) + 0.05, 0.2)),
                    2 => Shape::Limb {
                        a: p,
                        b: q,
                        radius_a: 0.1,
                        radius_b: 0.05,
                    },
                    _ => Shape::Can {
                        base: p,
                        axis: (q - p).normalized(),
                        height: 0.4,
                        radius: 0.1,
                    },
                };
                Primitive::new(shape, 0)
            })
            .collect();
        let bins = Bins::new(&view, 8, &primitives, |_| true);
        let mut met = 0;
        for y in 0..64 {
            for x in 0..64 {
                let ray = view.right * ((x as f32 - view.cx) / view.fx)
                    + view.down * ((y as f32 - view.cy) / view.fy)
                    + view.forward;
                let ray = ray.normalized();
                let candidates = bins.at(x as f32, y as f32);
                for (i, p) in primitives.iter().enumerate() {
                    if let Some(t) = p.shape.enter(view.eye, ray, 100.0) {
                        if t * ray.dot(view.forward) < NEAR {
                            continue;
                        }
                        met += 1;
                        assert!(
                            candidates.iter().any(|c| c.1 as usize == i),
                            "{x} {y} {:?}",
                            p.shape
                        );
                    }
                }
            }
        }
        assert!(met > 1000);
    }

    #[test]
    fn a_cube_of_faces_sees_shadows_in_every_direction() {
        let lamp = v3(0.1, 0.2, 0.3);
        for i in 0..200 {
            let r = |k| super::super::texture::hash(i, k, 9) - 0.5;
            let direction = v3(r(0), r(1), r(2)).normalized();
            let blocker = Primitive::new(
                Shape::Sphere {
                    centre: lamp + direction * 1.0,
                    radius: 0.05,
                },
                0,
            );
            let cube = Cube::new(lamp, 16, &[blocker]);
            assert!(cube.blocks(&[blocker], direction, 2.0));
            assert!(!cube.blocks(&[blocker], direction, 0.9));
            assert!(!cube.blocks(&[blocker], -direction, 2.0));
        }
    }
}
