//! `reviv` with three more modalities: build this crate and use its binary instead of `reviv`.

// Transforms are named `T_to_from`.
#![allow(non_snake_case)]

mod feet_contact;
mod head_turn;
mod object_pose;

fn main() -> std::process::ExitCode {
    reviv::cli::main()
}
