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

# The Python package, into the Python that runs it.
wheel:
    pip install .

# A fast look while editing.
check:
    cargo clippy --all-targets -- -D warnings

# Speed of recording, checking, planning, reading, evaluating: `just bench --bench run`.
bench *NAME:
    cargo bench {{ NAME }}

# Speed of models beside PyTorch: `just speed --python PATH`, with a Python that has it.
speed *ARGUMENTS:
    cargo bench --bench speed -- {{ ARGUMENTS }}

# A page about this machine's GPU: `just gpu --features cuda --device cuda`.
gpu *ARGUMENTS:
    examples/gpu_report.sh {{ ARGUMENTS }}

# Products of every model's shapes: `just products --blas /path/to/libmkl_rt.so`.
products *ARGUMENTS:
    cargo bench --bench products -- {{ ARGUMENTS }}

# Remakes benches/results.md: models, training and decoding with page faults beside PyTorch, products beside a CBLAS library, a clean build.
results PYTHON BLAS:
    cargo bench --bench speed -- --python {{ PYTHON }} --write benches/results.md
    cargo bench --bench products -- --blas {{ BLAS }} >> benches/results.md
    CARGO_TARGET_DIR=target/clean bash -c 'rm -rf target/clean; time -p cargo build --release --quiet' 2>&1 | sed -n 's/^real/\nA clean release build, seconds:/p' >> benches/results.md

# The editor's schema, after a setting has changed.
schema:
    cargo run --release -- schema

# Licences of the dependency tree.
licences:
    cargo deny check licenses bans sources

# The library's documentation.
doc:
    cargo doc --no-deps --open
