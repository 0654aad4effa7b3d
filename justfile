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

# Speed: recording, checking, planning, engine.
bench *NAME:
    cargo bench {{ NAME }}

# The editor's schema, after a setting has changed.
schema:
    cargo run --release -- schema

# Licences of the dependency tree.
licences:
    cargo deny check licenses bans sources

# The library's documentation.
doc:
    cargo doc --no-deps --open
