//! The head: a dense prediction transformer (DPT) with four temporal modules.
//!
//! Four levels of the encoder's features, at 4, 2, 1 and 1/2 times its grid, are fused from the coarsest to the finest. Rows are
//! packed: one per pixel, frame by frame.

use burn::tensor::{Tensor, activation::relu};

use super::NetworkSettings;
use super::motion::Motion;
use crate::engine::ops::{self, ConvWindow, Resize};
use crate::engine::{Initialise, Parameter, parameters};

/// Maps of several frames: `[frames * height * width, C]`.
#[derive(Debug, Clone)]
pub struct Maps {
    /// One per pixel, row-major within a frame: `[frames * height * width, C]`.
    pub rows: Tensor<2>,
    /// How many frames.
    pub frames: usize,
    /// Height and width.
    pub size: [usize; 2],
}

impl Maps {
    fn with(&self, rows: Tensor<2>) -> Self {
        Self {
            rows,
            frames: self.frames,
            size: self.size,
        }
    }

    fn resized(&self, to: [usize; 2]) -> Self {
        let resize = Resize {
            frames: self.frames,
            from: self.size,
            to,
        };
        Self {
            rows: ops::resize(self.rows.clone(), resize),
            frames: self.frames,
            size: to,
        }
    }

    /// The frames `start..start + frames`.
    #[must_use]
    pub fn narrow(&self, start: usize, frames: usize) -> Self {
        let each = self.size[0] * self.size[1];
        Self {
            rows: self.rows.clone().narrow(0, start * each, frames * each),
            frames,
            size: self.size,
        }
    }

    /// The frames of maps of one size, one after the other.
    ///
    /// # Panics
    /// When there are none.
    #[must_use]
    pub fn cat(all: &[Maps]) -> Self {
        let rows = all.iter().map(|maps| maps.rows.clone()).collect();
        Self {
            rows: Tensor::cat(rows, 0),
            frames: all.iter().map(|maps| maps.frames).sum(),
            size: all[0].size,
        }
    }
}

/// A convolution with a square kernel.
#[derive(Debug, Clone)]
struct Conv {
    /// `[O, C, k, k]`.
    weight: Parameter,
    bias: Option<Parameter>,
}
parameters!(Conv { weight, bias });

impl Conv {
    fn new(init: &Initialise<'_>, inputs: usize, outputs: usize, side: usize, bias: bool) -> Self {
        let bound = (3.0 / (inputs * side * side) as f64).sqrt();
        Self {
            weight: init.uniform("weight", &[outputs, inputs, side, side], bound),
            bias: bias.then(|| init.constant(&[outputs], 0.0)),
        }
    }

    fn matrix(&self) -> Tensor<2> {
        let outputs = self.weight.shape()[0];
        self.weight.reshaped([outputs, self.weight.len() / outputs])
    }

    /// 1 x 1.
    fn point(&self, x: &Maps) -> Maps {
        let bias = self.bias.as_ref().map(Parameter::tensor);
        x.with(ops::linear(x.rows.clone(), self.matrix(), bias))
    }

    /// 3 x 3 with zeros around the picture.
    fn near(&self, x: &Maps) -> Maps {
        x.with(self.convolve(x.rows.clone(), x.frames, x.size, 1))
    }

    /// 3 x 3 with stride 2 and zeros around the picture: half the size, rounded up.
    fn halve(&self, x: &Maps) -> Maps {
        let ([height, width], channels) = (x.size, x.rows.dims()[1]);
        // The engine's strided window has no zeros above and to the left.
        let rows = x.rows.clone().reshape([x.frames, height, width, channels]);
        let device = rows.device();
        let above = Tensor::zeros([x.frames, 1, width, channels], &device);
        let rows = Tensor::cat(vec![above, rows], 1);
        let left = Tensor::zeros([x.frames, height + 1, 1, channels], &device);
        let rows = Tensor::cat(vec![left, rows], 2);
        let size = [height + 1, width + 1];
        let rows = rows.reshape([x.frames * size[0] * size[1], channels]);
        Maps {
            rows: self.convolve(rows, x.frames, size, 2),
            frames: x.frames,
            size: size.map(|side| side / 2),
        }
    }

    fn convolve(
        &self,
        rows: Tensor<2>,
        frames: usize,
        [height, width]: [usize; 2],
        stride: usize,
    ) -> Tensor<2> {
        let bias = match &self.bias {
            Some(bias) => bias.tensor(),
            None => Tensor::zeros([self.weight.shape()[0]], &rows.device()),
        };
        let window = ConvWindow::Space {
            frames,
            height,
            width,
            stride,
        };
        ops::convolve(rows, self.matrix(), bias, window)
    }
}

/// A transposed convolution whose stride is its size: every pixel becomes a square of `side` pixels.
#[derive(Debug, Clone)]
struct Enlarge {
    /// `[C, O, side, side]`.
    weight: Parameter,
    bias: Parameter,
}
parameters!(Enlarge { weight, bias });

impl Enlarge {
    fn new(init: &Initialise<'_>, channels: usize, side: usize) -> Self {
        let bound = (3.0 / channels as f64).sqrt();
        Self {
            weight: init.uniform("weight", &[channels, channels, side, side], bound),
            bias: init.constant(&[channels], 0.0),
        }
    }

    fn forward(&self, x: &Maps) -> Maps {
        let &[inputs, outputs, side, _] = self.weight.shape() else {
            unreachable!("built with four axes");
        };
        let ([height, width], squares) = (x.size, side * side);
        let matrix = self
            .weight
            .reshaped([inputs, outputs, squares])
            .permute([2, 1, 0])
            .reshape([squares * outputs, inputs]);
        let bias = self.bias.tensor::<1>().repeat(&[squares]);
        let rows = ops::linear(x.rows.clone(), matrix, Some(bias))
            .reshape([x.frames * height, width, side, side * outputs])
            .swap_dims(1, 2)
            .reshape([x.frames * height * side * width * side, outputs]);
        Maps {
            rows,
            frames: x.frames,
            size: [height * side, width * side],
        }
    }
}

/// `conv2(relu(conv1(relu x))) + x`.
#[derive(Debug, Clone)]
struct Residual {
    conv1: Conv,
    conv2: Conv,
}
parameters!(Residual { conv1, conv2 });

impl Residual {
    fn new(init: &Initialise<'_>, channels: usize) -> Self {
        let conv = |name: &str| Conv::new(&init.at(name), channels, channels, 3, true);
        Self {
            conv1: conv("conv1"),
            conv2: conv("conv2"),
        }
    }

    fn forward(&self, x: &Maps) -> Maps {
        let hidden = self.conv1.near(&x.with(relu(x.rows.clone())));
        let hidden = self.conv2.near(&hidden.with(relu(hidden.rows.clone())));
        x.with(hidden.rows + x.rows.clone())
    }
}

/// Adds a finer level to the maps so far and brings them to the size of the next.
#[derive(Debug, Clone)]
struct Fusion {
    out_conv: Conv,
    /// On the finer level; the coarsest fusion has none.
    unit1: Option<Residual>,
    unit2: Residual,
}
parameters!(Fusion {
    out_conv,
    unit1 => "resConfUnit1",
    unit2 => "resConfUnit2"
});

impl Fusion {
    fn new(init: &Initialise<'_>, channels: usize, finer: bool) -> Self {
        Self {
            out_conv: Conv::new(&init.at("out_conv"), channels, channels, 1, true),
            unit1: finer.then(|| Residual::new(&init.at("resConfUnit1"), channels)),
            unit2: Residual::new(&init.at("resConfUnit2"), channels),
        }
    }

    fn forward(&self, so_far: &Maps, finer: Option<&Maps>, size: [usize; 2]) -> Maps {
        let sum = match (&self.unit1, finer) {
            (Some(unit), Some(finer)) => {
                so_far.with(so_far.rows.clone() + unit.forward(finer).rows)
            }
            _ => so_far.clone(),
        };
        self.out_conv.point(&self.unit2.forward(&sum).resized(size))
    }
}

/// Features of four taps to depth.
#[derive(Debug, Clone)]
pub struct Head {
    projects: Vec<Conv>,
    resize0: Enlarge,
    resize1: Enlarge,
    resize3: Conv,
    rn: [Conv; 4],
    fusions: [Fusion; 4],
    output1: Conv,
    output2: Conv,
    output3: Conv,
    motion: Vec<Motion>,
}

// Written out because the lists have names of their own for each element.
impl crate::engine::Parameters for Head {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        let at = |name: &str| crate::engine::parameters::join(path, name);
        self.projects.visit(&at("projects"), visitor);
        self.resize0.visit(&at("resize_layers.0"), visitor);
        self.resize1.visit(&at("resize_layers.1"), visitor);
        self.resize3.visit(&at("resize_layers.3"), visitor);
        for (index, conv) in self.rn.iter().enumerate() {
            conv.visit(&at(&format!("scratch.layer{}_rn", index + 1)), visitor);
        }
        for (index, fusion) in self.fusions.iter().enumerate() {
            fusion.visit(&at(&format!("scratch.refinenet{}", index + 1)), visitor);
        }
        self.output1.visit(&at("scratch.output_conv1"), visitor);
        self.output2.visit(&at("scratch.output_conv2.0"), visitor);
        self.output3.visit(&at("scratch.output_conv2.2"), visitor);
        for (index, motion) in self.motion.iter().enumerate() {
            motion.visit(&at(&motion_name(index)), visitor);
        }
    }

    fn visit_mut(&mut self, path: &str, visitor: &mut crate::engine::parameters::VisitMut<'_>) {
        let at = |name: &str| crate::engine::parameters::join(path, name);
        self.projects.visit_mut(&at("projects"), visitor);
        self.resize0.visit_mut(&at("resize_layers.0"), visitor);
        self.resize1.visit_mut(&at("resize_layers.1"), visitor);
        self.resize3.visit_mut(&at("resize_layers.3"), visitor);
        for (index, conv) in self.rn.iter_mut().enumerate() {
            conv.visit_mut(&at(&format!("scratch.layer{}_rn", index + 1)), visitor);
        }
        for (index, fusion) in self.fusions.iter_mut().enumerate() {
            fusion.visit_mut(&at(&format!("scratch.refinenet{}", index + 1)), visitor);
        }
        self.output1.visit_mut(&at("scratch.output_conv1"), visitor);
        self.output2
            .visit_mut(&at("scratch.output_conv2.0"), visitor);
        self.output3
            .visit_mut(&at("scratch.output_conv2.2"), visitor);
        for (index, motion) in self.motion.iter_mut().enumerate() {
            motion.visit_mut(&at(&motion_name(index)), visitor);
        }
    }
}

fn motion_name(index: usize) -> String {
    format!("motion_modules.{index}.temporal_transformer")
}

impl Head {
    /// A head of these sizes, which were checked.
    #[must_use]
    pub fn new(init: &Initialise<'_>, settings: &NetworkSettings) -> Self {
        let (features, levels) = (settings.features, settings.levels);
        let resize = init.at("resize_layers");
        let scratch = init.at("scratch");
        Self {
            projects: (0..4)
                .map(|k| {
                    let init = init.at("projects").item(k);
                    Conv::new(&init, settings.width, levels[k], 1, true)
                })
                .collect(),
            resize0: Enlarge::new(&resize.item(0), levels[0], 4),
            resize1: Enlarge::new(&resize.item(1), levels[1], 2),
            resize3: Conv::new(&resize.item(3), levels[3], levels[3], 3, true),
            rn: std::array::from_fn(|k| {
                let init = scratch.at(&format!("layer{}_rn", k + 1));
                Conv::new(&init, levels[k], features, 3, false)
            }),
            fusions: std::array::from_fn(|k| {
                let init = scratch.at(&format!("refinenet{}", k + 1));
                Fusion::new(&init, features, k < 3)
            }),
            output1: Conv::new(&scratch.at("output_conv1"), features, features / 2, 3, true),
            output2: Conv::new(&scratch.at("output_conv2.0"), features / 2, 32, 3, true),
            output3: Conv::new(&scratch.at("output_conv2.2"), 32, 1, 1, true),
            motion: (0..4)
                .map(|index| {
                    Motion::new(
                        &init.at(&motion_name(index)),
                        settings.motion_widths()[index],
                    )
                })
                .collect(),
        }
    }

    /// The temporal module `index`.
    #[must_use]
    pub fn module(&self, index: usize) -> &Motion {
        &self.motion[index]
    }

    /// The feature of tap `level` at the width of its level.
    #[must_use]
    pub fn project(&self, level: usize, feature: &Maps) -> Maps {
        self.projects[level].point(feature)
    }

    /// A projected level at its own size: 4, 2, 1 and 1/2 times the grid.
    #[must_use]
    pub fn resize(&self, level: usize, projected: &Maps) -> Maps {
        match level {
            0 => self.resize0.forward(projected),
            1 => self.resize1.forward(projected),
            2 => projected.clone(),
            _ => self.resize3.halve(projected),
        }
    }

    /// The temporal module `index`, on all frames of a window.
    #[must_use]
    pub fn motion(&self, index: usize, x: &Maps) -> Maps {
        x.with(self.motion[index].forward(x.rows.clone(), x.frames))
    }

    /// A level at the width of the fused maps.
    #[must_use]
    pub fn rn(&self, level: usize, x: &Maps) -> Maps {
        self.rn[level].near(x)
    }

    /// Fuses `level` into the maps of the coarser levels (the coarsest has none), at `size`.
    #[must_use]
    pub fn fuse(
        &self,
        level: usize,
        so_far: &Maps,
        finer: Option<&Maps>,
        size: [usize; 2],
    ) -> Maps {
        self.fusions[level].forward(so_far, finer, size)
    }

    /// The first output convolution.
    #[must_use]
    pub fn output(&self, fused: &Maps) -> Maps {
        self.output1.near(fused)
    }

    /// To the size of the picture.
    #[must_use]
    pub fn up(&self, x: &Maps, size: [usize; 2]) -> Maps {
        x.resized(size)
    }

    /// The last two convolutions: one value per pixel, at least 0.
    #[must_use]
    pub fn depth(&self, x: &Maps) -> Maps {
        let raw = self.raw(x);
        raw.with(relu(raw.rows.clone()))
    }

    /// [`Head::depth`] before it is cut at 0.
    #[must_use]
    pub fn raw(&self, x: &Maps) -> Maps {
        let hidden = self.output2.near(x);
        self.output3.point(&hidden.with(relu(hidden.rows.clone())))
    }
}
