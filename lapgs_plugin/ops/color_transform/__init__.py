"""Apply an affine colour transform to each image: A rgb + b, with gradients of image and transform."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.color_transform.in_torch import transform_colors_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def transform_colors(image: Tensor, transform: Tensor) -> Tensor:
    """Return A rgb + b at every pixel, differentiable by image and transform.

    Args:
        image: (3, h, w), or (b, 3, h, w) of several views.
        transform: (3, 4), or (b, 3, 4), of the same type and on the same device: A in the first three columns, b in
            the last.
    """
    if not triton_works(image):
        return transform_colors_torch(image, transform)
    from lapgs_plugin.ops.color_transform.in_triton import transform_colors_triton

    return transform_colors_triton(image, transform)


@matches_reference("colour transforms as products of matrices instead of one kernel", 1e-4)
def triton_works(device: torch.device) -> float:
    """Compare images and gradients; values are about 1."""
    from lapgs_plugin.ops.color_transform.in_triton import transform_colors_triton

    # Channels last in memory, as gsplat returns images: the kernel compiled here is then the one used later.
    image = torch.linspace(-1, 1, 2 * 3 * 37 * 50, device=device).view(2, 37, 50, 3).permute(0, 3, 1, 2)
    transform = torch.linspace(-1, 1, 24, device=device).view(2, 3, 4)
    results = []
    for version in (transform_colors_torch, transform_colors_triton):
        leaves = image.clone().requires_grad_(), transform.clone().requires_grad_()
        result = version(*leaves)
        by_image, by_transform = torch.autograd.grad(result.square().mean(), leaves)
        results.append((result.detach(), by_image * image.numel() / 2, by_transform))
    return largest((one - other).abs() for one, other in zip(*results, strict=True))
