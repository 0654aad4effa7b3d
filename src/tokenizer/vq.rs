//! The VQ-VAE of camera, gaze, hands and body (Supp. A): patches, transformer, codebook, transformer, patches.
//!
//! One model for signals over time (`compression: [2]`) and for joints over time (`compression: [2, 3]`); they differ in how
//! patches are cut and in the position table. Suffixes: `N` tokens of all samples, `P` values of a patch, `D` width, `L` code
//! width.

mod settings;

pub use settings::{Loss, VqSettings};

use burn::tensor::{Int, Tensor, TensorData};

use super::TokenizerError;
use super::patches::Patches;
use super::quantizer::{Assigned, Quantizer};
use super::whitening::{Whitening, scale};
use crate::engine::cuts::backward_order;
use crate::engine::parameters::to_host;
use crate::engine::{Cuts, Initialise, Parameter, Parameters, Reading, Segments, ops, parameters};
use crate::modality::Shape;
use crate::nn::positions;
use crate::nn::{Block, LayerNorm, Linear, Mlp};

/// What the ends of residual branches and the output are multiplied by before training.
const QUIET: f32 = 0.1;

/// A linear map stored as a convolution whose kernel covers its input.
#[derive(Debug, Clone)]
struct Convolution {
    weight: Parameter,
    bias: Parameter,
}
parameters!(Convolution { weight, bias });

impl Convolution {
    /// `[N, in]` to `[N, out]`.
    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let outputs = self.weight.shape()[0];
        let inputs = self.weight.len() / outputs;
        ops::linear(
            x,
            self.weight.reshaped([outputs, inputs]),
            Some(self.bias.tensor()),
        )
    }

    /// Weight and bias uniform in `+- 1 / sqrt(fan in)`, or a Xavier weight.
    fn new(init: &Initialise<'_>, shape: &[usize], xavier: bool) -> Self {
        let (outputs, kernel) = (shape[0], shape[2..].iter().product::<usize>());
        let fan_in = shape[1] * kernel;
        let bound = 1.0 / (fan_in as f64).sqrt();
        Self {
            weight: if xavier {
                init.xavier("weight", shape, fan_in, outputs * kernel)
            } else {
                init.uniform("weight", shape, bound)
            },
            bias: init.uniform("bias", &[outputs], bound),
        }
    }
}

/// Positions, blocks, and one MLP with tanh: the part encoder and decoder have in common.
#[derive(Debug, Clone)]
struct Transformer {
    /// `[1, rows(, columns), D]`.
    position_embeddings: Parameter,
    blocks: Vec<Block>,
    norm_mlp: LayerNorm,
    post_mlp: Mlp,
}
parameters!(Transformer {
    position_embeddings,
    blocks,
    norm_mlp,
    post_mlp
});

impl Transformer {
    fn new(init: &Initialise<'_>, settings: &VqSettings, patches: &Patches) -> Self {
        let (width, hidden) = (settings.width, settings.width * settings.mlp_ratio);
        let [rows, columns] = patches.rows_columns();
        let table = || {
            if patches.is_kinematic() {
                positions::grid(rows, columns, width, settings.positions)
            } else {
                positions::line(rows, width)
            }
        };
        let mut shape = vec![1];
        shape.extend(patches.grid());
        shape.push(width);
        let blocks = init.at("blocks");
        Self {
            position_embeddings: init.fixed(&shape, table),
            blocks: (0..settings.depth)
                .map(|i| Block::new(&blocks.item(i), width, settings.heads, hidden))
                .collect(),
            norm_mlp: LayerNorm::new(&init.at("norm_mlp"), width, true),
            post_mlp: Mlp::new(&init.at("post_mlp"), width, hidden, true),
        }
    }

    /// `[N, D]` of `samples` signals to `[N, D]`.
    fn forward(&self, h_ND: Tensor<2>, samples: usize, cuts: &mut Cuts) -> Tensor<2> {
        let [tokens, width] = h_ND.dims();
        let each = tokens / samples;
        let table = self.position_embeddings.reshaped([1, each, width]);
        let h_ND = (h_ND.reshape([samples, each, width]) + table).reshape([tokens, width]);
        let segments = Segments::batch(samples, each);
        let blocks = self.blocks.iter();
        let h_ND = blocks.fold(h_ND, |h_ND, block| block.forward(cuts.at(h_ND), &segments));
        let h_ND = cuts.at(h_ND);
        h_ND.clone() + self.post_mlp.forward_tanh(self.norm_mlp.forward(h_ND))
    }
}

/// Patches to hidden states.
#[derive(Debug, Clone)]
struct Encoder {
    conv: Convolution,
    transformer: Transformer,
}
parameters!(Encoder { conv, transformer => "" });

/// Hidden states to patches.
#[derive(Debug, Clone)]
struct Decoder {
    transformer: Transformer,
    out_proj: Linear,
}
parameters!(Decoder { transformer => "", out_proj });

/// The model; its parameters are named as in released checkpoints.
#[derive(Debug, Clone)]
pub struct VqVae {
    encoder: Encoder,
    quant_proj: Convolution,
    quantize: Quantizer,
    decoder: Decoder,
    post_quant_proj: Convolution,
    patches: Patches,
    settings: VqSettings,
}
parameters!(VqVae {
    encoder,
    quant_proj,
    quantize,
    decoder,
    post_quant_proj
});

/// Patches of a batch of normalised signals.
#[derive(Debug, Clone)]
pub struct Batch {
    /// `[N, P]`, zero where invalid.
    values_NP: Tensor<2>,
    /// `[N, P]`, 1 where valid; `None`: all are.
    valid_NP: Option<Tensor<2>>,
    samples: usize,
    /// Valid samples (or joints) in all.
    valid: f64,
}

/// What one training forward pass gives.
#[derive(Debug)]
pub struct Trained {
    /// Reconstruction plus weighted commitment, `[1]`: what to minimise.
    pub loss: Tensor<1>,
    /// What to minimise, and its two parts: the loss of the reconstruction, and how far latents are from their codes, the mean squared
    /// difference.
    pub numbers: Reading,
    /// For the codebook's update.
    pub assigned: Assigned,
}

impl VqVae {
    /// A model for signals of `shape`.
    ///
    /// # Errors
    /// When the settings do not fit each other or the shape.
    pub fn new(
        init: &Initialise<'_>,
        settings: &VqSettings,
        shape: &Shape,
    ) -> Result<Self, TokenizerError> {
        let patches = settings.patches(shape)?;
        let (width, code) = (settings.width, settings.code_width);
        let (encoder, decoder) = (init.at("encoder"), init.at("decoder"));
        let kernel = patches.convolution(width, patches.channels(), true);
        let to_code = patches.convolution(code, width, false);
        let from_code = patches.convolution(width, code, false);
        Ok(Self {
            encoder: Encoder {
                conv: Convolution::new(&encoder.at("conv"), &kernel, true),
                transformer: Transformer::new(&encoder, settings, &patches),
            },
            quant_proj: Convolution::new(&init.at("quant_proj"), &to_code, false),
            quantize: Quantizer::new(&init.at("quantize"), &settings.quantizer()),
            decoder: Decoder {
                transformer: Transformer::new(&decoder, settings, &patches),
                out_proj: Linear::new(&decoder.at("out_proj"), width, patches.width(), true),
            },
            post_quant_proj: Convolution::new(&init.at("post_quant_proj"), &from_code, false),
            patches,
            settings: settings.clone(),
        })
    }

    /// How signals are cut into tokens.
    #[must_use]
    pub fn patches(&self) -> &Patches {
        &self.patches
    }

    /// What it was made with.
    #[must_use]
    pub fn settings(&self) -> &VqSettings {
        &self.settings
    }

    /// The codebook.
    #[must_use]
    pub fn quantizer(&self) -> &Quantizer {
        &self.quantize
    }

    /// The codebook, to be moved.
    pub fn quantizer_mut(&mut self) -> &mut Quantizer {
        &mut self.quantize
    }

    /// A batch of normalised signals, each `(values, validity)` row-major; values that are not valid count as zeros.
    ///
    /// # Panics
    /// When a signal does not have the model's shape.
    #[must_use]
    pub fn batch<'a>(
        &self,
        signals: impl IntoIterator<Item = (&'a [f32], Option<&'a [bool]>)>,
    ) -> Batch {
        let channels = self.patches.channels();
        let (mut values, mut flags) = (Vec::new(), Vec::new());
        let (mut samples, mut valid, mut masked) = (0, 0_usize, false);
        for (signal, validity) in signals {
            samples += 1;
            let is_valid = |i: usize| validity.is_none_or(|valid| valid[i / channels]);
            let clean: Vec<f32> = (0..signal.len())
                .map(|i| if is_valid(i) { signal[i] } else { 0.0 })
                .collect();
            self.patches.cut(&clean, &mut values);
            let flag: Vec<f32> = (0..signal.len())
                .map(|i| f32::from(u8::from(is_valid(i))))
                .collect();
            self.patches.cut(&flag, &mut flags);
            let count = (0..signal.len() / channels)
                .filter(|i| is_valid(i * channels))
                .count();
            valid += count;
            masked |= count < signal.len() / channels;
        }
        let device = self.encoder.conv.bias.untracked().device();
        let shape = [samples * self.patches.tokens(), self.patches.width()];
        let tensor = |data: Vec<f32>| Tensor::from_data(TensorData::new(data, shape), &device);
        Batch {
            values_NP: tensor(values),
            valid_NP: masked.then(|| tensor(flags)),
            samples,
            valid: valid as f64,
        }
    }

    /// Hidden states of the encoder, `[N, D]`.
    #[must_use]
    pub fn encode_hidden(&self, batch: &Batch, cuts: &mut Cuts) -> Tensor<2> {
        let h_ND = self.encoder.conv.forward(batch.values_NP.clone());
        let transformer = &self.encoder.transformer;
        transformer.forward(h_ND, batch.samples, cuts)
    }

    /// Latents before quantisation, `[N, L]`, of hidden states.
    #[must_use]
    pub fn latents(&self, h_ND: Tensor<2>) -> Tensor<2> {
        self.quant_proj.forward(h_ND)
    }

    /// Reconstructed patches, `[N, P]`, of `samples` signals from quantised latents `[N, L]`.
    #[must_use]
    pub fn decode_latents(&self, q_NL: Tensor<2>, samples: usize, cuts: &mut Cuts) -> Tensor<2> {
        let h_ND = self.post_quant_proj.forward(q_NL);
        let h_ND = self.decoder.transformer.forward(h_ND, samples, cuts);
        self.decoder.out_proj.forward(h_ND)
    }

    /// Tokens of a batch, `[N]`.
    #[must_use]
    pub fn encode(&self, batch: &Batch) -> Vec<u32> {
        let z_NL = self.latents(self.encode_hidden(batch, &mut Cuts::none()));
        self.quantize.assign(to_host(z_NL)).ids
    }

    /// Reconstructed patches, `[N, P]`, of `samples` signals from tokens `[N]`.
    ///
    /// # Panics
    /// When a token is outside the vocabulary.
    #[must_use]
    pub fn decode(&self, ids: &[u32], samples: usize) -> Tensor<2> {
        self.decode_latents(self.codes(ids), samples, &mut Cuts::none())
    }

    /// The codes of `ids` as a tensor, `[N, L]`.
    fn codes(&self, ids: &[u32]) -> Tensor<2> {
        let device = self.encoder.conv.bias.untracked().device();
        let shape = [ids.len(), self.settings.code_width];
        Tensor::from_data(TensorData::new(self.quantize.look_up(ids), shape), &device)
    }

    /// The reconstruction loss of patches, `[1]`.
    #[must_use]
    pub fn loss(&self, found_NP: Tensor<2>, batch: &Batch) -> Tensor<1> {
        let error_NP = found_NP - batch.values_NP.clone();
        let square_NP = error_NP.clone().square();
        let square_NP = match (&batch.valid_NP, self.settings.loss) {
            (Some(valid_NP), Loss::MaskedMse) => square_NP * valid_NP.clone(),
            _ => square_NP,
        };
        let mut loss = self.total(square_NP, batch);
        let (velocity, pose) = (self.settings.velocity_weight, self.settings.pose_weight);
        if velocity > 0.0 {
            loss = loss + self.velocity(error_NP.clone(), batch) * velocity;
        }
        if pose > 0.0 {
            loss = loss + self.pose(error_NP, batch) * pose;
        }
        loss
    }

    /// The penalty of the errors of joints relative to the mean error of all joints of the sample; joints that are not valid have
    /// none.
    fn pose(&self, error_NP: Tensor<2>, batch: &Batch) -> Tensor<1> {
        let channels = self.patches.channels();
        let joints = self.patches.values_per_sample() / channels;
        let order = self.order(&error_NP);
        let over_joints = |x_NP: Tensor<2>| {
            let [samples, values] = [batch.samples, order.dims()[0]];
            let x = x_NP.reshape([samples, values]).select(1, order.clone());
            x.reshape([samples * values / joints / channels, joints, channels])
        };
        let error = over_joints(error_NP);
        let [rows, ..] = error.dims();
        let relative = match &batch.valid_NP {
            Some(valid_NP) => {
                let valid = over_joints(valid_NP.clone());
                let error = error * valid.clone();
                let count = valid.clone().sum_dim(1).clamp_min(1.0);
                (error.clone() - error.sum_dim(1) / count) * valid
            }
            None => error.clone() - error.mean_dim(1),
        };
        self.total(relative.square().reshape([rows, joints * channels]), batch)
    }

    /// Where the values of a signal stand in its patches, on the device of `like`.
    fn order(&self, like: &Tensor<2>) -> Tensor<1, Int> {
        let order: Vec<i64> = self.patches.positions().map(|at| at as i64).collect();
        let values = order.len();
        Tensor::from_data(TensorData::new(order, [values]), &like.device())
    }

    /// The penalty of the errors of steps from each sample to the next; both have to be valid.
    fn velocity(&self, error_NP: Tensor<2>, batch: &Batch) -> Tensor<1> {
        let [tokens, width] = error_NP.dims();
        let (values, each) = (
            tokens * width / batch.samples,
            self.patches.values_per_sample(),
        );
        let order = self.order(&error_NP);
        let over_time = |x_NP: Tensor<2>| {
            x_NP.reshape([batch.samples, values])
                .select(1, order.clone())
        };
        let both = |x: Tensor<2>| {
            (
                x.clone().narrow(1, each, values - each),
                x.narrow(1, 0, values - each),
            )
        };
        let (next, this) = both(over_time(error_NP));
        let step = (next - this).square();
        match &batch.valid_NP {
            Some(valid_NP) => {
                let (next, this) = both(over_time(valid_NP.clone()));
                self.total(step * next * this, batch)
            }
            None => self.total(step, batch),
        }
    }

    /// Masked squares over as much as the loss is over.
    fn total(&self, square: Tensor<2>, batch: &Batch) -> Tensor<1> {
        match self.settings.loss {
            Loss::Mse => square.mean(),
            Loss::MaskedMse => ops::sum(square) / batch.valid.max(1.0),
        }
    }

    /// Prepares a new model for training, fitted to `batches`, some of what it will train on: residual branches and the output
    /// start quiet, latents are white and of length 1, about, as the codes are. The reference does without.
    ///
    /// # Errors
    /// When there are no latents, or one is not finite.
    pub fn calibrate(&mut self, batches: &[Batch]) -> Result<(), TokenizerError> {
        let mut weights = self.weights();
        scale(&mut weights, QUIET, |name| {
            [".attn.proj.", "mlp.fc2.", "decoder.out_proj."]
                .iter()
                .any(|part| name.contains(part))
        });
        self.load(&weights)
            .map_err(|error| TokenizerError::Other(error.to_string()))?;
        let mut latents = Whitening::new(self.settings.code_width);
        for batch in batches {
            let hidden = self.encode_hidden(batch, &mut Cuts::none());
            latents.add(&to_host(self.latents(hidden)));
        }
        let spread = (self.settings.code_width as f64).powf(-0.5);
        latents.apply(&mut weights, "quant_proj", spread)?;
        self.load(&weights)
            .map_err(|error| TokenizerError::Other(error.to_string()))
    }

    /// The names of all parameters, about in the order in which backward is done with them.
    #[must_use]
    pub fn backward_order(&self) -> Vec<String> {
        let stages = ["encoder.", "quant_proj.", "post_quant_proj.", "decoder."];
        backward_order(self, &stages)
    }

    /// One forward pass with straight-through codes: gradients pass the codebook as if it were not there, and the commitment
    /// loss pulls latents to their codes. The codebook itself is moved by [`Quantizer::update`]. Backward can go block by block.
    #[must_use]
    pub fn forward_training(&self, batch: &Batch, cuts: &mut Cuts) -> Trained {
        let z_NL = self.latents(self.encode_hidden(batch, cuts));
        let z_NL = cuts.at(z_NL);
        let (q_NL, assigned) = self.quantize.quantise(&z_NL);
        let step_NL = q_NL - z_NL.clone();
        let commitment = step_NL.clone().square().mean();
        let passed_NL = z_NL + step_NL.detach();
        let found_NP = self.decode_latents(passed_NL, batch.samples, cuts);
        let reconstruction = self.loss(found_NP, batch);
        let parts = [reconstruction.clone(), commitment.clone()];
        let weight = self.settings.commitment_weight;
        let loss = reconstruction + commitment * weight;
        let numbers = Reading::of([loss.clone()].into_iter().chain(parts));
        Trained {
            numbers: match numbers {
                // In f64, where they are known.
                Reading::Host(all) => Reading::Host(vec![all[1] + weight * all[2], all[1], all[2]]),
                there @ Reading::Device(_) => there,
            },
            loss,
            assigned,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Compute, Parameters};

    fn meta(settings: &VqSettings, shape: &Shape) -> VqVae {
        let compute = Compute::cpu();
        VqVae::new(&Initialise::meta(&compute), settings, shape).unwrap()
    }

    /// Trainable parameters as counted on the released constructors (technical reference, 2.1).
    #[test]
    fn the_paper_sizes_have_the_published_parameter_counts() {
        let temporal = |channels| Shape::Temporal {
            samples: 60,
            channels,
        };
        let sizes = VqSettings::default();
        assert_eq!(meta(&sizes, &temporal(9)).count(), 179_635_250);
        assert_eq!(meta(&sizes, &temporal(2)).count(), 179_613_732);
        let joints = VqSettings {
            compression: vec![2, 3],
            ..sizes
        };
        let body = meta(
            &joints,
            &Shape::Kinematic {
                samples: 60,
                joints: 21,
            },
        );
        assert_eq!(body.count(), 179_635_250);
        assert_eq!(body.inventory().len(), 313);
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused_with_the_numbers() {
        let shape = Shape::Kinematic {
            samples: 60,
            joints: 21,
        };
        for (settings, number) in [
            (
                VqSettings {
                    width: 30,
                    ..joint_settings()
                },
                "30",
            ),
            (
                VqSettings {
                    heads: 5,
                    ..joint_settings()
                },
                "5 heads",
            ),
            (
                VqSettings {
                    codebook: 0,
                    ..joint_settings()
                },
                "codebook",
            ),
            (
                VqSettings {
                    compression: vec![2, 4],
                    ..joint_settings()
                },
                "[2, 4]",
            ),
        ] {
            let message = settings.patches(&shape).unwrap_err().to_string();
            assert!(message.contains(number), "{message}");
        }
    }

    #[test]
    fn the_pose_weight_sees_joints_against_each_other_and_not_where_all_of_them_are() {
        let shape = Shape::Kinematic {
            samples: 4,
            joints: 6,
        };
        let compute = Compute::cpu();
        let with = |pose_weight: f64| {
            let settings = VqSettings {
                pose_weight,
                ..joint_settings()
            };
            VqVae::new(&Initialise::new(&compute, 3), &settings, &shape).unwrap()
        };
        let (without, weighted) = (with(0.0), with(2.0));
        // Half of the samples are invalid, and far off where they are.
        let valid: Vec<bool> = (0..24).map(|i| i >= 12).collect();
        let truth = [0.0_f32; 72];
        let error = |shift: &dyn Fn(usize) -> f32| -> f64 {
            let values: Vec<f32> = (0..72)
                .map(|i| if i < 36 { 9.0 } else { shift(i / 3 % 6) })
                .collect();
            let batch = without.batch([(&truth[..], Some(&valid[..]))]);
            let mut found = Vec::new();
            without.patches().cut(&values, &mut found);
            let shape = batch.values_NP.dims();
            let found = Tensor::from_data(TensorData::new(found, shape), compute.device());
            let loss = |model: &VqVae| f64::from(to_host(model.loss(found.clone(), &batch))[0]);
            loss(&weighted) - loss(&without)
        };
        assert!(error(&|_| 1.5).abs() < 1e-5);
        // One joint of six is off by one: five by a sixth, one by five sixths, on three axes.
        let relative = 3.0 * (5.0 / 36.0 + 25.0 / 36.0) / 6.0;
        let found = error(&|joint| f32::from(u8::from(joint == 2)));
        assert!((found - 2.0 * relative).abs() < 1e-5, "{found}");

        let temporal = Shape::Temporal {
            samples: 4,
            channels: 9,
        };
        let refused = VqSettings {
            pose_weight: 1.0,
            ..VqSettings::temporal_small()
        };
        let message = refused.patches(&temporal).unwrap_err().to_string();
        assert!(message.contains("pose_weight is for joints"), "{message}");
    }

    fn joint_settings() -> VqSettings {
        VqSettings {
            compression: vec![2, 3],
            width: 24,
            heads: 2,
            depth: 1,
            codebook: 8,
            ..VqSettings::default()
        }
    }
}
