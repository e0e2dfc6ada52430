"""A term of the loss that makes unneeded Gaussians transparent and small (Kheradmand et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.regularization.in_torch import regularization_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def regularization(opacity_logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float) -> Tensor:
    """Return the weighted sum of the mean opacity and the mean size, a number.

    Args:
        opacity_logits: (n,).
        log_scales: (n, 3).
        opacity_weight, scale_weight: from 0.
    """
    if len(opacity_logits) and triton_works(opacity_logits, log_scales):
        from lapgs_plugin.ops.regularization.in_triton import regularization_triton

        return regularization_triton(opacity_logits, log_scales, opacity_weight, scale_weight)
    return regularization_torch(opacity_logits, log_scales, opacity_weight, scale_weight)


@matches_reference("regularization in several operations instead of two kernels", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare the number and its gradients, relative to the largest."""
    from lapgs_plugin.ops.regularization.in_triton import regularization_triton

    generator = torch.Generator().manual_seed(0)
    found = []
    logits, log_scales = (torch.randn(700, *columns, generator=generator).to(device) for columns in ((), (3,)))
    for compute in (regularization_triton, regularization_torch):
        leaves = [each.clone().requires_grad_() for each in (logits, log_scales)]
        value = compute(leaves[0], leaves[1], 0.3, 0.2)
        found.append([value.detach(), *torch.autograd.grad(3.0 * value, leaves)])
    return largest((one - other).abs() / other.abs().max() for one, other in zip(*found, strict=True))
