"""The discrete video tokenizer at full size (Cosmos DV4x8x8): pixels of a clip to tokens and back."""

import torch
from torch import nn
from torch.nn import functional as F

from measure import measure

FRAMES, SIDE = 17, 256
# Side of a wavelet block, and its coefficients.
PATCH = 4
COEFFICIENTS = 3 * PATCH**3
CHANNELS, LATENT = 128, 16
LEVELS = torch.tensor([8, 8, 8, 5, 5, 5])
# What a token is multiplied by for each latent dimension.
BASIS = torch.tensor([1, 8, 64, 512, 2560, 12800])


def point(inputs, outputs):
    return nn.Conv3d(inputs, outputs, 1)


class Time(nn.Conv3d):
    """Causal: a frame sees itself and the two before it, the first of all standing for what was before."""

    def __init__(self, width):
        super().__init__(width, width, (3, 1, 1))

    def forward(self, x):
        return super().forward(torch.cat([x[:, :, :1]] * 2 + [x], 2))


def factorised(inputs, outputs):
    return nn.Sequential(nn.Conv3d(inputs, outputs, (1, 3, 3), padding=(0, 1, 1)), Time(outputs))


class Norm(nn.GroupNorm):
    """Of each frame over its pixels and channels."""

    def __init__(self, width):
        super().__init__(1, width, eps=1e-6)

    def forward(self, x):
        b, c, t, h, w = x.shape
        y = super().forward(x.transpose(1, 2).reshape(b * t, c, h, w))
        return y.view(b, t, c, h, w).transpose(1, 2)


class Res(nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()
        self.norm1, self.conv1 = Norm(inputs), factorised(inputs, outputs)
        self.norm2, self.conv2 = Norm(outputs), factorised(outputs, outputs)
        self.shortcut = point(inputs, outputs) if inputs != outputs else nn.Identity()

    def forward(self, x):
        h = self.conv1(F.silu(self.norm1(x)))
        h = self.conv2(F.silu(self.norm2(h)))
        return self.shortcut(x) + h


class Attention(nn.Module):
    """One head over all channels: over the pixels of a frame, or over a pixel's frames so far."""

    def __init__(self, width, over_time):
        super().__init__()
        self.norm, self.over_time = Norm(width), over_time
        self.q, self.k, self.v, self.out = (point(width, width) for _ in range(4))

    def forward(self, x):
        b, c, t, h, w = x.shape
        y = self.norm(x)
        parts = (conv(y) for conv in (self.q, self.k, self.v))
        if self.over_time:
            q, k, v = (p.permute(0, 3, 4, 2, 1).reshape(b * h * w, 1, t, c) for p in parts)
            y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
            y = y.view(b, h, w, t, c).permute(0, 4, 3, 1, 2)
        else:
            q, k, v = (p.permute(0, 2, 3, 4, 1).reshape(b * t, 1, h * w, c) for p in parts)
            y = F.scaled_dot_product_attention(q, k, v)
            y = y.view(b, t, h, w, c).permute(0, 4, 1, 2, 3)
        return x + self.out(y)


def middle(width):
    return nn.Sequential(Res(width, width), Attention(width, False), Attention(width, True), Res(width, width))


class Halve(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.conv, self.mix = nn.Conv3d(width, width, (1, 3, 3), stride=(1, 2, 2)), point(width, width)

    def forward(self, x):
        return self.mix(self.conv(F.pad(x, (0, 1, 0, 1))) + F.avg_pool3d(x, (1, 2, 2)))


class Double(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.conv, self.mix = nn.Conv3d(width, width, (1, 3, 3), padding=(0, 1, 1)), point(width, width)

    def forward(self, x):
        x = F.interpolate(x, scale_factor=(1, 2, 2), mode="nearest")
        return self.mix(self.conv(x) + x)


class Tokenizer(nn.Module):
    def __init__(self):
        super().__init__()
        near, far = 2 * CHANNELS, 4 * CHANNELS
        self.encoder = nn.Sequential(
            factorised(COEFFICIENTS, CHANNELS),
            *(Res(CHANNELS, near), Res(near, near), Halve(near)),
            *(Res(near, far), Res(far, far)),
            *(Res(far, far), Res(far, far)),
            middle(far),
            *(Norm(far), nn.SiLU(), factorised(far, LATENT)),
            point(LATENT, len(LEVELS)),
        )
        self.decoder = nn.Sequential(
            point(len(LEVELS), LATENT),
            factorised(LATENT, far),
            middle(far),
            *(Res(far, far), Res(far, far), Res(far, far), Double(far)),
            *(Res(far, far), Res(far, far), Res(far, far)),
            *(Res(far, near), Res(near, near), Res(near, near)),
            *(Norm(near), nn.SiLU(), factorised(near, COEFFICIENTS)),
        )
        # Stands for both levels of the Haar wavelet: one fixed matrix per block of pixels.
        self.register_buffer("wavelet", torch.linalg.qr(torch.randn(COEFFICIENTS, COEFFICIENTS)).Q)
        self.half = (LEVELS - 1) * 1.001 / 2
        self.offset = torch.where(LEVELS % 2 == 0, 0.5, 0.0)

    @torch.inference_mode()
    def encode(self, video):
        """`[1, 3, frames, height, width]` to tokens `[1, frames', height', width']`."""
        # The first frame fills a block of its own.
        x = torch.cat([video[:, :, :1]] * (PATCH - 1) + [video], 2)
        b, c, t, h, w = (size // PATCH if axis > 1 else size for axis, size in enumerate(x.shape))
        x = x.view(b, c, t, PATCH, h, PATCH, w, PATCH).permute(0, 2, 4, 6, 3, 5, 7, 1)
        x = x.reshape(b, t, h, w, COEFFICIENTS) @ self.wavelet.t()
        z = self.encoder(x.permute(0, 4, 1, 2, 3).contiguous()).permute(0, 2, 3, 4, 1)
        squashed = torch.tanh(z + torch.atanh(self.offset / self.half)) * self.half - self.offset
        return ((squashed.round().long() + LEVELS // 2) * BASIS).sum(-1)

    @torch.inference_mode()
    def decode(self, tokens):
        """The inverse."""
        codes = (tokens[..., None] // BASIS % LEVELS - LEVELS // 2) / (LEVELS // 2)
        x = self.decoder(codes.permute(0, 4, 1, 2, 3).contiguous()).permute(0, 2, 3, 4, 1)
        b, t, h, w, _ = x.shape
        x = (x @ self.wavelet).view(b, t, h, w, PATCH, PATCH, PATCH, 3).permute(0, 7, 1, 4, 2, 5, 3, 6)
        return x.reshape(b, 3, t * PATCH, h * PATCH, w * PATCH)[:, :, PATCH - 1 :].clamp(-1, 1)


def run(repeats):
    model = Tokenizer()
    video = torch.sin(0.01 * torch.arange(3 * FRAMES * SIDE * SIDE).float()).view(1, 3, FRAMES, SIDE, SIDE)
    tokens = model.encode(video)
    measure("encode", repeats, lambda: model.encode(video))
    measure("decode", repeats, lambda: model.decode(tokens))
