"""Make scaled rotations in PyTorch's operations."""

from __future__ import annotations

import torch
from torch import Tensor


def scaled_rotations_torch(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return rotation times diagonal matrix (n, 3, 3) of scales (n, 3) and quaternions (n, 4) of any length."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    )
    return torch.stack(rows, 1) * scales[:, None, :]
