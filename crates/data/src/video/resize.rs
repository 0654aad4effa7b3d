//! Area interpolation: every target pixel is the mean of the part of the source it covers.
//!
//! This is the resize of the paper's data (the release resizes with area interpolation), so it is written out here instead of
//! being left to a library's idea of a box filter. Where the target is larger than the source, area interpolation becomes
//! linear interpolation between the two source pixels that a target pixel touches.

// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use crate::video::image::{Image, SquareFit, squared};

impl Image {
    /// The picture with square pixels, from pixels `aspect` times as wide as high; no side gets shorter.
    #[must_use]
    pub fn with_square_pixels(self, aspect: f64) -> Self {
        let (width, height) = squared(self.width, self.height, aspect);
        self.resized(width, height)
    }

    /// The picture at another size, by area.
    #[must_use]
    pub fn resized(self, width: u32, height: u32) -> Self {
        if (width, height) == (self.width, self.height) {
            return self;
        }
        area(&self, width, height)
    }

    /// Short side to `side` by area interpolation (the long side rounded), then the centre square: the geometry of every clip.
    #[must_use]
    pub fn square(&self, side: u32) -> Self {
        let fit = SquareFit::new(self.width, self.height, side);
        if fit.resized == (self.width, self.height) {
            return self.clone().crop(fit.left, fit.top, side, side);
        }
        window(self, fit.resized, (fit.left, fit.top), (side, side))
    }

    fn crop(self, left: u32, top: u32, width: u32, height: u32) -> Self {
        if (left, top, width, height) == (0, 0, self.width, self.height) {
            return self;
        }
        let mut data = Vec::with_capacity(width as usize * height as usize * 3);
        for row in top..top + height {
            let from = (row as usize * self.width as usize + left as usize) * 3;
            data.extend_from_slice(&self.data[from..from + width as usize * 3]);
        }
        Image {
            width,
            height,
            data,
        }
    }
}

/// The share of source pixel `index` in a target pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Share {
    index: usize,
    weight: f32,
}

/// For every target pixel the source pixels that make it up; shares add up to one.
fn shares(source: u32, target: u32) -> Vec<Vec<Share>> {
    let scale = f64::from(source) / f64::from(target);
    let last = source as usize - 1;
    (0..target)
        .map(|pixel| {
            let start = f64::from(pixel) * scale;
            if scale < 1.0 {
                // Enlarging: how far this pixel reaches into the next source pixel.
                let index = (start.floor() as usize).min(last);
                let reach = f64::from(pixel + 1) - (index + 1) as f64 / scale;
                let next = reach.max(0.0).fract() as f32;
                return if next > 0.0 && index < last {
                    vec![
                        Share {
                            index,
                            weight: 1.0 - next,
                        },
                        Share {
                            index: index + 1,
                            weight: next,
                        },
                    ]
                } else {
                    vec![Share { index, weight: 1.0 }]
                };
            }
            let end = (start + scale).min(f64::from(source));
            let mut parts = Vec::new();
            let mut index = start.floor() as usize;
            while (index as f64) < end - 1e-9 && index <= last {
                let covered = (end.min(index as f64 + 1.0) - start.max(index as f64)).max(0.0);
                if covered > 1e-9 {
                    parts.push(Share {
                        index,
                        weight: (covered / (end - start)) as f32,
                    });
                }
                index += 1;
            }
            parts
        })
        .collect()
}

/// Resizes to exactly `width` x `height`.
#[must_use]
pub fn area(image: &Image, width: u32, height: u32) -> Image {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    window(image, (width, height), (0, 0), (width, height))
}

/// The part of `size` pixels from `left` and `top` on of the picture resized to `resized`, without the rest.
#[must_use]
pub fn window(
    image: &Image,
    resized: (u32, u32),
    (left, top): (u32, u32),
    (width, height): (u32, u32),
) -> Image {
    let of = |all: Vec<Vec<Share>>, first: u32, count: u32| -> Vec<Vec<Share>> {
        all.into_iter()
            .skip(first as usize)
            .take(count as usize)
            .collect()
    };
    let mut columns = of(shares(image.width, resized.0), left, width);
    let rows = of(shares(image.height, resized.1), top, height);
    // Only these columns of the source are looked at.
    let ends = |shares: &Vec<Share>| shares.iter().map(|share| share.index).collect::<Vec<_>>();
    let touched: Vec<usize> = columns.iter().flat_map(ends).collect();
    let first = touched.iter().min().copied().unwrap_or(0);
    let last = touched.iter().max().copied().unwrap_or(0);
    for share in columns.iter_mut().flatten() {
        share.index -= first;
    }
    let stride = image.width as usize * 3;
    let used = (last + 1 - first) * 3;
    let mut data = Vec::with_capacity(width as usize * height as usize * 3);
    let mut sums = vec![0.0_f32; used];
    for row in &rows {
        sums.fill(0.0);
        for share in row {
            let line = &image.data[share.index * stride + first * 3..][..used];
            pulp::Arch::new().dispatch(
                #[inline(always)]
                || {
                    for (sum, value) in sums.iter_mut().zip(line) {
                        *sum += share.weight * f32::from(*value);
                    }
                },
            );
        }
        for column in &columns {
            let mut pixel = [0.0_f32; 3];
            for share in column {
                let from = &sums[share.index * 3..][..3];
                for (value, part) in pixel.iter_mut().zip(from) {
                    *value += share.weight * part;
                }
            }
            data.extend(pixel.map(|value| value.round_ties_even().clamp(0.0, 255.0) as u8));
        }
    }
    Image {
        width,
        height,
        data,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn shares_cover_the_source_evenly(source in 1u32..200, target in 1u32..200) {
            let shares = shares(source, target);
            let mut covered = vec![0.0_f64; source as usize];
            for pixel in &shares {
                let sum: f32 = pixel.iter().map(|share| share.weight).sum();
                prop_assert!((sum - 1.0).abs() < 1e-5);
                for share in pixel {
                    covered[share.index] += f64::from(share.weight);
                }
            }
            if target <= source {
                let even = f64::from(target) / f64::from(source);
                prop_assert!(covered.iter().all(|c| (c - even).abs() < 1e-4));
            }
        }

        #[test]
        fn one_colour_stays_that_colour(colour: [u8; 3], w in 1u32..40, h in 1u32..40, tw in 1u32..40, th in 1u32..40) {
            prop_assert_eq!(area(&Image::filled(w, h, colour), tw, th), Image::filled(tw, th, colour));
        }
    }

    #[test]
    fn halving_takes_the_mean_of_four() {
        let image = Image {
            width: 2,
            height: 2,
            data: vec![0, 0, 0, 10, 20, 30, 20, 40, 60, 30, 60, 90],
        };
        assert_eq!(area(&image, 1, 1).data, [15, 30, 45]);
    }

    #[test]
    fn a_fractional_scale_weighs_by_covered_area() {
        // Three pixels onto two: each takes one and a half.
        let image = Image {
            width: 3,
            height: 1,
            data: vec![0, 0, 0, 90, 90, 90, 180, 180, 180],
        };
        assert_eq!(area(&image, 2, 1).data, [30, 30, 30, 150, 150, 150]);
    }
}
