"""Compute the noise of positions in PyTorch's operations."""

from __future__ import annotations

import torch
from torch import Tensor

# Noise falls with the opacity as the sigmoid SHARPNESS (FAINT - opacity) (Kheradmand et al. 2024).
SHARPNESS, FAINT = 100.0, 0.005


def displacements(
    quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, noise: Tensor, amount: float
) -> Tensor:
    """Return noise (n, 3) times the covariance of each Gaussian, times `amount`, less where it is opaque.

    Args:
        quaternions: (n, 4), w first and of any length.
        log_scales: (n, 3).
        opacity_logits: (n,).
        noise: (n, 3), standard normal.
        amount: factor for a transparent Gaussian.
    """
    share = torch.sigmoid(SHARPNESS * (FAINT - torch.sigmoid(opacity_logits)))
    along = _turned(quaternions, noise * (amount * share)[:, None], back=True)
    return _turned(quaternions, along * torch.exp(2.0 * log_scales))


def shaken(noise: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, amount: float) -> Tensor:
    """Return `displacements` of Gaussians whose scales (n, 3) and opacities (n, 1) are given themselves."""
    share = torch.sigmoid(SHARPNESS * ((1.0 - opacities) - (1.0 - FAINT)))
    along = _turned(quaternions, noise * (amount * share), back=True)
    return _turned(quaternions, along * scales.square())


def _turned(quaternions: Tensor, vectors: Tensor, *, back: bool = False) -> Tensor:
    """Rotate vectors (n, 3) by quaternions (n, 4), or back; matrices would take three times the memory."""
    real, axis = quaternions[:, :1], quaternions[:, 1:]
    across: Tensor = torch.linalg.cross(axis, vectors) * (2.0 / quaternions.square().sum(1, keepdim=True))
    turned: Tensor = vectors + (-real if back else real) * across + torch.linalg.cross(axis, across)
    return turned
