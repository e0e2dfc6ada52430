"""Image quality as 3DGS papers report it: PSNR and SSIM of one image."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from lapgs_plugin.hierarchy import supervision

SMALLEST_MSE = 1e-10
"""Mean squared errors below this, which float32 images hardly resolve, count as this: no PSNR is above 100 dB."""


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of one image, over all its pixels and channels, at most 100.

    Args:
        image, target: (3, h, w), clamped to [0, 1] here, not rounded to 8 bits.
    """
    difference = image.detach().clamp(0.0, 1.0) - target.clamp(0.0, 1.0)
    mse = float(difference.double().square().mean())
    return -10.0 * math.log10(max(mse, SMALLEST_MSE))


@torch.no_grad()
def ssim(image: Tensor, target: Tensor) -> float:
    """Mean structural similarity of one image as 3DGS computes it, see `supervision.ssim`.

    Args:
        image, target: (3, h, w) of the same type and device, clamped to [0, 1] here.
    """
    image, target = image.clamp(0.0, 1.0), target.clamp(0.0, 1.0)
    if image.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import ssim_cpu

        return float(ssim_cpu(image, target))
    return float(supervision.ssim(image, target))


def mean_quality(pairs: Iterable[tuple[Tensor, Tensor]]) -> dict[str, float]:
    """Means over images of "psnr" in dB and "ssim"; empty without an image.

    Args:
        pairs: image and target of each, as `psnr` and `ssim` take them.
    """
    measured = [{"psnr": psnr(image, target), "ssim": ssim(image, target)} for image, target in pairs]
    names = measured[0] if measured else {}
    return {name: math.fsum(each[name] for each in measured) / len(measured) for name in names}
