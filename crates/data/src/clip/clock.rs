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
        let frames = |count: usize, rate: f64| -> Vec<usize> {
            (0..count).map(|k| nearest_index(k, 30.0, rate)).collect()
        };
        assert_eq!(
            frames(16, 8.0),
            [0, 4, 8, 11, 15, 19, 22, 26, 30, 34, 38, 41, 45, 49, 52, 56]
        );
        assert_eq!(
            frames(32, 16.0),
            [
                0, 2, 4, 6, 8, 9, 11, 13, 15, 17, 19, 21, 22, 24, 26, 28, 30, 32, 34, 36, 38, 39,
                41, 43, 45, 47, 49, 51, 52, 54, 56, 58
            ]
        );
        assert_eq!(samples_of_frames(16, 8.0), frames(16, 8.0));
    }
}
