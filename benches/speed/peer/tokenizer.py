"""The VQ-VAE of bodies at the paper's size (ViT-B)."""

import torch
from torch import nn
from torch.nn import functional as F

from measure import adamw, measure

# Clips per step; samples, joints and coordinates of a clip.
BATCH, CLIP = 8, (60, 21, 3)
WIDTH, DEPTH, HEADS, CODES, CODE_WIDTH = 768, 12, 12, 2048, 32
# A token covers 2 samples of 3 joints: a grid of 30 x 7.
TOKENS = 30 * 7


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm1 = nn.LayerNorm(WIDTH, eps=1e-6)
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.proj = nn.Linear(WIDTH, WIDTH)
        self.norm2 = nn.LayerNorm(WIDTH, eps=1e-6)
        self.fc1 = nn.Linear(WIDTH, 4 * WIDTH)
        self.fc2 = nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, h):
        b, n, _ = h.shape
        qkv = self.qkv(self.norm1(h)).view(b, n, 3, HEADS, WIDTH // HEADS).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(*qkv.unbind(0))
        h = h + self.proj(mixed.transpose(1, 2).reshape(b, n, WIDTH))
        return h + self.fc2(F.gelu(self.fc1(self.norm2(h))))


class Transformer(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("positions", torch.randn(1, TOKENS, WIDTH))
        self.blocks = nn.ModuleList(Block() for _ in range(DEPTH))
        self.norm = nn.LayerNorm(WIDTH, eps=1e-6)
        self.post1 = nn.Linear(WIDTH, 4 * WIDTH)
        self.post2 = nn.Linear(4 * WIDTH, WIDTH)

    def forward(self, h):
        h = h + self.positions
        for block in self.blocks:
            h = block(h)
        return h + self.post2(torch.tanh(self.post1(self.norm(h))))


class VqVae(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, WIDTH, (2, 3), stride=(2, 3))
        self.encoder, self.decoder = Transformer(), Transformer()
        self.to_code = nn.Linear(WIDTH, CODE_WIDTH)
        self.from_code = nn.Linear(CODE_WIDTH, WIDTH)
        self.out = nn.Linear(WIDTH, 2 * 3 * 3)
        self.register_buffer("codes", F.normalize(torch.randn(CODES, CODE_WIDTH), dim=-1))
        self.register_buffer("counts", torch.zeros(CODES))

    def encode(self, x):
        """Latents, the same at unit length, and the nearest code of each."""
        h = self.conv(x.permute(0, 3, 1, 2)).flatten(2).transpose(1, 2)
        z = self.to_code(self.encoder(h))
        unit = F.normalize(z.detach().flatten(0, 1), dim=-1)
        return z, unit, (unit @ F.normalize(self.codes, dim=-1).t()).argmax(-1)

    def decode(self, q):
        y = self.out(self.decoder(self.from_code(q)))
        y = y.view(-1, 30, 7, 3, 2, 3).permute(0, 1, 4, 2, 5, 3)
        return y.reshape(-1, *CLIP)

    @torch.no_grad()
    def update(self, unit, ids):
        """Running means of codes and counts; codes that are hardly used become latents of the batch."""
        n = torch.bincount(ids, minlength=CODES).float()
        sums = torch.zeros_like(self.codes).index_add_(0, ids, unit)
        mean = torch.where(n[:, None] > 0, F.normalize(sums, dim=-1), F.normalize(self.codes, dim=-1))
        self.counts.mul_(0.99).add_(n, alpha=0.01)
        self.codes.mul_(0.99).add_(mean, alpha=0.01)
        dead = self.counts < 2.0
        self.codes[dead] = unit[torch.randint(len(unit), (int(dead.sum()),))]


def run(repeats):
    model = VqVae()
    clips = torch.sin(0.017 * torch.arange(BATCH * 60 * 21 * 3).float()).view(BATCH, *CLIP)

    @torch.inference_mode()
    def encode():
        return model.encode(clips)[2].tolist()

    @torch.inference_mode()
    def forward():
        z, _, ids = model.encode(clips)
        return model.decode(model.codes[ids].view_as(z)).numpy()

    measure("encode", repeats, encode)
    measure("forward", repeats, forward)
    optimizer = adamw(model, 1e-4, (0.9, 0.99))

    def step():
        z, unit, ids = model.encode(clips)
        q = model.codes[ids].view_as(z)
        loss = F.mse_loss(model.decode(z + (q - z).detach()), clips) + F.mse_loss(z, q)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        model.update(unit, ids)
        return loss.item()

    measure("train step", repeats, step)
