//! Motions at other rates, linearly between neighbouring samples.

use super::skeleton::Pose;

/// The motion at `target` Hz: samples at `k / target` seconds, none after the last of the source.
#[must_use]
pub fn at_rate(poses: &[Pose], rate: f64, target: f64) -> Vec<Pose> {
    if (rate - target).abs() < 1e-9 || poses.is_empty() {
        return poses.to_vec();
    }
    let last = (poses.len() - 1) as f64;
    // A sample that rounding puts a hair behind the last one still counts.
    let count = (last * target / rate + 1e-9).floor() as usize + 1;
    (0..count)
        .map(|k| between(poses, k as f64 * rate / target))
        .collect()
}

/// `(T - 1) factor` evenly spaced samples from the first to the last inclusive: how `UniEgoMotion` brings its 10 Hz motions to
/// nearly 30 Hz.
#[must_use]
pub fn upsampled(poses: &[Pose], factor: usize) -> Vec<Pose> {
    let last = poses.len().saturating_sub(1);
    let count = last * factor;
    let step = last as f64 / count.saturating_sub(1).max(1) as f64;
    (0..count)
        .map(|k| between(poses, k as f64 * step))
        .collect()
}

fn between(poses: &[Pose], position: f64) -> Pose {
    let lower = (position.floor() as usize).min(poses.len() - 1);
    let upper = (lower + 1).min(poses.len() - 1);
    let share = (position - lower as f64).clamp(0.0, 1.0);
    let (a, b) = (&poses[lower], &poses[upper]);
    std::array::from_fn(|j| std::array::from_fn(|k| a[j][k] + share * (b[j][k] - a[j][k])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(samples: usize) -> Vec<Pose> {
        (0..samples).map(|t| [[t as f64; 3]; 22]).collect()
    }

    #[test]
    fn two_seconds_at_thirty_hertz_are_forty_samples_at_twenty() {
        let motion = at_rate(&line(60), 30.0, 20.0);
        assert_eq!(motion.len(), 40);
        assert_eq!(motion[1][0][0], 1.5);
        assert_eq!(motion[39][0][0], 58.5);
        assert_eq!(at_rate(&line(61), 30.0, 20.0).len(), 41);
        assert_eq!(at_rate(&line(7), 20.0, 20.0), line(7));
    }

    #[test]
    fn upsampling_keeps_both_ends() {
        let motion = upsampled(&line(20), 3);
        assert_eq!(motion.len(), 57);
        assert!((motion[56][3][1] - 19.0).abs() < 1e-12);
        assert_eq!(motion[0], line(1)[0]);
        assert!(upsampled(&line(1), 3).is_empty());
    }
}
