"""Gaussians that hardly anything is seen of.

When densification ends many Gaussians lie behind others, cover less than a pixel, or were grown where nothing was
missing. All of them are projected, sorted and stepped in every iteration that is left, and in every frame after.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.inheritance import SH_C0


def blended_pixels(images: Iterable[Tensor], coefficients: Tensor) -> Tensor:
    """(n,) how much of a view each Gaussian makes up at most, in pixels: its weights alpha T, summed over the view.

    A weight is the derivative of a pixel by the Gaussian's colour, so one backward pass a view gives all sums. The
    largest over the views, and not their sum, because what a single view shows belongs to the scene as well.

    Args:
        images: (3, h, w) of the views that count, rendered one after the other, without SH beyond `coefficients`.
        coefficients: (n, 1, 3) of the constant harmonic, with gradients; such that no colour is clamped, as zeros are.
    """
    most = torch.zeros_like(coefficients[:, 0, 0], requires_grad=False)
    for image in images:
        (by_coefficients,) = torch.autograd.grad(image[0].sum(), coefficients)
        torch.maximum(most, by_coefficients[:, 0, 0] / SH_C0, out=most)
    return most


def least_blended(pixels: Tensor, share: float) -> Tensor:
    """(n,) bool, the most Gaussians that together make up at most a share of the sum of `pixels`.

    Args:
        pixels: (n,) of each, not negative.
        share: from 0, for those alone that are blended nowhere, to below 1.
    """
    ordered, order = pixels.double().sort()
    total = ordered.sum()
    least = torch.zeros_like(pixels, dtype=torch.bool)
    least[order] = (ordered.cumsum(0) <= share * total) & (total > 0)  # where nothing is seen nothing can be said
    return least
