//! Signals with their own clocks, read at any time: between two samples by interpolation, in a gap not at all.

use nalgebra::{Isometry3, Point3};

/// Nanoseconds in a second.
pub const SECOND: i64 = 1_000_000_000;

/// Samples over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Track<T> {
    /// Nanoseconds, ascending, each once.
    times: Vec<i64>,
    values: Vec<T>,
    /// Two samples farther apart than this have a gap between them, nanoseconds.
    max_gap: i64,
    /// A sample stands for times up to this far from it where there is nothing to interpolate with, nanoseconds.
    hold: i64,
}

/// A value between two others.
pub trait Blend: Clone {
    /// `weight` of `other`, from 0 to 1. `None` where the two do not connect.
    fn blend(&self, other: &Self, weight: f64) -> Option<Self>;
}

impl Blend for Isometry3<f64> {
    fn blend(&self, other: &Self, weight: f64) -> Option<Self> {
        self.try_lerp_slerp(other, weight, 1e-9)
    }
}

impl Blend for [f64; 2] {
    fn blend(&self, other: &Self, weight: f64) -> Option<Self> {
        Some(std::array::from_fn(|k| {
            self[k] + weight * (other[k] - self[k])
        }))
    }
}

/// Joints, each of which may be missing.
pub type Joints = [Option<Point3<f64>>; 21];

/// Clocks are rounded: a sample this near, as a share of the way to the next, is the sample itself.
const NEGLIGIBLE: f64 = 1e-4;

impl Blend for Joints {
    fn blend(&self, other: &Self, weight: f64) -> Option<Self> {
        Some(std::array::from_fn(|joint| {
            match (self[joint], other[joint]) {
                (Some(a), Some(b)) => Some(a + (b - a) * weight),
                // Only one of the two is known: it counts at its own time alone.
                (a, _) if weight < NEGLIGIBLE => a,
                (_, b) if weight > 1.0 - NEGLIGIBLE => b,
                _ => None,
            }
        }))
    }
}

impl<T: Blend> Track<T> {
    /// From samples in any order. Of several at the same time the last one counts.
    #[must_use]
    pub fn new(mut samples: Vec<(i64, T)>, max_gap: i64, hold: i64) -> Self {
        samples.sort_by_key(|(time, _)| *time);
        let mut times: Vec<i64> = Vec::with_capacity(samples.len());
        let mut values: Vec<T> = Vec::with_capacity(samples.len());
        for (time, value) in samples {
            if times.last() == Some(&time) {
                values.pop();
                times.pop();
            }
            times.push(time);
            values.push(value);
        }
        Track {
            times,
            values,
            max_gap,
            hold,
        }
    }

    /// When the samples were taken: nanoseconds, ascending, each once.
    #[must_use]
    pub fn times(&self) -> &[i64] {
        &self.times
    }

    /// The samples, in the order of [`Track::times`].
    #[must_use]
    pub fn values(&self) -> &[T] {
        &self.values
    }

    /// Whether there is no sample.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.times.is_empty()
    }

    /// The value at `time`.
    #[must_use]
    pub fn at(&self, time: i64) -> Option<T> {
        let after = self.times.partition_point(|t| *t <= time);
        if after > 0 && after < self.times.len() {
            let (a, b) = (self.times[after - 1], self.times[after]);
            if b - a <= self.max_gap {
                let weight = (time - a) as f64 / (b - a) as f64;
                if let Some(value) = self.values[after - 1].blend(&self.values[after], weight) {
                    return Some(value);
                }
            }
        }
        let near = nearest(&self.times, time)?;
        ((self.times[near] - time).abs() <= self.hold).then(|| self.values[near].clone())
    }

    /// The value of the sample nearest to `time`, however far.
    #[must_use]
    pub fn nearest(&self, time: i64) -> Option<&T> {
        nearest(&self.times, time).map(|index| &self.values[index])
    }

    /// The same values on another clock; samples that have no time there are left out.
    #[must_use]
    pub fn on_clock(self, clock: impl Fn(i64) -> Option<i64>) -> Self {
        let samples = self
            .times
            .into_iter()
            .zip(self.values)
            .filter_map(|(time, value)| Some((clock(time)?, value)))
            .collect();
        Track::new(samples, self.max_gap, self.hold)
    }
}

/// Index of the time nearest to `time` in an ascending list; the earlier of two equally near.
#[must_use]
pub fn nearest(times: &[i64], time: i64) -> Option<usize> {
    let after = times.partition_point(|t| *t < time);
    match (after.checked_sub(1), times.get(after)) {
        (None, None) => None,
        (Some(before), None) => Some(before),
        (None, Some(_)) => Some(after),
        (Some(before), Some(next)) => Some(if time - times[before] <= next - time {
            before
        } else {
            after
        }),
    }
}

/// A piecewise linear map between two clocks, extended beyond its ends with slope one.
#[derive(Debug, Clone, PartialEq)]
pub struct ClockMap {
    /// (from, to), ascending in both.
    pairs: Vec<(i64, i64)>,
}

impl ClockMap {
    /// `None` when there is nothing to map with.
    #[must_use]
    pub fn new(mut pairs: Vec<(i64, i64)>) -> Option<Self> {
        pairs.sort_unstable();
        pairs.dedup_by_key(|pair| pair.0);
        (!pairs.is_empty()).then_some(ClockMap { pairs })
    }

    /// A time of the first clock on the second one, both in nanoseconds.
    #[must_use]
    pub fn map(&self, time: i64) -> i64 {
        let after = self.pairs.partition_point(|pair| pair.0 <= time);
        let (first, last) = (self.pairs[0], self.pairs[self.pairs.len() - 1]);
        if after == 0 {
            return first.1.saturating_add(time.saturating_sub(first.0));
        }
        if after == self.pairs.len() {
            return last.1.saturating_add(time.saturating_sub(last.0));
        }
        let ((a, from), (b, to)) = (self.pairs[after - 1], self.pairs[after]);
        from + ((time - a) as f64 / (b - a) as f64 * (to - from) as f64).round() as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    const MS: i64 = 1_000_000;

    #[test]
    fn values_are_interpolated_and_gaps_are_gaps() {
        let track = Track::new(
            vec![
                (100 * MS, [2.0, 0.0]),
                (0, [0.0, 0.0]),
                (400 * MS, [9.0, 0.0]),
            ],
            150 * MS,
            20 * MS,
        );
        assert_eq!(track.at(25 * MS), Some([0.5, 0.0]));
        assert_eq!(track.at(-10 * MS), Some([0.0, 0.0]));
        assert_eq!(track.at(-30 * MS), None);
        assert_eq!(track.at(110 * MS), Some([2.0, 0.0]));
        assert_eq!(track.at(250 * MS), None);
        assert_eq!(track.at(400 * MS), Some([9.0, 0.0]));
    }

    #[test]
    fn a_joint_counts_at_its_own_time_whatever_its_neighbours_lack() {
        let joints = |there: bool| -> Joints { [there.then(Point3::origin); 21] };
        let samples = vec![(0, joints(true)), (100, joints(false)), (200, joints(true))];
        let track = Track::new(samples, 150, 20);
        let known = [0, 50, 100, 150, 200].map(|time| track.at(time).unwrap()[3].is_some());
        assert_eq!(known, [true, false, false, false, true]);
    }

    #[test]
    fn poses_turn_and_move_together() {
        let a = Isometry3::identity();
        let b = Isometry3::new(Vector3::x(), Vector3::z() * 1.0);
        let middle = a.blend(&b, 0.5).unwrap();
        assert!((middle.translation.vector - Vector3::x() * 0.5).norm() < 1e-12);
        assert!((middle.rotation.angle() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn clocks_map_between_and_beyond_their_pairs() {
        let map = ClockMap::new(vec![(0, 1000), (100, 1200)]).unwrap();
        assert_eq!(
            [-5, 0, 50, 100, 110].map(|t| map.map(t)),
            [995, 1000, 1100, 1200, 1210]
        );
        assert!(ClockMap::new(Vec::new()).is_none());
    }
}
