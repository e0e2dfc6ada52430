"""Make unneeded Gaussians transparent and small (Kheradmand et al. 2024): gradients of their mean opacity and size."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.regularization.in_torch import add_regularization_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


@torch.no_grad()
def add_regularization(opacity_logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float) -> None:
    """Add the gradients of the weighted sum of the mean opacity and the mean size to those of two parameters.

    Args:
        opacity_logits: (n,) contiguous, with a gradient or none yet.
        log_scales: (n, 3), as well.
        opacity_weight, scale_weight: from 0.
    """
    if len(opacity_logits) == 0:
        return
    by_logits, by_log_scales = _gradient(opacity_logits), _gradient(log_scales)
    if triton_works(opacity_logits, log_scales):
        from lapgs_plugin.ops.regularization.in_triton import add_regularization_triton

        add_regularization_triton(opacity_logits, log_scales, by_logits, by_log_scales, opacity_weight, scale_weight)
    else:
        add_regularization_torch(opacity_logits, log_scales, by_logits, by_log_scales, opacity_weight, scale_weight)


def _gradient(parameter: Tensor) -> Tensor:
    """Return the gradient of a parameter, contiguous, to add to."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    elif not parameter.grad.is_contiguous():
        parameter.grad = parameter.grad.contiguous()
    return parameter.grad


@matches_reference("regularization in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare with the gradients of the formula, relative to the largest."""
    from lapgs_plugin.ops.regularization.in_triton import add_regularization_triton

    generator = torch.Generator().manual_seed(0)
    logits, log_scales, *before = (
        torch.randn(700, *columns, generator=generator).to(device) for columns in ((), (3,), (), (3,))
    )
    gradients = [gradient.clone() for gradient in before]
    add_regularization_triton(logits, log_scales, gradients[0], gradients[1], 300.0, 200.0)
    leaves = [logits.requires_grad_(), log_scales.requires_grad_()]
    term = 300.0 * logits.sigmoid().mean() + 200.0 * log_scales.exp().mean()
    expected = [added + begun for added, begun in zip(torch.autograd.grad(term, leaves), before, strict=True)]
    return largest((one - other).abs() / other.abs().max() for one, other in zip(gradients, expected, strict=True))
