//! Which rows of packed video a factorised convolution reads: the geometry of its taps.

/// Which input rows an output row is computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConvWindow {
    /// 3 x 3 within each frame. Stride 1: zeros around the frame. Stride 2: zeros to the right and below only.
    Space {
        /// Frames of all samples together.
        frames: usize,
        /// Of an input frame, pixels.
        height: usize,
        /// Of an input frame, pixels.
        width: usize,
        /// 1, or 2 to halve height and width.
        stride: usize,
    },
    /// 3 along time, ending at the present: the first frame is repeated in front, `3 - stride` times.
    Time {
        /// Videos, one after the other.
        samples: usize,
        /// Input frames of each.
        frames: usize,
        /// Rows of each frame: height times width.
        pixels: usize,
        /// 1, or 2 to halve the number of frames.
        stride: usize,
    },
}

impl ConvWindow {
    /// How many input rows make one output row.
    #[must_use]
    pub fn count(self) -> usize {
        match self {
            Self::Space { .. } => 9,
            Self::Time { .. } => 3,
        }
    }

    /// Frames, height and width (or samples, frames and pixels) of the output.
    fn outputs(self) -> [usize; 3] {
        match self {
            Self::Space {
                frames,
                height,
                width,
                stride,
            } => [frames, height / stride, width / stride],
            Self::Time {
                samples,
                frames,
                pixels,
                stride,
            } => [samples, (frames - stride) / stride + 1, pixels],
        }
    }

    /// How many rows come in.
    #[must_use]
    pub fn rows_in(self) -> usize {
        match self {
            Self::Space {
                frames,
                height,
                width,
                ..
            } => frames * height * width,
            Self::Time {
                samples,
                frames,
                pixels,
                ..
            } => samples * frames * pixels,
        }
    }

    /// How many rows come out.
    #[must_use]
    pub fn rows_out(self) -> usize {
        self.outputs().iter().product()
    }

    /// The input row of one tap of an output row; `None` where zeros are.
    pub(super) fn source(self, row: usize, tap: usize) -> Option<usize> {
        let [_, middle, last] = self.outputs();
        let (a, b, c) = (row / (middle * last), row / last % middle, row % last);
        match self {
            Self::Space {
                height,
                width,
                stride,
                ..
            } => {
                let pad = usize::from(stride == 1);
                let y = (b * stride + tap / 3)
                    .checked_sub(pad)
                    .filter(|y| *y < height)?;
                let x = (c * stride + tap % 3)
                    .checked_sub(pad)
                    .filter(|x| *x < width)?;
                Some((a * height + y) * width + x)
            }
            Self::Time {
                frames,
                pixels,
                stride,
                ..
            } => {
                let time = (b * stride + tap).saturating_sub(3 - stride);
                Some((a * frames + time) * pixels + c)
            }
        }
    }

    /// Fills `columns` with the taps of the output rows from `first` on, `[rows, taps, channels]`.
    pub(super) fn gather(self, x: &[f32], channels: usize, first: usize, columns: &mut [f32]) {
        let taps = self.count();
        for (i, row) in columns.chunks_exact_mut(taps * channels).enumerate() {
            for (tap, to) in row.chunks_exact_mut(channels).enumerate() {
                match self.source(first + i, tap) {
                    Some(from) => to.copy_from_slice(&x[from * channels..][..channels]),
                    None => to.fill(0.0),
                }
            }
        }
    }

    /// Output rows, each with the input rows they are computed from, such that no two share an input row.
    pub(super) fn units(self) -> Vec<[Panel; 2]> {
        const PIXELS: usize = 256;
        let [_, after, _] = self.outputs();
        match self {
            Self::Space {
                frames,
                height,
                width,
                stride,
            } => {
                let (inputs, outputs) = (height * width, (height / stride) * (width / stride));
                (0..frames)
                    .map(|frame| {
                        [
                            Panel::run(frame * outputs, outputs),
                            Panel::run(frame * inputs, inputs),
                        ]
                    })
                    .collect()
            }
            Self::Time {
                samples,
                frames,
                pixels,
                ..
            } => (0..samples)
                .flat_map(|sample| {
                    (0..pixels).step_by(PIXELS).map(move |first| {
                        [after, frames].map(|frames| Panel {
                            start: sample * frames * pixels + first,
                            stride: pixels,
                            runs: frames,
                            length: PIXELS.min(pixels - first),
                        })
                    })
                })
                .collect(),
        }
    }
}

/// Some rows: `runs` times `length` neighbours, `stride` rows from one to the next.
#[derive(Debug, Clone, Copy)]
pub(super) struct Panel {
    pub start: usize,
    pub stride: usize,
    pub runs: usize,
    pub length: usize,
}

impl Panel {
    fn run(start: usize, length: usize) -> Self {
        Self {
            start,
            stride: length,
            runs: 1,
            length,
        }
    }

    /// How many rows.
    pub fn count(self) -> usize {
        self.runs * self.length
    }

    /// The row at `place` of the panel.
    pub fn row(self, place: usize) -> usize {
        self.start + place / self.length * self.stride + place % self.length
    }

    /// Where in the panel `row` is.
    pub fn place(self, row: usize) -> usize {
        let from = row - self.start;
        from / self.stride * self.length + from % self.stride
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn convolutions_in_time_see_no_future() {
        let taps = ConvWindow::Time {
            samples: 1,
            frames: 4,
            pixels: 1,
            stride: 1,
        };
        for row in 0..4 {
            for tap in 0..3 {
                assert!(taps.source(row, tap).unwrap() <= row);
            }
        }
    }

    #[test]
    fn units_cover_all_rows_and_share_none() {
        let time = |stride| ConvWindow::Time {
            samples: 2,
            frames: 6,
            pixels: 300,
            stride,
        };
        let space = |stride| ConvWindow::Space {
            frames: 3,
            height: 4,
            width: 6,
            stride,
        };
        for taps in [time(1), time(2), space(1), space(2)] {
            let mut owner = vec![None; taps.rows_in()];
            let mut written = vec![0; taps.rows_out()];
            for (unit, [outputs, inputs]) in taps.units().into_iter().enumerate() {
                for place in 0..inputs.count() {
                    let row = inputs.row(place);
                    assert_eq!(inputs.place(row), place, "{taps:?}");
                    assert_eq!(owner[row].replace(unit), None, "{taps:?}");
                }
                for place in 0..outputs.count() {
                    let row = outputs.row(place);
                    written[row] += 1;
                    for source in (0..taps.count()).filter_map(|tap| taps.source(row, tap)) {
                        assert_eq!(owner[source], Some(unit), "{taps:?}");
                    }
                }
            }
            assert!(written.iter().all(|count| *count == 1), "{taps:?}");
        }
    }
}
