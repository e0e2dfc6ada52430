"""Call gsplat's compiled functions, with the conventions of the 3DGS family."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, PIXEL_VARIANCE

TILE = 16
FAR_PLANE = 1e10


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, poses: Tensor, intrinsics: Tensor,
    size: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Return radii (c, n, 2), centres (c, n, 2), depths (c, n) and conics (c, n, 3) of one or more activated Gaussians.

    Args:
        poses, intrinsics: (c, 4, 4) and (c, 3, 3).
        size: (width, height) of the image.
    """
    compiled = compiled_functions()
    radii, means2d, depths, conics, _ = compiled.projection_ewa_3dgs_fused_fwd(
        means, None, quaternions, scales, opacities, poses, intrinsics, *size,
        PIXEL_VARIANCE, NEAR_DEPTH, FAR_PLANE, 0.0, False, compiled.CameraModelType.PINHOLE,
    )  # fmt: skip
    return radii, means2d, depths, conics


def sort_into_tiles(
    projected: Sequence[Tensor], size: tuple[int, int], count: int = 1, of_image: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Sort Gaussians into tiles, front to back. This waits for the GPU, for the number of pairs with tiles.

    Args:
        projected: radii, centres and depths by `project`; or, without the leading dimension, those of several images
            in one list.
        size: (width, height) of all images.
        count: number of images.
        of_image: in a list, the image number (n,) of each Gaussian.

    Returns:
        The first pair of each tile, (count, tiles down, tiles across), and the Gaussian of each pair.
    """
    compiled = compiled_functions()
    radii, means2d, depths = projected[:3]
    across, down = (math.ceil(side / TILE) for side in size)
    # gsplat also takes the index of each Gaussian, but does not use it.
    _, pairs, flat = compiled.intersect_tile(
        means2d, radii, depths, of_image, of_image, count, TILE, across, down, True, False
    )
    return compiled.intersect_offset(pairs, count, across, down), flat


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # cached for later calls, which may need gradients
def zeros(shape: torch.Size, device: torch.device) -> Tensor:
    """Return cached zeros, the gradients by unused outputs; they must not be written to."""
    return torch.zeros(shape, device=device)


@lru_cache(maxsize=1)
def compiled_functions() -> Any:
    """Return gsplat's module of compiled functions."""
    from gsplat.cuda._backend import _C

    return _C
