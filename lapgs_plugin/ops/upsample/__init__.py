"""Up and the sum of one level in one pass over the images: Up(coarse) + fine.

As PyTorch operations Up alone goes over an image some twenty times. Along one side it is linear and short: a fine
sample is a sum of at most five neighbouring coarse ones, whose weights `Pyramid.up_taps` gives. A GPU does the sum over
both sides in one kernel, a CPU first across and then down.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid, require_half
from lapgs_plugin.ops.self_check import largest, matches_reference

LARGEST_DIFFERENCE = 1e-4
"""From PyTorch's operations, of values of about 1, that still counts as rounding."""


def upsample_add(pyramid: Pyramid, coarse: Tensor, fine: Tensor) -> Tensor:
    """Up(coarse) + fine, as `pyramid.up` gives it but for rounding.

    Args:
        coarse: (c, ceil(h / 2), ceil(w / 2)), or (b, c, ...) for several images.
        fine: (c, h, w) or (b, c, h, w), of the same type and on the same device.
    """
    if torch.is_grad_enabled() and (coarse.requires_grad or fine.requires_grad):
        return upsample(pyramid, coarse, (fine.shape[-2], fine.shape[-1])) + fine
    if _in_numba(fine):
        return _added_on_cpu(pyramid, coarse, fine)
    if _in_triton(fine):
        from lapgs_plugin.ops.upsample.in_triton import upsample_add_triton

        with torch.cuda.device(fine.device):  # Triton launches on the current one
            return upsample_add_triton(pyramid, coarse, fine)
    return pyramid.up(coarse, (fine.shape[-2], fine.shape[-1])) + fine


def upsample(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int]) -> Tensor:
    """`pyramid.up(coarse, size)` but for rounding, with its gradient.

    Args:
        coarse: as `upsample_add` takes it.
        size: (h, w), height first.

    Raises:
        UserInputError: the image is not half of `size`.
    """
    require_half(coarse, size)
    if _in_numba(coarse) and not (torch.is_grad_enabled() and coarse.requires_grad):
        return _upsample_on_cpu(pyramid, coarse, size)
    if not _in_triton(coarse):
        return pyramid.up(coarse, size)
    from lapgs_plugin.ops.upsample.in_triton import upsample_triton

    with torch.cuda.device(coarse.device):
        return upsample_triton(pyramid, coarse, size)


def _in_numba(image: Tensor) -> bool:
    return image.device.type == "cpu" and image.dtype in (torch.float32, torch.float64)


def _in_triton(image: Tensor) -> bool:
    return image.device.type == "cuda" and image.dtype == torch.float32 and _triton_works()


def _added_on_cpu(pyramid: Pyramid, coarse: Tensor, fine: Tensor) -> Tensor:
    from lapgs_plugin.ops.upsample.in_numba import upsample_add_cpu

    rows, columns = (_numpy_taps(pyramid.grid, side, fine.dtype) for side in fine.shape[-2:])
    result = upsample_add_cpu(_planes(coarse), _planes(fine), rows.first, rows.weights, columns.across)
    return torch.from_numpy(result).view(fine.shape)


def _upsample_on_cpu(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int]) -> Tensor:
    from lapgs_plugin.ops.upsample.in_numba import upsample_cpu

    rows, columns = (_numpy_taps(pyramid.grid, side, coarse.dtype) for side in size)
    result = upsample_cpu(_planes(coarse), size, rows.first, rows.weights, columns.across)
    return torch.from_numpy(result).view(*coarse.shape[:-2], *size)


def _planes(image: Tensor) -> NDArray[np.floating[Any]]:
    """(n, h, w) of all its channels."""
    return image.detach().reshape(-1, *image.shape[-2:]).contiguous().numpy()


class _NumpyTaps(NamedTuple):
    """`Pyramid.up_taps` of a side, and as the CPU's kernel wants them across."""

    first: NDArray[np.int64]
    weights: NDArray[np.floating[Any]]
    across: NDArray[np.floating[Any]]


@lru_cache(maxsize=64)
def _numpy_taps(grid: str, size: int, dtype: torch.dtype) -> _NumpyTaps:
    from lapgs_plugin.ops.upsample.in_numba import across_weights

    first, weights = Pyramid(grid).up_taps(size)
    values = weights.to(dtype).numpy()
    return _NumpyTaps(first.numpy(), values, across_weights(first.numpy(), values))


@lru_cache(maxsize=1)
def _triton_works() -> bool:
    """Whether there is Triton, which comes with PyTorch for CUDA on Linux, and can compile what is right."""
    return matches_reference(
        "Up in many small operations instead of one kernel",
        lambda: _difference_in_triton(Pyramid(), torch.device("cuda")),
        LARGEST_DIFFERENCE,
    )


def _difference_in_triton(pyramid: Pyramid, device: torch.device) -> float:
    """Of values and gradient from what PyTorch's operations make of them, relative to values of about 1."""
    from lapgs_plugin.ops.upsample.in_triton import upsample_add_triton, upsample_triton

    # Pixel by pixel, as gsplat's images lie: what is compiled here is what will be used.
    coarse, fine = (
        torch.linspace(-1, 1, 3 * side * side, device=device).square().view(side, side, 3).permute(2, 0, 1)
        for side in (5, 10)
    )
    weighed = []
    for up in (pyramid.up, lambda image, size: upsample_triton(pyramid, image, size)):
        leaf = coarse.clone().requires_grad_()
        image = up(leaf, (10, 10))
        (gradient,) = torch.autograd.grad((image * fine).sum(), leaf)
        weighed.append((image.detach(), gradient))
    (image, gradient), (in_triton, gradient_in_triton) = weighed
    pairs = (
        (in_triton, image),
        (gradient_in_triton, gradient),
        (upsample_add_triton(pyramid, coarse, fine), image + fine),
    )
    return largest((one - other).abs() for one, other in pairs)
