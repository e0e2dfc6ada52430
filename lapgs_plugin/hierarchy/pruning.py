"""Find Gaussians with negligible visibility in the training views.

When densification ends, many Gaussians are hidden, cover less than a pixel, or add nothing. Each still costs time in
every later iteration and every frame.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from lapgs_plugin.fields.spherical_harmonics import SH_C0


def blended_pixels(images: Iterable[Tensor], coefficients: Tensor) -> Tensor:
    """Return each Gaussian's visibility (n,) in pixels: the sum of its blending weights alpha T in its best view.

    A weight is the derivative of a pixel by the Gaussian's colour, so one backward pass per view gives all sums. They
    are not added over views, because a surface seen in a single view belongs to the scene as well.

    Args:
        images: (3, h, w) of the views, rendered one after the other, without SH above `coefficients`.
        coefficients: (n, 1, 3) of the constant harmonic, with gradients; such that no colour is clamped, as zeros are.
    """
    most = torch.zeros_like(coefficients[:, 0, 0], requires_grad=False)
    for image in images:
        (by_coefficients,) = torch.autograd.grad(image[0].sum(), coefficients)
        torch.maximum(most, by_coefficients[:, 0, 0] / SH_C0, out=most)
    return most


def unpruned_line(share: float, level: int) -> str:
    """Return the line that tells a user why --prune has no effect on a level."""
    return f"--prune {share}: level {level} is not pruned: no densification ends in its iterations"


def least_blended(pixels: Tensor, share: float) -> Tensor:
    """Return a mask (n,) of the least visible Gaussians that together have at most a share of total visibility.

    Args:
        pixels: (n,) visibility of each, not negative.
        share: from 0, which selects only Gaussians that are never blended, to below 1.
    """
    ordered, order = pixels.double().sort()
    total = ordered.sum()
    least = torch.zeros_like(pixels, dtype=torch.bool)
    least[order] = (ordered.cumsum(0) <= share * total) & (total > 0)  # without any visibility there is no order
    return least
