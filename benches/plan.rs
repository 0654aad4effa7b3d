//! What `reviv plan` says a training takes, and what it was seen to take: peak memory of the process and seconds, over three sizes and
//! three batches of tokenizers and of MGET. Memory has to be within 25 %, time within a factor of two.
//!
//! `cargo bench --bench plan [-- quick]`

use serde_json::Value;
use std::io::Error;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const REVIV: &str = env!("CARGO_BIN_EXE_reviv");
/// Steps of every training.
const STEPS: u64 = 6;

const HEAD: &str = "
experiment: plan_bench
about: Trainings that are planned and measured.
seed: 0
stages:
  clips: {op: clips, source: world_small, train: 64, validation: 8, test: 8}
  tok_rgb: {op: train_tokenizer, clips: clips, modality: rgb, tokenizer: video_tiny, warmup: {steps: 1}, steps: 2, batch: 2}
  tok_body: {op: train_tokenizer, clips: clips, modality: body, tokenizer: vq_kinematic_small, warmup: {steps: 1}, steps: 2, batch: 8}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, warmup: {steps: 1}, steps: 2, batch: 8}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_rgb, tok_body, tok_camera], pixels: rgb}
";

fn trainings(quick: bool) -> Vec<(String, String)> {
    let mut all = Vec::new();
    let batches: &[u32] = if quick { &[4] } else { &[2, 8, 32] };
    for (size, width, heads, depth) in [
        ("small", 96, 4, 2),
        ("middle", 192, 6, 4),
        ("large", 384, 6, 6),
    ] {
        for batch in batches {
            let stage = format!(
                "  it: {{op: train_mget, tokens: [tokens], size: {{use: laptop, width: {width}, heads: {heads}, encoder_depth: {depth}, \
                 decoder_depth: {depth}}}, masking: {{use: dirichlet_mixture, input_tokens: 256, target_tokens: 256}}, pixels: rgb, \
                 tubelet: [4, 16, 16], warmup: {{steps: 1}}, steps: {STEPS}, batch: {batch}}}\n"
            );
            all.push((format!("MGET {size}, batch {batch}"), stage));
        }
    }
    for (size, width, depth) in [("small", 64, 1), ("middle", 128, 2), ("large", 256, 4)] {
        for batch in if quick { &[32][..] } else { &[8, 64, 256][..] } {
            let stage = format!(
                "  it: {{op: train_tokenizer, clips: clips, modality: body, tokenizer: {{use: vq_kinematic_small, width: {width}, \
                 depth: {depth}}}, warmup: {{steps: 1}}, steps: {STEPS}, batch: {batch}}}\n"
            );
            all.push((format!("joints {size}, batch {batch}"), stage));
        }
    }
    for (size, channels) in [("small", 16), ("middle", 32), ("large", 64)] {
        for batch in if quick { &[2][..] } else { &[1, 4, 8][..] } {
            let stage = format!(
                "  it: {{op: train_tokenizer, clips: clips, modality: rgb, tokenizer: {{use: video_tiny, channels: {channels}}}, \
                 warmup: {{steps: 1}}, steps: {STEPS}, batch: {batch}}}\n"
            );
            all.push((format!("video {size}, batch {batch}"), stage));
        }
    }
    all
}

fn reviv(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(REVIV);
    command.current_dir(folder).args(arguments);
    command
}

/// Largest resident size of a process so far, bytes.
fn high_water(pid: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(1024 * kilobytes)
}

fn measured(folder: &Path) -> Result<(u64, f64), Error> {
    let begun = Instant::now();
    let mut child = reviv(folder, &["run", "it.yaml"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()?;
    let mut peak = 0;
    let status = loop {
        peak = high_water(child.id()).unwrap_or(0).max(peak);
        if let Some(status) = child.try_wait()? {
            break status;
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    if !status.success() {
        return Err(Error::other("the training failed"));
    }
    Ok((peak, begun.elapsed().as_secs_f64()))
}

fn planned(folder: &Path) -> Result<(f64, Option<f64>), Error> {
    let output = reviv(folder, &["plan", "it.yaml", "--json"]).output()?;
    let plan: Value = serde_json::from_slice(&output.stdout)?;
    let stages = plan["stages"]
        .as_array()
        .ok_or_else(|| Error::other("no stages"))?;
    let it = stages.iter().find(|stage| stage["name"] == "it");
    let it = it.ok_or_else(|| Error::other("no stage `it`"))?;
    let memory = it["plan"]["memory"].as_f64();
    let memory = memory.ok_or_else(|| Error::other("no memory is planned"))?;
    Ok((memory, it["plan"]["seconds"].as_f64()))
}

fn main() -> Result<(), Error> {
    let quick = std::env::args().any(|argument| argument == "quick");
    let folder = tempfile::tempdir()?;
    let path = folder.path();
    std::fs::write(path.join("it.yaml"), HEAD)?;
    let ready = reviv(path, &["run", "it.yaml"])
        .stdout(Stdio::null())
        .status()?;
    if !ready.success() {
        return Err(Error::other("the clips and tokens were not made"));
    }
    println!("| training | planned MB | measured MB | ratio | planned s | measured s |");
    println!("|---|---|---|---|---|---|");
    let (mut worst, mut slowest) = (1.0_f64, 1.0_f64);
    for (name, stage) in trainings(quick) {
        std::fs::write(path.join("it.yaml"), format!("{HEAD}{stage}"))?;
        let (memory, seconds) = planned(path)?;
        let (peak, took) = measured(path)?;
        let ratio = memory / peak as f64;
        worst = worst.max(ratio).max(1.0 / ratio);
        if let Some(seconds) = seconds {
            slowest = slowest.max(seconds / took).max(took / seconds);
        }
        println!(
            "| {name} | {:.0} | {:.0} | {ratio:.2} | {} | {took:.1} |",
            memory / 1e6,
            peak as f64 / 1e6,
            seconds.map_or("-".to_owned(), |s| format!("{s:.1}")),
        );
    }
    println!("\nmemory within a factor of {worst:.2}, time within {slowest:.2}");
    Ok(())
}
