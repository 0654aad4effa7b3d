//! The 3D Haar wavelet in space and time: blocks of `patch`^3 pixels to as many coefficients, and back.
//!
//! One level halves time, height and width; `low = (a + b) / 2`, `high = (a - b) / 2` along each. Bands are ordered
//! `lll llh lhl lhh hll hlh hhl hhh` (time, height, width), output channel `band * channels + channel`; the second level is applied
//! to all of the first level's channels. Since pairs never cross a block, both levels together are one fixed matrix per block.

/// Pixels of the first frame stand for `patch` frames, so that later frames come in whole blocks.
///
/// `video` is `[frames, height, width, colours]` with `1 + k * patch` frames; gives `[blocks, patch^3 * colours]`, blocks in
/// (time, height, width) order, coefficients in the order of the tokenizer's channels.
///
/// # Panics
/// When the sizes do not divide.
#[must_use]
pub fn forward(video: &[f32], size: [usize; 4], patch: usize) -> Vec<f32> {
    let colours = size[3];
    let blocks = cut(video, size, [patch; 2]);
    let matrix = matrix(patch);
    let pixels = patch.pow(3);
    let mut out = vec![0.0; blocks.len()];
    for (out, block) in out
        .chunks_exact_mut(pixels * colours)
        .zip(blocks.chunks_exact(pixels * colours))
    {
        let scale = 1.0 / pixels as f32;
        for (row, signs) in matrix.chunks_exact(pixels).enumerate() {
            for colour in 0..colours {
                let sum: f32 = signs
                    .iter()
                    .enumerate()
                    .map(|(pixel, sign)| sign * block[pixel * colours + colour])
                    .sum();
                out[row * colours + colour] = sum * scale;
            }
        }
    }
    out
}

/// The inverse of [`forward`]: `[blocks, patch^3 * colours]` to `[frames, height, width, colours]`.
///
/// # Panics
/// When the sizes do not divide.
#[must_use]
pub fn inverse(coefficients: &[f32], size: [usize; 4], patch: usize) -> Vec<f32> {
    let colours = size[3];
    let matrix = matrix(patch);
    let pixels = patch.pow(3);
    let mut blocks = vec![0.0; coefficients.len()];
    for (block, coefficients) in blocks
        .chunks_exact_mut(pixels * colours)
        .zip(coefficients.chunks_exact(pixels * colours))
    {
        for (row, signs) in matrix.chunks_exact(pixels).enumerate() {
            for colour in 0..colours {
                let value = coefficients[row * colours + colour];
                for (pixel, sign) in signs.iter().enumerate() {
                    block[pixel * colours + colour] += sign * value;
                }
            }
        }
    }
    paste(&blocks, size, [patch; 2])
}

/// The map from pixels of a block (`[patch^3 * colours]`, as [`cut`] has them) to coefficients, `[out, in]` row-major.
#[must_use]
pub fn block_matrix(patch: usize, colours: usize) -> Vec<f32> {
    let (matrix, pixels) = (matrix(patch), patch.pow(3));
    let side = pixels * colours;
    let mut out = vec![0.0; side * side];
    for (row, signs) in matrix.chunks_exact(pixels).enumerate() {
        for colour in 0..colours {
            let to = row * colours + colour;
            for (pixel, sign) in signs.iter().enumerate() {
                out[to * side + pixel * colours + colour] = sign / pixels as f32;
            }
        }
    }
    out
}

/// Blocks of `time` frames of `side` by `side` pixels, `[blocks, time, side, side, colours]`, the first frame repeated.
///
/// # Panics
/// When the sizes do not divide.
#[must_use]
pub fn cut(
    video: &[f32],
    [frames, height, width, colours]: [usize; 4],
    [time, side]: [usize; 2],
) -> Vec<f32> {
    let extra = time - 1;
    assert_eq!(video.len(), frames * height * width * colours);
    let grid = [(frames + extra, time), (height, side), (width, side)].map(|(n, by)| {
        assert!(n.is_multiple_of(by), "{n} in blocks of {by}");
        n / by
    });
    let mut out = Vec::with_capacity((frames + extra) * height * width * colours);
    let run = side * colours;
    for t in 0..grid[0] {
        for h in 0..grid[1] {
            for w in 0..grid[2] {
                for dt in 0..time {
                    let frame = (t * time + dt).saturating_sub(extra);
                    for dh in 0..side {
                        let at = ((frame * height + h * side + dh) * width + w * side) * colours;
                        out.extend_from_slice(&video[at..at + run]);
                    }
                }
            }
        }
    }
    out
}

/// The inverse of [`cut`]; the repeated frames are dropped.
#[must_use]
pub fn paste(
    blocks: &[f32],
    [frames, height, width, colours]: [usize; 4],
    [time, side]: [usize; 2],
) -> Vec<f32> {
    let extra = time - 1;
    let grid = [(frames + extra) / time, height / side, width / side];
    let run = side * colours;
    let mut out = vec![0.0; frames * height * width * colours];
    let mut pieces = blocks.chunks_exact(run);
    for t in 0..grid[0] {
        for h in 0..grid[1] {
            for w in 0..grid[2] {
                for dt in 0..time {
                    let frame = (t * time + dt).checked_sub(extra);
                    for dh in 0..side {
                        let piece = pieces.next().unwrap_or_default();
                        if let Some(frame) = frame {
                            let at =
                                ((frame * height + h * side + dh) * width + w * side) * colours;
                            out[at..at + run].copy_from_slice(piece);
                        }
                    }
                }
            }
        }
    }
    out
}

/// Signs, `[coefficients, pixels]`: row `band2 * 8 + band1` (or `band1` for one level), pixels in (time, height, width) order.
fn matrix(patch: usize) -> Vec<f32> {
    let levels = patch.ilog2() as usize;
    let pixels = patch.pow(3);
    let mut out = Vec::with_capacity(pixels * pixels);
    for row in 0..pixels {
        for pixel in 0..pixels {
            let place = [
                pixel / (patch * patch),
                pixel / patch % patch,
                pixel % patch,
            ];
            let mut sign = 1.0;
            for level in 0..levels {
                // Level 0 looks at neighbours, level 1 at neighbouring pairs. Bits of a band: time, height, width.
                let band = row >> (3 * level) & 7;
                for (axis, position) in place.iter().enumerate() {
                    let high = band >> (2 - axis) & 1 == 1;
                    if high && position >> level & 1 == 1 {
                        sign = -sign;
                    }
                }
            }
            out.push(sign);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_values_come_out() {
        // Golden values of the technical reference: x[c, t, h, w] = sin(0.1 (1000 c + 64 t + 8 h + w)).
        let size = [17, 8, 8, 3];
        let mut video = Vec::new();
        for t in 0..17 {
            for h in 0..8 {
                for w in 0..8 {
                    for c in 0..3 {
                        let angle = 0.1 * f64::from(1000 * c + 64 * t + 8 * h + w);
                        video.push(angle.sin() as f32);
                    }
                }
            }
        }
        let y = forward(&video, size, 4);
        let at = |c: usize, t: usize, h: usize, w: usize| y[((t * 2 + h) * 2 + w) * 192 + c];
        for (found, expected) in [
            (at(0, 0, 0, 0), 0.622_224),
            (at(0, 0, 0, 1), 0.627_493),
            (at(1, 2, 1, 0), -0.630_905),
            (at(1, 2, 1, 1), -0.564_878),
            (at(24, 1, 0, 0), 0.004_516),
            (at(24, 1, 0, 1), 0.028_801),
        ] {
            assert!((found - expected).abs() < 2e-6, "{found} {expected}");
        }
        let sum: f64 = y.iter().map(|v| f64::from(*v)).sum();
        assert!((sum + 1.240_313_05).abs() < 1e-4, "{sum}");
        let back = inverse(&y, size, 4);
        for (a, b) in back.iter().zip(&video) {
            assert!((a - b).abs() < 1e-5);
        }
    }

    #[test]
    fn every_patch_size_inverts_and_the_block_matrix_is_the_same_map() {
        for patch in [1, 2, 4] {
            let size = [1 + patch, 4, 8, 3];
            let video: Vec<f32> = (0..size.iter().product::<usize>())
                .map(|i| (i as f32 * 0.37).sin())
                .collect();
            let y = forward(&video, size, patch);
            for (a, b) in inverse(&y, size, patch).iter().zip(&video) {
                assert!((a - b).abs() < 1e-5);
            }
            let side = patch.pow(3) * 3;
            let matrix = block_matrix(patch, 3);
            let block = &cut(&video, size, [patch; 2])[..side];
            for (row, expected) in matrix.chunks_exact(side).zip(&y) {
                let sum: f32 = row.iter().zip(block).map(|(a, b)| a * b).sum();
                assert!((sum - expected).abs() < 1e-6);
            }
        }
    }
}
