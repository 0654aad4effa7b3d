//! A frame to the network's input: its size, bicubic resize without smoothing, colours normalised as in `ImageNet`.

use rayon::prelude::*;

use super::LabelError;
use super::encoder::cubic_taps;
use crate::video::image::Image;

const MEAN: [f64; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f64; 3] = [0.229, 0.224, 0.225];

/// Frames much wider than this (or higher) are seen at a smaller size.
const WIDEST: f64 = 1.78;
/// What the size is scaled by then, over the ratio of the sides.
const WIDE: f64 = 1.777;

/// The size the network sees a frame of `height` x `width` in, `[height, width]`, both multiples of `patch`, for a target of
/// `input_size` pixels on the shorter side. The ratio of the sides is kept up to that rounding; halves round to even.
///
/// # Errors
/// When the frame is empty, or so narrow that nothing is left of it.
pub fn network_size(
    height: usize,
    width: usize,
    input_size: usize,
    patch: usize,
) -> Result<[usize; 2], LabelError> {
    let refuse = || {
        LabelError::Frames(format!(
            "frames of {width} x {height} pixels cannot be seen at a size of {input_size}"
        ))
    };
    if height == 0 || width == 0 || patch == 0 || !(1..=1 << 13).contains(&input_size) {
        return Err(refuse());
    }
    let size = effective_input_size(height, width, input_size, patch);
    if size == 0 {
        return Err(refuse());
    }
    let (size, unit) = (size as f64, patch as f64);
    let factor = (size / height as f64).max(size / width as f64);
    let side = |pixels: usize| {
        let target = factor * pixels as f64;
        let nearest = unit * (target / unit).round_ties_even();
        if nearest < size {
            unit * (target / unit).ceil()
        } else {
            nearest
        }
    };
    Ok([side(height), side(width)].map(|side| side as usize))
}

/// What `input_size` becomes for very wide or high frames.
#[must_use]
pub fn effective_input_size(height: usize, width: usize, input_size: usize, patch: usize) -> usize {
    let ratio = height.max(width) as f64 / height.min(width) as f64;
    if ratio <= WIDEST {
        return input_size;
    }
    let (size, unit) = ((input_size as f64 * WIDE / ratio).trunc(), patch as f64);
    (unit * (size / unit).round_ties_even()) as usize
}

/// `[3, H, W]` of `size` (height, width): bicubic (a = -0.75, half-pixel centres, edges repeated), not clipped.
///
/// # Panics
/// When the frame holds fewer bytes than its size says, or is empty.
#[must_use]
pub fn normalised(frame: &Image, [height, width]: [usize; 2]) -> Vec<f32> {
    let (rows, columns) = (frame.height as usize, frame.width as usize);
    let axis = |source: usize, target: usize| {
        let step = source as f64 / target as f64;
        (0..target)
            .map(|i| {
                cubic_taps((i as f64 + 0.5) * step - 0.5, source)
                    .map(|(at, weight)| (at, weight as f32))
            })
            .collect::<Vec<_>>()
    };
    let (lines, pixels) = (axis(rows, height), axis(columns, width));
    let bytes = &frame.data[..rows * columns * 3];
    // [H, W, 3] first: a line of it needs four lines of the frame.
    let mut resized = vec![0.0_f32; height * width * 3];
    resized.par_chunks_mut(width * 3).zip(&lines).for_each_init(
        || vec![0.0_f32; columns * 3],
        |mixed, (out, line)| {
            mixed.fill(0.0);
            for (at, weight) in line {
                let source = &bytes[at * columns * 3..][..columns * 3];
                for (sum, byte) in mixed.iter_mut().zip(source) {
                    *sum += f32::from(*byte) / 255.0 * weight;
                }
            }
            for (out, pixel) in out.chunks_exact_mut(3).zip(&pixels) {
                for (channel, out) in out.iter_mut().enumerate() {
                    let terms = pixel.iter().map(|(at, w)| mixed[at * 3 + channel] * w);
                    *out = terms.sum();
                }
            }
        },
    );
    let mut planes = vec![0.0; resized.len()];
    planes
        .par_chunks_mut(height * width)
        .enumerate()
        .for_each(|(channel, plane)| {
            let values = resized.iter().skip(channel).step_by(3);
            for (out, value) in plane.iter_mut().zip(values) {
                *out = ((f64::from(*value) - MEAN[channel]) / DEVIATION[channel]) as f32;
            }
        });
    planes
}

/// The pixels of each patch, `[cells, 3 * patch^2]` (channel, row, column), of a picture `[3, H, W]`.
#[must_use]
pub fn patches(planes: &[f32], [height, width]: [usize; 2], patch: usize) -> Vec<f32> {
    let columns = width / patch;
    let mut out = vec![0.0; planes.len()];
    out.par_chunks_mut(3 * patch * patch)
        .enumerate()
        .for_each(|(cell, out)| {
            let (top, left) = (cell / columns * patch, cell % columns * patch);
            for (line, out) in out.chunks_exact_mut(patch).enumerate() {
                let (channel, y) = (line / patch, top + line % patch);
                let start = (channel * height + y) * width + left;
                out.copy_from_slice(&planes[start..start + patch]);
            }
        });
    out
}

/// Every how many frames one is taken to come from `fps` to about `target`; 1 where no target is set.
#[must_use]
pub fn stride(fps: f64, target: Option<f64>) -> usize {
    match target {
        Some(target) if target > 0.0 && fps.is_finite() => {
            ((fps / target).round_ties_even() as usize).max(1)
        }
        _ => 1,
    }
}

/// `[height, width]` of a frame whose longer side may have at most `longest` pixels; sides are rounded, halves to even.
#[must_use]
pub fn limited_size(height: usize, width: usize, longest: usize) -> [usize; 2] {
    let longer = height.max(width);
    if longer <= longest {
        return [height, width];
    }
    let scale = longest as f64 / longer as f64;
    [height, width].map(|side| ((side as f64 * scale).round_ties_even() as usize).max(1))
}

/// A frame at another size, bilinearly between the centres of pixels, nothing smoothed.
#[must_use]
pub fn shrunk(frame: Image, [height, width]: [usize; 2]) -> Image {
    let (rows, columns) = (frame.height as usize, frame.width as usize);
    if [rows, columns] == [height, width] {
        return frame;
    }
    let axis = |source: usize, target: usize| {
        let step = source as f64 / target as f64;
        (0..target)
            .map(|i| {
                let place = ((i as f64 + 0.5) * step - 0.5).clamp(0.0, (source - 1) as f64);
                let lower = place.floor() as usize;
                (
                    lower,
                    (lower + 1).min(source - 1),
                    (place - lower as f64) as f32,
                )
            })
            .collect::<Vec<_>>()
    };
    let (lines, pixels) = (axis(rows, height), axis(columns, width));
    let mut data = vec![0; height * width * 3];
    data.par_chunks_mut(width * 3)
        .zip(&lines)
        .for_each(|(out, (above, below, down))| {
            for (out, (left, right, across)) in out.chunks_exact_mut(3).zip(&pixels) {
                for (channel, out) in out.iter_mut().enumerate() {
                    let value =
                        |y: usize, x: usize| f32::from(frame.data[(y * columns + x) * 3 + channel]);
                    let mix =
                        |y: usize| value(y, *left) * (1.0 - across) + value(y, *right) * across;
                    let mixed = mix(*above) * (1.0 - down) + mix(*below) * down;
                    *out = mixed.round_ties_even() as u8;
                }
            }
        });
    Image {
        width: width as u32,
        height: height as u32,
        data,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_follow_the_shorter_side_and_very_wide_frames_are_seen_smaller() {
        let size = |height, width| network_size(height, width, 518, 14).unwrap();
        assert_eq!(size(720, 1280), [518, 924]);
        assert_eq!(size(2160, 3840), [518, 924]);
        assert_eq!(size(1280, 720), [924, 518]);
        assert_eq!(size(480, 640), [518, 686]);
        assert_eq!(size(1080, 3840), [252, 896]);
        assert_eq!(size(1, 1), [518, 518]);
        for (height, width) in [(0, 5), (5, 0), (1, 5000)] {
            assert!(network_size(height, width, 518, 14).is_err());
        }
    }

    #[test]
    fn a_grey_frame_stays_grey_at_any_size() {
        for (height, width) in [(7, 9), (40, 56), (1, 1)] {
            let frame = Image {
                width,
                height,
                data: vec![128; (width * height * 3) as usize],
            };
            let planes = normalised(&frame, [28, 42]);
            for (channel, plane) in planes.chunks_exact(28 * 42).enumerate() {
                let grey = (128.0 / 255.0 - MEAN[channel]) / DEVIATION[channel];
                assert!(plane.iter().all(|v| (f64::from(*v) - grey).abs() < 1e-5));
            }
        }
    }

    #[test]
    fn a_patch_holds_its_own_pixels() {
        let planes: Vec<f32> = (0..3 * 4 * 6).map(|i| i as f32).collect();
        let patches = patches(&planes, [4, 6], 2);
        // The second patch of the second row: rows 2 and 3, columns 2 and 3 of every channel.
        let cell = &patches[4 * 12..5 * 12];
        assert_eq!(cell[..4], [14.0, 15.0, 20.0, 21.0]);
        assert_eq!(cell[4], 24.0 + 14.0);
    }
}
