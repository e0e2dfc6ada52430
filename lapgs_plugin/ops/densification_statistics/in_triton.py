"""What densification sums up of every Gaussian in every iteration, in one kernel."""

from __future__ import annotations

from typing import Any

import triton
import triton.language as tl
from torch import Tensor

BLOCK = 512


@triton.jit(do_not_specialize=("half_width", "half_height", "n"))  # type: ignore[untyped-decorator]  # no types
def _kernel(
    gradient: tl.tensor, radii: tl.tensor, norms: tl.tensor, counts: tl.tensor,
    half_width: float, half_height: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    shown = (rows < n) & (tl.load(radii + rows, rows < n, 0) > 0)
    x = tl.load(gradient + 2 * rows, shown, 0.0) * half_width
    y = tl.load(gradient + 2 * rows + 1, shown, 0.0) * half_height
    tl.store(norms + rows, tl.load(norms + rows, shown, 0.0) + tl.sqrt(x * x + y * y), shown)
    tl.store(counts + rows, tl.load(counts + rows, shown, 0.0) + 1.0, shown)


def add_statistics(gradient: Tensor, radii: Tensor, size: tuple[int, int], norms: Tensor, counts: Tensor) -> None:
    """Add the norms of screen-space gradients, in half images a pixel, and 1 where a Gaussian was shown; in place.

    Args:
        gradient: (n, 2) by the centre in pixels.
        radii: (n,) int32, above 0 where shown.
        size: (width, height) of the image.
        norms, counts: (n,) sums so far.
    """
    n = len(norms)
    launch: Any = _kernel[(triton.cdiv(n, BLOCK),)]
    launch(gradient, radii, norms, counts, size[0] / 2.0, size[1] / 2.0, n, block=BLOCK)
