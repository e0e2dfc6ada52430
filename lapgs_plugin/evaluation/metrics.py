"""Compute PSNR and SSIM of one image, as 3DGS papers report them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean, median

import torch
from torch import Tensor

from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.photometric_loss import in_torch

LITTLE = 1e-6
"""Weight of the identity in a colour fit, relative to that of the pixels."""
FAR_WORSE = 6.0
"""Fewest dB below the median at which an image is far worse than the rest: twice the error."""
SPREADS = 4.5
"""The same as a multiple of the better half's median distance from the median: three deviations of a normal one."""
SMALLEST_MSE = 1e-10
"""Smallest mean squared error that counts, near the resolution of float32 images; it bounds PSNR."""


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio of one image in dB, over all pixels and channels, at most 100.

    Args:
        image, target: (3, h, w), clamped to [0, 1] here and not rounded to 8 bits.
        mask: (1, h, w) bool or weights in [0, 1] of the pixels; None counts all.
    """
    squares = (image.detach().clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).double().square()
    return psnr_of(float(squares.mean() if mask is None else (squares * mask).sum() / (len(squares) * mask.sum())))


def psnr_of(mse: float) -> float:
    """Return the peak signal-to-noise ratio in dB of a mean squared error of intensities in [0, 1], at most 100."""
    return -10.0 * math.log10(max(mse, SMALLEST_MSE))


def far_worse_below(psnrs: Sequence[float]) -> float:
    """Return the PSNR in dB below which an image is far worse than the rest. The worse half does not move it."""
    middle = median(psnrs)
    return middle - max(FAR_WORSE, SPREADS * median(value - middle for value in psnrs if value >= middle))


@torch.no_grad()
def color_fitted_psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the PSNR in dB of the right half of an image, after a colour fit on its left half.

    The fit is the affine transform of RGB, A rgb + b, with the least squared error. It removes differences of exposure
    and white balance that no other photo of a scene tells. Arguments are those of `psnr`, two pixels wide or more.
    """
    middle = image.shape[-1] // 2
    left, right = slice(None, middle), slice(middle, None)
    masks = [None if mask is None else mask[..., half] for half in (left, right)]
    fit = fit_colors(image[..., left], target[..., left], masks[0])
    if masks[1] is not None and not bool(masks[1].any()):
        right, masks[1] = slice(None), mask  # nothing counts there
    return psnr(transform_colors(image[..., right].float(), fit.float()), target[..., right], masks[1])


@torch.no_grad()
def fit_colors(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the transform (3, 4) for which A rgb + b is closest to the target, in least squares.

    A tiny weight of the identity decides where the pixels leave the transform open, as in an image of one colour.

    Args:
        image, target: (3, h, w), clamped to [0, 1] here.
        mask: (1, h, w) bool or weights of the pixels; None counts all.
    """
    pixels, wanted = (values.clamp(0.0, 1.0).flatten(1).double() for values in (image, target))  # (3, n)
    pixels = torch.cat([pixels, torch.ones_like(pixels[:1])])  # (4, n)
    counted = pixels if mask is None else pixels * mask.flatten(1)
    identity = torch.eye(3, 4, dtype=torch.float64)
    little = LITTLE * max(1.0, float(counted[3].sum()))
    normal = (counted @ pixels.T).cpu() + little * torch.eye(4, dtype=torch.float64)
    right = (counted @ wanted.T).cpu() + little * identity.T
    transform: Tensor = torch.linalg.solve(normal, right).T
    return transform.to(image.device)


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
        similarity = in_torch.ssim_map_torch(torch.where(mask, image, target)[None], target[None])[0]
        return float(similarity.mean(0, keepdim=True)[mask].mean())
    if image.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

        # Training has compiled this kernel. Its gradient is not needed here, but costs less than compiling another.
        return 1.0 - float(photometric_loss_cpu(image, target, 1.0))
    return float(in_torch.ssim(image, target))


def mean_quality(pairs: Iterable[tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor | None]]) -> dict[str, float]:
    """Return the means of "psnr" (dB) and "ssim" over pairs of images, with masks or without; empty without images."""
    return means(qualities(pairs))


def qualities(
    pairs: Iterable[tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor | None]],
) -> list[dict[str, float]]:
    """Return the "psnr" (dB) and "ssim" of each pair of images, with masks or without."""
    return [{"psnr": psnr(*pair), "ssim": ssim(*pair)} for pair in pairs]


def means(entries: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each figure over entries that all have it; empty without an entry."""
    return {name: fmean(entry[name] for entry in entries) for name in (entries[0] if entries else ())}
