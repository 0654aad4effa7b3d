//! Reconstructs the wearer and the world of a video: `cargo run --release --example reconstruct VIDEO MODEL OUT`.
#![allow(clippy::print_stdout)]

use reviv::{Compute, Joint, Model, ReconstructOptions, Video};
use std::error::Error;

pub fn run(video: &str, model: &str, out: &str) -> Result<(), Box<dyn Error>> {
    let model = Model::open(model, &Compute::cpu())?;
    let video = Video::open(video)?;
    let result = reviv::reconstruct(&video, &model, &ReconstructOptions::default())?;

    let wrist = result.body().position(Joint::LeftWrist, 1.5);
    println!("left wrist at 1.5 s: {wrist:?}, metres, z up");
    println!("depth is {}", result.depth().scale().words());
    for frame in result.depth().frames() {
        println!(
            "nearest: {:.2}",
            frame?.iter().copied().fold(f32::INFINITY, f32::min)
        );
    }
    for fact in result.assumptions() {
        println!("{}: {}", fact.label, fact.value);
    }
    result.write(out)?; // arrays, exports and the page `view.html`
    Ok(())
}

#[allow(dead_code, reason = "the tests call `run`")]
fn main() -> Result<(), Box<dyn Error>> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [video, model, out] = given.as_slice() else {
        return Err("give a video, a model folder and a folder to make".into());
    };
    run(video, model, out)
}
