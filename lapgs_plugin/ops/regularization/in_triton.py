"""Add the gradients of regularization in one kernel."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # no types
def _kernel(
    logits: tl.tensor, log_scales: tl.tensor, by_logits: tl.tensor, by_log_scales: tl.tensor,
    by_opacity: float, by_scale: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    before = tl.load(by_logits + rows, rows < n, 0.0)
    tl.store(by_logits + rows, before + by_opacity * opacity * (1.0 - opacity), rows < n)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        before = tl.load(by_log_scales + places, places < 3 * n, 0.0)
        tl.store(by_log_scales + places, before + by_scale * scale, places < 3 * n)


def add_regularization_triton(
    opacity_logits: Tensor, log_scales: Tensor, by_logits: Tensor, by_log_scales: Tensor,
    opacity_weight: float, scale_weight: float,
) -> None:  # fmt: skip
    """Do `add_regularization_torch` for contiguous float32 tensors on one CUDA device, not empty."""
    n = len(opacity_logits)
    tensors = opacity_logits, log_scales, by_logits, by_log_scales
    launch(_kernel, (blocks(n, BLOCK),), *tensors, opacity_weight / n, scale_weight / (3 * n), n, block=BLOCK)
