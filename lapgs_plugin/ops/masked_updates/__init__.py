"""Update the rows of tensors that a mask chooses, without waiting for the GPU to say how many they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.ops.masked_updates.in_torch import Update, read_columns, update_rows_torch
from lapgs_plugin.ops.self_check import largest, matches_reference

READABLE = torch.float32, torch.int32
NUMBERS = int, float
MOST_LOOKS = 256
"""Most descriptions of updates that are remembered. They have the number of Gaussians, which densification changes."""

_fitting: set[tuple[Any, ...]] = set()  # descriptions by `_looks` of masks and updates that fit


def update_rows(mask: Any, updates: Sequence[Update]) -> bool:
    """Update rows of several tensors in place, one after the other; return whether that was possible.

    Args:
        mask: (n,) bool, true for the rows to update.
        updates: of different tensors, none of which another update reads; or tuples of their fields. Nothing is changed
            if they or the mask are otherwise than described, if gradients would be recorded, or if n is 0.
    """
    looks = _looks(mask, updates)
    if torch.is_grad_enabled() or looks not in _fitting:
        if not _is_mask(mask) or not all(_fits(Update(*update), mask) for update in updates):
            return False
        if len(_fitting) >= MOST_LOOKS:
            _fitting.clear()
        _fitting.add(looks)
    if not _independent(mask, updates):
        return False
    if triton_works(updates[0][0]):  # the others are alike
        from lapgs_plugin.ops.masked_updates.in_triton import update_rows_triton

        update_rows_triton(mask, updates)
    else:
        update_rows_torch(mask, updates)
    return True


def _looks(mask: Any, updates: Sequence[Update]) -> tuple[Any, ...]:
    """Return all that decides whether a mask and updates fit, besides gradients and places in memory."""
    values, columns = [mask], []
    for target, _, source, read, factor in updates:
        values += target, source, factor
        columns.append(read)
    looks = [
        (value.shape, value.dtype, value.get_device(), value.is_contiguous())
        if isinstance(value, Tensor)
        else value is not None and (type(value), value if isinstance(value, NUMBERS) else None)
        for value in values
    ]
    return (*columns, *looks)


def _is_mask(mask: Any) -> bool:
    is_rows = isinstance(mask, Tensor) and mask.dtype is torch.bool and mask.ndim == 1
    return is_rows and 0 < mask.shape[0] < 2**31 and mask.is_contiguous()


def _fits(update: Update, mask: Tensor) -> bool:
    target, source, n = update.target, update.source, mask.shape[0]
    if not _is_readable(target, mask) or target.dtype is not torch.float32 or target.shape not in ((n,), (n, 1)):
        return False
    if update.factor is not None and not _is_like(update.factor, target):
        return False
    if update.columns is None:
        return _is_like(source, target) or (type(source) in (int, float) and update.factor is None)
    return (
        _is_readable(source, mask)
        and source.dtype is torch.float32
        and source.ndim == target.ndim == 2
        and source.shape[0] == n
        and 1 <= len(read_columns(update.columns, source.shape[1])) <= 2
    )


def _is_like(value: Any, target: Tensor) -> bool:
    return _is_readable(value, target) and value.shape == target.shape


def _is_readable(value: Any, other: Tensor) -> bool:
    """Return whether a value is a tensor on the device of another one that kernels read, and nothing is recorded."""
    return (
        isinstance(value, Tensor)
        and value.dtype in READABLE
        and value.device == other.device
        and value.is_contiguous()
        and not (value.requires_grad and torch.is_grad_enabled())
    )


def _independent(mask: Tensor, updates: Sequence[Update]) -> bool:
    """Return whether no update changes what another one, or itself by another row, reads or changes."""
    changed, read = [], [mask.untyped_storage().data_ptr()]
    for target, _, source, _, factor in updates:
        changed.append(target.untyped_storage().data_ptr())
        for value in (source, factor):
            if isinstance(value, Tensor):
                read.append(value.untyped_storage().data_ptr())
    return len(set(changed)) == len(changed) and set(changed).isdisjoint(read)


@matches_reference("updates of visible rows in several operations instead of one kernel", 0.0)
def triton_works(device: torch.device) -> float:
    """Compare every kind of update, to the bit: whether square roots and sums are rounded as PyTorch does."""
    from lapgs_plugin.ops.masked_updates.in_triton import update_rows_triton

    generator = torch.Generator().manual_seed(0)
    rows, points = (torch.randn(3000, columns, generator=generator).to(device) for columns in (1, 4))
    mask, radii = rows[:, 0] > 0.2, (100 * rows[:, 0]).int()
    both = []
    for update in (update_rows_torch, update_rows_triton):
        targets = [rows[:, 0].clone(), *(rows.clone() for _ in range(6))]
        updates = [
            Update(targets[0], True, radii),
            Update(targets[1], False, 1),
            Update(targets[2], False, points, (None, 2)),
            Update(targets[3], False, points, (2, None), rows),
            Update(targets[4], True, points, (2, None)),
            Update(targets[5], False, rows, None, rows),
            Update(targets[6], True, points, (3, None)),
        ]
        update(mask, updates[:1])  # by a kernel of its own
        update(mask, updates[1:])
        both.append(targets)
    return largest((one - other).abs() for one, other in zip(*both, strict=True))
