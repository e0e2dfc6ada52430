"""The photometric loss of 3DGS in plain PyTorch, on any device: the version that the others are checked against."""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

DEFAULT_SSIM_WEIGHT = 0.2
"""Lambda of 3DGS's loss (1 - lambda) L1 + lambda (1 - SSIM)."""

SSIM_RADIUS, SSIM_SIGMA = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""SSIM as 3DGS trains with it: an 11x11 Gaussian window, and the stabilisers for a dynamic range of 1."""


def photometric_loss_torch(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """`photometric_loss` in plain PyTorch, on any device."""
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(prediction, target))


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two images as 3DGS computes it, a differentiable scalar, 1 for equal images.

    An 11x11 Gaussian window of sigma 1.5, zeros outside the image, averaged over all pixels and channels, nothing
    clamped (Wang et al. 2004, equation 13).

    Args:
        prediction, target: (3, h, w), any float type; or (b, 3, h, w), whose mean is that of all images.
    """
    prediction, target = (image.reshape(-1, *image.shape[-2:]) for image in (prediction, target))  # (3 b, h, w)
    products = torch.stack(
        [prediction, target, prediction * prediction, target * target, prediction * target]
    )  # (5, 3 b, h, w)
    mean_p, mean_t, mean_pp, mean_tt, mean_pt = _window_mean(products)
    var_p, var_t, covariance = mean_pp - mean_p**2, mean_tt - mean_t**2, mean_pt - mean_p * mean_t
    luminance = (2 * mean_p * mean_t + SSIM_C1) / (mean_p**2 + mean_t**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (var_p + var_t + SSIM_C2)
    similarity: Tensor = (luminance * structure).mean()
    return similarity


def _window_mean(images: Tensor) -> Tensor:
    """Gaussian-weighted mean around each pixel of (n, c, h, w), separably, zeros outside."""
    n, c, h, w = images.shape
    window = _window(images.dtype, images.device)  # (11,)
    flat = images.reshape(n * c, 1, h, w)
    flat = F.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, SSIM_RADIUS))
    flat = F.conv2d(flat, window.view(1, 1, -1, 1), padding=(SSIM_RADIUS, 0))
    return flat.reshape(n, c, h, w)


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # kept for others, who may need gradients
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(device, dtype)
