"""Build pyramids of masked images: pixels outside of a mask change nothing at any level."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid


def masked_gaussian(pyramid: Pyramid, image: Tensor, mask: Tensor, levels: int) -> list[tuple[Tensor, Tensor]]:
    """Build the Gaussian pyramid of a masked image: each level is Down(image x mask) / Down(mask).

    Args:
        image: (3, h, w).
        mask: (1, h, w) bool or in [0, 1]; pixels with 0 are ignored.

    Returns:
        Image and weight (1, h, w) of each level, finest first. The weight is the share of the pixel inside of the
        mask, as k/255. Where it is 0 the image continues the inside smoothly, because windows of SSIM reach there.
    """
    weight = mask.to(image.dtype)
    sums, result = image * weight, []
    for level in range(levels):
        if level > 0:
            sums, weight = pyramid.down(sums), pyramid.down(weight)
        result.append((_filled(pyramid, sums, weight), (weight * 255).round_() / 255))
    return result


def fill_outside(prediction: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
    """Return the prediction inside of a mask and the target outside, where the prediction gets no gradient.

    Args:
        prediction, target: (3, h, w), or (b, 3, h, w) of several views.
        weight: (1, h, w) or (b, 1, h, w) in [0, 1]; None without a mask.
    """
    return prediction if weight is None else torch.lerp(target, prediction, weight.to(target.dtype))


def _filled(pyramid: Pyramid, sums: Tensor, weight: Tensor) -> Tensor:
    """Return sums / weight, and where the weight is 0 the average of the nearest coarser pixels, as k/255."""
    known = sums / weight.clamp_min(torch.finfo(weight.dtype).tiny)
    inside, size = weight > 0, (weight.shape[-2], weight.shape[-1])
    if max(size) == 1 or bool(inside.all()):
        return known
    below = pyramid.up(_filled(pyramid, pyramid.down(sums), pyramid.down(weight)), size)
    return torch.where(inside, known, (below * 255).round_() / 255)  # an 8-bit photo stays one
