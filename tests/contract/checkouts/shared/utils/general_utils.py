"""Activations, rotations, schedules, random state."""

import random
import sys
from datetime import datetime

import numpy as np
import torch


def identity_gate(x):
    return x


def inverse_sigmoid(x):
    return torch.log(x / (1 - x))


def PILtoTorch(pil_image, resolution):
    pixels = torch.from_numpy(np.array(pil_image.resize(resolution))) / 255.0
    return pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels[None]


def get_expon_lr_func(lr_init, lr_final, lr_delay_steps=0, lr_delay_mult=1.0, max_steps=1000000):
    """A rate that falls exponentially over `max_steps`, after a warm-up from `lr_delay_mult` times it."""

    def rate(step):
        if step < 0 or lr_init == lr_final == 0.0:
            return 0.0
        warmth = np.clip(step / lr_delay_steps, 0, 1) if lr_delay_steps > 0 else 1.0
        delay = lr_delay_mult + (1 - lr_delay_mult) * np.sin(0.5 * np.pi * warmth)
        passed = np.clip(step / max_steps, 0, 1)
        return delay * np.exp((1 - passed) * np.log(lr_init) + passed * np.log(lr_final))

    return rate


def build_rotation(r):
    w, x, y, z = torch.nn.functional.normalize(r).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)


class TimedOutput:
    """Standard output with the time at the end of each line, or none at all."""

    def __init__(self, stream, silent):
        self.stream = stream
        self.silent = silent

    def write(self, text):
        if not self.silent:
            self.stream.write(text.replace("\n", f" [{datetime.now():%d/%m %H:%M:%S}]\n"))

    def flush(self):
        self.stream.flush()


def safe_state(silent):
    sys.stdout = TimedOutput(sys.stdout, silent)
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    torch.cuda.set_device(torch.device("cuda:0"))
