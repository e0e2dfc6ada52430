"""Parameters as our kernels read them, 16 bytes at once: from a multiple of these on, or a GPU stops."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.gpu_raster.records import ALIGNMENT, Parameters
from tests.training_scene import blob_field


def beside(value: Tensor) -> Tensor:
    """The same values, contiguous, 4 bytes after a multiple of 16."""
    memory = torch.empty(value.numel() + 8)
    start = (4 + -memory.data_ptr() % ALIGNMENT) // 4
    memory = memory[start : start + value.numel()].view(value.shape)
    assert memory.data_ptr() % ALIGNMENT == 4
    return memory.copy_(value)


def turned(value: Tensor) -> Tensor:
    return value.movedim(0, -1).contiguous().movedim(-1, 0)


def test_they_begin_at_multiples_of_16_bytes() -> None:
    field = blob_field(7)
    for move in (beside, turned):
        moved = field.with_parameters({name: move(value) for name, value in field.parameters.items()})
        for value in moved.parameters.values():
            value.requires_grad_()
        parameters = Parameters.of(moved)
        for part, value in zip(parameters, moved.parameters.values(), strict=True):
            assert part.is_contiguous()
            assert part.data_ptr() % ALIGNMENT == 0
            assert torch.equal(part, value)
            part.sum().backward()
            assert value.grad is not None


def test_what_lies_so_is_not_copied() -> None:
    field = blob_field(8)
    field = field.with_parameters({name: value.clone() for name, value in field.parameters.items()})
    pairs = zip(Parameters.of(field), field.parameters.values(), strict=True)
    assert all(part.data_ptr() == value.data_ptr() for part, value in pairs)
