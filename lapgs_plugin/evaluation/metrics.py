"""Compute PSNR and SSIM of one image, as 3DGS papers report them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from statistics import fmean

import torch
from torch import Tensor

from lapgs_plugin.ops.photometric_loss import in_torch

SMALLEST_MSE = 1e-10
"""Smallest mean squared error that counts, near the resolution of float32 images: no PSNR is above 100 dB."""


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio of one image in dB, over all pixels and channels, at most 100.

    Args:
        image, target: (3, h, w), clamped to [0, 1] here and not rounded to 8 bits.
        mask: (1, h, w) bool or weights in [0, 1] of the pixels; None counts all.
    """
    squares = (image.detach().clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).double().square()
    mse = float(squares.mean() if mask is None else (squares * mask).sum() / (len(squares) * mask.sum()))
    return -10.0 * math.log10(max(mse, SMALLEST_MSE))


@torch.no_grad()
def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean structural similarity of one image as 3DGS computes it, see `in_torch.ssim`.

    Args:
        image, target: (3, h, w) of the same type and device, clamped to [0, 1] here.
        mask: (1, h, w) bool; with it, the mean over the pixels inside, after the image was replaced by the target
            outside.
    """
    image, target = image.clamp(0.0, 1.0), target.clamp(0.0, 1.0)
    if mask is not None:
        each = in_torch.ssim_map(torch.where(mask, image, target)[None], target[None])[0]
        return float(each.mean(0, keepdim=True)[mask].mean())
    if image.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import ssim_cpu

        return float(ssim_cpu(image, target))
    return float(in_torch.ssim(image, target))


def mean_quality(pairs: Iterable[tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor | None]]) -> dict[str, float]:
    """Return the means of "psnr" (in dB) and "ssim" over images; empty without an image.

    Args:
        pairs: image, target and perhaps a mask, as `psnr` and `ssim` take them.
    """
    measured = [{"psnr": psnr(*pair), "ssim": ssim(*pair)} for pair in pairs]
    names = measured[0] if measured else {}
    return {name: fmean(each[name] for each in measured) for name in names}
