"""How a Gaussian lies in memory for blending, and its gradients after it."""

from __future__ import annotations

import torch
from torch import Tensor

RECORD, COLOR_IN_RECORD = 12, 8
"""Numbers of a Gaussian's record, which lies together in memory, and where its colour begins.

They are x, y, conic (a, b, c), opacity, two without meaning, red, green, blue, and one more without meaning.
"""
GRADIENT = 8
"""Numbers of its first gradients: by red, green, blue, opacity, x, y, a and b. That by c lies elsewhere."""


def records_of(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor) -> Tensor:
    """Return the records (c, n, RECORD) of Gaussians, (c, n, 2), (c, n, 3), (c, n, 3) and (c, n).

    Training and frames have them from `kernels.project`.
    """
    two = torch.zeros_like(means2d)
    return torch.cat([means2d, conics, opacities[..., None], two, colors, two[..., :1]], -1)
