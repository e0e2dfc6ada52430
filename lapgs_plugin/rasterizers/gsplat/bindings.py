"""Call gsplat's compiled functions, with the conventions of the 3DGS family."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

TILE = 16


def sort_into_tiles(
    projected: Sequence[Tensor], size: tuple[int, int], count: int = 1, of_image: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Sort Gaussians into tiles, front to back. This waits for the GPU, for the number of pairs with tiles.

    Args:
        projected: radii (c, n, 2), centres (c, n, 2) and depths (c, n); or, without the leading dimension, those of
            several images in one list.
        size: (width, height) of all images.
        count: number of images.
        of_image: in a list, the image number (n,) of each Gaussian.

    Returns:
        The first pair of each tile, (count, tiles down, tiles across), and the Gaussian of each pair.
    """
    compiled = compiled_functions()
    radii, means2d, depths = projected[:3]
    across, down = (math.ceil(side / TILE) for side in size)
    with torch.cuda.device(radii.device):  # gsplat's functions launch on the current one
        # gsplat also takes the index of each Gaussian, but does not use it.
        _, pairs, flat = compiled.intersect_tile(
            means2d, radii, depths, of_image, of_image, count, TILE, across, down, True, False
        )
        return compiled.intersect_offset(pairs, count, across, down), flat


@lru_cache(maxsize=1)
def compiled_functions() -> Any:
    """Return gsplat's module of compiled functions."""
    from gsplat.cuda._backend import _C

    return _C
