"""Slice bilateral grids: affine colour transforms that vary over an image and with brightness.

A grid has a transform (3, 4) at each of its nodes, which lie evenly from the first to the last row and column of an
image, and from black to white. A pixel gets the trilinear interpolation of those around it, as in Bilateral Guided
Radiance Field Processing (Wang et al. 2024), nerfstudio and gsplat.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.bilateral_grid.in_torch import add_variation_torch, slice_grids_torch
from lapgs_plugin.ops.mixed_sizes import Sizes
from lapgs_plugin.ops.self_check import largest, matches_reference

TONES = 8
"""Nodes of a grid by brightness."""
MOST_NODES = 16
"""Most nodes along a side of a grid, as in the literature."""
LEAST_NODES = 4
"""Fewest nodes along a side of a grid."""
CELL = 32
"""Fewest pixels of a photo between two nodes, where `LEAST_NODES` allows it: finer grids learn what a photo shows."""


def grid_nodes(size: tuple[int, int]) -> tuple[int, int, int]:
    """Return the nodes of a grid along the height, along the width, and by brightness.

    Args:
        size: (width, height) of the photos at full size.
    """
    width, height = (min(MOST_NODES, max(LEAST_NODES, 1 + side // CELL)) for side in size)
    return height, width, TONES


def uniform_grids(transforms: Tensor, nodes: tuple[int, int, int]) -> Tensor:
    """Return (v, *nodes, 12) grids with transforms (v, 3, 4) at all of their nodes."""
    return transforms.reshape(-1, 1, 1, 1, 12).expand(-1, *nodes, -1).contiguous()


def slice_grids(image: Tensor, grids: Tensor, sizes: Sizes | None = None) -> Tensor:
    """Transform each pixel by its place and brightness, differentiably by image and grids.

    Args:
        image: (3, h, w), or (b, 3, h, w) of several views.
        grids: (y, x, l, 12), or (b, y, x, l, 12), of the same type and on the same device; the 12 are a transform's
            rows, one after the other. y and x are 2 at least.
        sizes: of several views whose sizes differ, see `mixed_sizes`; None if images are whole.
    """
    if not triton_works(image, grids):
        return slice_grids_torch(image, grids, sizes)
    from lapgs_plugin.ops.bilateral_grid.in_triton import slice_grids_triton

    return slice_grids_triton(image, grids, sizes)


def add_variation(grids: Tensor, by_grids: Tensor, weight: float) -> None:
    """Add the gradient of the weighted `total_variation` of grids (v, y, x, l, 12) to one by them, both contiguous."""
    if not triton_works(grids, by_grids):
        add_variation_torch(grids, by_grids, weight)
        return
    from lapgs_plugin.ops.bilateral_grid.in_triton import add_variation_triton

    add_variation_triton(grids, by_grids, weight)


@matches_reference("bilateral grids in PyTorch's operations instead of our kernels", 1e-4)
def triton_works(device: torch.device) -> float:
    """Compare images and gradients relative to the largest value of each, those of nodes with a tolerance of 2e-3."""
    from lapgs_plugin.ops.bilateral_grid.in_triton import add_variation_triton, slice_grids_triton

    generator = torch.Generator().manual_seed(0)
    # Channels last in memory, as gsplat returns images: the kernels compiled here are then the ones used later.
    image = torch.rand(2, 61, 90, 3, generator=generator).to(device).permute(0, 3, 1, 2)
    grids, weights = torch.rand(2, 4, 5, TONES, 12, generator=generator).to(device), image.flip(-1)
    results = []
    for sliced, add in ((slice_grids_torch, add_variation_torch), (slice_grids_triton, add_variation_triton)):
        leaves = image.clone().requires_grad_(), grids.clone().requires_grad_()
        result = sliced(*leaves)
        by_image, by_grids = torch.autograd.grad((result * weights).sum(), leaves)
        by_variation = torch.zeros_like(grids)
        add(grids, by_variation, 1.0)
        results.append((result.detach(), by_image, by_grids, by_variation))
    in_tf32 = 1.0, 1.0, 0.05, 1.0
    return largest(
        scale * (one - other).abs() / other.abs().max() for scale, other, one in zip(in_tf32, *results, strict=True)
    )
