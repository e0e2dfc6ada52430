"""Slice bilateral grids: affine colour transforms that vary over an image and with brightness.

A grid has a transform (3, 4) at each of its nodes, which lie evenly from the first to the last row and column of an
image, and from black to white. A pixel gets the trilinear interpolation of those around it, as in Bilateral Guided
Radiance Field Processing (Wang et al. 2024), nerfstudio and gsplat. Operations of PyTorch alone, none of which waits.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from lapgs_plugin.ops.mixed_sizes import Sizes

TONES = 8
"""Nodes of a grid by brightness."""
MOST_NODES = 16
"""Most nodes along a side of a grid, as in the literature."""
LEAST_NODES = 4
"""Fewest nodes along a side of a grid, for vignetting."""
CELL = 32
"""Fewest pixels of a photo between two nodes, where `LEAST_NODES` allows it: finer grids learn what a photo shows."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness of a pixel."""


def grid_nodes(size: tuple[int, int]) -> tuple[int, int, int]:
    """Return the nodes of a grid by brightness, along the height, and along the width.

    Args:
        size: (width, height) of the photos at full size.
    """
    width, height = (min(MOST_NODES, max(LEAST_NODES, 1 + side // CELL)) for side in size)
    return TONES, height, width


def uniform_grids(transforms: Tensor, nodes: tuple[int, int, int]) -> Tensor:
    """Return (v, 12, *nodes) grids with transforms (v, 3, 4) at all of their nodes."""
    return transforms.reshape(-1, 12, 1, 1, 1).expand(-1, -1, *nodes).contiguous()


def slice_grids(image: Tensor, grids: Tensor, sizes: Sizes | None = None) -> Tensor:
    """Transform each pixel by its place and brightness, differentiably by image and grids.

    Args:
        image: (3, h, w), or (b, 3, h, w) of several views.
        grids: (12, l, y, x), or (b, 12, l, y, x), of the same type and on the same device; the 12 are a transform's
            rows, one after the other.
        sizes: of several views whose sizes differ, see `mixed_sizes`; None if images are whole.
    """
    height, width = image.shape[-2:]
    images = image.reshape(-1, 3, height, width)
    red, green, blue = images.unbind(1)  # (b, h, w)
    brightness = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    places = [_places(size, (width, height), image.dtype, image.device) for size in sizes or [(width, height)]]
    where = torch.stack(places).expand(len(images), -1, -1, -1)  # (b, h, w, 2)
    where = torch.cat([where, (2 * brightness - 1)[..., None]], dim=-1)[:, None]  # (b, 1, h, w, 3)
    rows = torch.nn.functional.grid_sample(
        grids.reshape(-1, *grids.shape[-4:]), where, padding_mode="border", align_corners=True
    )
    a, b, c, d = rows.view(-1, 3, 4, height, width).unbind(2)  # (b, 3, h, w) each
    return (a * red[:, None] + b * green[:, None] + c * blue[:, None] + d).view(image.shape)


def total_variation(grids: Tensor) -> Tensor:
    """Return the sum over grids (v, 12, l, y, x) of mean squared slopes along each axis, from its one end to the other.

    The literature has differences between neighbours, whose weight depends on the number of nodes.
    """
    slopes = [grids.diff(dim=axis) * (grids.shape[axis] - 1) for axis in (2, 3, 4)]
    return len(grids) * torch.stack([slope.square().mean() for slope in slopes]).sum()


@lru_cache(maxsize=64)  # views of a stage have few sizes
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _places(size: tuple[int, int], whole: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return (H, W, 2) x and y of pixel centres, -1 to 1 over an image of a size at the top left of a larger one."""
    (width, height), (columns, rows) = size, whole
    x = (2 * torch.arange(columns, dtype=dtype, device=device) + 1) / width - 1
    y = (2 * torch.arange(rows, dtype=dtype, device=device) + 1) / height - 1
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
