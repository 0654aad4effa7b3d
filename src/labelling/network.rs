//! Encoder and head together: the features of single frames, and the depth of a window of them.

use burn::tensor::Tensor;

use super::encoder::Encoder;
use super::head::{Head, Maps};
use super::settings::WINDOW;
use super::{LabelError, NetworkSettings};
use crate::engine::parameters::to_host;
use crate::engine::{Initialise, parameters};

/// Video Depth Anything.
#[derive(Debug, Clone)]
pub struct DepthNetwork {
    encoder: Encoder,
    head: Head,
    settings: NetworkSettings,
}
parameters!(DepthNetwork {
    encoder => "pretrained",
    head
});

/// What the head needs of one frame: the four projected levels on the encoder's grid. They do not depend on other frames, so
/// windows that share a frame share its features.
#[derive(Debug, Clone)]
pub struct FrameFeatures {
    levels: [Maps; 4],
}

/// Frames that pass through the per-frame parts of the head together.
const TOGETHER: usize = 4;

impl DepthNetwork {
    /// A network of these sizes.
    ///
    /// # Errors
    /// When the sizes do not fit each other.
    pub fn new(init: &Initialise<'_>, settings: &NetworkSettings) -> Result<Self, LabelError> {
        settings.check()?;
        Ok(Self {
            encoder: Encoder::new(&init.at("pretrained"), settings),
            head: Head::new(&init.at("head"), settings),
            settings: settings.clone(),
        })
    }

    /// The sizes it was built with.
    #[must_use]
    pub fn settings(&self) -> &NetworkSettings {
        &self.settings
    }

    /// The image encoder, which sees each frame alone.
    #[must_use]
    pub fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// The head, which mixes the frames of a window.
    #[must_use]
    pub fn head(&self) -> &Head {
        &self.head
    }

    /// The features of `frames` frames of `cells` (rows, columns), from the pixels of their patches `[frames * rows * columns,
    /// 3 * patch^2]` and the position table of [`Encoder::positions`].
    #[must_use]
    pub fn encode(
        &self,
        patches: Tensor<2>,
        frames: usize,
        cells: [usize; 2],
        positions: &Tensor<2>,
    ) -> Vec<FrameFeatures> {
        let features = self.encoder.forward(patches, frames, positions);
        let projected: Vec<Maps> = features
            .into_iter()
            .enumerate()
            .map(|(level, rows)| {
                let feature = Maps {
                    rows,
                    frames,
                    size: cells,
                };
                self.head.project(level, &feature)
            })
            .collect();
        (0..frames)
            .map(|frame| FrameFeatures {
                levels: std::array::from_fn(|level| projected[level].narrow(frame, 1)),
            })
            .collect()
    }

    /// The depth of a window: for every slot of `wanted` in turn, `[height * width]` values of the picture's size go to `sink`.
    /// All frames take part in it, wanted or not.
    ///
    /// # Panics
    /// When the window is empty or longer than [`WINDOW`].
    pub fn decode<E>(
        &self,
        window: &[&FrameFeatures],
        wanted: &[usize],
        sink: &mut dyn FnMut(usize, Vec<f32>) -> Result<(), E>,
    ) -> Result<(), E> {
        assert!((1..=WINDOW).contains(&window.len()), "frames of a window");
        let head = &self.head;
        let level = |k: usize| -> Maps {
            let all: Vec<Maps> = window.iter().map(|frame| frame.levels[k].clone()).collect();
            Maps::cat(&all)
        };
        let cells = window[0].levels[0].size;
        let times = |n: usize| cells.map(|side| side * n);
        let coarse = head.motion(0, &level(2));
        let coarsest = head.motion(1, &head.resize(3, &level(3)));
        let coarse = head.rn(2, &coarse);
        let fused = head.fuse(3, &head.rn(3, &coarsest), None, cells);
        let fused = head.motion(2, &fused);
        let fused = head.fuse(2, &fused, Some(&coarse), times(2));
        let fused = head.motion(3, &fused);
        for slots in wanted.chunks(TOGETHER) {
            let pick = |k: usize| -> Maps {
                let all: Vec<Maps> = slots
                    .iter()
                    .map(|slot| window[*slot].levels[k].clone())
                    .collect();
                Maps::cat(&all)
            };
            let own: Vec<Maps> = slots.iter().map(|slot| fused.narrow(*slot, 1)).collect();
            let fine = head.rn(1, &head.resize(1, &pick(1)));
            let fused = head.fuse(1, &Maps::cat(&own), Some(&fine), times(4));
            let finest = head.rn(0, &head.resize(0, &pick(0)));
            let fused = head.fuse(0, &fused, Some(&finest), times(8));
            let output = head.up(&head.output(&fused), times(self.settings.patch));
            let depth = to_host(head.depth(&output).rows);
            let pixels = depth.len() / slots.len();
            for (slot, map) in slots.iter().zip(depth.chunks_exact(pixels)) {
                sink(*slot, map.to_vec())?;
            }
        }
        Ok(())
    }
}
