//! The two clocks of a clip: video at 8 (or 16) Hz, everything else at 30 Hz (Sec. 3.2).

/// Seconds a clip lasts.
pub const CLIP_SECONDS: f64 = 2.0;
/// Hz of everything that is not video.
pub const SIGNAL_RATE: f64 = 30.0;
/// Samples of everything that is not video.
pub const SIGNAL_SAMPLES: usize = 60;
/// Hz of video in the 256 pathway.
pub const VIDEO_RATE: f64 = 8.0;

/// The nearest index of a recording at `native` Hz for sample `k` of a clip at `rate` Hz: ties go to the even index.
pub fn nearest_index(k: usize, native: f64, rate: f64) -> usize {
    (k as f64 * native / rate).round_ties_even() as usize
}

/// Which frames of a recording make a clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameChoice {
    /// One per clip frame, ascending.
    pub indices: Vec<usize>,
    /// How many at the end repeat the recording's last frame because it ended too early.
    pub repeated: usize,
}

/// The frames of a clip of `count` frames at `rate` Hz that starts at frame `start` of a recording of `available` frames at
/// `native` Hz.
///
/// `None` when the recording has no frame at `start`.
pub fn choose_frames(
    count: usize,
    native: f64,
    rate: f64,
    start: usize,
    available: usize,
) -> Option<FrameChoice> {
    let last = available.checked_sub(1).filter(|&last| start <= last)?;
    let wanted = (0..count).map(|k| start.saturating_add(nearest_index(k, native, rate)));
    let mut repeated = 0;
    let indices = wanted
        .map(|index| {
            repeated += usize::from(index > last);
            index.min(last)
        })
        .collect();
    Some(FrameChoice { indices, repeated })
}

/// The signal sample (30 Hz) that belongs to each of `frames` video frames at `video_rate`, never beyond the clip's last.
pub fn samples_of_frames(frames: usize, video_rate: f64) -> Vec<usize> {
    let last = SIGNAL_SAMPLES - 1;
    (0..frames)
        .map(|k| nearest_index(k, SIGNAL_RATE, video_rate).min(last))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_indices_are_the_releases_at_8_and_16_hz() {
        let at_8 = choose_frames(16, 30.0, 8.0, 0, 60).unwrap();
        assert_eq!(
            at_8.indices,
            [0, 4, 8, 11, 15, 19, 22, 26, 30, 34, 38, 41, 45, 49, 52, 56]
        );
        assert_eq!(at_8.repeated, 0);
        let at_16 = choose_frames(32, 30.0, 16.0, 0, 60).unwrap();
        assert_eq!(
            at_16.indices,
            [
                0, 2, 4, 6, 8, 9, 11, 13, 15, 17, 19, 21, 22, 24, 26, 28, 30, 32, 34, 36, 38, 39,
                41, 43, 45, 47, 49, 51, 52, 54, 56, 58
            ]
        );
        assert_eq!(samples_of_frames(16, 8.0), at_8.indices);
    }

    #[test]
    fn a_short_recording_repeats_its_last_frame_and_says_so() {
        let choice = choose_frames(16, 30.0, 8.0, 20, 40).unwrap();
        assert_eq!(choice.indices[..4], [20, 24, 28, 31]);
        assert_eq!(*choice.indices.last().unwrap(), 39);
        assert_eq!(choice.repeated, 10);
        assert!(choose_frames(16, 30.0, 8.0, 40, 40).is_none());
        assert!(choose_frames(16, 30.0, 8.0, 0, 0).is_none());
    }
}
