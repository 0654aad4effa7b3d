//! Where the numbers of a new model come from.
//!
//! Every parameter draws from its own stream, keyed by the seed and its full name, so adding or reordering layers changes
//! nothing else.

use rand::RngExt;
use rand_distr::{Distribution, Normal};

use super::Compute;
use super::parameters::{Kind, Parameter, join};
use crate::random::stream;

/// What values the parameters get.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fill {
    Drawn {
        seed: u64,
    },
    /// All will be loaded.
    Zeros,
    /// Shapes only.
    Nothing,
}

/// The place in a model under construction: device, seed and path.
#[derive(Debug, Clone)]
pub struct Initialise<'a> {
    compute: &'a Compute,
    values: Fill,
    path: String,
}

impl<'a> Initialise<'a> {
    /// A new model, drawn from `seed`.
    #[must_use]
    pub fn new(compute: &'a Compute, seed: u64) -> Self {
        Self {
            compute,
            values: Fill::Drawn { seed },
            path: String::new(),
        }
    }

    /// A model whose values will all be loaded from a file.
    #[must_use]
    pub fn empty(compute: &'a Compute) -> Self {
        Self {
            compute,
            values: Fill::Zeros,
            path: String::new(),
        }
    }

    /// A model that is only looked at: names, shapes and counts, no memory.
    #[must_use]
    pub fn meta(compute: &'a Compute) -> Self {
        Self {
            compute,
            values: Fill::Nothing,
            path: String::new(),
        }
    }

    /// The place `name` below this one. Use the names of the `parameters!` list.
    #[must_use]
    pub fn at(&self, name: &str) -> Self {
        Self {
            path: join(&self.path, name),
            ..self.clone()
        }
    }

    /// The element `index` of a list below this place.
    #[must_use]
    pub fn item(&self, index: usize) -> Self {
        self.at(&index.to_string())
    }

    /// The device that the parameters are made on.
    #[must_use]
    pub fn compute(&self) -> &'a Compute {
        self.compute
    }

    fn parameter(
        &self,
        kind: Kind,
        shape: &[usize],
        values: impl FnOnce(usize) -> Vec<f32>,
    ) -> Parameter {
        if self.values == Fill::Nothing {
            return Parameter::meta(kind, shape);
        }
        let values = values(shape.iter().product());
        Parameter::new(kind, values, shape, self.compute.device())
    }

    fn drawn(
        &self,
        name: &str,
        shape: &[usize],
        draw: impl Fn(&mut crate::random::StreamRng) -> f32,
    ) -> Parameter {
        self.parameter(Kind::Trainable, shape, |length| match self.values {
            Fill::Drawn { seed } => {
                let stream_name = format!("initialise.{}", join(&self.path, name));
                let mut random = stream(seed, &stream_name, 0, 0);
                (0..length).map(|_| draw(&mut random)).collect()
            }
            Fill::Zeros | Fill::Nothing => vec![0.0; length],
        })
    }

    /// Uniform in `[-bound, bound)`.
    #[must_use]
    pub fn uniform(&self, name: &str, shape: &[usize], bound: f64) -> Parameter {
        self.drawn(name, shape, |random| {
            ((2.0 * random.random::<f32>() - 1.0) * bound as f32).clamp(-bound as f32, bound as f32)
        })
    }

    /// Xavier uniform: bound `sqrt(6 / (fan_in + fan_out))`.
    #[must_use]
    pub fn xavier(&self, name: &str, shape: &[usize], fan_in: usize, fan_out: usize) -> Parameter {
        self.uniform(name, shape, (6.0 / (fan_in + fan_out) as f64).sqrt())
    }

    /// Normal with mean 0.
    #[must_use]
    pub fn normal(&self, name: &str, shape: &[usize], deviation: f64) -> Parameter {
        let normal = Normal::new(0.0, deviation).expect("a finite deviation");
        self.drawn(name, shape, |random| normal.sample(random) as f32)
    }

    /// All `value`, trainable.
    #[must_use]
    pub fn constant(&self, shape: &[usize], value: f32) -> Parameter {
        self.parameter(Kind::Trainable, shape, |length| vec![value; length])
    }

    /// Given values that no optimizer changes.
    #[must_use]
    pub fn fixed(&self, shape: &[usize], values: impl FnOnce() -> Vec<f32>) -> Parameter {
        self.parameter(Kind::Buffer, shape, |_| values())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parameter_depends_on_its_name_and_seed_alone() {
        let compute = Compute::cpu();
        let root = Initialise::new(&compute, 3);
        let a = root.at("encoder").item(0).xavier("weight", &[4, 4], 4, 4);
        let b = root.at("encoder").item(1).xavier("weight", &[4, 4], 4, 4);
        let again = Initialise::new(&compute, 3)
            .at("encoder.0")
            .xavier("weight", &[4, 4], 4, 4);
        assert_eq!(a.to_vec(), again.to_vec());
        assert_ne!(a.to_vec(), b.to_vec());
        assert!(a.to_vec().iter().all(|value| value.abs() <= 0.866_026));
    }
}
