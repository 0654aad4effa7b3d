"""The computation of benches/mget.rs in plain PyTorch: prints seconds of a training step and of a forward pass.

usage: peer_mget.py tiny|base THREADS
"""

import math
import statistics
import sys
import time

import torch
from torch import nn
from torch.nn import functional as F

CASES = {"tiny": (384, 6, 6, 8, 256, 5), "base": (768, 12, 12, 1, 1024, 3)}
# Name, tokens, vocabulary; the order is that of the benchmark's spec.
MODALITIES = [("body", 210, 2048), ("camera", 30, 256), ("depth", 5120, 64000), ("gaze", 30, 512), ("rgb", 5120, 64000)]


class Attention(nn.Module):
    def __init__(self, width, heads, cross=False):
        super().__init__()
        self.heads, self.cross = heads, cross
        if cross:
            self.q = nn.Linear(width, width, bias=False)
            self.kv = nn.Linear(width, 2 * width, bias=False)
        else:
            self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width, bias=False)

    def forward(self, x, context=None, mask=None):
        batch, tokens, width = x.shape

        def split(t, parts):
            return t.view(batch, -1, parts, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)

        if self.cross:
            (q,), (k, v) = split(self.q(x), 1), split(self.kv(context), 2)
        else:
            q, k, v = split(self.qkv(x), 3)
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return self.proj(y.transpose(1, 2).reshape(batch, tokens, width))


class SwiGlu(nn.Module):
    def __init__(self, width, hidden):
        super().__init__()
        self.fc1 = nn.Linear(width, hidden, bias=False)
        self.fc3 = nn.Linear(width, hidden, bias=False)
        self.fc2 = nn.Linear(hidden, width, bias=False)

    def forward(self, x):
        return self.fc2(F.silu(self.fc1(x)) * self.fc3(x))


def norm(width):
    return nn.LayerNorm(width, eps=1e-6, bias=False)


class Encoder(nn.Module):
    def __init__(self, width, heads, hidden):
        super().__init__()
        self.norm1, self.norm2 = norm(width), norm(width)
        self.attn, self.mlp = Attention(width, heads), SwiGlu(width, hidden)

    def forward(self, x):
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class Decoder(nn.Module):
    def __init__(self, width, heads, hidden):
        super().__init__()
        self.norm1, self.norm2, self.query_norm, self.context_norm = (norm(width) for _ in range(4))
        self.self_attn, self.cross_attn = Attention(width, heads), Attention(width, heads, cross=True)
        self.mlp = SwiGlu(width, hidden)

    def forward(self, y, context, mask):
        y = y + self.self_attn(self.norm1(y), mask=mask)
        y = y + self.cross_attn(self.query_norm(y), self.context_norm(context))
        return y + self.mlp(self.norm2(y))


class Mget(nn.Module):
    def __init__(self, width, heads, depth):
        super().__init__()
        hidden = 2 * (4 * width) // 3
        self.inputs = nn.ModuleDict({m: nn.Embedding(v, width) for m, _, v in MODALITIES})
        self.outputs = nn.ModuleDict({m: nn.Linear(width, v, bias=False) for m, _, v in MODALITIES})
        self.vectors = nn.ParameterDict({m: nn.Parameter(torch.randn(width) * 0.02) for m, _, _ in MODALITIES})
        self.places = {m: torch.randn(n, width) for m, n, _ in MODALITIES}
        self.mask_token = nn.Parameter(torch.randn(width) * 0.02)
        self.encoder = nn.ModuleList(Encoder(width, heads, hidden) for _ in range(depth))
        self.decoder = nn.ModuleList(Decoder(width, heads, hidden) for _ in range(depth))
        self.encoder_norm, self.decoder_norm = norm(width), norm(width)
        self.context = nn.Linear(width, width)
        for table in self.inputs.values():
            nn.init.normal_(table.weight, std=0.02)

    def place(self, positions):
        return torch.cat([self.places[m][p] + self.vectors[m] for m, p in positions.items()])

    def forward(self, given, asked, ids, mask):
        x = torch.cat([self.inputs[m](ids[m][:, p]) for m, p in given.items()], 1)
        place = self.place(given)
        h = x + place
        for block in self.encoder:
            h = block(h)
        context = self.context(self.encoder_norm(h)) + place
        y = (self.place(asked) + self.mask_token).expand(x.shape[0], -1, -1)
        for block in self.decoder:
            y = block(y, context, mask)
        y = self.decoder_norm(y)
        total, start = 0.0, 0
        for m, p in asked.items():
            logits = self.outputs[m](y[:, start : start + len(p)])
            total = total + F.cross_entropy(logits.flatten(0, 1), ids[m][:, p].flatten())
            start += len(p)
        return total / len(MODALITIES)


def main():
    name, threads = sys.argv[1], int(sys.argv[2])
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    width, heads, depth, samples, tokens, repetitions = CASES[name]
    model = Mget(width, heads, depth)
    ids = {}
    for index, (m, n, v) in enumerate(MODALITIES):
        p = torch.arange(n)
        ids[m] = torch.stack([(p * 7919 + s * 104729 + index * 1299709) % v for s in range(samples)])
    first = (tokens - 30) // 2
    given = {"camera": torch.arange(30), "depth": torch.arange(first), "rgb": torch.arange(tokens - 30 - first)}
    first = (tokens - 64) // 2
    asked = {
        "body": torch.arange(34),
        "depth": torch.arange(2560, 2560 + first),
        "gaze": torch.arange(30),
        "rgb": torch.arange(2560, 2560 + tokens - 64 - first),
    }
    kinds = torch.cat([torch.full((len(p),), i) for i, p in enumerate(asked.values())])
    mask = (kinds[:, None] == kinds[None, :])[None, None]

    def median(work):
        times = []
        for _ in range(repetitions + 1):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
        return statistics.median(times[1:])

    def forward():
        with torch.no_grad():
            assert math.isfinite(model(given, asked, ids, mask).item())

    forward_seconds = median(forward)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, betas=(0.9, 0.95), eps=1e-8, weight_decay=0.05)

    def step():
        optimizer.zero_grad(set_to_none=False)
        model(given, asked, ids, mask).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    print(f"{median(step):.4f} {forward_seconds:.4f}")


main()
