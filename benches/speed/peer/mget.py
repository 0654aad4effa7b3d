"""MGET: one training step and one forward pass, at three sizes."""

import math

import torch
from torch import nn
from torch.nn import functional as F

from measure import adamw, measure

# Width, heads, depth.
SIZES = {"short": (96, 4, 2), "tiny": (384, 6, 6), "base": (768, 12, 12)}
# Samples, and tokens on each side.
BATCHES = {"short": (2, 128), "tiny": (8, 256), "base": (1, 1024)}
# Name, tokens, vocabulary.
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
    def __init__(self, width):
        super().__init__()
        hidden = 2 * (4 * width) // 3
        self.fc1 = nn.Linear(width, hidden, bias=False)
        self.fc3 = nn.Linear(width, hidden, bias=False)
        self.fc2 = nn.Linear(hidden, width, bias=False)

    def forward(self, x):
        return self.fc2(F.silu(self.fc1(x)) * self.fc3(x))


def norm(width):
    return nn.LayerNorm(width, eps=1e-6, bias=False)


class Encoder(nn.Module):
    def __init__(self, width, heads):
        super().__init__()
        self.norm1, self.norm2 = norm(width), norm(width)
        self.attn, self.mlp = Attention(width, heads), SwiGlu(width)

    def forward(self, x):
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class Decoder(nn.Module):
    def __init__(self, width, heads):
        super().__init__()
        self.norm1, self.norm2, self.query_norm, self.context_norm = (norm(width) for _ in range(4))
        self.self_attn, self.cross_attn = Attention(width, heads), Attention(width, heads, cross=True)
        self.mlp = SwiGlu(width)

    def forward(self, y, context, mask):
        y = y + self.self_attn(self.norm1(y), mask=mask)
        if context is not None:
            y = y + self.cross_attn(self.query_norm(y), self.context_norm(context))
        return y + self.mlp(self.norm2(y))


class Mget(nn.Module):
    """Tokens are given and asked for by modality: `{name: positions}`, the same for all samples."""

    def __init__(self, size):
        super().__init__()
        width, heads, depth = SIZES[size]
        self.inputs = nn.ModuleDict({m: nn.Embedding(v, width) for m, _, v in MODALITIES})
        self.outputs = nn.ModuleDict({m: nn.Linear(width, v, bias=False) for m, _, v in MODALITIES})
        self.vectors = nn.ParameterDict({m: nn.Parameter(torch.randn(width) * 0.02) for m, _, _ in MODALITIES})
        self.places = {m: torch.randn(n, width) for m, n, _ in MODALITIES}
        self.mask_token = nn.Parameter(torch.randn(width) * 0.02)
        self.encoder = nn.ModuleList(Encoder(width, heads) for _ in range(depth))
        self.decoder = nn.ModuleList(Decoder(width, heads) for _ in range(depth))
        self.encoder_norm, self.decoder_norm = norm(width), norm(width)
        self.context = nn.Linear(width, width)
        for table in self.inputs.values():
            nn.init.normal_(table.weight, std=0.02)

    def place(self, positions):
        return torch.cat([self.places[m][p] + self.vectors[m] for m, p in positions.items()])

    def encode(self, given, ids):
        """`ids[m]` is `[samples, tokens of m]`; gives what the decoder sees."""
        x = torch.cat([self.inputs[m](ids[m][:, p]) for m, p in given.items()], 1)
        place = self.place(given)
        h = x + place
        for block in self.encoder:
            h = block(h)
        return self.context(self.encoder_norm(h)) + place

    def decode(self, context, asked, samples):
        """Answers by modality. Asked tokens of different modalities do not see each other."""
        mask = None
        if len(asked) > 1:
            kinds = torch.cat([torch.full((len(p),), i) for i, p in enumerate(asked.values())])
            mask = (kinds[:, None] == kinds[None, :])[None, None]
        y = (self.place(asked) + self.mask_token).expand(samples, -1, -1)
        for block in self.decoder:
            y = block(y, context, mask)
        parts = self.decoder_norm(y).split([len(p) for p in asked.values()], 1)
        return dict(zip(asked, parts))

    def forward(self, given, asked, ids):
        """The mean over modalities of their cross-entropies."""
        samples = len(next(iter(ids.values())))
        answers = self.decode(self.encode(given, ids), asked, samples)
        losses = [
            F.cross_entropy(self.outputs[m](answers[m]).flatten(0, 1), ids[m][:, p].flatten()) for m, p in asked.items()
        ]
        return sum(losses) / len(MODALITIES)


def tokens(samples):
    """Ids that depend on sample, modality and position alone, as on our side."""
    ids = {}
    for index, (m, n, v) in enumerate(MODALITIES):
        p = torch.arange(n)
        ids[m] = torch.stack([(p * 7919 + s * 104729 + index * 1299709) % v for s in range(samples)])
    return ids


def masks(count):
    """The `count` given and the `count` asked tokens of each sample, as on our side."""
    first = (count - 30) // 2
    given = {"camera": torch.arange(30), "depth": torch.arange(first), "rgb": torch.arange(count - 30 - first)}
    first = (count - 64) // 2
    asked = {
        "body": torch.arange(34),
        "depth": torch.arange(2560, 2560 + first),
        "gaze": torch.arange(30),
        "rgb": torch.arange(2560, 2560 + count - 64 - first),
    }
    return given, asked


def run(size, repeats, compiled=False):
    samples, count = BATCHES[size]
    model = Mget(size)
    if compiled:
        model.compile()
    ids = tokens(samples)
    given, asked = masks(count)

    @torch.inference_mode()
    def forward():
        assert math.isfinite(model(given, asked, ids).item())

    measure("forward", repeats, forward)
    optimizer = adamw(model, 1e-4, (0.9, 0.95))

    def step():
        optimizer.zero_grad()
        model(given, asked, ids).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    measure("train step", repeats, step)
