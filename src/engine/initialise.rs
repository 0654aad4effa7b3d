//! Where the numbers of a new model come from.
//!
//! Every parameter draws from its own stream, keyed by the seed and its full name, so adding or reordering layers changes
//! nothing else.

use rand::RngExt;
use rand_distr::{Distribution, Normal};

use super::Compute;
use super::parameters::{Kind, Parameter, join};
use crate::random::stream;

/// The place in a model under construction: device, seed and path.
#[derive(Debug, Clone)]
pub struct Initialise<'a> {
    compute: &'a Compute,
    /// `None` when all values will be loaded: parameters start as zeros.
    seed: Option<u64>,
    path: String,
}

impl<'a> Initialise<'a> {
    /// A new model, drawn from `seed`.
    #[must_use]
    pub fn new(compute: &'a Compute, seed: u64) -> Self {
        Self {
            compute,
            seed: Some(seed),
            path: String::new(),
        }
    }

    /// A model whose values will all be loaded from a file.
    #[must_use]
    pub fn to_load(compute: &'a Compute) -> Self {
        Self {
            compute,
            seed: None,
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

    #[must_use]
    pub fn compute(&self) -> &'a Compute {
        self.compute
    }

    fn parameter(&self, kind: Kind, values: Vec<f32>, shape: &[usize]) -> Parameter {
        Parameter::new(kind, values, shape, self.compute.device())
    }

    fn drawn(
        &self,
        name: &str,
        shape: &[usize],
        draw: impl Fn(&mut crate::random::StreamRng) -> f32,
    ) -> Parameter {
        let length = shape.iter().product();
        let values = match self.seed {
            None => vec![0.0; length],
            Some(seed) => {
                let mut random = stream(
                    seed,
                    &format!("initialise.{}", join(&self.path, name)),
                    0,
                    0,
                );
                (0..length).map(|_| draw(&mut random)).collect()
            }
        };
        self.parameter(Kind::Trainable, values, shape)
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
        self.parameter(Kind::Trainable, vec![value; shape.iter().product()], shape)
    }

    /// Given values that no optimizer changes.
    #[must_use]
    pub fn fixed(&self, values: Vec<f32>, shape: &[usize]) -> Parameter {
        self.parameter(Kind::Fixed, values, shape)
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
