"""`fused_ssim`, and the two functions of the same kind in `diff_gaussian_rasterization._C`: SSIM with an 11x11 window.

Outside of the images are zeros. Only the first image gets a gradient. The window has sigma 1.5, the constants are
0.01^2 and 0.03^2.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

__all__ = ["fused_ssim", "fused_ssim_", "fusedssim", "fusedssim_backward"]

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Mean SSIM of two batches of images (b, c, h, w), a scalar; "valid" leaves out five pixels at each border."""
    first, second = _prepared(img1, img2, padding, train)
    if padding == "valid":
        return _cropped(ssim_map(first, second), padding).mean()
    return torch.stack([1 - photometric_loss_cpu(a, b, 1.0) for a, b in zip(first, second, strict=True)]).mean()


def fused_ssim_(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """SSIM of one pair of images (1, c, h, w), the mean over channels: (h, w), or 10 less of each with "valid"."""
    first, second = _prepared(img1, img2, padding, train)
    return _cropped(ssim_map(first, second), padding).squeeze(0).mean(0)


def fusedssim(c1: float, c2: float, img1: Tensor, img2: Tensor) -> Tensor:
    """SSIM of each pixel and channel of two batches (b, c, h, w), in that shape; not differentiable by itself."""
    return ssim_map(img1.detach(), img2.detach(), c1, c2)


def fusedssim_backward(c1: float, c2: float, img1: Tensor, img2: Tensor, grad_map: Tensor) -> Tensor:
    """Derivative of a loss by the first image (b, c, h, w), from that by what `fusedssim` returns."""
    leaf = img1.detach().requires_grad_(True)
    with torch.enable_grad():
        found = ssim_map(leaf, img2.detach(), c1, c2)
    return torch.autograd.grad(found, leaf, grad_map)[0]


def ssim_map(first: Tensor, second: Tensor, c1: float = C1, c2: float = C2) -> Tensor:
    """SSIM of each pixel and channel (b, c, h, w), differentiable."""
    moments = _blurred(torch.stack([first, second, first * first, second * second, first * second]))
    mu1, mu2, square1, square2, product = moments
    sigma1, sigma2, sigma12 = square1 - mu1 * mu1, square2 - mu2 * mu2, product - mu1 * mu2
    above = (2 * mu1 * mu2 + c1) * (2 * sigma12 + c2)
    found: Tensor = above / ((mu1 * mu1 + mu2 * mu2 + c1) * (sigma1 + sigma2 + c2))
    return found


def _blurred(images: Tensor) -> Tensor:
    """(..., h, w) filtered with the window, zeros outside."""
    places = torch.arange(-RADIUS, RADIUS + 1, dtype=images.dtype)
    window = torch.exp(-(places**2) / (2 * SIGMA**2))
    window = window / window.sum()
    flat = images.reshape(-1, 1, *images.shape[-2:])
    down = conv2d(flat, window[None, None, :, None], padding=(RADIUS, 0))
    return conv2d(down, window[None, None, None, :], padding=(0, RADIUS)).reshape(images.shape)


def _cropped(values: Tensor, padding: str) -> Tensor:
    return values[..., RADIUS:-RADIUS, RADIUS:-RADIUS] if padding == "valid" else values


def _prepared(img1: Tensor, img2: Tensor, padding: str, train: bool) -> tuple[Tensor, Tensor]:
    if padding not in ("same", "valid"):
        raise UserInputError(f"padding {padding!r}: expected 'same' or 'valid'")
    return (img1 if train else img1.detach()), img2.detach()
