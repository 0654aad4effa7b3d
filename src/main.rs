fn main() -> std::process::ExitCode {
    reviv::cli::main()
}
