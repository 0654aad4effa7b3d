"""The encoder of benches/cosmos.rs in PyTorch, from the same description: same layers, random weights.

python benches/cosmos_peer.py [threads]
"""
import sys
import time

import torch
import torch.nn.functional as F

torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
torch.manual_seed(0)


def conv(i, o, kernel):
    return torch.randn(o, i, *kernel) * 0.02, torch.zeros(o)


def space(x, w, stride=1):
    pad = (1, 1, 1, 1) if stride == 1 else (0, 1, 0, 1)
    return F.conv3d(F.pad(x, pad), *w, stride=(1, stride, stride))


def time_(x, w):
    return F.conv3d(torch.cat([x[:, :, :1]] * 2 + [x], 2), *w)


def norm(x, silu=True):
    b, c, t, h, w = x.shape
    y = x.transpose(1, 2).reshape(b * t, c, h, w)
    y = F.group_norm(y, 1, torch.ones(c), torch.zeros(c), 1e-6)
    y = y.reshape(b, t, c, h, w).transpose(1, 2)
    return F.silu(y) if silu else y


class Res:
    def __init__(self, i, o):
        self.a, self.b = conv(i, o, (1, 3, 3)), conv(o, o, (3, 1, 1))
        self.c, self.d = conv(o, o, (1, 3, 3)), conv(o, o, (3, 1, 1))
        self.short = conv(i, o, (1, 1, 1)) if i != o else None

    def __call__(self, x):
        h = time_(space(norm(x), self.a), self.b)
        h = time_(space(norm(h), self.c), self.d)
        return h + (F.conv3d(x, *self.short) if self.short else x)


def attention(x, weights, along_time):
    q, k, v, out = weights
    b, c, t, h, w = x.shape
    y = norm(x, False)
    q, k, v = (F.conv3d(y, *p) for p in (q, k, v))
    if along_time:
        q, k, v = (p.permute(0, 3, 4, 2, 1).reshape(b * h * w, t, c) for p in (q, k, v))
        mask = torch.tril(torch.ones(t, t, dtype=torch.bool))
        s = (q @ k.transpose(1, 2) * c**-0.5).masked_fill(~mask, float("-inf"))
        y = (s.softmax(-1) @ v).reshape(b, h, w, t, c).permute(0, 4, 3, 1, 2)
    else:
        q, k, v = (p.transpose(1, 2).reshape(b * t, c, h * w).transpose(1, 2) for p in (q, k, v))
        s = (q @ k.transpose(1, 2) * c**-0.5).softmax(-1)
        y = (s @ v).transpose(1, 2).reshape(b, t, c, h, w).transpose(1, 2)
    return x + F.conv3d(y.contiguous(), *out)


first = conv(192, 128, (1, 3, 3)), conv(128, 128, (3, 1, 1))
level0 = Res(128, 256), Res(256, 256)
down = conv(256, 256, (1, 3, 3)), conv(256, 256, (1, 1, 1))
rest = Res(256, 512), Res(512, 512), Res(512, 512), Res(512, 512), Res(512, 512)
attentions = [[conv(512, 512, (1, 1, 1)) for _ in range(4)] for _ in range(2)]
last = Res(512, 512)
end = conv(512, 16, (1, 3, 3)), conv(16, 16, (3, 1, 1)), conv(16, 6, (1, 1, 1))
HAAR = torch.randn(192, 192) / 8


def encode(video):
    x = torch.cat([video[:, :, :1]] * 3 + [video], 2)
    b, c, t, h, w = x.shape
    x = x.reshape(b, c, t // 4, 4, h // 4, 4, w // 4, 4).permute(0, 2, 4, 6, 3, 5, 7, 1)
    x = (x.reshape(b, t // 4, h // 4, w // 4, 192) @ HAAR).permute(0, 4, 1, 2, 3).contiguous()
    x = time_(space(x, first[0]), first[1])
    for block in level0:
        x = block(x)
    x = space(x, down[0], 2) + F.avg_pool3d(x, (1, 2, 2))
    x = F.conv3d(x, *down[1])
    for block in rest:
        x = block(x)
    x = attention(x, attentions[0], False)
    x = attention(x, attentions[1], True)
    x = last(x)
    x = time_(space(norm(x), end[0]), end[1])
    return F.conv3d(x, *end[2])


with torch.inference_mode():
    video = torch.rand(1, 3, 17, 256, 256) * 2 - 1
    encode(video)
    for _ in range(5):
        start = time.perf_counter()
        encode(video)
        print(f"{time.perf_counter() - start:.3f} s")
