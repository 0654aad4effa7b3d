"""A model that was trained for seconds, and a video to reconstruct: what every test needs."""

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import reviv

# The smallest transformer, on tokens of a stage of that name.
MGET = """\
  mget:
    op: train_mget
    tokens: [tokens]
    size: {use: laptop_small, width: 48, heads: 2, encoder_depth: 1, decoder_depth: 1}
    masking: {use: dirichlet, input_tokens: 32, target_tokens: 32}
    positions: aligned
    pixels: rgb
    tubelet: [4, 16, 16]
    steps: 2
    batch: 2
    warmup: {steps: 0}
"""

EXPERIMENT = """
experiment: tiny
about: As quickstart, in seconds; nothing is learned.
seed: 0
stages:
  clips: {op: clips, source: world_small, train: 6, validation: 2, test: 3}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, steps: 2, batch: 2, warmup: {steps: 0}}
  tok_gaze: {op: train_tokenizer, clips: clips, modality: gaze, tokenizer: vq_temporal_small, steps: 2, batch: 2, warmup: {steps: 0}}
  tok_body: {op: train_tokenizer, clips: clips, modality: body, tokenizer: vq_kinematic_small, steps: 2, batch: 2, warmup: {steps: 0}}
  tok_hand: {op: train_tokenizer, clips: clips, modality: left_hand, tokenizer: vq_kinematic_small, steps: 2, batch: 2, warmup: {steps: 0}}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_camera, tok_gaze, tok_body, tok_hand], pixels: rgb}
""" + MGET + """  predictions: {op: predict, model: mget, clips: clips, inputs: [pixels], decoding: fast, split: test}
  scores: {op: evaluate, predictions: predictions, clips: clips, suite: {use: world_all, metrics: [body.ga_mpjpe, camera.rte]}, split: test}
"""


def command(*arguments, folder, check=True):
    """Runs `reviv` as a user does."""
    made = subprocess.run(
        [sys.executable, "-m", "reviv", *map(str, arguments)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert not check or made.returncode == 0, made.stderr
    return made


def write_png(path, image):
    """An 8-bit RGB picture `[height, width, 3]`."""

    def chunk(kind, data):
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    height, width, _ = image.shape
    rows = b"".join(b"\0" + row.tobytes() for row in image)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """A folder with a finished run."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "tiny.yaml").write_text(EXPERIMENT)
    command("run", "tiny.yaml", folder=folder)
    return folder


DEEP = """
experiment: deep
about: As tiny, with depth.
seed: 0
stages:
  clips: {op: clips, source: world_small, train: 4, validation: 2, test: 2}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, steps: 2, batch: 2, warmup: {steps: 0}}
  tok_depth: {op: train_tokenizer, clips: clips, modality: depth, tokenizer: {use: video_tiny, channels: 4}, steps: 2, batch: 2, warmup: {steps: 0}}
  tokens: {op: tokenize, clips: clips, tokenizers: [tok_camera, tok_depth], pixels: rgb}
""" + MGET


@pytest.fixture(scope="session")
def deep(tmp_path_factory, video):
    """A reconstruction with relative depth, and the same with metric depth: twice the relative, and one metre."""
    folder = tmp_path_factory.mktemp("deep")
    (folder / "deep.yaml").write_text(DEEP)
    command("run", "deep.yaml", folder=folder)
    model = reviv.load(runs=folder / "runs")
    relative = reviv.reconstruct(video, model, seconds=2)
    np.savez(folder / "anchor.npz", depth=2 * relative.depth.values + 1)
    metric = reviv.reconstruct(video, model, seconds=2, anchor=folder / "anchor.npz")
    assert not relative.depth.metric and metric.depth.metric, metric.depth.refused
    return relative, metric


@pytest.fixture(scope="session")
def runs(place):
    return place / "runs"


@pytest.fixture(scope="session")
def model(runs):
    return reviv.load(runs=runs)


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """Three and a half seconds of the built-in world, as a folder of pictures (30 a second)."""
    folder = tmp_path_factory.mktemp("video") / "walk"
    folder.mkdir()
    frames = reviv.world(1, first=7)[0]["rgb"]
    for number in range(105):
        write_png(folder / f"{number:05}.png", np.ascontiguousarray(frames[number * len(frames) // 105]))
    return folder


@pytest.fixture(scope="session")
def made(video, model):
    return reviv.reconstruct(video, model)


def skip_without(*modules):
    """Skips, with the reason, where a reader that others wrote is not installed."""

    def module(name):
        reason = f"{name} is not installed here: `pip install '.[test]'`"
        return pytest.importorskip(name, reason=reason, exc_type=ImportError)

    return [module(name) for name in modules]


@pytest.fixture
def folder(tmp_path: Path, made):
    made.write(tmp_path / "out")
    return tmp_path / "out"
