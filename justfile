# Short names for what is done often. `just` lists them; https://just.systems

_default:
    @just --list

# The first experiment, on any machine.
quickstart:
    cargo run --release -- run experiments/quickstart.yaml

# All tests.
test:
    cargo test --release

# Everything that must hold for a change.
ci:
    .ci/run

# A fast look while editing.
check:
    cargo clippy --all-targets -- -D warnings

# Speed of recording, checking, planning, reading, evaluating: `just bench --bench run`.
bench *NAME:
    cargo bench {{ NAME }}

# Speed of models beside PyTorch: `just speed --python PATH`, with a Python that has it.
speed *ARGUMENTS:
    cargo bench --bench speed -- {{ ARGUMENTS }}

# The editor's schema, after a setting has changed.
schema:
    cargo run --release -- schema

# Licences of the dependency tree.
licences:
    cargo deny check licenses bans sources

# The library's documentation.
doc:
    cargo doc --no-deps --open
