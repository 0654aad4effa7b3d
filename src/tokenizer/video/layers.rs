//! The parts of the networks, on packed rows: `N` = samples * frames * height * width in that order, `C` channels.

use burn::tensor::{Bool, Tensor, TensorData, activation::softmax};

use super::settings::Resampling;
use crate::engine::ops::{self, ConvWindow};
use crate::engine::{Initialise, Parameter, Segments, parameters};

/// Where the rows of an activation lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    /// Clips in the batch.
    pub samples: usize,
    /// Frames of a clip.
    pub frames: usize,
    /// Rows of a frame.
    pub height: usize,
    /// Columns of a frame.
    pub width: usize,
}

impl Extent {
    /// Pixels of a frame.
    #[must_use]
    pub fn pixels(self) -> usize {
        self.height * self.width
    }

    /// All rows.
    #[must_use]
    pub fn rows(self) -> usize {
        self.samples * self.frames * self.pixels()
    }

    fn space(self, stride: usize) -> ConvWindow {
        ConvWindow::Space {
            frames: self.samples * self.frames,
            height: self.height,
            width: self.width,
            stride,
        }
    }

    fn time(self, stride: usize) -> ConvWindow {
        ConvWindow::Time {
            samples: self.samples,
            frames: self.frames,
            pixels: self.pixels(),
            stride,
        }
    }
}

/// The kernels that occur.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// 1 x 1 x 1.
    Point,
    /// 1 x 3 x 3.
    Space,
    /// 3 x 1 x 1, causal.
    Time,
}

/// A convolution with a bias.
#[derive(Debug, Clone)]
pub struct Conv {
    /// `[O, C, time, height, width]`.
    weight: Parameter,
    /// `[O]`.
    bias: Parameter,
    kernel: Kernel,
}
parameters!(Conv { weight => "conv3d.weight", bias => "conv3d.bias" });

impl Conv {
    /// Weight uniform in `+- sqrt(3 / fan in)`, so that activations keep their variance through dozens of convolutions; bias
    /// uniform in `+- 1 / sqrt(fan in)`, so that the norms have something to divide by where a frame is black.
    #[must_use]
    pub fn new(init: &Initialise<'_>, inputs: usize, outputs: usize, kernel: Kernel) -> Self {
        let size = match kernel {
            Kernel::Point => [1, 1, 1],
            Kernel::Space => [1, 3, 3],
            Kernel::Time => [3, 1, 1],
        };
        let fan_in = inputs * size.iter().product::<usize>();
        let bound = (3.0 / fan_in as f64).sqrt();
        let shape = [outputs, inputs, size[0], size[1], size[2]];
        Self {
            weight: init.uniform("conv3d.weight", &shape, bound),
            bias: init.uniform("conv3d.bias", &[outputs], (fan_in as f64).powf(-0.5)),
            kernel,
        }
    }

    fn matrix(&self) -> Tensor<2> {
        let outputs = self.weight.shape()[0];
        self.weight.reshaped([outputs, self.weight.len() / outputs])
    }

    fn strided(&self, x_NC: Tensor<2>, extent: Extent, stride: usize) -> Tensor<2> {
        let bias = self.bias.tensor();
        match self.kernel {
            Kernel::Point => ops::linear(x_NC, self.matrix(), Some(bias)),
            Kernel::Space => ops::convolve(x_NC, self.matrix(), bias, extent.space(stride)),
            Kernel::Time => ops::convolve(x_NC, self.matrix(), bias, extent.time(stride)),
        }
    }

    /// `[N, C]` to `[N, O]`.
    #[must_use]
    pub fn forward(&self, x_NC: Tensor<2>, extent: Extent) -> Tensor<2> {
        self.strided(x_NC, extent, 1)
    }
}

/// A convolution in space, then one in time.
pub type Factorised = Vec<Conv>;

/// Space from `inputs` to `outputs`, then time.
#[must_use]
pub fn factorised(init: &Initialise<'_>, inputs: usize, outputs: usize) -> Factorised {
    vec![
        Conv::new(&init.item(0), inputs, outputs, Kernel::Space),
        Conv::new(&init.item(1), outputs, outputs, Kernel::Time),
    ]
}

/// Applies convolutions one after the other.
#[must_use]
pub fn chain(convs: &[Conv], x_NC: Tensor<2>, extent: Extent) -> Tensor<2> {
    convs
        .iter()
        .fold(x_NC, |x_NC, conv| conv.forward(x_NC, extent))
}

/// Normalisation of each frame over pixels and channels.
#[derive(Debug, Clone)]
pub struct Norm {
    weight: Parameter,
    bias: Parameter,
}
parameters!(Norm { weight => "norm.weight", bias => "norm.bias" });

impl Norm {
    /// Weight 1, bias 0.
    #[must_use]
    pub fn new(init: &Initialise<'_>, channels: usize) -> Self {
        Self {
            weight: init.constant(&[channels], 1.0),
            bias: init.constant(&[channels], 0.0),
        }
    }

    /// `[N, C]` to `[N, C]`, followed by SiLU if `silu`.
    #[must_use]
    pub fn forward(&self, x_NC: Tensor<2>, extent: Extent, silu: bool) -> Tensor<2> {
        ops::frame_norm(
            x_NC,
            self.weight.tensor(),
            self.bias.tensor(),
            extent.samples * extent.frames,
            silu,
        )
    }
}

/// Norm, SiLU, factorised convolution, twice; plus the input (through a 1x1x1 convolution where widths differ).
#[derive(Debug, Clone)]
pub struct ResBlock {
    norm1: Norm,
    conv1: Factorised,
    norm2: Norm,
    conv2: Factorised,
    nin_shortcut: Option<Conv>,
}
parameters!(ResBlock {
    norm1,
    conv1,
    norm2,
    conv2,
    nin_shortcut
});

impl ResBlock {
    /// A block from `inputs` to `outputs` channels.
    #[must_use]
    pub fn new(init: &Initialise<'_>, inputs: usize, outputs: usize) -> Self {
        Self {
            norm1: Norm::new(&init.at("norm1"), inputs),
            conv1: factorised(&init.at("conv1"), inputs, outputs),
            norm2: Norm::new(&init.at("norm2"), outputs),
            conv2: factorised(&init.at("conv2"), outputs, outputs),
            nin_shortcut: (inputs != outputs)
                .then(|| Conv::new(&init.at("nin_shortcut"), inputs, outputs, Kernel::Point)),
        }
    }

    /// `[N, inputs]` to `[N, outputs]`.
    #[must_use]
    pub fn forward(&self, x_NC: Tensor<2>, extent: Extent) -> Tensor<2> {
        let h_NC = self.norm1.forward(x_NC.clone(), extent, true);
        let h_NC = chain(&self.conv1, h_NC, extent);
        let h_NC = self.norm2.forward(h_NC, extent, true);
        let h_NC = chain(&self.conv2, h_NC, extent);
        let shortcut_NC = match &self.nin_shortcut {
            Some(conv) => conv.forward(x_NC, extent),
            None => x_NC,
        };
        shortcut_NC + h_NC
    }
}

/// What attention attends to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attends {
    /// All pixels of the same frame.
    Space,
    /// The same pixel in this and earlier frames.
    Time,
}

/// Attention with one head over all channels, with a residual.
#[derive(Debug, Clone)]
pub struct Attention {
    /// Named `norm.norm.weight` in files.
    norm: Norm,
    q: Conv,
    k: Conv,
    v: Conv,
    proj_out: Conv,
    attends: Attends,
}
parameters!(Attention {
    norm,
    q,
    k,
    v,
    proj_out
});

impl Attention {
    /// Attention over `channels` channels.
    #[must_use]
    pub fn new(init: &Initialise<'_>, channels: usize, attends: Attends) -> Self {
        let conv = |name: &str| Conv::new(&init.at(name), channels, channels, Kernel::Point);
        Self {
            norm: Norm::new(&init.at("norm"), channels),
            q: conv("q"),
            k: conv("k"),
            v: conv("v"),
            proj_out: conv("proj_out"),
            attends,
        }
    }

    /// `[N, C]` to `[N, C]`.
    #[must_use]
    pub fn forward(&self, x_NC: Tensor<2>, extent: Extent) -> Tensor<2> {
        let h_NC = self.norm.forward(x_NC.clone(), extent, false);
        let parts = [&self.q, &self.k, &self.v].map(|conv| conv.forward(h_NC.clone(), extent));
        let h_NC = match self.attends {
            Attends::Space => {
                let frames = extent.samples * extent.frames;
                let qkv = Tensor::cat(parts.to_vec(), 1);
                ops::self_attention(qkv, 1, &Segments::batch(frames, extent.pixels()))
            }
            Attends::Time => over_time(parts, extent),
        };
        x_NC + self.proj_out.forward(h_NC, extent)
    }
}

/// Causal attention along time, pixel by pixel.
fn over_time(parts: [Tensor<2>; 3], extent: Extent) -> Tensor<2> {
    let Extent {
        samples, frames, ..
    } = extent;
    let [rows, channels] = parts[0].dims();
    let pixels = extent.pixels();
    // [samples, frames, pixels, C] to [samples * pixels, frames, C].
    let [q, k, v] = parts.map(|part| {
        part.reshape([samples, frames, pixels, channels])
            .swap_dims(1, 2)
            .reshape([samples * pixels, frames, channels])
    });
    let future: Vec<bool> = (0..frames * frames)
        .map(|i| i % frames > i / frames)
        .collect();
    let future: Tensor<2, Bool> = Tensor::from_data(
        TensorData::new(future, [frames, frames]),
        &q.device().without_autodiff(),
    );
    let scores = q.matmul(k.swap_dims(1, 2)) * (channels as f64).powf(-0.5);
    let future = future
        .reshape([1, frames, frames])
        .expand([samples * pixels, frames, frames]);
    let weights = softmax(scores.mask_fill(future, f32::NEG_INFINITY), 2);
    weights
        .matmul(v)
        .reshape([samples, pixels, frames, channels])
        .swap_dims(1, 2)
        .reshape([rows, channels])
}

/// Halves space, then time: strided convolution plus average, then a 1x1x1 convolution.
#[derive(Debug, Clone)]
pub struct Downsample {
    /// Space.
    conv1: Option<Conv>,
    /// Time.
    conv2: Option<Conv>,
    conv3: Conv,
}
parameters!(Downsample {
    conv1,
    conv2,
    conv3
});

impl Downsample {
    /// `None` where nothing is resampled.
    #[must_use]
    pub fn new(init: &Initialise<'_>, channels: usize, way: Resampling) -> Option<Self> {
        let conv = |name: &str, kernel| Conv::new(&init.at(name), channels, channels, kernel);
        (way != Resampling::default()).then(|| Self {
            conv1: way.space.then(|| conv("conv1", Kernel::Space)),
            conv2: way.time.then(|| conv("conv2", Kernel::Time)),
            conv3: conv("conv3", Kernel::Point),
        })
    }

    /// `[N, C]` to fewer rows, and their extent: height and width halved, `frames` to `(frames + 1) / 2`, where resampled.
    #[must_use]
    pub fn forward(&self, mut x_NC: Tensor<2>, mut extent: Extent) -> (Tensor<2>, Extent) {
        let channels = x_NC.dims()[1];
        if let Some(conv) = &self.conv1 {
            let half = Extent {
                height: extent.height / 2,
                width: extent.width / 2,
                ..extent
            };
            let mean_NC = x_NC
                .clone()
                .reshape([
                    extent.samples * extent.frames * half.height,
                    2,
                    half.width,
                    2 * channels,
                ])
                .mean_dim(1)
                .reshape([half.rows(), 2, channels])
                .mean_dim(1)
                .reshape([half.rows(), channels]);
            x_NC = conv.strided(x_NC, extent, 2) + mean_NC;
            extent = half;
        }
        if let Some(conv) = &self.conv2 {
            let inner = extent.pixels() * channels;
            let x = x_NC.reshape([extent.samples, extent.frames, inner]);
            let x = Tensor::cat(vec![x.clone().narrow(1, 0, 1), x], 1);
            let longer = Extent {
                frames: extent.frames + 1,
                ..extent
            };
            let half = Extent {
                frames: longer.frames / 2,
                ..extent
            };
            let mean_NC = x
                .clone()
                .reshape([extent.samples * half.frames, 2, inner])
                .mean_dim(1)
                .reshape([half.rows(), channels]);
            let x_NC_longer = x.reshape([longer.rows(), channels]);
            x_NC = conv.strided(x_NC_longer, longer, 2) + mean_NC;
            extent = half;
        }
        (self.conv3.forward(x_NC, extent), extent)
    }
}

/// Doubles time, then space: repetition, refined by a convolution; then a 1x1x1 convolution.
#[derive(Debug, Clone)]
pub struct Upsample {
    /// Time.
    conv1: Option<Conv>,
    /// Space.
    conv2: Option<Conv>,
    conv3: Conv,
}
parameters!(Upsample {
    conv1,
    conv2,
    conv3
});

impl Upsample {
    /// `None` where nothing is resampled.
    #[must_use]
    pub fn new(init: &Initialise<'_>, channels: usize, way: Resampling) -> Option<Self> {
        let conv = |name: &str, kernel| Conv::new(&init.at(name), channels, channels, kernel);
        (way != Resampling::default()).then(|| Self {
            conv1: way.time.then(|| conv("conv1", Kernel::Time)),
            conv2: way.space.then(|| conv("conv2", Kernel::Space)),
            conv3: conv("conv3", Kernel::Point),
        })
    }

    /// `[N, C]` to more rows, and their extent: `frames` to `2 * frames - 1`, height and width doubled, where resampled.
    #[must_use]
    pub fn forward(&self, mut x_NC: Tensor<2>, mut extent: Extent) -> (Tensor<2>, Extent) {
        let channels = x_NC.dims()[1];
        if let Some(conv) = &self.conv1 {
            // Every frame twice, but the first once.
            let inner = extent.pixels() * channels;
            let twice = 2 * extent.frames;
            let x = x_NC
                .reshape([extent.samples * extent.frames, 1, inner])
                .repeat_dim(1, 2)
                .reshape([extent.samples, twice, inner])
                .narrow(1, 1, twice - 1);
            extent.frames = twice - 1;
            x_NC = x.reshape([extent.rows(), channels]);
            x_NC = conv.forward(x_NC.clone(), extent) + x_NC;
        }
        if let Some(conv) = &self.conv2 {
            let lines = extent.samples * extent.frames * extent.height;
            x_NC = x_NC
                .reshape([lines * extent.width, 1, channels])
                .repeat_dim(1, 2)
                .reshape([lines, 1, 2 * extent.width * channels])
                .repeat_dim(1, 2)
                .reshape([4 * extent.rows(), channels]);
            extent.height *= 2;
            extent.width *= 2;
            x_NC = conv.forward(x_NC.clone(), extent) + x_NC;
        }
        (self.conv3.forward(x_NC, extent), extent)
    }
}
