//! Gradients with the activations of one block at a time: of every block its input is kept, and backward computes the block
//! once more. More arithmetic, and memory that hardly grows with depth. Parts of the model are complete one after the other, as in
//! `backward_in_parts`.

use super::batch::{Batch, EncoderInput};
use super::loss::{Loss, Losses};
use super::model::{Mget, decoder_segments};
use crate::engine::gradients::Complete;
use crate::engine::{Gradients, Parameters, Segments, Tensor, ops};

impl Mget {
    /// The losses of a batch, and the gradients of `share` times their total; `None` when there is no target or the total is not
    /// finite. Equal to [`Mget::losses`] and [`Gradients::of`] up to rounding. `complete` hears of the gradients of every part when
    /// backward is done with it, in the order of [`Mget::backward_order`].
    #[must_use]
    pub fn recomputed(
        &self,
        batch: &Batch,
        kind: Loss,
        share: f64,
        complete: &mut Complete<'_>,
    ) -> (Losses, Option<Gradients>) {
        let frozen = self.frozen();
        let encoder = frozen.encoder_inputs(&batch.visible);
        let context_ND = encoder.last().map(|h_ND| {
            let positional_ND = frozen
                .encoder_embeddings
                .positional_embedding(&batch.visible.sequence);
            frozen.context(frozen.encoder_norm.forward(h_ND.clone()), positional_ND)
        });
        let decoder = frozen.decoder_inputs(context_ND.as_ref(), batch);
        drop(frozen);

        // From here on backwards, a part at a time: its input becomes a leaf, and its output is multiplied by the gradient that the
        // part behind it gave.
        let mut gradients = Gradients::default();
        let y_MD = decoder.last().map(leaf);
        let losses = self.losses_of(
            y_MD.clone().map(|y_MD| self.decoder_norm.forward(y_MD)),
            batch,
            kind,
        );
        let found = losses.untracked();
        let (Some(y_MD), Some(total)) = (y_MD, losses.total) else {
            return (found, None);
        };
        if found.is_known_bad() {
            return (found, None);
        }
        let [mut dy_MD] = gradients.add(&(total * share), self, [&y_MD]);
        drop(y_MD);
        gradients.close("decoder_norm", &self.decoder_norm, complete);
        gradients.close("decoder_embeddings", &self.decoder_embeddings, complete);

        let targets = &batch.targets.sequence;
        let (own_modality, visible) = decoder_segments(&batch.visible.sequence.lengths, targets);
        let mut dcontext_ND: Option<Tensor<2>> = None;
        for (index, (block, input_MD)) in self.decoder.iter().zip(&decoder).enumerate().rev() {
            let y_MD = leaf(input_MD);
            let context_ND = context_ND.as_ref().map(leaf);
            let out_MD = block.forward(y_MD.clone(), context_ND.as_ref(), &own_modality, &visible);
            let slope = ops::slope(out_MD, dy_MD);
            if let Some(context_ND) = context_ND {
                let [dy, dcontext] = gradients.add(&slope, self, [&y_MD, &context_ND]);
                dy_MD = dy;
                dcontext_ND = Some(match dcontext_ND {
                    Some(sum) => sum + dcontext,
                    None => dcontext,
                });
            } else {
                [dy_MD] = gradients.add(&slope, self, [&y_MD]);
            }
            gradients.close_item("decoder", index, block, complete);
        }
        let [] = gradients.add(&ops::slope(self.decoder_queries(targets), dy_MD), self, []);

        if let (Some(dcontext_ND), Some(h_ND)) = (dcontext_ND, encoder.last().map(leaf)) {
            let positional_ND = self
                .encoder_embeddings
                .positional_embedding(&batch.visible.sequence);
            let context_ND = self.context(self.encoder_norm.forward(h_ND.clone()), positional_ND);
            let [mut dh_ND] = gradients.add(&ops::slope(context_ND, dcontext_ND), self, [&h_ND]);
            gradients.close("encoder_norm", &self.encoder_norm, complete);
            gradients.close("decoder_proj_context", &self.decoder_proj_context, complete);
            let samples = Segments::within(&batch.visible.sequence.lengths);
            for (index, (block, input_ND)) in self.encoder.iter().zip(&encoder).enumerate().rev() {
                let h_ND = leaf(input_ND);
                let out_ND = block.forward(h_ND.clone(), &samples);
                [dh_ND] = gradients.add(&ops::slope(out_ND, dh_ND), self, [&h_ND]);
                gradients.close_item("encoder", index, block, complete);
            }
            // Anew: backward has consumed the graph of the first.
            let positional_ND = self
                .encoder_embeddings
                .positional_embedding(&batch.visible.sequence);
            let input_ND = self.input_embedding(&batch.visible, positional_ND);
            let [] = gradients.add(&ops::slope(input_ND, dh_ND), self, []);
        }
        gradients.close("", self, complete);
        (found, Some(gradients))
    }

    /// The input of every block of the encoder, and the output of the last; nothing when nothing is visible.
    fn encoder_inputs(&self, visible: &EncoderInput) -> Vec<Tensor<2>> {
        if visible.sequence.is_empty() {
            return Vec::new();
        }
        let samples = Segments::within(&visible.sequence.lengths);
        let positional_ND = self
            .encoder_embeddings
            .positional_embedding(&visible.sequence);
        let mut inputs = vec![self.input_embedding(visible, positional_ND)];
        for (place, block) in self.encoder.iter().enumerate() {
            inputs.push(block.forward(inputs[place].clone(), &samples));
        }
        inputs
    }

    /// The input of every block of the decoder, and the output of the last; empty when there are no targets.
    fn decoder_inputs(&self, context_ND: Option<&Tensor<2>>, batch: &Batch) -> Vec<Tensor<2>> {
        let targets = &batch.targets.sequence;
        if targets.is_empty() {
            return Vec::new();
        }
        let (own_modality, visible) = decoder_segments(&batch.visible.sequence.lengths, targets);
        let mut inputs = vec![self.decoder_queries(targets)];
        for (place, block) in self.decoder.iter().enumerate() {
            let y_MD = inputs[place].clone();
            inputs.push(block.forward(y_MD, context_ND, &own_modality, &visible));
        }
        inputs
    }
}

/// A value whose gradient is needed.
fn leaf(value: &Tensor<2>) -> Tensor<2> {
    value.clone().autodiff().require_grad()
}

#[cfg(test)]
mod tests {
    use super::super::{Content, MgetSpec, ModalitySpec, Positions, Size};
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{Compute, DeviceChoice, Initialise, Precision};
    use crate::masking::Mask;

    fn spec() -> MgetSpec {
        MgetSpec {
            size: Size {
                width: 24,
                heads: 2,
                encoder_depth: 2,
                decoder_depth: 3,
                hidden: 0,
            },
            positions: Positions::Released,
            modalities: vec![
                ModalitySpec::tokens("camera", &[4], 10),
                ModalitySpec::tokens("gaze", &[4], 7),
                ModalitySpec::pixels("pixels", [2, 4, 4, 1], [1, 2, 2]),
            ],
        }
    }

    fn batch(inputs: [[&[u32]; 3]; 2], targets: [[&[u32]; 3]; 2]) -> Batch {
        let clip: Vec<f32> = (0..32_u8).map(|i| f32::from(i) / 32.0).collect();
        let sample = || {
            vec![
                Content::Ids(&[1, 2, 3, 4]),
                Content::Ids(&[5, 6, 0, 1]),
                Content::Floats(&clip),
            ]
        };
        let masks: Vec<Mask> = inputs
            .iter()
            .zip(targets)
            .map(|(input, target)| Mask {
                input: input.map(<[u32]>::to_vec).to_vec(),
                target: target.map(<[u32]>::to_vec).to_vec(),
            })
            .collect();
        Batch::new(&spec(), &[sample(), sample()], &masks).unwrap()
    }

    fn model() -> Mget {
        model_in(Precision::F32)
    }

    fn model_in(precision: Precision) -> Mget {
        let compute = Compute::new(DeviceChoice::CPU, precision).unwrap();
        let mut model = Mget::new(&spec(), &Initialise::new(&compute, 3)).unwrap();
        model.start_training();
        model
    }

    #[test]
    fn recomputed_gradients_are_those_of_the_whole_graph() {
        let nothing: [&[u32]; 3] = [&[], &[], &[]];
        let cases = [
            batch(
                [[&[0, 2], &[1], &[0, 5]], [&[], &[3], &[]]],
                [[&[1], &[0, 2], &[]], [&[0, 1, 2], &[], &[]]],
            ),
            batch([nothing, nothing], [[&[1], &[0], &[]], nothing]),
        ];
        let model = model();
        for batch in cases {
            let whole = model.losses(&batch, Loss::Mod);
            let expected = Gradients::of(&(whole.total.clone().unwrap() * 0.5), &model);
            let (losses, found) = model.recomputed(&batch, Loss::Mod, 0.5, &mut |_, _| ());
            let found = found.unwrap();
            assert_eq!(losses.values(), whole.values());
            assert_eq!(found.iter().count(), expected.iter().count());
            for (name, gradient) in expected.iter() {
                let other = to_host(found.get(name).unwrap().clone());
                for (a, b) in to_host(gradient.clone()).into_iter().zip(other) {
                    assert!((a - b).abs() < 1e-6 + 1e-5 * a.abs(), "{name}: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn gradients_in_parts_are_those_of_the_whole_graph_to_the_bit_and_complete_when_they_are_said_to_be()
     {
        let nothing: [&[u32]; 3] = [&[], &[], &[]];
        let cases = [
            batch(
                [[&[0, 2], &[1], &[0, 5]], [&[], &[3], &[]]],
                [[&[1], &[0, 2], &[]], [&[0, 1, 2], &[], &[]]],
            ),
            batch([nothing, nothing], [[&[1], &[0], &[]], nothing]),
        ];
        let bits = |gradient: &Tensor<1>| -> Vec<u32> {
            to_host(gradient.clone())
                .into_iter()
                .map(f32::to_bits)
                .collect()
        };
        for model in [Precision::F32, Precision::Bf16].map(model_in) {
            for batch in &cases {
                let whole = model.losses(batch, Loss::Mod);
                let expected = Gradients::of(&(whole.total.clone().unwrap() * 0.5), &model);
                let mut told: Vec<(String, Vec<u32>)> = Vec::new();
                let mut hear = |name: &str, gradient: &Tensor<1>| {
                    if told.iter().all(|(other, _)| other != name) {
                        told.push((name.to_owned(), bits(gradient)));
                    }
                };
                let (losses, found) = model.gradients_in_parts(batch, Loss::Mod, 0.5, &mut hear);
                let found = found.unwrap();
                assert_eq!(losses.values(), whole.values());
                assert_eq!(found.iter().count(), expected.iter().count());
                assert_eq!(told.len(), expected.iter().count());
                for (name, early) in &told {
                    let gradient = expected.get(name).unwrap();
                    assert_eq!(bits(found.get(name).unwrap()), bits(gradient), "{name}");
                    assert_eq!(*early, bits(gradient), "{name} when it was told");
                }
                let (_, recomputed) = model.recomputed(batch, Loss::Mod, 0.5, &mut |_, _| ());
                assert_eq!(recomputed.unwrap().iter().count(), told.len());
            }
        }
    }

    #[test]
    fn the_order_of_backward_names_every_parameter_once_and_blocks_from_the_last_to_the_first() {
        let model = model();
        let order = model.backward_order();
        let mut names: Vec<String> = model.inventory().into_iter().map(|entry| entry.0).collect();
        let at = |part: &str| {
            order
                .iter()
                .position(|name| name.starts_with(part))
                .unwrap()
        };
        assert!(
            at("decoder_embeddings.") < at("decoder.2.") && at("decoder.2.") < at("decoder.0.")
        );
        assert!(
            at("decoder.0.") < at("encoder.1.") && at("encoder.0.") < at("encoder_embeddings.")
        );
        let mut sorted = order.clone();
        sorted.sort();
        names.sort();
        assert_eq!(sorted, names);
    }

    #[test]
    fn rounding_products_to_bf16_changes_losses_and_gradients_a_little() {
        let batch = batch(
            [[&[0, 2], &[1], &[0, 5]], [&[], &[3], &[]]],
            [[&[1], &[0, 2], &[]], [&[0, 1, 2], &[], &[]]],
        );
        let found = [Precision::F32, Precision::Bf16].map(|precision| {
            let model = model_in(precision);
            let losses = model.losses(&batch, Loss::Mod);
            let gradients = Gradients::of(losses.total.as_ref().unwrap(), &model);
            let norm = gradients.norm().read();
            (losses.values().total, norm, gradients)
        });
        let [(loss, norm, exact), (loss16, norm16, rounded)] = found;
        assert!(
            loss != loss16 && (loss16 / loss - 1.0).abs() < 2e-2,
            "{loss} {loss16}"
        );
        assert!((norm16 / norm - 1.0).abs() < 2e-2, "{norm} {norm16}");
        let apart: f64 = exact
            .iter()
            .map(|(name, gradient)| {
                let other = rounded.get(name).unwrap().clone();
                let off = to_host(gradient.clone() - other);
                off.into_iter().map(|x| f64::from(x).powi(2)).sum::<f64>()
            })
            .sum();
        let apart = apart.sqrt() / norm;
        assert!(apart > 0.0 && apart < 2e-2, "{apart}");
    }

    #[test]
    fn a_batch_that_asks_for_nothing_has_no_gradient() {
        let nothing: [&[u32]; 3] = [&[], &[], &[]];
        let batch = batch([[&[0], &[], &[]], nothing], [nothing, nothing]);
        let (losses, gradients) = model().recomputed(&batch, Loss::Mod, 1.0, &mut |_, _| ());
        assert_eq!(losses.values().total, 0.0);
        assert!(gradients.is_none());
    }
}
