//! `reviv` with one more modality: build this crate and use its binary instead of `reviv`.

mod head_turn;

fn main() -> std::process::ExitCode {
    reviv::cli::main()
}
