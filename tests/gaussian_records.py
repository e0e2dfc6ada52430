"""Make the records of Gaussians that kernels read, which training and frames have from `kernels.project`."""

from __future__ import annotations

import torch
from torch import Tensor


def records_of(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor) -> Tensor:
    """Return the records (c, n, RECORD) of Gaussians, (c, n, 2), (c, n, 3), (c, n, 3) and (c, n)."""
    two = torch.zeros_like(means2d)
    return torch.cat([means2d, conics, opacities[..., None], two, colors, two[..., :1]], -1)
