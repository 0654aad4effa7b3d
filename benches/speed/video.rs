//! The video tokenizer at its full size, one clip of 17 x 256 x 256: pixels to tokens, and tokens to pixels.

use crate::measure::Meter;
use ndarray::{ArrayD, IxDyn};
use reviv::clip::Signal;
use reviv::engine::Initialise;
use reviv::tokenizer::Tokenizer;
use reviv::tokenizer::video::{Network, VideoSettings, VideoTokenizer};

pub fn run(meter: &Meter) {
    let compute = crate::compute();
    let network = Network::new(&Initialise::new(&compute, 0), &VideoSettings::default())
        .expect("the default sizes fit each other");
    let tokenizer = VideoTokenizer::new("rgb", [17, 256, 256], network, &compute)
        .expect("the clip is not empty");
    let values = ArrayD::from_shape_fn(IxDyn(&[17, 256, 256, 3]), |at| {
        ((at[0] * 7 + at[1] * 3 + at[2] * 5 + at[3]) as f32 * 0.01).sin()
    });
    let clip = [Signal {
        values,
        valid: None,
    }];
    let tokens = tokenizer.encode(&clip).expect("the clip fits");
    meter.measure("encode", || {
        std::hint::black_box(tokenizer.encode(&clip).expect("the clip fits"));
    });
    meter.measure("decode", || {
        std::hint::black_box(tokenizer.decode(&tokens).expect("the tokens are its own"));
    });
}
