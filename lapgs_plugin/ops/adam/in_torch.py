"""Take Adam's steps in PyTorch's operations: the version that the others are checked against."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

ADAM_EPS = 1e-15
"""Epsilon of Adam in 3DGS."""
BETAS = 0.9, 0.999


class AdamSlot(NamedTuple):
    """Hold a tensor under optimization with its Adam state; all contiguous, of one type, on one device.

    Attributes:
        values, gradient, mean, square: (n, ...) the tensor, its gradient, Adam's first and second moment.
        step: number of views optimized on, this step's included.
        rate: step size of the first three columns.
        rest: step size of all further columns.
    """

    values: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    step: float
    rate: float
    rest: float


class PlainOptimizer(torch.optim.Optimizer):
    """Add groups of parameters as PyTorch's optimizers do, without importing its compiler, which takes seconds."""

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group."""
        inspect.unwrap(torch.optim.Optimizer.add_param_group)(self, param_group)


@torch.no_grad()
def step_torch(slots: Sequence[AdamSlot], views: int = 1, gradient: float = 1.0) -> None:
    """Step each tensor in place; `views` and `gradient` are those of a `StepScale`."""
    for slot in slots:
        (keep1, keep2), scaled, count = (beta**views for beta in BETAS), gradient * slot.gradient, slot.step
        slot.mean.mul_(keep1).add_(scaled, alpha=1 - keep1)
        slot.square.mul_(keep2).addcmul_(scaled, scaled, value=1 - keep2)
        row = slot.values.shape[1:]
        sizes = torch.full((row.numel(),), slot.rest, dtype=slot.values.dtype, device=slot.values.device)
        sizes[:3] = slot.rate
        root = slot.square.sqrt() / (1 - BETAS[1] ** count) ** 0.5
        slot.values.sub_(sizes.view(row) / (1 - BETAS[0] ** count) * slot.mean / (root + ADAM_EPS))
