//! Trains tokenizers and a model on clips of the built-in world: `cargo run --release --example train [FOLDER]`.
#![allow(clippy::print_stdout)]

use reviv::training::Event;
use reviv::{Flow, Model, TokenizerOptions, Tokenizers, TrainOptions, World};
use std::error::Error;

pub fn run(
    folder: &str,
    clips: u64,
    tokenizers: &TokenizerOptions,
    options: &TrainOptions,
) -> Result<(), Box<dyn Error>> {
    let clips = World::small().clips(0..clips);
    let tokenizers = Tokenizers::fit(&clips, tokenizers)?;
    let model = Model::train(&tokenizers, &clips, options, |event| {
        if let Event::Step { report, total } = event {
            println!("step {} of {total}: loss {:.3}", report.step, report.loss);
        }
        Flow::Continue // `Flow::Stop` ends it
    })?;
    model.write(folder)?;
    Ok(())
}

#[allow(dead_code, reason = "the tests call `run`")]
fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().nth(1);
    let folder = folder.as_deref().unwrap_or("models/small");
    run(
        folder,
        800,
        &TokenizerOptions::small(),
        &TrainOptions::default(),
    )
}
