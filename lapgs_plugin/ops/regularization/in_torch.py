"""Compute the gradients of regularization in PyTorch's operations."""

from __future__ import annotations

import torch
from torch import Tensor


def add_regularization_torch(
    opacity_logits: Tensor, log_scales: Tensor, by_logits: Tensor, by_log_scales: Tensor,
    opacity_weight: float, scale_weight: float,
) -> None:  # fmt: skip
    """Do `add_regularization` in PyTorch's operations; `by_logits` and `by_log_scales` are the gradients so far."""
    if opacity_weight:
        opacities = torch.sigmoid(opacity_logits)
        by_logits.addcmul_(opacities, 1 - opacities, value=opacity_weight / opacity_logits.numel())
    if scale_weight:
        by_log_scales.add_(torch.exp(log_scales), alpha=scale_weight / log_scales.numel())
