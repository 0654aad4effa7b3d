//! Values over time: keys that are reached smoothly, and curves sampled on a fine grid.

use nalgebra::{Point3, Vector3};

/// Grid steps per second of everything that is simulated.
pub const GRID_RATE: f64 = 120.0;

/// From 0 to 1 with zero speed and acceleration at both ends: how people move a hand.
pub fn minimum_jerk(u: f64) -> f64 {
    let u = u.clamp(0.0, 1.0);
    u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
}

/// Something that can be mixed.
pub trait Mix: Copy {
    /// `t` 0 gives `self`, 1 gives `other`.
    #[must_use]
    fn mix(&self, other: &Self, t: f64) -> Self;
}

impl Mix for f64 {
    fn mix(&self, other: &Self, t: f64) -> Self {
        self + (other - self) * t
    }
}
impl Mix for Point3<f64> {
    fn mix(&self, other: &Self, t: f64) -> Self {
        self + (other - self) * t
    }
}
impl Mix for Vector3<f64> {
    fn mix(&self, other: &Self, t: f64) -> Self {
        self.lerp(other, t)
    }
}

/// A value to be reached between two times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Key<T> {
    /// Seconds: the value before holds until then.
    pub start: f64,
    /// Seconds: from then on the value holds.
    pub end: f64,
    /// The value that is reached.
    pub value: T,
}

impl<T> Key<T> {
    /// How much of the way to this key's value is done.
    pub fn progress(&self, t: f64) -> f64 {
        minimum_jerk((t - self.start) / (self.end - self.start).max(1e-6))
    }
}

/// Keys in the order they start; each moves on from whatever the earlier ones give.
pub fn value_at<T: Mix>(keys: &[Key<T>], initial: T, t: f64) -> T {
    keys.iter()
        .take_while(|k| k.start <= t)
        .fold(initial, |value, key| value.mix(&key.value, key.progress(t)))
}

/// A curve on the grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve(pub Vec<f64>);

impl Curve {
    /// Samples a function from 0 to `seconds`.
    pub fn sample(seconds: f64, f: impl FnMut(f64) -> f64) -> Self {
        let count = (seconds * GRID_RATE).ceil() as usize + 1;
        Self((0..count).map(|i| i as f64 / GRID_RATE).map(f).collect())
    }

    /// The value at a time; held at both ends, a cubic through the neighbours in between.
    pub fn at(&self, t: f64) -> f64 {
        let x = (t * GRID_RATE).clamp(0.0, (self.0.len() - 1) as f64);
        let i = (x.floor() as usize).min(self.0.len().saturating_sub(2));
        let u = x - i as f64;
        let get = |k: isize| {
            let k = (i as isize + k).clamp(0, self.0.len() as isize - 1);
            self.0[k as usize]
        };
        let (a, b, c, d) = (get(-1), get(0), get(1), get(2));
        let slope = (c - a) / 2.0;
        let next = (d - b) / 2.0;
        let (u2, u3) = (u * u, u * u * u);
        b * (2.0 * u3 - 3.0 * u2 + 1.0)
            + slope * (u3 - 2.0 * u2 + u)
            + c * (3.0 * u2 - 2.0 * u3)
            + next * (u3 - u2)
    }

    /// Three box filters: close to a Gaussian whose deviation is `sigma` seconds.
    #[must_use]
    pub fn smoothed(&self, sigma: f64) -> Self {
        let radius = (sigma * GRID_RATE).round() as usize;
        let mut values = self.0.clone();
        for _ in 0..3 {
            values = box_filter(&values, radius);
        }
        Self(values)
    }

    /// The smallest value within `radius` seconds.
    #[must_use]
    pub fn lowest_within(&self, radius: f64) -> Self {
        let r = (radius * GRID_RATE).ceil() as usize;
        let n = self.0.len();
        let lowest = |i: usize| {
            self.0[i.saturating_sub(r)..(i + r + 1).min(n)]
                .iter()
                .fold(f64::INFINITY, |a, b| a.min(*b))
        };
        Self((0..n).map(lowest).collect())
    }
}

fn box_filter(values: &[f64], radius: usize) -> Vec<f64> {
    let n = values.len() as isize;
    let get = |i: isize| values[i.clamp(0, n - 1) as usize];
    let width = (2 * radius + 1) as f64;
    let r = radius as isize;
    let mut sum: f64 = (-r..=r).map(get).sum();
    (0..n)
        .map(|i| {
            let mean = sum / width;
            sum += get(i + r + 1) - get(i - r);
            mean
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_arrive_on_time_and_hold() {
        let keys = [
            Key {
                start: 1.0,
                end: 2.0,
                value: 4.0,
            },
            Key {
                start: 3.0,
                end: 3.5,
                value: -1.0,
            },
        ];
        assert_eq!(value_at(&keys, 1.0, 0.5), 1.0);
        assert!((value_at(&keys, 1.0, 1.5) - 2.5).abs() < 1e-12);
        assert_eq!(value_at(&keys, 1.0, 2.7), 4.0);
        assert_eq!(value_at(&keys, 1.0, 9.0), -1.0);
    }

    #[test]
    fn curves_interpolate_smoothly_and_filters_keep_lines() {
        let line = Curve::sample(2.0, |t| 3.0 * t);
        assert!((line.at(0.504) - 1.512).abs() < 1e-9);
        assert!((line.smoothed(0.1).at(1.0) - 3.0).abs() < 1e-9);
        assert!((line.lowest_within(0.1).at(1.0) - 2.7).abs() < 0.03);
        let wave = Curve::sample(2.0, |t| (5.0 * t).sin());
        assert!((wave.at(0.777) - (5.0 * 0.777f64).sin()).abs() < 1e-4);
        // A minimum over the filter's whole support keeps the smooth curve below the sharp one.
        let low = wave.lowest_within(0.32).smoothed(0.1);
        for i in 0..wave.0.len() {
            assert!(low.0[i] <= wave.0[i] + 1e-9);
        }
    }
}
