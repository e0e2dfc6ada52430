"""Sum up densification statistics in PyTorch's operations."""

from __future__ import annotations

import torch
from torch import Tensor


def add_statistics_torch(gradient: Tensor, radii: Tensor, size: tuple[int, int], norms: Tensor, counts: Tensor) -> None:
    """Do `add_statistics` on any device."""
    scaled = gradient.clone().view(-1, len(norms), 2)
    scaled[..., 0] *= size[0] / 2.0
    scaled[..., 1] *= size[1] / 2.0
    for of_view, shown in zip(scaled, (radii > 0).view(-1, len(norms)), strict=True):
        norms += torch.where(shown, of_view.norm(dim=-1), 0.0)
        counts += shown
