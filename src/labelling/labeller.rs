//! Frames in, depth out: a video of any length with the memory of one window.

use std::collections::{BTreeMap, VecDeque};

use burn::tensor::{Tensor, TensorData};

use super::plan::{KEY_SLOTS, OVERLAP, STEP, needed_slots};
use super::preprocess::{network_size, normalised, patches};
use super::settings::WINDOW;
use super::{DepthLabelKind, DepthNetwork, FrameFeatures, LabelError, Map, Stitcher};
use crate::engine::Compute;
use crate::video::image::Image;

/// How frames are seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LabelOptions {
    /// Pixels of the shorter side as the network sees it (a very wide frame is seen smaller).
    pub input_size: usize,
}

impl Default for LabelOptions {
    fn default() -> Self {
        Self { input_size: 518 }
    }
}

/// Frames that are encoded together.
const TOGETHER: usize = 4;

/// A depth network with the kind of its weights.
#[derive(Debug, Clone)]
pub struct DepthLabeller {
    network: DepthNetwork,
    kind: DepthLabelKind,
    compute: Compute,
}

/// What a video was labelled as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Labelled {
    /// Frames of the video.
    pub frames: usize,
    /// Windows that the network saw.
    pub windows: usize,
    /// Height and width that the network saw.
    pub network_size: [usize; 2],
}

impl DepthLabeller {
    /// A labeller with a network whose weights are of `kind`; `compute` is where the frames are sent.
    #[must_use]
    pub fn new(network: DepthNetwork, kind: DepthLabelKind, compute: &Compute) -> Self {
        Self {
            network,
            kind,
            compute: compute.clone(),
        }
    }

    /// What the weights give: relative inverse depth or metres.
    #[must_use]
    pub fn kind(&self) -> DepthLabelKind {
        self.kind
    }

    /// The network that labels.
    #[must_use]
    pub fn network(&self) -> &DepthNetwork {
        &self.network
    }

    /// The depth of every frame, `[height * width]` in row-major order, in the unit of [`DepthLabeller::kind`], handed to `sink`
    /// in order. Frames are taken as they are needed; at most a window of their features is held.
    ///
    /// # Errors
    /// What `frames` and `sink` refuse; when there is no frame, or frames differ in size.
    pub fn label<E: From<LabelError>>(
        &self,
        frames: impl IntoIterator<Item = Result<Image, E>>,
        options: &LabelOptions,
        sink: &mut dyn FnMut(usize, Vec<f32>) -> Result<(), E>,
    ) -> Result<Labelled, E> {
        let mut frames = frames.into_iter();
        let Some(first) = frames.next().transpose()? else {
            return Err(LabelError::Frames("the video has no frames".to_owned()).into());
        };
        let size = [first.height as usize, first.width as usize];
        let patch = self.network.settings().patch;
        let seen = network_size(size[0], size[1], options.input_size, patch)?;
        let mut reader = Reader {
            labeller: self,
            frames,
            waiting: Some(first),
            size,
            seen,
            positions: self
                .network
                .encoder()
                .positions(seen.map(|side| side / patch)),
            taken: 0,
            ended: false,
        };
        let mut stitcher = Stitcher::new(self.kind, size);
        let mut window: VecDeque<FrameFeatures> = VecDeque::with_capacity(WINDOW);
        let fitted = self.kind == DepthLabelKind::Relative;
        let mut index = 0;
        loop {
            while window.len() < WINDOW {
                let more = reader.next(WINDOW - window.len())?;
                if more.is_empty() {
                    break;
                }
                window.extend(more);
            }
            // Beyond its end a video repeats its last frame; the frames of the next window, if there is one, were asked for.
            if let Some(end) = window.back().cloned() {
                window.resize(WINDOW, end);
            }
            let end = reader.ended.then_some(reader.taken);
            let last = end.is_some_and(|frames| frames <= (index + 1) * STEP);
            // Before its end is reached, a video has more frames than this window shows.
            let slots = needed_slots(index, end.unwrap_or(usize::MAX / 2), fitted);
            let views: Vec<&FrameFeatures> = window.iter().collect();
            let mut maps = BTreeMap::new();
            self.network.decode(&views, &slots, &mut |slot, values| {
                maps.insert(slot, Map { values, size: seen });
                Ok::<(), E>(())
            })?;
            stitcher.push(maps, end, sink)?;
            if last {
                return Ok(Labelled {
                    frames: reader.taken,
                    windows: index + 1,
                    network_size: seen,
                });
            }
            window = KEY_SLOTS.iter().map(|slot| window[*slot].clone()).collect();
            debug_assert_eq!(window.len(), OVERLAP);
            index += 1;
        }
    }
}

/// Encodes frames as they are needed.
struct Reader<'a, I> {
    labeller: &'a DepthLabeller,
    frames: I,
    /// The frame that was looked at for its size.
    waiting: Option<Image>,
    size: [usize; 2],
    seen: [usize; 2],
    positions: Tensor<2>,
    taken: usize,
    ended: bool,
}

impl<E: From<LabelError>, I: Iterator<Item = Result<Image, E>>> Reader<'_, I> {
    /// The features of the next frames: at most `most`, none at the end.
    fn next(&mut self, most: usize) -> Result<Vec<FrameFeatures>, E> {
        let patch = self.labeller.network.settings().patch;
        let (mut values, mut count) = (Vec::new(), 0);
        while count < most.min(TOGETHER) && !self.ended {
            let next = self.waiting.take().map(Ok).or_else(|| self.frames.next());
            let Some(frame) = next.transpose()? else {
                self.ended = true;
                break;
            };
            self.check(&frame)?;
            let planes = normalised(&frame, self.seen);
            values.extend(patches(&planes, self.seen, patch));
            (self.taken, count) = (self.taken + 1, count + 1);
        }
        if count == 0 {
            return Ok(Vec::new());
        }
        let width = 3 * patch * patch;
        let data = TensorData::new(values.clone(), [values.len() / width, width]);
        let data = Tensor::from_data(data, self.labeller.compute.device());
        let cells = self.seen.map(|side| side / patch);
        let network = &self.labeller.network;
        Ok(network.encode(data, count, cells, &self.positions))
    }

    fn check(&self, frame: &Image) -> Result<(), LabelError> {
        let [height, width] = self.size;
        if [frame.height as usize, frame.width as usize] != self.size
            || frame.data.len() != height * width * 3
        {
            return Err(LabelError::Frames(format!(
                "frame {} has {} x {} pixels, the first has {width} x {height}",
                self.taken, frame.width, frame.height
            )));
        }
        Ok(())
    }
}
