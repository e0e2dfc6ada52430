"""Compute the photometric loss of 3DGS, L1 + SSIM, with its gradient."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import torch
from torch import Tensor

from lapgs_plugin.ops.photometric_loss.in_torch import DEFAULT_SSIM_WEIGHT, as_batch, photometric_loss_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def photometric_loss(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """Return the loss of 3DGS, (1 - ssim_weight) L1 + ssim_weight (1 - SSIM), differentiable by the prediction.

    On the CPU a fused kernel computes it together with its gradient. On a GPU SSIM comes from the package `fused_ssim`
    where that is installed, else from kornia.

    Args:
        prediction, target: (3, h, w), or (b, 3, h, w) of several views; the target without gradient.
        ssim_weight: lambda, in [0, 1].

    Returns:
        The loss, a scalar; the mean over several views.
    """
    if prediction.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

        if prediction.ndim == 4:
            each = zip(prediction.unbind(), target.unbind(), strict=True)
            return torch.stack([photometric_loss_cpu(*pair, ssim_weight) for pair in each]).mean()
        return photometric_loss_cpu(prediction, target, ssim_weight)
    fused = fused_ssim()
    if fused is None or prediction.dtype != torch.float32:
        return photometric_loss_torch(prediction, target, ssim_weight)
    ssim = fused(as_batch(prediction), as_batch(target))
    if triton_works(prediction):
        from lapgs_plugin.ops.photometric_loss.in_triton import weighted_l1

        # The kernel also adds the constant: each scalar operation would cost a launch, and another for its gradient.
        rest = weighted_l1(prediction.contiguous(), target.contiguous(), 1.0 - ssim_weight, ssim_weight)
        return torch.sub(rest, ssim, alpha=ssim_weight)
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim)


@matches_reference("L1 in several operations instead of one kernel", 1e-4)
def triton_works(device: torch.device) -> float:
    """Compare the loss and its gradient."""
    from lapgs_plugin.ops.photometric_loss.in_triton import weighted_l1

    target = torch.linspace(0, 1, 3000, device=device)
    prediction = (2 * target.square()).requires_grad_()
    losses = weighted_l1(prediction, target, 0.8, 0.2), 0.2 + 0.8 * (prediction - target).abs().mean()
    gradients = [torch.autograd.grad(3.0 * loss, prediction)[0] * len(target) for loss in losses]
    return largest((one - other).abs() for one, other in (losses, gradients))


@lru_cache(maxsize=1)
def fused_ssim() -> Callable[[Tensor, Tensor], Tensor] | None:
    """Return the function of the package `fused_ssim`, mean SSIM of (b, c, h, w) images; None without the package."""
    try:
        found: Callable[[Tensor, Tensor], Tensor] = import_module("fused_ssim").fused_ssim
    except ImportError:
        return None
    return found
