"""Update rows in PyTorch's operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Update(NamedTuple):
    """Describe an update of rows: the largest, or the sum, of what is there and a value.

    The value of a row is that of a source, or the norm of one or two columns of it, and may be multiplied by a factor.

    Attributes:
        target: (n,) or (n, 1) contiguous float32.
        takes_largest: whether the larger one stays, NaN if one of them is; they are added otherwise.
        source: contiguous float32 or int32 of the target's shape, or a number; (n, c) float32 if there are columns.
        columns: bounds of the slice of one or two columns; None if the source is the value.
        factor: contiguous float32 or int32 of the target's shape; None for 1.
    """

    target: Any
    takes_largest: bool
    source: Any
    columns: tuple[int | None, int | None] | None = None
    factor: Any = None


def read_columns(columns: tuple[int | None, int | None], width: int) -> range:
    """Return the columns of a source of so many whose norm is the value."""
    return range(width)[slice(*columns)]


def update_rows_torch(mask: Tensor, updates: Sequence[Update]) -> None:
    """Do what `update_rows` does for updates that fit, on any device."""
    for target, takes_largest, source, columns, factor in updates:
        value = source
        if columns is not None:
            # A copy, as indexing makes: sums of strided rows may be rounded otherwise.
            value = torch.norm(value[:, slice(*columns)].contiguous(), dim=-1, keepdim=True)
        if factor is not None:
            value = value * factor
        updated = torch.maximum(target, value) if takes_largest else target + value
        target.copy_(torch.where(mask.view_as(target), updated, target))
