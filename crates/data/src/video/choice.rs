//! Which frames of a video become the frames of a clip (the release's rule).

/// When the frames of a video are shown.
#[derive(Debug, Clone, PartialEq)]
pub enum FrameTimes {
    /// Frame `k` at `k / fps`.
    Constant {
        /// Frames per second.
        fps: f64,
        /// How many there are.
        frames: usize,
    },
    /// Seconds of every frame from the first one, ascending.
    Variable {
        /// When each frame is shown; the first one is at 0.
        seconds: Vec<f64>,
    },
}

/// A frame may stand this far from its place on an even grid before the video counts as one of variable rate.
const UNEVEN: f64 = 0.25;

impl FrameTimes {
    /// From presentation times in ticks, ascending; only a video of variable rate keeps them.
    #[must_use]
    pub fn from_ticks(ticks: &[i64], timescale: u32) -> Self {
        let first = ticks.first().copied().unwrap_or(0);
        let last = ticks.last().copied().unwrap_or(0);
        let frames = ticks.len();
        if frames < 2 || last <= first {
            return FrameTimes::Constant { fps: 30.0, frames };
        }
        let step = (last - first) as f64 / (frames - 1) as f64;
        let even = ticks
            .iter()
            .enumerate()
            .all(|(k, tick)| ((tick - first) as f64 - k as f64 * step).abs() <= UNEVEN * step);
        if even {
            // Either end may have been rounded by half a tick.
            let slack = 1.0 / (last - first) as f64;
            let fps = tidy(f64::from(timescale) / step, slack.max(2e-5));
            FrameTimes::Constant { fps, frames }
        } else {
            let seconds = ticks
                .iter()
                .map(|tick| (tick - first) as f64 / f64::from(timescale))
                .collect();
            FrameTimes::Variable { seconds }
        }
    }

    /// How many frames are shown.
    pub fn frames(&self) -> usize {
        match self {
            FrameTimes::Constant { frames, .. } => *frames,
            FrameTimes::Variable { seconds } => seconds.len(),
        }
    }

    /// Mean frames per second.
    pub fn fps(&self) -> f64 {
        match self {
            FrameTimes::Constant { fps, .. } => *fps,
            FrameTimes::Variable { seconds } => {
                (seconds.len() - 1) as f64 / (seconds[seconds.len() - 1] - seconds[0])
            }
        }
    }

    /// When `frame` is shown, in seconds from the first frame.
    pub fn seconds(&self, frame: usize) -> f64 {
        match self {
            FrameTimes::Constant { fps, .. } => frame as f64 / fps,
            FrameTimes::Variable { seconds } => seconds
                .get(frame)
                .or(seconds.last())
                .copied()
                .unwrap_or(0.0),
        }
    }

    /// The frame shown nearest to `at` seconds; of two equally near the even one, or the earlier one where the rate varies.
    pub fn nearest(&self, at: f64) -> usize {
        let last = self.frames().saturating_sub(1);
        match self {
            FrameTimes::Constant { fps, .. } => {
                ((at * fps).round_ties_even().max(0.0) as usize).min(last)
            }
            FrameTimes::Variable { seconds } => {
                let after = seconds.partition_point(|s| *s < at);
                if after == 0 {
                    0
                } else if after > last || at - seconds[after - 1] <= seconds[after] - at {
                    after - 1
                } else {
                    after
                }
            }
        }
    }

    /// The frames of a clip of `count` frames at `fps` that begins at frame `start`.
    ///
    /// A video of constant rate gives `start + round(k * native / fps)`, half to even, as in the release; one of variable rate
    /// gives the frame nearest to each tick. Beyond the end the last frame is repeated.
    pub fn clip(&self, start: usize, fps: f64, count: usize) -> Vec<usize> {
        let last = self.frames().saturating_sub(1);
        (0..count)
            .map(|k| match self {
                FrameTimes::Constant { fps: native, .. } => {
                    let step = (k as f64 * native / fps).round_ties_even();
                    (start as f64 + step).min(last as f64) as usize
                }
                FrameTimes::Variable { .. } => self
                    .nearest(self.seconds(start) + k as f64 / fps)
                    .max(start)
                    .min(last),
            })
            .collect()
    }
}

/// Rounds away what the container's ticks added to a common rate: 29.9700299 is 30000/1001.
/// `slack` is how far, as a share, the rate may be off.
fn tidy(fps: f64, slack: f64) -> f64 {
    // 30 and 30/1.001 lie within the slack of a short video together: the nearer one is meant.
    let off = |rate: f64| (fps / rate - 1.0).abs();
    [1.0, 1.001]
        .map(|base| ((fps * base).round(), base))
        .into_iter()
        .filter(|(whole, _)| *whole >= 1.0)
        .map(|(whole, base)| whole / base)
        .filter(|rate| off(*rate) < slack)
        .min_by(|a, b| off(*a).total_cmp(&off(*b)))
        .unwrap_or(fps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thirty_to_eight_and_sixteen_are_the_releases_lists() {
        let schedule = FrameTimes::Constant {
            fps: 30.0,
            frames: 1000,
        };
        assert_eq!(
            schedule.clip(0, 8.0, 16),
            [0, 4, 8, 11, 15, 19, 22, 26, 30, 34, 38, 41, 45, 49, 52, 56]
        );
        assert_eq!(
            schedule.clip(100, 16.0, 32),
            [
                0, 2, 4, 6, 8, 9, 11, 13, 15, 17, 19, 21, 22, 24, 26, 28, 30, 32, 34, 36, 38, 39,
                41, 43, 45, 47, 49, 51, 52, 54, 56, 58
            ]
            .map(|k| k + 100)
        );
    }

    #[test]
    fn the_last_frame_is_repeated() {
        let schedule = FrameTimes::Constant {
            fps: 10.0,
            frames: 3,
        };
        assert_eq!(schedule.clip(1, 10.0, 4), [1, 2, 2, 2]);
    }

    #[test]
    fn uneven_frames_are_chosen_by_time() {
        // 0.0, 0.1, 0.5, 0.6 s
        let schedule = FrameTimes::from_ticks(&[0, 100, 500, 600], 1000);
        assert!(matches!(schedule, FrameTimes::Variable { .. }));
        assert_eq!(schedule.clip(0, 5.0, 4), [0, 1, 2, 3]);
        assert_eq!(schedule.nearest(0.29), 1);
        assert_eq!(schedule.nearest(0.31), 2);
    }

    #[test]
    fn rates_come_out_clean() {
        let ticks: Vec<i64> = (0..300)
            .map(|k| (k as f64 * 1001.0 / 30.0).round() as i64)
            .collect();
        let FrameTimes::Constant { fps, .. } = FrameTimes::from_ticks(&ticks, 1000) else {
            panic!("constant within rounding")
        };
        assert_eq!(fps, 30.0 / 1.001);
    }
}
