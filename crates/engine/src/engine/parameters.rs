//! How a model holds its numbers.
//!
//! A [`Parameter`] is one named array: trainable, or fixed (position tables, codebooks). A model is a struct of parameters and
//! of other such structs; [`parameters!`] lists its fields once, and from that list come names (the field path joined by dots,
//! exactly as in released checkpoints: `encoder.blocks.0.attn.qkv.weight`), counting, loading with shape checks and storing.

use std::collections::{BTreeMap, BTreeSet};

use burn::tensor::{Device, Tensor, TensorData};

use super::EngineError;
use super::weights::{HostTensor, Values, Weights};

/// Whether an optimizer touches a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Gradients are kept for it while the model trains.
    Trainable,
    /// Stored and loaded with the model, never changed by an optimizer.
    Buffer,
}

/// One array of a model.
#[derive(Debug, Clone)]
pub struct Parameter {
    shape: Vec<usize>,
    kind: Kind,
    /// Flat; `shape` is applied on use. `None` while an optimizer has the values out, and in models that are only planned.
    values: Option<Tensor<1>>,
}

impl Parameter {
    /// A parameter of `shape` with row-major `values`.
    ///
    /// # Panics
    /// When the number of values is not that of the shape.
    #[must_use]
    pub fn new(kind: Kind, values: Vec<f32>, shape: &[usize], device: &Device) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "{shape:?}");
        Self {
            shape: shape.to_vec(),
            kind,
            values: Some(flat(values, device)),
        }
    }

    /// A parameter without values: for counting and planning.
    #[must_use]
    pub fn meta(kind: Kind, shape: &[usize]) -> Self {
        Self {
            shape: shape.to_vec(),
            kind,
            values: None,
        }
    }

    /// The length of each axis: `[out, in]` for the weight of a linear layer.
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Whether an optimizer touches it.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// How many numbers it holds.
    #[must_use]
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether it holds no number: an axis of length 0.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The values at their shape; part of the autodiff graph while the model trains.
    ///
    /// # Panics
    /// When `D` is not the rank, or the model is only planned.
    #[must_use]
    pub fn tensor<const D: usize>(&self) -> Tensor<D> {
        let shape: [usize; D] = self
            .shape
            .as_slice()
            .try_into()
            .expect("the rank the layer was built with");
        self.flat().reshape(shape)
    }

    /// The values at another shape of as many elements (a 1x1 convolution as a matrix).
    #[must_use]
    pub fn reshaped<const D: usize>(&self, shape: [usize; D]) -> Tensor<D> {
        self.flat().reshape(shape)
    }

    /// The values, flat; the leaf of the autodiff graph while the model trains.
    #[must_use]
    pub fn flat(&self) -> Tensor<1> {
        self.values
            .clone()
            .expect("a model that computes has values")
    }

    /// The values, flat, outside any autodiff graph.
    #[must_use]
    pub fn untracked(&self) -> Tensor<1> {
        self.flat().without_autodiff()
    }

    /// Takes the values out for an in-place update; [`Parameter::put`] must follow.
    pub fn take(&mut self) -> Tensor<1> {
        self.values
            .take()
            .expect("a model that computes has values")
            .without_autodiff()
    }

    /// Puts values back, tracked if `tracked` and trainable.
    pub fn put(&mut self, values: Tensor<1>, tracked: bool) {
        self.values = Some(if tracked && self.kind == Kind::Trainable {
            values.autodiff().require_grad()
        } else {
            values
        });
    }

    /// Whether gradients are kept for it now.
    #[must_use]
    pub fn is_tracked(&self) -> bool {
        self.values.as_ref().is_some_and(Tensor::is_require_grad)
    }

    /// Replaces the values; the shape stays.
    ///
    /// # Panics
    /// When the number of values differs.
    pub fn set(&mut self, values: Vec<f32>) {
        assert_eq!(values.len(), self.len());
        let tracked = self.is_tracked();
        let device = self.take().device();
        self.put(flat(values, &device), tracked);
    }

    /// The values on the host, row-major.
    #[must_use]
    pub fn to_vec(&self) -> Vec<f32> {
        to_host(self.untracked())
    }
}

fn flat(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let length = values.len();
    Tensor::from_data(TensorData::new(values, [length]), device)
}

/// The values of a float tensor on the host, row-major.
#[must_use]
pub fn to_host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor
        .without_autodiff()
        .try_into_vec_as::<f32>()
        .expect("float tensors read back as f32")
}

/// A visitor of parameters that may change them.
pub type VisitMut<'a> = dyn FnMut(&str, &mut Parameter) + 'a;

/// Anything made of parameters. Implement it with [`parameters!`].
pub trait Parameters {
    /// Calls `visitor` with the name and the parameter, for every parameter, in the order of declaration.
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter));
    /// As [`Parameters::visit`], with the right to change.
    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>);

    /// Every name with its parameter's shape and kind, in order.
    fn inventory(&self) -> Vec<(String, Vec<usize>, Kind)> {
        let mut all = Vec::new();
        self.visit("", &mut |name, parameter| {
            all.push((
                name.to_owned(),
                parameter.shape().to_vec(),
                parameter.kind(),
            ));
        });
        all
    }

    /// How many trainable numbers there are.
    fn count(&self) -> usize {
        let mut count = 0;
        self.visit("", &mut |_, parameter| {
            if parameter.kind() == Kind::Trainable {
                count += parameter.len();
            }
        });
        count
    }

    /// All values on the host, by name.
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        self.visit("", &mut |name, parameter| {
            weights.tensors.insert(
                name.to_owned(),
                HostTensor {
                    shape: parameter.shape().to_vec(),
                    values: Values::F32(parameter.to_vec()),
                },
            );
        });
        weights
    }

    /// Checks that `weights` has every parameter in its shape. A model that is only planned may ask, so that a file whose
    /// description asks for more than it holds is refused before anything is allocated.
    ///
    /// # Errors
    /// On the first missing or misshapen tensor.
    fn check_shapes(&self, weights: &Weights) -> Result<(), EngineError> {
        for (name, shape, _) in self.inventory() {
            weights.get(&name, &shape)?;
        }
        Ok(())
    }

    /// Takes every value from `weights`, which must hold exactly the model's names and shapes, all finite.
    ///
    /// # Errors
    /// On the first missing, misshapen or non-finite tensor, or if `weights` holds names the model does not know. The model is
    /// not changed then.
    fn load(&mut self, weights: &Weights) -> Result<(), EngineError> {
        let mut known = BTreeSet::new();
        let mut error = None;
        self.visit("", &mut |name, parameter| {
            known.insert(name.to_owned());
            if error.is_none() {
                error = check(weights, name, parameter).err();
            }
        });
        if let Some(error) = error {
            return Err(error);
        }
        let mut unknown = weights.tensors.keys().filter(|name| !known.contains(*name));
        if let Some(first) = unknown.next() {
            return Err(EngineError::Unknown {
                count: 1 + unknown.count(),
                first: first.clone(),
            });
        }
        self.visit_mut("", &mut |name, parameter| {
            if let Some(HostTensor {
                values: Values::F32(values),
                ..
            }) = weights.tensors.get(name)
            {
                parameter.set(values.clone());
            }
        });
        Ok(())
    }

    /// Starts to keep gradients: from here on, forward passes record what backward needs.
    fn start_training(&mut self) {
        self.visit_mut("", &mut |_, parameter| {
            let values = parameter.take();
            parameter.put(values, true);
        });
    }

    /// A view of the model (sharing its memory) that records nothing: for validation and inference.
    #[must_use]
    fn frozen(&self) -> Self
    where
        Self: Clone,
    {
        let mut copy = self.clone();
        copy.visit_mut("", &mut |_, parameter| {
            let values = parameter.take();
            parameter.put(values, false);
        });
        copy
    }
}

fn check(weights: &Weights, name: &str, parameter: &Parameter) -> Result<(), EngineError> {
    let tensor = weights.get(name, parameter.shape())?;
    if tensor.f32(name)?.iter().any(|value| !value.is_finite()) {
        return Err(EngineError::NotFinite {
            name: name.to_owned(),
        });
    }
    Ok(())
}

/// `path.name`, or `name` at the root.
#[must_use]
pub fn join(path: &str, name: &str) -> String {
    match (path, name) {
        ("", name) => name.to_owned(),
        (path, "") => path.to_owned(),
        (path, name) => format!("{path}.{name}"),
    }
}

impl Parameters for Parameter {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        visitor(path, self);
    }
    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        visitor(path, self);
    }
}

impl<P: Parameters> Parameters for Option<P> {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        if let Some(inner) = self {
            inner.visit(path, visitor);
        }
    }
    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        if let Some(inner) = self {
            inner.visit_mut(path, visitor);
        }
    }
}

impl<P: Parameters> Parameters for Vec<P> {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        for (index, inner) in self.iter().enumerate() {
            inner.visit(&join(path, &index.to_string()), visitor);
        }
    }
    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        for (index, inner) in self.iter_mut().enumerate() {
            inner.visit_mut(&join(path, &index.to_string()), visitor);
        }
    }
}

impl<P: Parameters> Parameters for BTreeMap<String, P> {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        for (name, inner) in self {
            inner.visit(&join(path, name), visitor);
        }
    }
    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        for (name, inner) in self {
            inner.visit_mut(&join(path, name), visitor);
        }
    }
}

/// Lists the parameter-holding fields of a struct, in order: `parameters!(Linear { weight, bias })`. A field whose name in
/// files differs is written `field => "name"`; `""` puts the field's own parameters at the struct's level.
#[macro_export]
macro_rules! parameters {
    ($type:ty { $($field:ident $(=> $name:literal)?),* $(,)? }) => {
        impl $crate::engine::Parameters for $type {
            fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &$crate::engine::Parameter)) {
                $( $crate::engine::Parameters::visit(
                    &self.$field,
                    &$crate::engine::parameters::join(path, $crate::parameters!(@name $field $(=> $name)?)),
                    visitor,
                ); )*
            }
            fn visit_mut(&mut self, path: &str, visitor: &mut $crate::engine::parameters::VisitMut<'_>) {
                $( $crate::engine::Parameters::visit_mut(
                    &mut self.$field,
                    &$crate::engine::parameters::join(path, $crate::parameters!(@name $field $(=> $name)?)),
                    visitor,
                ); )*
            }
        }
    };
    (@name $field:ident) => { stringify!($field) };
    (@name $field:ident => $name:literal) => { $name };
}
pub use crate::parameters;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Compute;

    #[derive(Debug, Clone)]
    struct Leaf {
        weight: Parameter,
        table: Option<Parameter>,
    }
    parameters!(Leaf { weight, table => "position_embeddings" });

    #[derive(Debug, Clone)]
    struct Tree {
        blocks: Vec<Leaf>,
        last: Leaf,
    }
    parameters!(Tree { blocks, last => "out.proj" });

    fn tree() -> Tree {
        let compute = Compute::cpu();
        let leaf = |value: f32, table: bool| Leaf {
            weight: Parameter::new(Kind::Trainable, vec![value; 6], &[2, 3], compute.device()),
            table: table
                .then(|| Parameter::new(Kind::Buffer, vec![value; 2], &[2], compute.device())),
        };
        Tree {
            blocks: vec![leaf(1.0, true), leaf(2.0, false)],
            last: leaf(3.0, false),
        }
    }

    #[test]
    fn names_are_field_paths() {
        let names: Vec<String> = tree()
            .inventory()
            .into_iter()
            .map(|entry| entry.0)
            .collect();
        assert_eq!(
            names,
            [
                "blocks.0.weight",
                "blocks.0.position_embeddings",
                "blocks.1.weight",
                "out.proj.weight"
            ]
        );
        assert_eq!(tree().count(), 18);
    }

    #[test]
    fn loading_checks_names_shapes_and_values_and_changes_nothing_on_error() {
        let mut model = tree();
        let good = model.weights();

        let mut missing = good.clone();
        missing.tensors.remove("blocks.1.weight");
        assert!(matches!(
            model.load(&missing),
            Err(EngineError::Missing { .. })
        ));

        let mut other = good.clone();
        other.tensors.insert(
            "blocks.1.weight".into(),
            HostTensor::f32_of(vec![0.0; 4], &[4]),
        );
        let message = model.load(&other).unwrap_err().to_string();
        assert!(
            message.contains("[4]") && message.contains("[2, 3]"),
            "{message}"
        );

        let mut extra = good.clone();
        extra
            .tensors
            .insert("more".into(), HostTensor::f32_of(vec![0.0], &[1]));
        assert!(matches!(
            model.load(&extra),
            Err(EngineError::Unknown { count: 1, .. })
        ));

        let mut nan = good.clone();
        nan.tensors.insert(
            "out.proj.weight".into(),
            HostTensor::f32_of(vec![f32::NAN; 6], &[2, 3]),
        );
        assert!(matches!(
            model.load(&nan),
            Err(EngineError::NotFinite { .. })
        ));

        assert_eq!(model.weights(), good);
        let mut changed = good.clone();
        changed.tensors.insert(
            "out.proj.weight".into(),
            HostTensor::f32_of(vec![7.0; 6], &[2, 3]),
        );
        model.load(&changed).unwrap();
        assert_eq!(model.weights(), changed);
    }

    #[test]
    fn only_trainable_parameters_are_tracked_and_a_frozen_view_is_not() {
        let mut model = tree();
        model.start_training();
        let tracked = |model: &Tree| {
            let mut count = 0;
            model.visit("", &mut |_, parameter| {
                count += usize::from(parameter.is_tracked());
            });
            count
        };
        assert_eq!(tracked(&model), 3);
        assert_eq!(tracked(&model.frozen()), 0);
        assert_eq!(tracked(&model), 3);
    }
}
