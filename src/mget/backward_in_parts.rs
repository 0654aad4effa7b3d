//! Gradients part by part: the graph of a batch is cut between blocks, and backward goes from cut to cut. After each the gradients
//! of a part of the model are complete, and can be on their way to other ranks while backward goes on.
//!
//! Nothing is computed twice, and nothing is added in another order: the bits are those of [`Mget::losses`] and [`Gradients::of`].

use super::batch::Batch;
use super::loss::{Loss, Losses};
use super::model::{Mget, decoder_segments};
use crate::engine::gradients::Complete;
use crate::engine::{Gradients, Parameters, Segments, Tensor, ops};

/// A part of the graph: what went in, cut off from where it came from, and what came out.
struct Part {
    input: Tensor<2>,
    output: Tensor<2>,
}

impl Part {
    fn new(input: &Tensor<2>, forward: impl FnOnce(Tensor<2>) -> Tensor<2>) -> Self {
        let input = leaf(input);
        let output = forward(input.clone());
        Self { input, output }
    }
}

/// The encoder's side of a graph that was cut.
struct EncoderGraph {
    /// `[N, D]`, a leaf of its own: it is used twice.
    positional_ND: Tensor<2>,
    cut_positional_ND: Tensor<2>,
    input_ND: Tensor<2>,
    blocks: Vec<Part>,
    /// From the last block to the context.
    context: Part,
}

impl Mget {
    /// The losses of a batch, and the gradients of `share` times their total; `None` when there is no target or the total is not
    /// finite. `complete` hears of the gradients of every part when backward is done with it.
    #[must_use]
    pub fn gradients_in_parts(
        &self,
        batch: &Batch,
        kind: Loss,
        share: f64,
        complete: &mut Complete<'_>,
    ) -> (Losses, Option<Gradients>) {
        let encoder = self.encoder_graph(batch);
        let context_ND = encoder.as_ref().map(|graph| leaf(&graph.context.output));
        let targets = &batch.targets.sequence;
        let (own_modality, visible) = decoder_segments(&batch.visible.sequence.lengths, targets);
        let queries_MD = (!targets.is_empty()).then(|| self.decoder_queries(targets));
        let mut decoder: Vec<Part> = Vec::new();
        let mut y_MD = queries_MD.clone();
        for block in &self.decoder {
            y_MD = y_MD.map(|y_MD| {
                let part = Part::new(&y_MD, |y_MD| {
                    block.forward(y_MD, context_ND.as_ref(), &own_modality, &visible)
                });
                let output = part.output.clone();
                decoder.push(part);
                output
            });
        }
        let y_MD = y_MD.as_ref().map(leaf);
        let normed_MD = y_MD.clone().map(|y_MD| self.decoder_norm.forward(y_MD));
        let losses = self.losses_of(normed_MD, batch, kind);
        let found = losses.untracked();
        let (Some(y_MD), Some(queries_MD), Some(total)) = (y_MD, queries_MD, losses.total) else {
            return (found, None);
        };
        if found.is_known_bad() {
            return (found, None);
        }

        let mut gradients = Gradients::default();
        let [mut dy_MD] = gradients.add(&(total * share), self, [&y_MD]);
        gradients.close("decoder_norm", &self.decoder_norm, complete);
        gradients.close("decoder_embeddings", &self.decoder_embeddings, complete);
        let mut dcontext_ND: Option<Tensor<2>> = None;
        for (index, (block, part)) in self.decoder.iter().zip(decoder).enumerate().rev() {
            let slope = ops::slope(part.output, dy_MD);
            if let Some(context_ND) = &context_ND {
                let [dy, dcontext] = gradients.add(&slope, self, [&part.input, context_ND]);
                dy_MD = dy;
                dcontext_ND = Some(match dcontext_ND {
                    Some(sum) => sum + dcontext,
                    None => dcontext,
                });
            } else {
                [dy_MD] = gradients.add(&slope, self, [&part.input]);
            }
            gradients.close_item("decoder", index, block, complete);
        }
        let [] = gradients.add(&ops::slope(queries_MD, dy_MD), self, []);
        if let (Some(graph), Some(dcontext_ND)) = (encoder, dcontext_ND) {
            self.encoder_gradients(graph, dcontext_ND, &mut gradients, complete);
        }
        gradients.close("", self, complete);
        (found, Some(gradients))
    }

    /// The names of all trainable parameters, in the order in which [`Mget::gradients_in_parts`] completes their gradients.
    #[must_use]
    pub fn backward_order(&self) -> Vec<String> {
        let mut names = Vec::new();
        let mut note = |path: &str, part: &dyn Parameters| {
            part.visit(path, &mut |name, _| names.push(name.to_owned()));
        };
        note("decoder_norm", &self.decoder_norm);
        note("decoder_embeddings", &self.decoder_embeddings);
        for (index, block) in self.decoder.iter().enumerate().rev() {
            note(&format!("decoder.{index}"), block);
        }
        note("encoder_norm", &self.encoder_norm);
        note("decoder_proj_context", &self.decoder_proj_context);
        for (index, block) in self.encoder.iter().enumerate().rev() {
            note(&format!("encoder.{index}"), block);
        }
        note("encoder_embeddings", &self.encoder_embeddings);
        names.push("mask_token".to_owned());
        names
    }

    fn encoder_graph(&self, batch: &Batch) -> Option<EncoderGraph> {
        let visible = &batch.visible;
        if visible.sequence.is_empty() {
            return None;
        }
        let samples = Segments::within(&visible.sequence.lengths);
        let positional_ND = self
            .encoder_embeddings
            .positional_embedding(&visible.sequence);
        let cut_positional_ND = leaf(&positional_ND);
        let input_ND = self.input_embedding(visible, cut_positional_ND.clone());
        let mut blocks: Vec<Part> = Vec::new();
        for block in &self.encoder {
            let input = blocks.last().map_or(&input_ND, |part| &part.output);
            let part = Part::new(input, |h_ND| block.forward(h_ND, &samples));
            blocks.push(part);
        }
        let last = blocks.last().map_or(&input_ND, |part| &part.output);
        let context = Part::new(last, |h_ND| {
            let h_ND = self.encoder_norm.forward(h_ND);
            self.context(h_ND, cut_positional_ND.clone())
        });
        Some(EncoderGraph {
            positional_ND,
            cut_positional_ND,
            input_ND,
            blocks,
            context,
        })
    }

    fn encoder_gradients(
        &self,
        graph: EncoderGraph,
        dcontext_ND: Tensor<2>,
        gradients: &mut Gradients,
        complete: &mut Complete<'_>,
    ) {
        let cut_positional_ND = &graph.cut_positional_ND;
        let slope = ops::slope(graph.context.output, dcontext_ND);
        let inputs = [&graph.context.input, cut_positional_ND];
        let [mut dh_ND, from_context_ND] = gradients.add(&slope, self, inputs);
        gradients.close("encoder_norm", &self.encoder_norm, complete);
        gradients.close("decoder_proj_context", &self.decoder_proj_context, complete);
        for (index, (block, part)) in self.encoder.iter().zip(graph.blocks).enumerate().rev() {
            [dh_ND] = gradients.add(&ops::slope(part.output, dh_ND), self, [&part.input]);
            gradients.close_item("encoder", index, block, complete);
        }
        let slope = ops::slope(graph.input_ND, dh_ND);
        let [from_input_ND] = gradients.add(&slope, self, [cut_positional_ND]);
        let dpositional_ND = from_input_ND + from_context_ND;
        let [] = gradients.add(&ops::slope(graph.positional_ND, dpositional_ND), self, []);
    }
}

/// The same values, without the graph that they came from; their gradient is asked for.
fn leaf(value: &Tensor<2>) -> Tensor<2> {
    value.clone().without_autodiff().autodiff().require_grad()
}
