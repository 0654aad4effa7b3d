//! Procedural materials: wood, tiles, bricks, carpet, wallpaper, fabric, books, pictures.
//!
//! A pattern is a function of texture coordinates in metres; where a pixel covers more than its details it fades to its mean,
//! so that distant surfaces do not flicker.

use super::vector::{V3, v3};

/// What a surface looks like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// How the colours are laid out.
    pub pattern: Pattern,
    /// Linear light, 0 to 1.
    pub colours: [V3; 3],
    /// Metres of one repetition.
    pub scale: f32,
    /// 0 matt to 1 shiny.
    pub gloss: f32,
    /// Light of its own, 0 or more.
    pub glow: f32,
    /// Picks one variant of the pattern.
    pub seed: u32,
}

/// How the colours are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pattern {
    /// The first colour everywhere.
    Plain,
    /// Boards with grain between the first two colours; seams in the third.
    Planks,
    /// Squares in the first two colours by turns; joints in the third.
    Tiles,
    /// Rows of bricks between the first two colours; mortar in the third.
    Bricks,
    /// Soft patches between the first two colours, and a fine pile.
    Carpet,
    /// Stripes of the first two colours with flowers in the third.
    Wallpaper,
    /// Bands of all three colours.
    Stripes,
    /// Dots of the second colour on the first.
    Dots,
    /// Squares of the first two colours by turns, without joints.
    Checker,
    /// Rings and grain between the first two colours.
    Wood,
    /// Folds between the first two colours, and a fine weave.
    Fabric,
    /// Diamonds of the first two colours within two bands along the outline.
    Rug,
    /// An abstract painting on the first colour.
    Picture,
    /// Sky and hills behind glass.
    Outdoors,
}

impl Material {
    /// One colour, matt.
    pub fn plain(colour: V3) -> Self {
        Self {
            pattern: Pattern::Plain,
            colours: [colour; 3],
            scale: 1.0,
            gloss: 0.0,
            glow: 0.0,
            seed: 0,
        }
    }

    /// The colour at texture coordinates; `footprint` is the size of the pixel on the surface, metres.
    pub fn colour(&self, uv: V3, footprint: f32) -> V3 {
        let [a, b, c] = self.colours;
        let (u, v) = (uv.x / self.scale, uv.y / self.scale);
        // 1 where details of relative size `d` are resolved, 0 where a pixel holds several.
        let detail = |d: f32| (1.5 - footprint / (self.scale * d)).clamp(0.0, 1.0);
        match self.pattern {
            Pattern::Plain => a,
            Pattern::Planks => {
                let row = v.floor();
                let shift = hash(row as i32, 7, self.seed);
                let plank = (u / 6.0 + shift).floor();
                let tone = hash(plank as i32, row as i32, self.seed);
                let grain = noise(u * 1.5 + 31.0 * tone, v * 14.0, self.seed) - 0.5;
                let seam = edge(v - row, 0.03).max(edge(fract(u / 6.0 + shift), 0.006));
                let base = a.lerp(b, tone * detail(1.0)) * (1.0 + 0.35 * grain * detail(0.15));
                base.lerp(c, seam * 0.8 * detail(0.12))
            }
            Pattern::Tiles => {
                let (i, j) = (u.floor(), v.floor());
                let seam = edge(u - i, 0.03).max(edge(v - j, 0.03));
                let tone = hash(i as i32, j as i32, self.seed);
                let marble = noise(u * 3.0, v * 3.0, self.seed ^ 5) - 0.5;
                let odd = (i as i32 + j as i32) & 1 == 0;
                let base = if odd { a } else { b };
                let base = base * (1.0 + (0.1 * (tone - 0.5) + 0.16 * marble) * detail(0.5));
                let mean = a.lerp(b, 0.5);
                mean.lerp(base, detail(1.0)).lerp(c, seam * detail(0.15))
            }
            Pattern::Bricks => {
                let row = (v * 3.0).floor();
                let x = u + 0.5 * (row as i32 & 1) as f32;
                let tone = hash(x.floor() as i32, row as i32, self.seed);
                let seam = edge(fract(x), 0.04).max(edge(v * 3.0 - row, 0.1));
                let rough = noise(u * 9.0, v * 9.0, self.seed) - 0.5;
                (a.lerp(b, tone * detail(0.5)) * (1.0 + 0.25 * rough * detail(0.12)))
                    .lerp(c, seam * (0.3 + 0.7 * detail(0.15)))
            }
            Pattern::Carpet => {
                let soft = noise(u, v, self.seed) - 0.5;
                let fine = noise(u * 12.0, v * 12.0, self.seed ^ 9) - 0.5;
                a.lerp(b, 0.5 + 0.6 * soft * detail(1.0)) * (1.0 + 0.5 * fine * detail(0.1))
            }
            Pattern::Wallpaper => {
                let stripe = if fract(u) < 0.5 { a } else { b };
                let base = a.lerp(b, 0.5).lerp(stripe, detail(0.5));
                let (x, y) = (fract(u * 2.0) - 0.5, fract(v) - 0.5);
                let flower = (x * x * 0.25 + y * y < 0.012 * (1.0 + (8.0 * y.atan2(x)).cos() * 0.4))
                    as i32 as f32;
                base.lerp(c, flower * 0.7 * detail(0.25))
            }
            Pattern::Stripes => {
                let band = fract(u);
                let base = if band < 0.5 {
                    a
                } else if band < 0.85 {
                    b
                } else {
                    c
                };
                (a * 0.5 + b * 0.35 + c * 0.15).lerp(base, detail(0.4))
            }
            Pattern::Dots => {
                let row = v.floor() as i32;
                let (x, y) = (fract(u + 0.5 * (row & 1) as f32) - 0.5, fract(v) - 0.5);
                let dot = ((x * x + y * y) < 0.07) as i32 as f32;
                a.lerp(b, 0.22 + (dot - 0.22) * detail(0.5))
            }
            Pattern::Checker => {
                let odd = (u.floor() as i32 + v.floor() as i32) & 1 == 0;
                a.lerp(b, 0.5).lerp(if odd { a } else { b }, detail(1.0))
            }
            Pattern::Wood => {
                let rings = (v * 3.0 + 2.0 * noise(u * 0.7, v * 1.3, self.seed)).sin() * 0.5 + 0.5;
                let grain = noise(u * 2.0, v * 24.0, self.seed) - 0.5;
                a.lerp(b, 0.5 + (rings - 0.5) * detail(0.5)) * (1.0 + 0.25 * grain * detail(0.08))
            }
            Pattern::Fabric => {
                let weave = ((u * 40.0).sin() * (v * 40.0).sin()) * 0.5;
                let fold = noise(u * 2.0, v * 2.0, self.seed) - 0.5;
                a.lerp(b, 0.5 + 0.5 * fold * detail(0.5)) * (1.0 + 0.2 * weave * detail(0.1))
            }
            Pattern::Rug => {
                // The third coordinate is the distance from the outline: bands follow it, diamonds fill the rest.
                let d = uv.z;
                let diamonds = (fract(u) - 0.5).abs() + (fract(v) - 0.5).abs() < 0.4;
                let inner = if diamonds { b } else { a };
                let inner = a.lerp(b, 0.35).lerp(inner, detail(0.5));
                if d < 0.06 {
                    c
                } else if d < 0.12 {
                    b
                } else {
                    inner
                }
            }
            Pattern::Picture => picture(u, v, &self.colours, self.seed),
            Pattern::Outdoors => {
                let hill =
                    0.15 * (u * 5.0 + self.seed as f32).sin() + 0.1 * (u * 11.0).sin() - 0.25;
                let tree = 0.3 * noise(u * 8.0, 3.0, self.seed) - 0.35;
                if v < tree {
                    c * (0.6 + 0.4 * noise(u * 20.0, v * 20.0, self.seed))
                } else if v < hill {
                    b
                } else {
                    let cloud = (noise(u * 3.0, v * 6.0, self.seed ^ 3) - 0.5).max(0.0) * 1.6;
                    a.lerp(V3::splat(1.0), (0.3 - 0.4 * v + cloud).clamp(0.0, 1.0))
                }
            }
        }
    }
}

/// An abstract painting: overlapping discs and bars on a ground.
fn picture(u: f32, v: f32, colours: &[V3; 3], seed: u32) -> V3 {
    let mut colour = colours[0];
    for i in 0..6 {
        let r = |k: i32| hash(i, k, seed);
        let (x, y) = (u - (r(0) - 0.5), v - (r(1) - 0.5));
        let inside = if r(2) < 0.5 {
            x * x + y * y < 0.02 + 0.05 * r(3)
        } else {
            let (s, c) = (r(4) * std::f32::consts::PI).sin_cos();
            (x * c + y * s).abs() < 0.04 + 0.1 * r(3)
        };
        if inside {
            colour = colours[(i % 2 + 1) as usize].lerp(v3(r(5), r(6), r(7)), 0.4);
        }
    }
    colour
}

fn fract(v: f32) -> f32 {
    v - v.floor()
}

/// 1 within `width` of either end of a unit cell.
fn edge(x: f32, width: f32) -> f32 {
    if x < width || x > 1.0 - width {
        1.0
    } else {
        0.0
    }
}

/// A number in [0, 1) for a cell.
pub fn hash(i: i32, j: i32, seed: u32) -> f32 {
    let mut h = (i as u32).wrapping_mul(0x9E37_79B1)
        ^ (j as u32).wrapping_mul(0x85EB_CA77)
        ^ seed.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    ((h ^ (h >> 15)) >> 8) as f32 / 16_777_216.0
}

/// Smooth value noise in [0, 1).
pub fn noise(x: f32, y: f32, seed: u32) -> f32 {
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    let (fx, fy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
    let (i, j) = (i as i32, j as i32);
    let top = hash(i, j, seed) * (1.0 - fx) + hash(i.wrapping_add(1), j, seed) * fx;
    let j = j.wrapping_add(1);
    let low = hash(i, j, seed) * (1.0 - fx) + hash(i.wrapping_add(1), j, seed) * fx;
    top * (1.0 - fy) + low * fy
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Pattern; 14] = [
        Pattern::Plain,
        Pattern::Planks,
        Pattern::Tiles,
        Pattern::Bricks,
        Pattern::Carpet,
        Pattern::Wallpaper,
        Pattern::Stripes,
        Pattern::Dots,
        Pattern::Checker,
        Pattern::Wood,
        Pattern::Fabric,
        Pattern::Rug,
        Pattern::Picture,
        Pattern::Outdoors,
    ];

    #[test]
    fn every_pattern_stays_a_colour_anywhere() {
        for pattern in ALL {
            let material = Material {
                pattern,
                colours: [v3(0.8, 0.4, 0.2), v3(0.3, 0.5, 0.7), v3(0.1, 0.1, 0.1)],
                ..Material::plain(V3::ZERO)
            };
            for i in -40..40 {
                let p = v3(i as f32 * 0.37, i as f32 * -0.83, i as f32 * 0.11);
                for footprint in [0.001, 0.1, 10.0] {
                    let c = material.colour(p, footprint);
                    for v in [c.x, c.y, c.z] {
                        assert!((0.0..=1.6).contains(&v), "{pattern:?} {v}");
                    }
                }
            }
        }
    }

    #[test]
    fn noise_is_continuous_and_not_constant() {
        let mut spread = (1.0f32, 0.0f32);
        for i in 0..1000 {
            let x = i as f32 * 0.05;
            let (a, b) = (noise(x, 0.3, 1), noise(x + 0.001, 0.3, 1));
            assert!((a - b).abs() < 0.01);
            spread = (spread.0.min(a), spread.1.max(a));
        }
        assert!(spread.0 < 0.2 && spread.1 > 0.8);
    }
}
