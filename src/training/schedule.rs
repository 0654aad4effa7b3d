//! The learning rate of every step (Supp. B).
//!
//! Warm-up is linear from 0 to the peak, both included: with `W` warm-up steps, step `W - 1` and step `W` have the full rate.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What the learning rate does after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Shape {
    /// Half a cosine from the peak towards the final rate, which is never quite reached.
    #[default]
    Cosine,
    /// Stays at the peak.
    Constant,
    /// `sqrt(timescale / (timescale + i))` with a `timescale` above 0, then a linear cool-down to the final rate, which is
    /// reached.
    InverseSqrt {
        /// Steps after the warm-up at which the rate has fallen to `1 / sqrt(2)` of the peak; above 0.
        timescale: u64,
        /// Steps of the cool-down, the last ones of the run.
        cooldown_steps: u64,
    },
}

/// A learning rate for each of `total` steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    peak: f64,
    last: f64,
    warmup: u64,
    total: u64,
    shape: Shape,
}

/// Why a schedule cannot be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{warmup} warm-up and {cooldown} cool-down steps do not fit into a run of {total} steps")]
pub struct ScheduleError {
    /// Warm-up steps.
    pub warmup: u64,
    /// Cool-down steps.
    pub cooldown: u64,
    /// Steps of the whole run.
    pub total: u64,
}

impl Schedule {
    /// A schedule that rises to `peak` in `warmup` steps and ends near `last` after `total`.
    ///
    /// # Errors
    /// When warm-up and cool-down are longer than the run.
    pub fn new(
        shape: Shape,
        peak: f64,
        last: f64,
        warmup: u64,
        total: u64,
    ) -> Result<Self, ScheduleError> {
        let cooldown = match shape {
            Shape::InverseSqrt { cooldown_steps, .. } => cooldown_steps,
            _ => 0,
        };
        if warmup.checked_add(cooldown).is_none_or(|both| both > total) {
            return Err(ScheduleError {
                warmup,
                cooldown,
                total,
            });
        }
        Ok(Self {
            peak,
            last,
            warmup,
            total,
            shape,
        })
    }

    /// How many steps it covers.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// The learning rate of `step` (0-based); after the end, that of the last step.
    #[must_use]
    pub fn rate(&self, step: u64) -> f64 {
        let step = step.min(self.total.saturating_sub(1));
        if step < self.warmup {
            return if self.warmup == 1 {
                0.0
            } else {
                self.peak * step as f64 / (self.warmup - 1) as f64
            };
        }
        let i = (step - self.warmup) as f64;
        match self.shape {
            Shape::Constant => self.peak,
            Shape::Cosine => {
                let n = (self.total - self.warmup) as f64;
                self.last
                    + 0.5 * (self.peak - self.last) * (1.0 + (std::f64::consts::PI * i / n).cos())
            }
            Shape::InverseSqrt {
                timescale,
                cooldown_steps,
            } => {
                let decay = |i: f64| self.peak * (timescale as f64 / (timescale as f64 + i)).sqrt();
                let main = self.total - self.warmup - cooldown_steps;
                if step - self.warmup < main {
                    return decay(i);
                }
                let start = decay(main.saturating_sub(1) as f64);
                let j = i - main as f64;
                let share = if cooldown_steps == 1 {
                    0.0
                } else {
                    j / (cooldown_steps - 1) as f64
                };
                start + (self.last - start) * share
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_up_reaches_the_peak_twice_and_the_cosine_ends_near_zero() {
        let schedule = Schedule::new(Shape::Cosine, 4e-4, 0.0, 2385, 120_048).unwrap();
        assert_eq!(schedule.rate(0), 0.0);
        assert_eq!(schedule.rate(2384), 4e-4);
        assert_eq!(schedule.rate(2385), 4e-4);
        let last = schedule.rate(120_047);
        assert!((last - 7.128_857_504_312_691e-14).abs() < 1e-18, "{last}");
    }

    #[test]
    fn a_warm_up_longer_than_the_run_is_refused() {
        let error = Schedule::new(Shape::Cosine, 1.0, 0.0, 20, 10).unwrap_err();
        assert_eq!(
            error.to_string(),
            "20 warm-up and 0 cool-down steps do not fit into a run of 10 steps"
        );
    }
}
