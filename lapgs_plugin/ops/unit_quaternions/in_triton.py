"""Normalise quaternions in one kernel, and their gradient in another."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 256
SHORTEST = tl.constexpr(1e-12)
"""Length by which PyTorch divides at least."""


@triton.jit(do_not_specialize=("n",))  # no types
def _kernel(quaternions: tl.tensor, units: tl.tensor, n: int, block: tl.constexpr) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)
    places, here = 4 * rows.to(tl.int64)[:, None] + tl.arange(0, 4)[None, :], (rows < n)[:, None]
    quaternion = tl.load(quaternions + places, here, 0.0)
    length = tl.sqrt(tl.sum(quaternion * quaternion, axis=1))
    tl.store(units + places, quaternion / tl.maximum(length, SHORTEST)[:, None], here)


@triton.jit(do_not_specialize=("n",))  # no types
def _gradient_kernel(
    quaternions: tl.tensor, by_units: tl.tensor, by_quaternions: tl.tensor, n: int, block: tl.constexpr
) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)
    places, here = 4 * rows.to(tl.int64)[:, None] + tl.arange(0, 4)[None, :], (rows < n)[:, None]
    quaternion, gradient = tl.load(quaternions + places, here, 0.0), tl.load(by_units + places, here, 0.0)
    length = tl.sqrt(tl.sum(quaternion * quaternion, axis=1))
    divisor = tl.maximum(length, SHORTEST)
    unit = quaternion / divisor[:, None]
    along = tl.where(length >= SHORTEST, tl.sum(unit * gradient, axis=1), 0.0)  # a shorter one is divided by a constant
    tl.store(by_quaternions + places, (gradient - unit * along[:, None]) / divisor[:, None], here)


class _UnitQuaternions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quaternions: Tensor) -> Tensor:
        units = torch.empty_like(quaternions)
        n = units.shape[0]
        launch(_kernel, (blocks(n, BLOCK),), quaternions, units, n, block=BLOCK)
        ctx.save_for_backward(quaternions)
        return units

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_units: Tensor) -> Tensor:
        (quaternions,) = ctx.saved_tensors
        gradient = torch.empty_like(quaternions)
        n = gradient.shape[0]
        launch(_gradient_kernel, (blocks(n, BLOCK),), quaternions, by_units.contiguous(), gradient, n, block=BLOCK)
        return gradient


def unit_quaternions_triton(quaternions: Tensor) -> Tensor:
    """Do `unit_quaternions` for contiguous float32 (n, 4) on a CUDA device, n above 0."""
    units: Tensor = _UnitQuaternions.apply(quaternions)  # type: ignore[no-untyped-call]  # torch's
    return units
