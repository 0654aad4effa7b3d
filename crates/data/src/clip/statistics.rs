//! What is in many clips: per channel of a signal how many values there are, how many are valid, and their mean, spread and
//! range. One pass, in the order of the clips, so that the same clips give the same bytes.

use super::Signal;
use serde::{Deserialize, Serialize};

/// Statistics of one modality over many clips.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SignalStatistics {
    /// Clips that have the signal.
    pub clips: u64,
    /// Clips that do not.
    pub without: u64,
    /// Samples (of every joint, of every pixel) and how many of them are valid.
    pub samples: u64,
    /// Those of [`SignalStatistics::samples`] that are valid.
    pub valid: u64,
    /// By channel: the last axis of the signal.
    pub channels: Vec<ChannelStatistics>,
}

/// Statistics of one channel over the valid samples.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ChannelStatistics {
    /// Unit of the values, as the modality names it; empty where it names none.
    pub unit: String,
    /// Valid and finite values.
    pub count: u64,
    /// Mean of the counted values, in their unit; 0 where there are none.
    pub mean: f64,
    /// Population standard deviation.
    pub std: f64,
    /// Smallest counted value; 0 where there are none.
    pub min: f64,
    /// Largest counted value; 0 where there are none.
    pub max: f64,
    /// Sum of squared deviations from the mean (Welford).
    #[serde(skip)]
    squares: f64,
}

impl SignalStatistics {
    /// Adds a clip's signal; `units` has one entry per channel, or one for all.
    pub fn add(&mut self, signal: Option<&Signal>, units: &[String]) {
        let Some(signal) = signal else {
            self.without += 1;
            return;
        };
        self.clips += 1;
        let width = signal.values.shape().last().copied().unwrap_or(1).max(1);
        while self.channels.len() < width {
            let unit = units.get(self.channels.len()).or(units.first()).cloned();
            self.channels.push(ChannelStatistics {
                unit: unit.unwrap_or_default(),
                ..ChannelStatistics::default()
            });
        }
        let samples = signal.values.len() / width;
        self.samples += samples as u64;
        let mut values = signal.values.iter();
        let mut valid = signal.valid.as_ref().map(|valid| valid.iter());
        for _ in 0..samples {
            let is_valid = valid
                .as_mut()
                .is_none_or(|valid| valid.next() == Some(&true));
            self.valid += u64::from(is_valid);
            for channel in &mut self.channels[..width] {
                let value = values.next().copied().unwrap_or(f32::NAN);
                if is_valid && value.is_finite() {
                    channel.add(f64::from(value));
                }
            }
        }
        for channel in &mut self.channels {
            channel.std = (channel.squares / channel.count.max(1) as f64).sqrt();
        }
    }

    /// Adds the statistics of other clips; in the order of the clips, the same numbers come out whatever was counted apart.
    pub fn merge(&mut self, other: &Self) {
        self.clips += other.clips;
        self.without += other.without;
        self.samples += other.samples;
        self.valid += other.valid;
        for (index, channel) in other.channels.iter().enumerate() {
            match self.channels.get_mut(index) {
                Some(own) => own.merge(channel),
                None => self.channels.push(channel.clone()),
            }
        }
    }

    /// The share of samples that are valid, in 0..=1.
    pub fn valid_share(&self) -> f64 {
        self.valid as f64 / (self.samples.max(1)) as f64
    }
}

impl ChannelStatistics {
    fn add(&mut self, value: f64) {
        if self.count == 0 {
            (self.min, self.max) = (value, value);
        }
        self.count += 1;
        let before = value - self.mean;
        self.mean += before / self.count as f64;
        self.squares += before * (value - self.mean);
        self.min = self.min.min(value);
        self.max = self.max.max(value);
    }

    /// Chan's combination of two counts.
    fn merge(&mut self, other: &Self) {
        if other.count == 0 {
            return;
        }
        if self.count == 0 {
            let unit = std::mem::take(&mut self.unit);
            *self = other.clone();
            self.unit = unit;
            return;
        }
        let (a, b) = (self.count as f64, other.count as f64);
        let apart = other.mean - self.mean;
        self.count += other.count;
        self.mean += apart * b / (a + b);
        self.squares += other.squares + apart * apart * a * b / (a + b);
        self.std = (self.squares / (a + b)).sqrt();
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{ArrayD, IxDyn};

    #[test]
    fn only_valid_and_finite_values_count() {
        let values = vec![1.0, 10.0, 3.0, f32::NAN, 100.0, 1000.0];
        let signal = Signal {
            values: ArrayD::from_shape_vec(IxDyn(&[3, 2]), values).unwrap(),
            valid: Some(ArrayD::from_shape_vec(IxDyn(&[3]), vec![true, true, false]).unwrap()),
        };
        let mut all = SignalStatistics::default();
        all.add(Some(&signal), &["m".into()]);
        all.add(None, &["m".into()]);
        assert_eq!(
            (all.clips, all.without, all.samples, all.valid),
            (1, 1, 3, 2)
        );
        let [x, y] = all.channels.as_slice() else {
            panic!("two channels");
        };
        assert_eq!(
            (x.count, x.mean, x.std, x.min, x.max),
            (2, 2.0, 1.0, 1.0, 3.0)
        );
        assert_eq!((y.count, y.mean, y.std), (1, 10.0, 0.0));
        assert_eq!(y.unit, "m");
    }

    #[test]
    fn clips_counted_apart_add_up_to_clips_counted_together() {
        let part = |from: u16, to: u16| Signal {
            values: ArrayD::from_shape_fn(IxDyn(&[usize::from(to - from), 1]), |i| {
                (f32::from(from) + i[0] as f32).sin() * 5.0
            }),
            valid: None,
        };
        let [mut whole, mut first, mut second] = [(); 3].map(|()| SignalStatistics::default());
        whole.add(Some(&part(0, 100)), &["m".into()]);
        first.add(Some(&part(0, 30)), &["m".into()]);
        second.add(Some(&part(30, 100)), &["m".into()]);
        first.merge(&second);
        let (a, b) = (&whole.channels[0], &first.channels[0]);
        assert_eq!((a.count, a.min, a.max), (b.count, b.min, b.max));
        assert!((a.mean - b.mean).abs() < 1e-12 && (a.std - b.std).abs() < 1e-12);
        assert_eq!(b.unit, "m");
    }

    #[test]
    fn values_far_from_zero_keep_their_spread() {
        let values: Vec<f32> = (0..1000_u16).map(|i| 1e6 + f32::from(i % 2)).collect();
        let signal = Signal {
            values: ArrayD::from_shape_vec(IxDyn(&[1000, 1]), values).unwrap(),
            valid: None,
        };
        let mut all = SignalStatistics::default();
        all.add(Some(&signal), &[]);
        assert!((all.channels[0].std - 0.5).abs() < 1e-9);
    }
}
