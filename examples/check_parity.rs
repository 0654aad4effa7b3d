//! Compares this implementation with numbers of the reference: `cargo run --example check_parity -- DIR [--device cuda] [--bf16]`.
//!
//! `DIR` holds a set of vectors (`vq/`, `optim/`, ...), or is one of those folders. Settings, sizes and tolerances are read
//! from the files. Prints one line per tensor, the worst last, and exits 1 if any is off.

#[path = "check_parity/mod.rs"]
mod check_parity;

use clap::Parser;
use reviv::engine::{Compute, DeviceChoice, Precision};
use std::path::PathBuf;
use std::process::ExitCode;

/// Compares this implementation with numbers of the reference.
#[derive(Debug, Parser)]
struct Arguments {
    /// A set of vectors (`vq/`, `optim/`, ...), or one of those folders.
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// What computes: auto, cpu, cuda, vulkan, metal or wgpu, a GPU also with its number: `cuda:1`.
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: DeviceChoice,
    /// Round the operands of the transformer's products to bfloat16, and let numbers be 2e-2 off where the files ask for more.
    #[arg(long)]
    bf16: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let precision = if arguments.bf16 {
        Precision::Bf16
    } else {
        Precision::F32
    };
    let compute = match Compute::new(arguments.device, precision) {
        Ok(compute) => compute,
        Err(error) => {
            eprintln!("error: {error}");
            return ExitCode::from(2);
        }
    };
    println!("on {}", compute.name());
    match check_parity::check(&arguments.folder, &compute) {
        Ok(report) => {
            print!("{report}");
            ExitCode::from(u8::from(!report.passed()))
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}
