"""What the cases share: taking the time, the peak of memory, the optimizer."""

import json
import time

import torch


def say(line):
    print(json.dumps(line), flush=True)


def measure(name, repeats, work):
    """Says the seconds of each of `repeats` calls of `work`, after one that is not counted, and the peak of memory meanwhile."""
    reset_peak()
    work()
    wait()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        wait()
        seconds.append(time.perf_counter() - start)
    say({"measured": {"name": name, "seconds": seconds, "memory_mib": peak()}})


def on_gpu():
    return torch.get_default_device().type == "cuda"


def wait():
    """Until a GPU has done what it was asked for."""
    if on_gpu():
        torch.cuda.synchronize()


def reset_peak():
    """Lets the peak begin at what is in use now, where the system can."""
    if on_gpu():
        torch.cuda.reset_peak_memory_stats()
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        pass


def peak():
    """Peak of memory in MiB, of the GPU or resident; `None` where the system does not tell."""
    if on_gpu():
        return torch.cuda.max_memory_allocated() / 2**20
    try:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        return None


def adamw(model, rate, betas):
    """AdamW without decay on norms and biases; the fused one where this PyTorch has it for the CPU."""
    kept, decayed = [], []
    for name, parameter in model.named_parameters():
        (kept if "norm" in name or name.endswith("bias") else decayed).append(parameter)
    groups = [{"params": decayed, "weight_decay": 0.05}, {"params": kept, "weight_decay": 0.0}]
    try:
        return torch.optim.AdamW(groups, lr=rate, betas=betas, fused=True)
    except (RuntimeError, TypeError):
        return torch.optim.AdamW(groups, lr=rate, betas=betas, foreach=True)
