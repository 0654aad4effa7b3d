//! Overlapping two-second windows over a video of any length.
//!
//! Windows start on a grid of half seconds, the shortest time that is a whole number of motion samples (15 at 30 Hz) and of
//! video frames (4 at 8 Hz, 8 at 16 Hz). The last window may reach beyond the end of the video: what lies there is not part of
//! the reconstruction, however it was filled.

use crate::clip::clock::{SIGNAL_RATE, SIGNAL_SAMPLES};
use serde::{Deserialize, Serialize};

/// Motion samples between two possible window starts: half a second.
const GRID: usize = 15;

/// One window, in motion samples from the start of the video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Window {
    /// Which window, from 0.
    pub index: usize,
    /// First sample.
    pub start: usize,
    /// Samples of the window that lie within the video, 1 to 60.
    pub inside: usize,
    /// Leading samples that the window before it also covers; 0 for the first.
    pub overlap: usize,
}

impl Window {
    /// Seconds from the start of the video.
    pub fn start_seconds(&self) -> f64 {
        self.start as f64 / SIGNAL_RATE
    }

    /// Where the window starts in a video of `rate` frames per second.
    pub fn start_frame(&self, rate: f64) -> usize {
        (self.start_seconds() * rate).round() as usize
    }
}

/// Why a video cannot be cut into windows.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum WindowError {
    /// The length of the video is not finite or not above 0.
    #[error("the video has no frame")]
    Empty,
    /// The overlap of neighbouring windows is none of those that the grid of half seconds has.
    #[error("an overlap of {found} s is not 0.5, 1 or 1.5 s")]
    Overlap {
        /// The overlap that is asked for, seconds.
        found: f64,
    },
}

/// Motion samples in a video of `seconds`: those whose time lies before its end, at least one.
pub fn samples_of(seconds: f64) -> usize {
    ((seconds * SIGNAL_RATE - 1e-6).ceil() as usize).max(1)
}

/// Windows that cover `seconds` of video with `overlap` seconds in common between neighbours.
///
/// # Errors
/// When the video is empty, or the overlap is not 0.5, 1 or 1.5 s.
pub fn windows(seconds: f64, overlap: f64) -> Result<Vec<Window>, WindowError> {
    if !seconds.is_finite() || seconds <= 0.0 {
        return Err(WindowError::Empty);
    }
    let shared = (overlap * SIGNAL_RATE).round() as usize;
    if !(overlap * SIGNAL_RATE - shared as f64).abs().le(&1e-9)
        || shared == 0
        || shared >= SIGNAL_SAMPLES
        || !shared.is_multiple_of(GRID)
    {
        return Err(WindowError::Overlap { found: overlap });
    }
    let total = samples_of(seconds);
    let mut list = vec![Window {
        index: 0,
        start: 0,
        inside: total.min(SIGNAL_SAMPLES),
        overlap: 0,
    }];
    let mut end = SIGNAL_SAMPLES;
    while end < total {
        // The last window moves back on the grid so that it holds as much video as it can.
        let latest = (total - SIGNAL_SAMPLES).div_ceil(GRID) * GRID;
        let start = (end - shared).min(latest);
        list.push(Window {
            index: list.len(),
            start,
            inside: (total - start).min(SIGNAL_SAMPLES),
            overlap: end - start,
        });
        end = start + SIGNAL_SAMPLES;
    }
    Ok(list)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_is_covered_and_neighbours_overlap() {
        for tenths in 1..400 {
            let seconds = f64::from(tenths) / 10.0;
            let list = windows(seconds, 0.5).unwrap();
            let total = samples_of(seconds);
            for pair in list.windows(2) {
                assert!(pair[1].start > pair[0].start);
                assert_eq!(
                    pair[0].start + SIGNAL_SAMPLES - pair[1].start,
                    pair[1].overlap
                );
                assert!(pair[1].overlap >= GRID);
            }
            for window in &list {
                assert!(window.start.is_multiple_of(GRID));
                assert_eq!(window.inside, (total - window.start).min(SIGNAL_SAMPLES));
                assert!(window.inside >= window.overlap.min(window.inside) && window.inside > 0);
            }
            let last = list.last().unwrap();
            assert!(
                last.start + SIGNAL_SAMPLES >= total,
                "{seconds} s is not covered"
            );
            assert!(total - last.start > SIGNAL_SAMPLES - GRID || list.len() == 1);
        }
    }

    #[test]
    fn a_window_starts_on_a_whole_video_frame() {
        let list = windows(10.0, 0.5).unwrap();
        assert_eq!(list[1].start_frame(8.0), 12);
        assert_eq!(list[1].start_frame(16.0), 24);
    }

    #[test]
    fn empty_videos_and_odd_overlaps_are_refused() {
        assert_eq!(windows(0.0, 0.5), Err(WindowError::Empty));
        assert_eq!(windows(5.0, 0.4), Err(WindowError::Overlap { found: 0.4 }));
        assert_eq!(windows(5.0, 2.0), Err(WindowError::Overlap { found: 2.0 }));
    }
}
