#!/usr/bin/env bash
# What reviv does on this machine's GPU, as a page: parity with the reference, seconds and tokens per second of training and
# decoding, memory, beside PyTorch where a Python has it. Needs no network once the crates are there.
#
#   examples/gpu_report.sh --features cuda --device cuda --vectors DIR --python PATH
#
#   --features F   how reviv is built: cuda, cuda-nvrtc, vulkan, metal or wgpu    [cuda]
#   --device D     where it computes: cuda, cuda:1, vulkan, metal, wgpu           [cuda]
#   --vectors DIR  numbers of the reference (`vq/`, `mget/`, ...); without it parity is not checked
#   --python PATH  a Python with PyTorch; without it reviv is measured alone
#   --rounds N     how often each side has its turn                               [3]
#   --short        the smallest case alone, once: whether everything runs, not how fast
#   --config C     handed to cargo as `--config C`; may be repeated
#   --write FILE   the page                                                       [benches/results-gpu.md]
set -euo pipefail
cd "$(dirname "$0")/.."

features=cuda device=cuda vectors='' python='' rounds=3 short='' write=benches/results-gpu.md
config=()
while [ $# -gt 0 ]; do
    case $1 in
        --short) short=yes; shift; continue ;;
        --features | --device | --vectors | --python | --rounds | --config | --write)
            [ $# -ge 2 ] || { echo "$1 takes a value" >&2; exit 2; } ;;
        *) echo "unknown: $1; the first lines of $0 say what there is" >&2; exit 2 ;;
    esac
    case $1 in
        --features) features=$2 ;;
        --device) device=$2 ;;
        --vectors) vectors=$2 ;;
        --python) python=$2 ;;
        --rounds) rounds=$2 ;;
        --config) config+=(--config "$2") ;;
        --write) write=$2 ;;
    esac
    shift 2
done
if [ -n "$vectors" ] && [ ! -d "$vectors" ]; then
    echo "$vectors is no folder" >&2
    exit 2
fi

cases=(product mget-tiny mget-base tokenizer video depth-short decoding-fast)
rounded=(product mget-tiny mget-base decoding-fast)
compiled=(mget-tiny mget-base)
if [ -n "$short" ]; then
    cases=(mget-short)
    rounded=(mget-short)
    compiled=()
    rounds=1
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
page=$work/page.md
built=(--release --features "$features" "${config[@]}")

echo "building with --features $features" >&2
cargo build "${built[@]}" --example check_parity
cargo bench --features "$features" "${config[@]}" --bench speed --no-run

{
    echo "# On a GPU"
    echo
    echo "By \`examples/gpu_report.sh --features $features --device $device\`, $(date -u +%F)."
    if command -v nvidia-smi >/dev/null; then
        nvidia-smi --query-gpu=index,name,driver_version,memory.total --format=csv,noheader | sed 's/^/* GPU /'
    fi
    [ -z "$short" ] || printf '\nA dry run: it shows that everything runs, and nothing about speed.\n'
    echo
    echo "## Parity with the reference"
    echo
} >"$page"

status=0
# PRECISION FOLDER [OPTION]: holds what the reference says, or not, or the device cannot.
parity() {
    local precision=$1 folder=$2 rc=0
    shift 2
    cargo run "${built[@]}" --example check_parity -- "$folder" --device "$device" "$@" \
        >"$work/parity.txt" 2>"$work/parity.err" || rc=$?
    case $rc in
        0) echo "Parity in $precision holds; the worst tensors:" ;;
        1)
            echo "Parity in $precision **does not hold**; the worst tensors:"
            status=1
            ;;
        *)
            echo "Parity in $precision was not checked: $(tail -n 1 "$work/parity.err")"
            [ "$precision" = bf16 ] || status=1
            echo
            return
            ;;
    esac
    echo
    echo '```'
    head -n 1 "$work/parity.txt"
    tail -n 12 "$work/parity.txt"
    echo '```'
    echo
}

if [ -n "$vectors" ]; then
    # Tolerances are those of the files in f32, and at least 2e-2 in bf16.
    parity f32 "$vectors" >>"$page"
    if [ -d "$vectors/mget" ]; then
        parity bf16 "$vectors/mget" --bf16 >>"$page"
    fi
else
    echo "Not checked: no \`--vectors\` were given." >>"$page"
fi

# HEADING OPTION... -- CASE...: what is measured, and the tokens per second of its trainings.
speed() {
    local heading=$1 options=()
    shift
    while [ "$1" != -- ]; do
        options+=("$1")
        shift
    done
    shift
    echo "measuring: $heading" >&2
    [ -z "$python" ] || options+=(--python "$python")
    options+=(--device "$device" --rounds "$rounds" --write "$work/speed.md")
    rm -f "$work/speed.md"
    cargo bench --features "$features" "${config[@]}" --bench speed -- "${options[@]}" "$@" >/dev/null 2>"$work/speed.err" || true
    echo
    echo "## $heading"
    echo
    if [ ! -f "$work/speed.md" ]; then
        echo "Not measured: $(grep -m 1 '^error' "$work/speed.err" || tail -n 1 "$work/speed.err")"
        return
    fi
    sed '1,2d' "$work/speed.md"
    echo
    echo "| training, tokens per second | reviv | PyTorch |"
    echo "|---|--:|--:|"
    # | MGET `tiny` (8 samples, 256 + 256 tokens): train step | 0.123 s (...) | 0.234 s (...) | ...
    awk -F '|' '
        function rate(cell, tokens) {
            split(cell, word, " ")
            return word[2] == "s" && word[1] > 0 ? sprintf("%.0f", tokens / word[1]) : "-"
        }
        /^\| MGET .*: train step \|/ {
            match($2, /\([0-9]+ samples?, [0-9]+ \+ [0-9]+ tokens\)/)
            split(substr($2, RSTART + 1, RLENGTH - 2), size, /[^0-9]+/)
            tokens = size[1] * (size[2] + size[3])
            name = $2
            sub(/: train step */, "", name)
            printf "|%s | %s | %s |\n", name, rate($3, tokens), rate($4, tokens)
        }' "$work/speed.md"
}

speed "Speed in f32" -- "${cases[@]}" >>"$page"
grep -q '^Not measured' "$page" && status=1
speed "Speed with products in bf16" --bf16 -- "${rounded[@]}" >>"$page"
if [ -n "$python" ] && [ ${#compiled[@]} -gt 0 ]; then
    speed "Beside a compiled PyTorch, in bf16" --bf16 --compile -- "${compiled[@]}" >>"$page"
fi

mkdir -p "$(dirname "$write")"
cp "$page" "$write"
echo "$write" >&2
exit "$status"
