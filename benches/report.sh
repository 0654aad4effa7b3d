#!/usr/bin/env bash
# Everything in benches/results.md, measured again on this machine: models beside PyTorch, products beside a CBLAS library, training at
# laptop size, planned beside measured trainings, reading video, and building. Takes an hour or two, and nothing else may run meanwhile.
#
#   benches/report.sh [--python PATH] [--blas PATH] [--rounds N] [--write FILE]
#
# PATH is a Python that has PyTorch, and a CBLAS library (MKL: `libmkl_rt.so` of PyPI's `mkl`); without them reviv is measured alone.
# With `mpirun` installed, scaling over processes is measured too.
set -e -o pipefail
cd "$(dirname "$0")/.."

python='' blas='' rounds=3 write=benches/results.md
while [ $# -gt 0 ]; do
    case $1 in
        --python) python=$2 ;;
        --blas) blas=$2 ;;
        --rounds) rounds=$2 ;;
        --write) write=$2 ;;
        *)
            echo "unknown: $1; say --python PATH, --blas PATH, --rounds N or --write FILE" >&2
            exit 2
            ;;
    esac
    shift 2
done

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
page=$work/results.md

# Runs a command, and says its time in seconds.
timed() {
    local start end
    start=$(date +%s.%N)
    "$@" >"$work/log" 2>&1 || { tail -n 20 "$work/log" >&2; return 1; }
    end=$(date +%s.%N)
    awk -v start="$start" -v end="$end" 'BEGIN { printf "%.0f", end - start }'
}

section() {
    printf '\n## %s\n\n' "$1" >>"$page"
    echo "$1 ..." >&2
}

echo "Models ..." >&2
cargo bench --bench speed -- ${python:+--python "$python"} --rounds "$rounds" --write "$page" >/dev/null

section "Matrix products"
# MKL's threads otherwise go on spinning on the cores that the other side is measured on.
KMP_BLOCKTIME=0 cargo bench --bench products -- ${blas:+--blas "$blas"} 2>/dev/null >>"$page"

section "Laptop-size training"
echo "Stages of \`reviv run experiments/quickstart.yaml\`, from an empty cache." >>"$page"
echo >>"$page"
cargo build --release --quiet
target/release/reviv run experiments/quickstart.yaml --runs "$work/runs" 2>&1 |
    sed -n 's/^ *\[[0-9/]*\] \([a-z_]*\): done in \(.*\)/- \1: \2/p' >>"$page"

section "What a training is planned to take"
cargo bench --bench plan 2>/dev/null >>"$page"

section "Reading video"
cargo bench -p reviv-data --bench recordings 2>/dev/null >>"$page"

if command -v mpirun >/dev/null; then
    section "Several processes"
    cargo bench --features mpi --bench scaling 2>/dev/null >>"$page"
fi

section "Building"
clean=$(CARGO_TARGET_DIR=$work/target timed cargo build --release)
touch src/cli/mod.rs
edit=$(CARGO_TARGET_DIR=$work/target timed cargo build --release)
tests=$(CARGO_TARGET_DIR=$work/target timed cargo test --release --no-run)
{
    echo "A clean release build of the README's first command: $clean s. After an edit in \`src/cli/\`: $edit s. Tests after it: $tests s."
    echo "Crates are compiled from a registry that is already here."
} >>"$page"

mv "$page" "$write"
echo "$write" >&2
