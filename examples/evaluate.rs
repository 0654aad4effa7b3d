//! Scores a model on clips it has not seen: `cargo run --release --example evaluate [FOLDER]`.
#![allow(clippy::print_stdout)]

use reviv::evaluation::render::{Format, render};
use reviv::{Compute, EvaluateOptions, Flow, Model, World};
use std::error::Error;

pub fn run(folder: &str, clips: u64) -> Result<String, Box<dyn Error>> {
    let model = Model::open(folder, &Compute::cpu())?;
    let options = EvaluateOptions {
        inputs: vec!["pixels".to_owned()], // from raw video alone
        ..EvaluateOptions::default()
    };
    let clips = World::small().clips(10_000..10_000 + clips);
    let scores = reviv::evaluate(&model, &clips, &options, |_done, _total| Flow::Continue)?;
    let table = reviv::table("clips of the built-in world", &[scores])?;
    Ok(render(&table, Format::Terminal))
}

#[allow(dead_code, reason = "the tests call `run`")]
fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().nth(1);
    println!("{}", run(folder.as_deref().unwrap_or("models/small"), 32)?);
    Ok(())
}
