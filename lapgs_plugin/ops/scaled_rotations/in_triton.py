"""Make scaled rotations in one kernel."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 256


@triton.jit
def _store(
    matrices: tl.tensor, rows: tl.tensor, here: tl.tensor, row: tl.constexpr,
    a: tl.tensor, b: tl.tensor, c: tl.tensor,
) -> None:  # fmt: skip
    places = matrices + 9 * rows.to(tl.int64) + 3 * row
    tl.store(places, a, here)
    tl.store(places + 1, b, here)
    tl.store(places + 2, c, here)


@triton.jit(do_not_specialize=("n",))  # no types
def _kernel(scales: tl.tensor, quaternions: tl.tensor, matrices: tl.tensor, n: int, block: tl.constexpr) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    w, x = tl.load(quaternions + 4 * rows, here, 1.0), tl.load(quaternions + 4 * rows + 1, here, 0.0)
    y, z = tl.load(quaternions + 4 * rows + 2, here, 0.0), tl.load(quaternions + 4 * rows + 3, here, 0.0)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    a = tl.load(scales + 3 * rows, here, 0.0)
    b, c = tl.load(scales + 3 * rows + 1, here, 0.0), tl.load(scales + 3 * rows + 2, here, 0.0)
    _store(matrices, rows, here, 0, a * (1 - 2 * (y * y + z * z)), b * 2 * (x * y - w * z), c * 2 * (x * z + w * y))
    _store(matrices, rows, here, 1, a * 2 * (x * y + w * z), b * (1 - 2 * (x * x + z * z)), c * 2 * (y * z - w * x))
    _store(matrices, rows, here, 2, a * 2 * (x * z - w * y), b * 2 * (y * z + w * x), c * (1 - 2 * (x * x + y * y)))


def scaled_rotations_triton(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Do `scaled_rotations_torch` for contiguous float32 tensors on a CUDA device, n above 0, without gradients."""
    n = len(scales)
    matrices = torch.empty((n, 3, 3), device=scales.device)
    launch(_kernel, (blocks(n, BLOCK),), scales, quaternions, matrices, n, block=BLOCK)
    return matrices
