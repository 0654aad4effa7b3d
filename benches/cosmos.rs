//! The video tokenizer's encoder at its full size, 17 x 256 x 256; `cosmos_peer.py` does the same in PyTorch.
//!
//! `RAYON_NUM_THREADS=2 cargo bench --bench cosmos [-- decode]`
#![allow(clippy::unwrap_used)] // A bench that cannot go on should stop where it is.

use ndarray::{ArrayD, IxDyn};
use reviv::clip::Signal;
use reviv::engine::{Compute, Initialise};
use reviv::tokenizer::Tokenizer;
use reviv::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use std::time::Instant;

fn main() {
    let compute = Compute::cpu();
    let network = Network::new(&Initialise::new(&compute, 0), &VideoSettings::default()).unwrap();
    let tokenizer = VideoTokenizer::new("rgb", [17, 256, 256], network, &compute).unwrap();
    let values = ArrayD::from_shape_fn(IxDyn(&[17, 256, 256, 3]), |at| {
        ((at[0] * 7 + at[1] * 3 + at[2] * 5 + at[3]) as f32 * 0.01).sin()
    });
    let clip = [Signal {
        values,
        valid: None,
    }];
    let decode = std::env::args().any(|argument| argument == "decode");
    let tokens = tokenizer.encode(&clip).unwrap();
    for _ in 0..5 {
        let start = Instant::now();
        if decode {
            let _ = tokenizer.decode(&tokens).unwrap();
        } else {
            let _ = tokenizer.encode(&clip).unwrap();
        }
        println!("{:.3} s", start.elapsed().as_secs_f64());
    }
}
