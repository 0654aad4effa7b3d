/// Steps allocate the same arrays again and again.
#[global_allocator]
static MEMORY: reviv::engine::memory::Pool = reviv::engine::memory::Pool;

fn main() -> std::process::ExitCode {
    reviv::cli::main()
}
