"""Sum up densification statistics in one kernel."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512


@triton.jit(do_not_specialize=("half_width", "half_height", "n", "views"))  # no types
def _kernel(
    gradient: tl.tensor, radii: tl.tensor, norms: tl.tensor, counts: tl.tensor,
    half_width: float, half_height: float, n: tl.tensor, views: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    norm, count = tl.load(norms + rows, here, 0.0), tl.load(counts + rows, here, 0.0)
    view = 0
    while view < views:  # `range` of a tensor cannot be interpreted with NumPy 2.4
        seen = rows + view * n.to(tl.int64)
        shown = here & (tl.load(radii + seen, here, 0) > 0)
        x = tl.load(gradient + 2 * seen, shown, 0.0) * half_width
        y = tl.load(gradient + 2 * seen + 1, shown, 0.0) * half_height
        norm += tl.sqrt(x * x + y * y)
        count += tl.where(shown, 1.0, 0.0)
        view += 1
    tl.store(norms + rows, norm, here)
    tl.store(counts + rows, count, here)


def add_statistics_triton(
    gradient: Tensor, radii: Tensor, size: tuple[int, int], norms: Tensor, counts: Tensor
) -> None:
    """Do `add_statistics` for contiguous float32 tensors on one CUDA device."""
    n = len(norms)
    halves, views = (size[0] / 2.0, size[1] / 2.0), radii.numel() // n
    launch(_kernel, (blocks(n, BLOCK),), gradient, radii, norms, counts, *halves, n, views, block=BLOCK)
