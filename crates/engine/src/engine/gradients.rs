//! Gradients by parameter name.

use std::collections::BTreeMap;

use burn::tensor::{Gradients as Tape, Tensor};

use super::ops::Norm;
use super::parameters::{Parameters, join};

/// Hears of gradients that are complete while backward goes on with others: the parameter's name and its gradient, flat.
pub type Complete<'a> = dyn FnMut(&str, &Tensor<1>) + 'a;

/// One flat gradient per trainable parameter of a model. A parameter that took no part has a gradient of zeros, as in the
/// reference: momentum and weight decay still move it.
#[derive(Debug, Clone, Default)]
pub struct Gradients {
    by_name: BTreeMap<String, Tensor<1>>,
}

impl Gradients {
    /// Gradients of `loss` (one element) in every tracked parameter of `model`.
    ///
    /// # Panics
    /// When `loss` does not depend on any tracked parameter.
    pub fn of<M: Parameters + ?Sized>(loss: &Tensor<1>, model: &M) -> Self {
        let mut gradients = Self::default();
        let [] = gradients.add(loss, model, []);
        gradients.complete(model);
        gradients
    }

    /// Adds the gradients of `loss` (one element) in those tracked parameters of `model` that it depends on, and gives its
    /// gradients in `inputs`, tracked arrays that are no parameters. [`Gradients::complete`] must follow the last one.
    ///
    /// # Panics
    /// When `loss` does not depend on anything tracked.
    pub fn add<M: Parameters + ?Sized, const N: usize>(
        &mut self,
        loss: &Tensor<1>,
        model: &M,
        inputs: [&Tensor<2>; N],
    ) -> [Tensor<2>; N] {
        let mut tape = loss.backward();
        self.collect(&mut tape, model);
        inputs.map(|input| {
            let gradient = input.grad_remove(&mut tape);
            gradient.unwrap_or_else(|| input.clone().without_autodiff().zeros_like())
        })
    }

    fn collect<M: Parameters + ?Sized>(&mut self, tape: &mut Tape, model: &M) {
        model.visit("", &mut |name, parameter| {
            if !parameter.is_tracked() {
                return;
            }
            let Some(more) = parameter.flat().grad_remove(tape) else {
                return;
            };
            match self.by_name.get_mut(name) {
                Some(sum) => sum.inplace(|sum| sum + more),
                None => {
                    self.by_name.insert(name.to_owned(), more);
                }
            }
        });
    }

    /// As [`Gradients::add`] for a part of a graph whose parameters no other part has: `complete` hears of their gradients. There is
    /// nothing for `inputs` that the part does not depend on.
    ///
    /// # Panics
    /// When another part has one of them, or `loss` does not depend on anything tracked.
    pub fn add_part<M: Parameters + ?Sized>(
        &mut self,
        loss: &Tensor<1>,
        model: &M,
        inputs: &[Tensor<2>],
        complete: &mut Complete<'_>,
    ) -> Vec<Option<Tensor<2>>> {
        let mut tape = loss.backward();
        let mut part = Self::default();
        part.collect(&mut tape, model);
        for (name, gradient) in part.by_name {
            assert!(
                !self.by_name.contains_key(&name),
                "parameter `{name}` is in two parts of the graph"
            );
            complete(&name, &gradient);
            self.by_name.insert(name, gradient);
        }
        let inputs = inputs.iter();
        inputs.map(|input| input.grad_remove(&mut tape)).collect()
    }

    /// Gives every tracked parameter of `model` that has no gradient yet one of zeros.
    pub fn complete<M: Parameters + ?Sized>(&mut self, model: &M) {
        self.close("", model, &mut |_, _| ());
    }

    /// Backward is done with `part`, whose names begin with `path`: its tracked parameters that have no gradient get one of zeros, and
    /// `complete` hears of all of them.
    pub fn close<M: Parameters + ?Sized>(
        &mut self,
        path: &str,
        part: &M,
        complete: &mut Complete<'_>,
    ) {
        part.visit(path, &mut |name, parameter| {
            if parameter.is_tracked() {
                let gradient = self.by_name.entry(name.to_owned());
                let gradient = gradient.or_insert_with(|| parameter.untracked().zeros_like());
                complete(name, gradient);
            }
        });
    }

    /// As [`Gradients::close`] for part `index` of a list at `path`.
    pub fn close_item<M: Parameters + ?Sized>(
        &mut self,
        path: &str,
        index: usize,
        part: &M,
        complete: &mut Complete<'_>,
    ) {
        self.close(&join(path, &index.to_string()), part, complete);
    }

    /// From flat tensors by name.
    #[must_use]
    pub fn from_map(by_name: BTreeMap<String, Tensor<1>>) -> Self {
        Self { by_name }
    }

    /// The gradient of one parameter, flat.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Tensor<1>> {
        self.by_name.get(name)
    }

    /// Takes the gradient of one parameter out.
    pub fn remove(&mut self, name: &str) -> Option<Tensor<1>> {
        self.by_name.remove(name)
    }

    /// All gradients in the order of names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor<1>)> {
        self.by_name
            .iter()
            .map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// Adds `other`, a gradient of the same model (gradient accumulation, sums over devices).
    ///
    /// # Panics
    /// When the names differ.
    #[must_use]
    pub fn plus(mut self, mut other: Self) -> Self {
        assert_eq!(self.by_name.len(), other.by_name.len());
        for (name, tensor) in &mut self.by_name {
            let more = other
                .by_name
                .remove(name)
                .expect("gradients of the same model");
            tensor.inplace(|sum| sum + more);
        }
        self
    }

    /// The Euclidean norm over all gradients together.
    #[must_use]
    pub fn norm(&self) -> Norm {
        Norm::of(self.by_name.values())
    }
}
