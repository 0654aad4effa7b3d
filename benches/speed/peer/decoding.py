"""Decoding with the tiny MGET: camera, gaze and body of one clip from its video tokens.

The presets are `registry/decoding/fast.yaml` and `registry/decoding/release.yaml`. Passes are shared as on our side: what the
encoder makes of the given tokens alone is kept, and a pass without conditions that sees nothing skips encoder and
cross-attention.
"""

import math

import torch

from measure import measure
from mget import MODALITIES, Mget, tokens

COUNTS = {m: n for m, n, _ in MODALITIES}
TEMPERATURE, TOP_P = 0.01, 0.8
# Targets that are decided together, steps, scale of the guidance (1: none).
PRESETS = {
    "fast": ([["camera", "gaze", "body"]], 1, 1.0),
    "release": ([["camera"], ["gaze"], ["body"]], 3, 2.0),
}


def sample(logits):
    """A token per row from the nucleus, and how sure the model was of it: 1 minus the entropy as a share of the largest."""
    ordered, order = logits.sort(dim=-1, descending=True)
    probabilities = ordered.softmax(-1)
    # The token that crosses the mass stays.
    before = probabilities.cumsum(-1) - probabilities
    kept = ordered.masked_fill(before > TOP_P, float("-inf"))
    drawn = torch.multinomial((kept / TEMPERATURE).softmax(-1), 1)
    entropy = torch.special.entr(probabilities).sum(-1)
    return order.gather(-1, drawn)[:, 0], 1 - entropy / math.log(logits.shape[-1])


@torch.inference_mode()
def generate(model, video, groups, steps, guidance):
    """Tokens and certainty of every target, `{name: ([tokens], [tokens])}`, from `video`, `[1, tokens]`."""
    given = {"rgb": torch.arange(COUNTS["rgb"])}
    context_of_given = model.encode(given, {"rgb": video})
    found = {}
    for group in groups:
        ids = {m: torch.zeros(1, COUNTS[m], dtype=torch.long) for m in group}
        certainty = {m: torch.zeros(COUNTS[m]) for m in group}
        order = {m: torch.randperm(COUNTS[m]) for m in group}
        for step in range(steps):
            parts = {m: order[m].tensor_split(steps) for m in group}
            asked = {m: parts[m][step].sort().values for m in group}
            known = {m: torch.cat(parts[m][:step]).sort().values for m in group} if step > 0 else {}
            context = model.encode(given | known, ids | {"rgb": video}) if known else context_of_given
            answers = model.decode(context, asked, 1)
            if guidance != 1.0:
                context = model.encode(known, ids) if known else None
                without = model.decode(context, asked, 1)
            for m, positions in asked.items():
                logits = model.outputs[m](answers[m][0])
                if guidance != 1.0:
                    plain = model.outputs[m](without[m][0])
                    logits = plain + guidance * (logits - plain)
                ids[m][0, positions], certainty[m][positions] = sample(logits)
        found |= {m: (ids[m][0].tolist(), certainty[m].tolist()) for m in group}
    return found


def run(preset, repeats):
    model = Mget("tiny")
    video = tokens(1)["rgb"]
    groups, steps, guidance = PRESETS[preset]
    measure("generate", repeats, lambda: generate(model, video, groups, steps, guidance))
