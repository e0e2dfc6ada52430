"""Compute the regularization of opacities and sizes in PyTorch's operations."""

from __future__ import annotations

import torch
from torch import Tensor


def regularization_torch(
    opacity_logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float
) -> Tensor:
    """Do `regularization` in PyTorch's operations."""
    terms = []
    if opacity_weight:
        terms.append(opacity_weight * torch.sigmoid(opacity_logits).mean())
    if scale_weight:
        terms.append(scale_weight * torch.exp(log_scales).mean())
    return sum(terms[1:], terms[0])
