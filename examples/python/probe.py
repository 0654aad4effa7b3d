"""How much of the wearer's walk is in the tokens of the video? A small probe in PyTorch on tokens that a run made.

    reviv run experiments/quickstart.yaml
    python examples/python/probe.py quickstart

Cells (`# %%`) are those of a notebook. Needs PyTorch beside `reviv`: `pip install torch`.
"""

# %% A run that has clips and tokens
import argparse
import sys

import numpy as np
import reviv

try:
    import torch
except ImportError:
    sys.exit("this example trains with PyTorch, which is not installed: pip install torch")

parser = argparse.ArgumentParser()
parser.add_argument("run", nargs="?", default="quickstart", help="a run with `op: tokenize`")
parser.add_argument("--modality", default="rgb", help="whose tokens the probe sees")
parser.add_argument("--runs", default="runs")
parser.add_argument("--epochs", type=int, default=30)
arguments = parser.parse_args()
torch.manual_seed(0)


# %% Tokens in, metres walked out
def walked(clip: reviv.Clip) -> float:
    """The length of the camera's path over the two seconds, metres."""
    places = clip["camera"][:, :3, 3]
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def load(split: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Token ids `[clips, tokens]` and metres `[clips]`."""
    clips = reviv.clips(arguments.run, split, modalities=["camera"], runs=arguments.runs)
    metres = {clip.id: walked(clip) for clip in clips}
    ids, truth = [], []
    tokens = reviv.tokens(arguments.run, split, modalities=[arguments.modality], runs=arguments.runs)
    for batch in tokens.batches(64):
        rows = torch.from_numpy(batch[arguments.modality]).flatten(1).long()
        ids.append(rows[torch.from_numpy(batch.present[arguments.modality])])
        has = batch.present[arguments.modality]
        truth += [metres[name] for name, there in zip(batch.ids, has) if there]
    return torch.cat(ids), torch.tensor(truth)


train_ids, train_metres = load("train")
test_ids, test_metres = load("test")
vocabulary = int(max(train_ids.max(), test_ids.max())) + 1
print(f"{len(train_ids)} clips to train on, {len(test_ids)} to test; {train_ids.shape[1]} tokens of {vocabulary} kinds each")

# %% An embedding per token, their mean, and a line: as small as a probe can be
embed = torch.nn.Embedding(vocabulary, 32)
line = torch.nn.Linear(32, 1)
parameters = [*embed.parameters(), *line.parameters()]
optimizer = torch.optim.AdamW(parameters, lr=3e-3, weight_decay=1e-2)
mean, spread = train_metres.mean(), train_metres.std()


def probe(ids: torch.Tensor) -> torch.Tensor:
    return line(embed(ids).mean(dim=1)).squeeze(-1) * spread + mean


for epoch in range(arguments.epochs):
    for rows in torch.randperm(len(train_ids)).split(32):
        loss = ((probe(train_ids[rows]) - train_metres[rows]) / spread).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    if epoch % 10 == 9:
        print(f"epoch {epoch + 1}: loss {loss.item():.3f}")

# %% Beside the constant that knows nothing
with torch.no_grad():
    error = (probe(test_ids) - test_metres).abs().mean().item()
constant = (mean - test_metres).abs().mean().item()
print(f"mean error on held-out clips: probe {error:.3f} m, the mean of the training clips {constant:.3f} m")
