"""PyTorch's side of `cargo bench --bench speed`: eager, f32, as one would write it by hand, unless told otherwise.

usage: python benches/speed/peer CASE REPEATS THREADS [DEVICE] [bf16] [compile]

DEVICE is `cpu` or, with a number or not, `cuda`; with `bf16` under autocast, with `compile` MGET is compiled.

Says what `benches/speed/peer.rs` reads: a line of JSON about PyTorch, then one per measurement. Weights are random; shapes,
passes and arithmetic are those of our side.
"""

import sys

import torch

# Before anything else makes a tensor.
torch.set_default_device(sys.argv[4] if len(sys.argv) > 4 else "cpu")

import decoding
import depth
import mget
import product
import tokenizer
import video
from measure import say

CASES = {
    "tokenizer": tokenizer.run,
    "video": video.run,
    "depth": lambda repeats: depth.run(32, repeats),
    "depth-short": lambda repeats: depth.run(8, repeats),
    "mget-short": lambda repeats: mget.run("short", repeats, "compile" in sys.argv),
    "mget-tiny": lambda repeats: mget.run("tiny", repeats, "compile" in sys.argv),
    "mget-base": lambda repeats: mget.run("base", repeats, "compile" in sys.argv),
    "decoding-fast": lambda repeats: decoding.run("fast", repeats),
    "decoding-release": lambda repeats: decoding.run("release", repeats),
    "product": product.run,
}

case, repeats, threads = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
torch.set_num_threads(threads)
torch.manual_seed(0)
say({"engine": {"version": torch.__version__, "threads": torch.get_num_threads()}})
with torch.autocast(torch.get_default_device().type, torch.bfloat16, enabled="bf16" in sys.argv):
    CASES[case](repeats)
