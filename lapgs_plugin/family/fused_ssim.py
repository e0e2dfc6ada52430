"""Stand in for `fused_ssim` and for the two SSIM functions of `diff_gaussian_rasterization._C`.

Only the first image gets a gradient.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.photometric_loss import ssim_map, triton_works
from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_C1, SSIM_C2, SSIM_RADIUS, check_arguments

__all__ = ["fused_ssim", "fused_ssim_", "fusedssim", "fusedssim_backward"]


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return mean SSIM of two batches (b, c, h, w), a scalar; "valid" leaves out five pixels at each border."""
    first, second = _prepared(img1, img2, padding, train)
    if padding == "valid":
        return _cropped(ssim_map(first, second), padding).mean()
    if first.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

        return 1 - photometric_loss_cpu(first, second, 1.0)
    if first.shape[1] == 3 and triton_works(first, second):
        from lapgs_plugin.ops.photometric_loss.in_triton import photometric_loss_triton

        check_arguments(first, second, 1.0)
        return 1 - photometric_loss_triton(first, second, 1.0)
    return ssim_map(first, second).mean()


def fused_ssim_(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return SSIM of two images (1, c, h, w), the mean over channels: (h, w), or 10 less of each with "valid"."""
    first, second = _prepared(img1, img2, padding, train)
    return _cropped(ssim_map(first, second), padding).squeeze(0).mean(0)


def fusedssim(c1: float, c2: float, img1: Tensor, img2: Tensor) -> Tensor:
    """Return SSIM of each pixel and channel of two batches (b, c, h, w), in that shape, without gradient."""
    _check_constants(c1, c2)
    return ssim_map(img1.detach(), img2.detach())


def fusedssim_backward(c1: float, c2: float, img1: Tensor, img2: Tensor, grad_map: Tensor) -> Tensor:
    """Return the derivative of a loss by the first image (b, c, h, w), from that by the result of `fusedssim`."""
    _check_constants(c1, c2)
    leaf = img1.detach().requires_grad_(True)
    with torch.enable_grad():
        similarity = ssim_map(leaf, img2.detach())
    return torch.autograd.grad(similarity, leaf, grad_map)[0]


def _check_constants(c1: float, c2: float) -> None:
    if not (math.isclose(c1, SSIM_C1) and math.isclose(c2, SSIM_C2)):
        raise UserInputError(f"SSIM with the constants {c1:g} and {c2:g}: expected 0.01^2 and 0.03^2")


def _cropped(values: Tensor, padding: str) -> Tensor:
    inside = slice(SSIM_RADIUS, -SSIM_RADIUS)
    return values[..., inside, inside] if padding == "valid" else values


def _prepared(img1: Tensor, img2: Tensor, padding: str, train: bool) -> tuple[Tensor, Tensor]:
    if padding not in ("same", "valid"):
        raise UserInputError(f"padding {padding!r}: expected 'same' or 'valid'")
    return (img1 if train else img1.detach()), img2.detach()
