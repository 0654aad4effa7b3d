//! Video Depth Anything Small, one window of pictures of 518 x 518: frames to depth, encoder and head together.

use crate::measure::Meter;
use burn::tensor::{Tensor, TensorData};
use reviv::engine::Initialise;
use reviv::labelling::{DepthNetwork, FrameFeatures, NetworkSettings};

/// Patches along a side.
const CELLS: usize = 37;
/// Frames that are encoded together, as the product does.
const TOGETHER: usize = 4;

pub fn run(meter: &Meter, frames: usize) {
    let compute = crate::compute();
    let network = DepthNetwork::new(&Initialise::new(&compute, 0), &NetworkSettings::small())
        .expect("the sizes of Small fit each other");
    let positions = network.encoder().positions([CELLS; 2]);
    let (cells, width) = (CELLS * CELLS, 3 * 14 * 14);
    let pixels: Vec<f32> = (0..TOGETHER * cells * width)
        .map(|i| (i as f32 * 0.01).sin())
        .collect();
    let encode = || -> Vec<FrameFeatures> {
        (0..frames / TOGETHER)
            .flat_map(|_| {
                let data = TensorData::new(pixels.clone(), [TOGETHER * cells, width]);
                let patches = Tensor::from_data(data, compute.device());
                network.encode(patches, TOGETHER, [CELLS; 2], &positions)
            })
            .collect()
    };
    let features = encode();
    let all: Vec<usize> = (0..frames).collect();
    let decode = |features: &[FrameFeatures]| {
        let window: Vec<&FrameFeatures> = features.iter().collect();
        network
            .decode(&window, &all, &mut |_, map| {
                std::hint::black_box(map);
                Ok::<(), ()>(())
            })
            .expect("nothing refuses");
    };
    meter.measure("encoder", || {
        std::hint::black_box(encode());
    });
    meter.measure("head", || decode(&features));
}
