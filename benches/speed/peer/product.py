"""One large product of matrices."""

import torch

from measure import measure

SIDE = 4096


@torch.inference_mode()
def run(repeats):
    a, b = (((torch.arange(SIDE * SIDE) * 0.37 + phase).sin()).view(SIDE, SIDE) for phase in (0.0, 0.5))

    def product():
        (a @ b.T)[0, 0].item()

    measure("product", repeats, product)
