"""Compute the photometric loss of 3DGS, L1 + SSIM, with its gradient."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import torch
from torch import Tensor

from lapgs_plugin.ops.mixed_sizes import Sizes, own_parts
from lapgs_plugin.ops.photometric_loss.in_torch import (
    DEFAULT_SSIM_WEIGHT,
    check_arguments,
    photometric_loss_torch,
    ssim,
    ssim_map_torch,
)
from lapgs_plugin.ops.self_check import largest, matches_reference


def photometric_loss(
    prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT, sizes: Sizes | None = None
) -> Tensor:
    """Return the loss of 3DGS, (1 - ssim_weight) L1 + ssim_weight (1 - SSIM), differentiable by the prediction.

    It is a scalar, the mean over several views. On the CPU a fused kernel computes it together with its gradient. On a
    GPU two Triton kernels do, where they work; else SSIM comes from the package `fused_ssim` or from kornia.

    Args:
        prediction: (3, h, w), or (b, 3, h, w) of several views; colours in [0, 1], not clamped. Other numbers of
            channels take longer on a GPU.
        target: of that shape, without gradient; any float type, or uint8 levels k of k / 255.
        ssim_weight: lambda, in [0, 1].
        sizes: (width, height) of several views, each in the top left of its image; None if they are whole.

    Raises:
        UserInputError: the images differ in shape or device, their channels come last, the target requires a gradient,
            the weight leaves [0, 1], or the prediction is on a CPU and neither float32 nor float64.
    """
    check_arguments(prediction, target, ssim_weight)
    if prediction.shape[-3] == 3 and triton_works(prediction):
        from lapgs_plugin.ops.photometric_loss.in_triton import photometric_loss_triton

        return photometric_loss_triton(prediction, target, ssim_weight, sizes)
    if sizes is not None:
        pairs = zip(own_parts(prediction, sizes), own_parts(target, sizes), strict=True)
        return torch.stack([photometric_loss(one, other, ssim_weight) for one, other in pairs]).mean()
    target = decoded(target).to(prediction.dtype)
    if prediction.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

        return photometric_loss_cpu(prediction, target, ssim_weight)
    fused = fused_ssim() if prediction.dtype == torch.float32 else None
    return photometric_loss_torch(prediction, target, ssim_weight, fused or ssim)


def loss_and_l1(prediction: Tensor, target: Tensor, ssim_weight: float) -> tuple[Tensor, Tensor]:
    """Return `photometric_loss` and L1 alone, the mean absolute difference, both differentiable by the prediction.

    Where Triton works, both come from one kernel.

    Args:
        prediction: (3, h, w) or (b, 3, h, w), float32.
        target: of that shape, float32, without gradient.
        ssim_weight: lambda, in [0, 1].
    """
    if triton_works(prediction, target):
        from lapgs_plugin.ops.photometric_loss.in_triton import loss_and_l1_triton

        return loss_and_l1_triton(prediction, target, ssim_weight)
    return photometric_loss(prediction, target, ssim_weight), (prediction - target).abs().mean()


def ssim_map(prediction: Tensor, target: Tensor) -> Tensor:
    """Return SSIM of each pixel and channel of float32 images (b, c, h, w), differentiable by the prediction.

    The window is an 11x11 Gaussian of sigma 1.5, with zeros outside of the images.

    Raises:
        UserInputError: as `photometric_loss`; the target may require a gradient, and gets none.
    """
    target = target.detach()
    check_arguments(prediction, target, 1.0)
    if prediction.shape[1] == 3 and triton_works(prediction, target):
        from lapgs_plugin.ops.photometric_loss.in_triton import ssim_map_triton

        return ssim_map_triton(prediction, target)
    return ssim_map_torch(prediction, target)


def decoded(target: Tensor) -> Tensor:
    """Return a target in a float type: levels k of uint8 as k / 255."""
    # Divided by a tensor: GPUs multiply by the reciprocal of a number, which differs from how photographs are read.
    return target / torch.tensor(255.0, device=target.device) if target.dtype == torch.uint8 else target


@matches_reference("the photometric loss in many operations instead of two kernels", 1e-3)
def triton_works(device: torch.device) -> float:
    """Compare the loss, SSIM of the pixels, and the gradients, times the number of values; these are then about 1."""
    from lapgs_plugin.ops.photometric_loss.in_triton import photometric_loss_triton, ssim_map_triton

    # As gsplat returns images: the kernels that are compiled here are then those of training.
    target = torch.linspace(0, 1, 3 * 19 * 47, device=device).view(19, 47, 3).permute(2, 0, 1)
    prediction = (target + 0.1 * (40 * target).sin()).requires_grad_()
    levels = (255 * target).round().to(torch.uint8).contiguous()
    exact = prediction.double(), decoded(levels).double()  # GPUs convolve float32 with fewer bits
    results = []
    for loss in (photometric_loss_triton(prediction, levels, 0.2), photometric_loss_torch(*exact, 0.2)):
        results.append((loss, torch.autograd.grad(3.0 * loss, prediction)[0] * target.numel()))
    for values in (
        ssim_map_triton(prediction[None], target[None]),
        ssim_map_torch(exact[0][None], target.double()[None]),
    ):
        results.append((values, torch.autograd.grad((values * target).sum(), prediction)[0]))
    pairs = (*zip(*results[:2], strict=True), *zip(*results[2:], strict=True))
    return largest((one - other).abs() for one, other in pairs)


@lru_cache(maxsize=1)
def fused_ssim() -> Callable[[Tensor, Tensor], Tensor] | None:
    """Return the function of the package `fused_ssim`, mean SSIM of (b, c, h, w) images; None without the package."""
    try:
        mean_ssim: Callable[[Tensor, Tensor], Tensor] = import_module("fused_ssim").fused_ssim
    except ImportError:
        return None
    return mean_ssim
