//! Undistortion: for every pixel of a target camera, where a source camera with the same centre and axes saw it.

use super::camera::Camera;
use nalgebra::Vector2;

/// A map from target pixels to source pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Remap {
    /// Source position per target pixel, row by row; NaN where the source saw nothing.
    from: Vec<[f32; 2]>,
    width: usize,
    height: usize,
    source_width: usize,
    source_height: usize,
}

impl Remap {
    /// The map that shows what `source` saw as `target` would have seen it.
    #[must_use]
    pub fn new(source: &Camera, target: &Camera) -> Self {
        let mut from = Vec::with_capacity(target.width as usize * target.height as usize);
        for v in 0..target.height {
            for u in 0..target.width {
                let pixel = Vector2::new(f64::from(u), f64::from(v));
                let seen = target
                    .unproject(&pixel)
                    .and_then(|ray| source.project(&ray))
                    .filter(|pixel| source.sees(pixel));
                from.push(seen.map_or([f32::NAN; 2], |pixel| [pixel.x as f32, pixel.y as f32]));
            }
        }
        Remap {
            from,
            width: target.width as usize,
            height: target.height as usize,
            source_width: source.width as usize,
            source_height: source.height as usize,
        }
    }

    /// Target size as (width, height).
    #[must_use]
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// RGB bytes by bilinear interpolation; black where nothing was seen.
    ///
    /// # Panics
    /// Never for a source of the size the map was made for; a shorter one is read as black.
    #[must_use]
    pub fn colour(&self, rgb: &[u8]) -> Vec<u8> {
        let (w, h) = (self.source_width, self.source_height);
        let mut out = vec![0; self.from.len() * 3];
        if rgb.len() < w * h * 3 {
            return out;
        }
        for (pixel, [u, v]) in out.chunks_exact_mut(3).zip(&self.from) {
            if u.is_nan() {
                continue;
            }
            let (u, v) = (u.clamp(0.0, (w - 1) as f32), v.clamp(0.0, (h - 1) as f32));
            let (left, top) = (u as usize, v as usize);
            let (right, bottom) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
            let (fu, fv) = (u - left as f32, v - top as f32);
            for (k, value) in pixel.iter_mut().enumerate() {
                let at = |x: usize, y: usize| f32::from(rgb[(y * w + x) * 3 + k]);
                let above = at(left, top) * (1.0 - fu) + at(right, top) * fu;
                let below = at(left, bottom) * (1.0 - fu) + at(right, bottom) * fu;
                *value = (above * (1.0 - fv) + below * fv).round() as u8;
            }
        }
        out
    }

    /// The nearest source value per target pixel, for labels and depth (z-depth is the same in both cameras); `None` where
    /// nothing was seen.
    pub fn nearest<'a, T: Copy>(&'a self, values: &'a [T]) -> impl Iterator<Item = Option<T>> + 'a {
        self.from.iter().map(move |[u, v]| {
            if u.is_nan() {
                return None;
            }
            let x = (u.round().max(0.0) as usize).min(self.source_width - 1);
            let y = (v.round().max(0.0) as usize).min(self.source_height - 1);
            values.get(y * self.source_width + x).copied()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::{KannalaBrandt, Lens, Pinhole};

    /// A picture whose colour is the ray's direction, seen through a fisheye, comes out as the pinhole sees it.
    #[test]
    fn straight_lines_become_straight() {
        let source = Camera {
            lens: Lens::KannalaBrandt(KannalaBrandt {
                fx: 100.0,
                fy: 100.0,
                cx: 127.5,
                cy: 127.5,
                radial: [0.02, -0.01, 0.0, 0.0],
            }),
            width: 256,
            height: 256,
            valid_radius: Some(130.0),
        };
        let target = Camera {
            lens: Lens::Pinhole(Pinhole {
                fx: 60.0,
                fy: 60.0,
                cx: 63.5,
                cy: 63.5,
            }),
            width: 128,
            height: 128,
            valid_radius: None,
        };
        let paint =
            |ray: nalgebra::Vector3<f64>| ((ray.x + 1.5) / 3.0 * 255.0).clamp(0.0, 255.0) as u8;
        let mut picture = vec![0; 256 * 256 * 3];
        for (index, pixel) in picture.chunks_exact_mut(3).enumerate() {
            let at = Vector2::new((index % 256) as f64, (index / 256) as f64);
            if let Some(ray) = source.unproject(&at) {
                pixel.fill(paint(ray));
            }
        }
        let out = Remap::new(&source, &target).colour(&picture);
        for v in [10_usize, 64, 120] {
            for u in [5_usize, 30, 64, 100, 122] {
                let ray = target.unproject(&Vector2::new(u as f64, v as f64)).unwrap();
                let found = out[(v * 128 + u) * 3];
                assert!(
                    found.abs_diff(paint(ray)) <= 2,
                    "{u} {v}: {found} {}",
                    paint(ray)
                );
            }
        }
    }
}
