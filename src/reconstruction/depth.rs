//! Depth over windows: each window is fitted to the one before it where they overlap, blended, and handed on frame by frame, so
//! that memory does not grow with the length of the video.

use super::track::ramp;
use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use serde::{Deserialize, Serialize};

/// How a window's depth was brought to the scale of the one before it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DepthSeam {
    /// The later window.
    pub window: usize,
    /// `previous = scale * this + shift`.
    pub scale: f64,
    /// In units of the depth.
    pub shift: f64,
    /// Root mean square difference after the fit, in units of the depth.
    pub residual: f64,
    /// False where the fit was not usable (not positive, or constant depth) and the window was taken as it is.
    pub fitted: bool,
}

/// Takes windows of depth in order; finished frames come out of [`DepthStitcher::push`].
#[derive(Debug, Clone, Default)]
pub struct DepthStitcher {
    /// Frames that a later window may still blend with.
    held: Vec<Array2<f32>>,
    /// Index of `held[0]`.
    start: usize,
    seams: Vec<DepthSeam>,
}

impl DepthStitcher {
    /// Adds `[T, h, w]` depth that starts at video frame `start`; returns the frames that are final now, in order.
    pub fn push(
        &mut self,
        window: usize,
        start: usize,
        depth: ArrayView3<f32>,
    ) -> Vec<Array2<f32>> {
        let overlap = (self.start + self.held.len())
            .saturating_sub(start)
            .min(depth.shape()[0]);
        let done = self.held.len() - overlap.min(self.held.len());
        let finished: Vec<Array2<f32>> = self.held.drain(..done).collect();
        let mut depth = depth.to_owned();
        if overlap > 0 {
            let seam = fit(window, &self.held, depth.slice(s![..overlap, .., ..]));
            if seam.fitted {
                let (scale, shift) = (seam.scale as f32, seam.shift as f32);
                depth.mapv_inplace(|d| scale * d + shift);
            }
            self.seams.push(seam);
        }
        let old = std::mem::take(&mut self.held);
        self.held = depth
            .axis_iter(Axis(0))
            .enumerate()
            .map(|(i, new)| match old.get(i) {
                Some(old) => mix(old, &new.to_owned(), ramp(i, overlap) as f32),
                None => new.to_owned(),
            })
            .collect();
        self.start = start;
        finished
    }

    /// The frames that are left, and how the seams were.
    pub fn finish(self) -> (Vec<Array2<f32>>, Vec<DepthSeam>) {
        (self.held, self.seams)
    }
}

fn mix(old: &Array2<f32>, new: &Array2<f32>, t: f32) -> Array2<f32> {
    ndarray::Zip::from(old)
        .and(new)
        .map_collect(|&a, &b| match (a.is_finite(), b.is_finite()) {
            (true, true) => a * (1.0 - t) + b * t,
            (true, false) => a,
            _ => b,
        })
}

/// Least squares `old = scale * new + shift` over pixels known on both sides.
fn fit(window: usize, old: &[Array2<f32>], new: ArrayView3<f32>) -> DepthSeam {
    let pairs = || {
        old.iter().zip(new.axis_iter(Axis(0))).flat_map(|(a, b)| {
            let b = b.to_owned();
            a.iter()
                .zip(b)
                .map(|(&a, b)| (f64::from(b), f64::from(a)))
                .filter(|(b, a)| a.is_finite() && b.is_finite())
                .collect::<Vec<_>>()
        })
    };
    let (n, sum_x, sum_y) =
        pairs().fold((0.0, 0.0, 0.0), |(n, x, y), (b, a)| (n + 1.0, x + b, y + a));
    let (mean_x, mean_y) = (sum_x / n, sum_y / n);
    let (xx, xy) = pairs().fold((0.0, 0.0), |(xx, xy), (b, a)| {
        (xx + (b - mean_x).powi(2), xy + (b - mean_x) * (a - mean_y))
    });
    let scale = xy / xx;
    let fitted = n >= 2.0 && xx > 1e-12 * n && scale.is_finite() && scale > 0.0;
    let (scale, shift) = if fitted {
        (scale, mean_y - scale * mean_x)
    } else {
        (1.0, 0.0)
    };
    let square = pairs()
        .map(|(b, a)| (scale * b + shift - a).powi(2))
        .sum::<f64>();
    DepthSeam {
        window,
        scale,
        shift,
        residual: if n > 0.0 { (square / n).sqrt() } else { 0.0 },
        fitted,
    }
}

/// `[T, h, w]` from frames of one size; empty input gives an empty array.
pub fn stack(frames: &[Array2<f32>]) -> Array3<f32> {
    let views: Vec<_> = frames.iter().map(|f| f.view()).collect();
    ndarray::stack(Axis(0), &views).unwrap_or_else(|_| Array3::zeros((0, 0, 0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(frame: usize) -> Array2<f32> {
        Array2::from_shape_fn((4, 5), |(y, x)| {
            1.0 + 0.1 * frame as f32 + 0.3 * x as f32 + 0.05 * y as f32
        })
    }

    #[test]
    fn windows_of_other_scale_come_back_to_the_first() {
        let mut stitcher = DepthStitcher::default();
        let mut frames = Vec::new();
        for (window, start) in [0, 12, 24].into_iter().enumerate() {
            let own = stack(&(start..start + 16).map(scene).collect::<Vec<_>>());
            let own = own.mapv(|d| (d - 0.2 * window as f32) / (1.0 + window as f32));
            frames.extend(stitcher.push(window, start, own.view()));
        }
        let (rest, seams) = stitcher.finish();
        frames.extend(rest);
        assert_eq!(frames.len(), 40);
        for (k, frame) in frames.iter().enumerate() {
            assert!(
                (frame - &scene(k)).iter().all(|e| e.abs() < 1e-4),
                "frame {k}"
            );
        }
        assert!((seams[0].scale - 2.0).abs() < 1e-4 && seams[1].fitted);
    }

    #[test]
    fn a_constant_window_is_taken_as_it_is_and_said_so() {
        let mut stitcher = DepthStitcher::default();
        stitcher.push(0, 0, Array3::from_elem((16, 2, 2), 1.0).view());
        stitcher.push(1, 12, Array3::from_elem((16, 2, 2), 3.0).view());
        let (frames, seams) = stitcher.finish();
        assert!(!seams[0].fitted);
        assert_eq!(frames.last().unwrap()[[0, 0]], 3.0);
    }
}
