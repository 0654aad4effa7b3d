//! A forward pass that is cut into parts, so that backward goes part by part, from the last to the first: after each the gradients of
//! its parameters are complete, and can be on their way to other ranks while backward goes on.
//!
//! Nothing is computed twice, and nothing is added in another order: the bits are those of the whole graph, where what is used in more than
//! two parts is used in them in the order of the parts.

use burn::tensor::Tensor;

use super::gradients::{Complete, Gradients};
use super::ops;
use super::parameters::Parameters;

/// Where a forward pass was cut.
#[derive(Debug, Default)]
pub struct Cuts {
    wanted: bool,
    cuts: Vec<Cut>,
}

/// The end of a part, and the beginning of the next: the same values, without where they came from.
#[derive(Debug)]
struct Cut {
    end: Tensor<2>,
    beginning: Tensor<2>,
}

impl Cuts {
    /// Leaves the graph whole.
    #[must_use]
    pub fn none() -> Self {
        Self::default()
    }

    /// Cuts where the forward pass can be cut, if that is `wanted`.
    #[must_use]
    pub fn wanted(wanted: bool) -> Self {
        Self {
            wanted,
            cuts: Vec::new(),
        }
    }

    /// Here it can be cut: whatever is computed from now on comes from the array that is given back, or from earlier ones, and with
    /// parameters that were not used before.
    #[must_use]
    pub fn at(&mut self, end: Tensor<2>) -> Tensor<2> {
        if !self.wanted {
            return end;
        }
        let beginning = end.clone().without_autodiff().autodiff().require_grad();
        self.cuts.push(Cut {
            end,
            beginning: beginning.clone(),
        });
        beginning
    }

    /// The gradients of `loss` (one element), which the last part has computed, in the parameters of `model`. `complete` hears of
    /// those of every part when backward is done with it.
    ///
    /// # Panics
    /// When two parts have a parameter in common.
    #[must_use]
    pub fn gradients<M: Parameters + ?Sized>(
        self,
        loss: &Tensor<1>,
        model: &M,
        complete: &mut Complete<'_>,
    ) -> Gradients {
        let mut gradients = Gradients::default();
        let beginnings: Vec<Tensor<2>> =
            self.cuts.iter().map(|cut| cut.beginning.clone()).collect();
        let mut slopes: Vec<Option<Tensor<2>>> = vec![None; beginnings.len()];
        let mut slope = Some(loss.clone());
        for (index, cut) in self.cuts.into_iter().enumerate().rev() {
            let before = &beginnings[..=index];
            if let Some(slope) = &slope {
                let found = gradients.add_part(slope, model, before, complete);
                for (sum, more) in slopes.iter_mut().zip(found) {
                    *sum = match (sum.take(), more) {
                        (Some(sum), Some(more)) => Some(sum + more),
                        (sum, more) => sum.or(more),
                    };
                }
            }
            slope = slopes[index].take().map(|slope| ops::slope(cut.end, slope));
        }
        if let Some(slope) = slope {
            gradients.add_part(&slope, model, &[], complete);
        }
        gradients.close("", model, complete);
        gradients
    }
}

/// The names of all parameters, about in the order in which backward is done with them: as the forward pass goes through `stages`
/// (beginnings of names) and within each through the parameters as they are declared, from the last to the first.
#[must_use]
pub fn backward_order<M: Parameters + ?Sized>(model: &M, stages: &[&str]) -> Vec<String> {
    let mut names = Vec::new();
    model.visit("", &mut |name, _| names.push(name.to_owned()));
    names.reverse();
    let stage = |name: &String| stages.iter().rposition(|stage| name.starts_with(stage));
    // What no stage names comes last.
    names.sort_by_key(|name| std::cmp::Reverse(stage(name)));
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{Compute, Initialise, parameters};
    use crate::nn::Linear;
    use burn::tensor::TensorData;

    struct Chain {
        layers: Vec<Linear>,
    }
    parameters!(Chain { layers });

    fn chain() -> Chain {
        let compute = Compute::cpu();
        let init = Initialise::new(&compute, 3);
        let mut chain = Chain {
            layers: (0..3)
                .map(|i| Linear::new(&init.item(i), 4, 4, true))
                .collect(),
        };
        chain.start_training();
        chain
    }

    /// Of the last layer's output, and of what comes out of the first.
    fn loss(chain: &Chain, order: &[usize], cuts: &mut Cuts) -> Tensor<1> {
        let values: Vec<f32> = (0..8_u8).map(|i| f32::from(i) * 0.1).collect();
        let mut x = Tensor::from_data(TensorData::new(values, [2, 4]), Compute::cpu().device());
        let mut first = None;
        for index in order {
            x = cuts.at(chain.layers[*index].forward(x).tanh());
            first.get_or_insert(x.clone());
        }
        x.square().sum() + first.unwrap().exp().sum()
    }

    #[test]
    fn parts_complete_from_the_last_to_the_first_with_the_bits_of_the_whole_graph() {
        let chain = chain();
        let expected = Gradients::of(&loss(&chain, &[0, 1, 2], &mut Cuts::none()), &chain);
        let mut cuts = Cuts::wanted(true);
        let loss = loss(&chain, &[0, 1, 2], &mut cuts);
        let mut told = Vec::new();
        let mut hear = |name: &str, gradient: &Tensor<1>| {
            told.push((name.to_owned(), to_host(gradient.clone())));
        };
        let found = cuts.gradients(&loss, &chain, &mut hear);
        let layers: Vec<&str> = told.iter().map(|(name, _)| &name[..8]).collect();
        let first = ["layers.2", "layers.1", "layers.0"].map(|layer| [layer; 2]);
        // Then all are named once more: whatever took no part has zeros.
        assert_eq!(layers[..6], first.concat());
        assert_eq!(layers.len(), 12);
        for (name, values) in &told {
            for gradients in [&expected, &found] {
                let of = gradients.get(name).unwrap().clone();
                assert_eq!(to_host(of), *values, "{name}");
            }
        }
    }

    #[test]
    #[should_panic(expected = "`layers.0.bias` is in two parts")]
    fn a_parameter_of_two_parts_is_refused() {
        let chain = chain();
        let mut cuts = Cuts::wanted(true);
        let loss = loss(&chain, &[0, 1, 0], &mut cuts);
        let _ = cuts.gradients(&loss, &chain, &mut |_, _| ());
    }
}
