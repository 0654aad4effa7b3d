"""Video Depth Anything Small, one window of pictures of 518 x 518: frames to depth, encoder and head together."""

import torch
from torch import nn
from torch.nn import functional as F

from measure import measure

SIDE, PATCH = 518, 14
CELLS = SIDE // PATCH
WIDTH, BLOCKS, HEADS = 384, 12, 6
TAPS = (2, 5, 8, 11)
LEVELS = (48, 96, 192, 384)
FEATURES = 64
WINDOW = 32
# Frames that pass through the encoder and the last layers together.
TOGETHER = 4


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(WIDTH, eps=1e-6) for _ in range(2))
        self.qkv, self.proj = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.fc1, self.fc2 = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)
        self.ls1, self.ls2 = (nn.Parameter(torch.ones(WIDTH)) for _ in range(2))

    def forward(self, x):
        b, n, _ = x.shape
        q, k, v = self.qkv(self.norm1(x)).view(b, n, 3, HEADS, -1).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, WIDTH)
        x = x + self.ls1 * self.proj(mixed)
        return x + self.ls2 * self.fc2(F.gelu(self.fc1(self.norm2(x))))


class Encoder(nn.Module):
    def __init__(self):
        super().__init__()
        self.patch = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.token = nn.Parameter(torch.randn(1, 1, WIDTH))
        self.positions = nn.Parameter(torch.randn(1, 1 + CELLS**2, WIDTH))
        self.blocks = nn.ModuleList(Block() for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(WIDTH, eps=1e-6)

    def forward(self, x):
        x = self.patch(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.token.expand(len(x), -1, -1), x], 1) + self.positions
        features = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in TAPS:
                map = self.norm(x)[:, 1:].transpose(1, 2)
                features.append(map.reshape(len(x), WIDTH, CELLS, CELLS))
        return features


class Attention(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.q, self.k, self.v = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.out = nn.Linear(width, width)
        self.register_buffer("positions", torch.randn(1, WINDOW, width))

    def forward(self, x):
        p, t, c = x.shape
        x = x + self.positions[:, :t]
        q, k, v = (part(x).view(p, t, 8, c // 8).transpose(1, 2) for part in (self.q, self.k, self.v))
        return self.out(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(p, t, c))


class Motion(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm = nn.GroupNorm(32, width, eps=1e-6)
        self.proj_in, self.proj_out = nn.Linear(width, width), nn.Linear(width, width)
        self.attention = nn.ModuleList(Attention(width) for _ in range(2))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.ff_norm = nn.LayerNorm(width)
        self.ff_in, self.ff_out = nn.Linear(width, 8 * width), nn.Linear(4 * width, width)

    def forward(self, x):
        t, c, h, w = x.shape
        y = self.proj_in(self.norm(x).flatten(2).permute(2, 0, 1))
        for attention, norm in zip(self.attention, self.norms):
            y = y + attention(norm(y))
        value, gate = self.ff_in(self.ff_norm(y)).chunk(2, -1)
        y = self.proj_out(y + self.ff_out(value * F.gelu(gate)))
        return x + y.permute(1, 2, 0).reshape(t, c, h, w)


class Residual(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(FEATURES, FEATURES, 3, padding=1) for _ in range(2))

    def forward(self, x):
        return self.conv2(F.relu(self.conv1(F.relu(x)))) + x


def resized(x, size):
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


class Fusion(nn.Module):
    def __init__(self, finer):
        super().__init__()
        self.unit1, self.unit2 = Residual() if finer else None, Residual()
        self.out = nn.Conv2d(FEATURES, FEATURES, 1)

    def forward(self, x, size, finer=None):
        if finer is not None:
            x = x + self.unit1(finer)
        return self.out(resized(self.unit2(x), size))


class Head(nn.Module):
    def __init__(self):
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(WIDTH, width, 1) for width in LEVELS)
        self.resize = nn.ModuleList([
            nn.ConvTranspose2d(LEVELS[0], LEVELS[0], 4, 4),
            nn.ConvTranspose2d(LEVELS[1], LEVELS[1], 2, 2),
            nn.Identity(),
            nn.Conv2d(LEVELS[3], LEVELS[3], 3, 2, 1),
        ])
        self.motion = nn.ModuleList(Motion(width) for width in (LEVELS[2], LEVELS[3], FEATURES, FEATURES))
        self.rn = nn.ModuleList(nn.Conv2d(width, FEATURES, 3, padding=1, bias=False) for width in LEVELS)
        self.fusions = nn.ModuleList(Fusion(index < 3) for index in range(4))
        self.output1 = nn.Conv2d(FEATURES, FEATURES // 2, 3, padding=1)
        self.output2 = nn.Sequential(
            nn.Conv2d(FEATURES // 2, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 1, 1), nn.ReLU()
        )

    def forward(self, features):
        levels = [resize(project(x)) for project, resize, x in zip(self.projects, self.resize, features)]
        levels[2], levels[3] = self.motion[0](levels[2]), self.motion[1](levels[3])
        rn = [conv(level) for conv, level in zip(self.rn, levels)]
        x = self.motion[2](self.fusions[3](rn[3], (CELLS, CELLS)))
        x = self.motion[3](self.fusions[2](x, (2 * CELLS, 2 * CELLS), rn[2]))
        depth = []
        for start in range(0, len(x), TOGETHER):
            part = slice(start, start + TOGETHER)
            y = self.fusions[1](x[part], (4 * CELLS, 4 * CELLS), rn[1][part])
            y = self.fusions[0](y, (8 * CELLS, 8 * CELLS), rn[0][part])
            depth.append(self.output2(resized(self.output1(y), (SIDE, SIDE))))
        return torch.cat(depth)


@torch.inference_mode()
def run(frames, repeats):
    encoder, head = Encoder(), Head()
    pictures = torch.sin(0.01 * torch.arange(TOGETHER * 3 * SIDE * SIDE).float()).view(TOGETHER, 3, SIDE, SIDE)

    def encode():
        parts = [encoder(pictures) for _ in range(frames // TOGETHER)]
        return [torch.cat(level) for level in zip(*parts)]

    features = encode()
    measure("encoder", repeats, encode)
    measure("head", repeats, lambda: head(features))
