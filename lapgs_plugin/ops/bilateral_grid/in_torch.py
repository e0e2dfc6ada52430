"""Slice bilateral grids with PyTorch's operations; the reference of `in_triton`. None of them waits."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from lapgs_plugin.ops.mixed_sizes import Sizes

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness of a pixel."""


def slice_grids_torch(image: Tensor, grids: Tensor, sizes: Sizes | None = None) -> Tensor:
    """Do `slice_grids` for images of any type on any device."""
    height, width = image.shape[-2:]
    images = image.reshape(-1, 3, height, width)
    red, green, blue = images.unbind(1)  # (b, h, w)
    brightness = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    places = [_places(size, (width, height), image.dtype, image.device) for size in sizes or [(width, height)]]
    where = torch.stack(places).expand(len(images), -1, -1, -1)  # (b, h, w, 2)
    where = torch.cat([where, (2 * brightness - 1)[..., None]], dim=-1)[:, None]  # (b, 1, h, w, 3)
    rows = torch.nn.functional.grid_sample(
        grids.reshape(-1, *grids.shape[-4:]).permute(0, 4, 3, 1, 2), where, padding_mode="border", align_corners=True
    )
    a, b, c, d = rows.view(-1, 3, 4, height, width).unbind(2)  # (b, 3, h, w) each
    return (a * red[:, None] + b * green[:, None] + c * blue[:, None] + d).view(image.shape)


def total_variation(grids: Tensor) -> Tensor:
    """Return the sum over grids (v, y, x, l, 12) of mean squared slopes along each axis, from its one end to the other.

    The literature has differences between neighbours, whose weight depends on the number of nodes.
    """
    slopes = [grids.diff(dim=axis) * (grids.shape[axis] - 1) for axis in (1, 2, 3)]
    return len(grids) * torch.stack([slope.square().mean() for slope in slopes]).sum()


def add_variation_torch(grids: Tensor, by_grids: Tensor, weight: float) -> None:
    """Do `add_variation` for grids of any type on any device."""
    with torch.enable_grad():
        leaf = grids.detach().requires_grad_()
        by_grids.add_(torch.autograd.grad(weight * total_variation(leaf), leaf)[0])


@lru_cache(maxsize=64)  # views of a stage have few sizes
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _places(size: tuple[int, int], whole: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return (H, W, 2) x and y of pixel centres, -1 to 1 over an image of a size at the top left of a larger one."""
    (width, height), (columns, rows) = size, whole
    x = (2 * torch.arange(columns, dtype=dtype, device=device) + 1) / width - 1
    y = (2 * torch.arange(rows, dtype=dtype, device=device) + 1) / height - 1
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
