"""Take one Adam step of several tensors, or of all tensors of a field, in one kernel.

PyTorch's fused Adam launches a kernel for each tensor and has one learning rate for it. With it, SH have to be two
tensors, which are concatenated for every render and split in every backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS, AdamSlot
from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512
COLUMNS = tuple(f"columns{i}" for i in range(5))
MOST_TENSORS = 6
"""Tensors that `step_tensors_triton` steps at most: as many as an optimizer of 3DGS has."""


@triton.jit
def _move(
    values: tl.tensor, gradients: tl.tensor, means: tl.tensor, squares: tl.tensor,
    rate: float, rest: float, unbias: float, scale: float, keep1: float, take1: float, keep2: float, take2: float,
    eps: float, n: tl.tensor, i: tl.tensor, columns: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Step the i-th `block` rows of one tensor, `columns` contiguous numbers each.

    rate and rest have the first moment's bias correction, and unbias is the second one's, of its root.
    keep1 and take1 are the weights of the first moment and of the gradient in the next moment, keep2 and take2 those of
    the second moment and of the gradient's square.
    """
    start = i.to(tl.int64) * block * columns
    for part in range(columns):
        places = start + part * block + tl.arange(0, block)
        here = places < n.to(tl.int64) * columns
        gradient = scale * tl.load(gradients + places, here, 0.0)
        mean = keep1 * tl.load(means + places, here, 0.0) + take1 * gradient
        square = keep2 * tl.load(squares + places, here, 0.0) + take2 * gradient * gradient
        size = rate
        if columns > 4:
            size = tl.where(places % columns < 3, rate, rest)
        moved = tl.load(values + places, here, 0.0) - size * mean / (tl.sqrt(square) * unbias + eps)
        tl.store(means + places, mean, here)
        tl.store(squares + places, square, here)
        tl.store(values + places, moved, here)


@triton.jit(do_not_specialize=("n",))
def _kernel(
    values0: tl.tensor, grads0: tl.tensor, means0: tl.tensor, squares0: tl.tensor,
    rate0: float, rest0: float, unbias0: float,
    values1: tl.tensor, grads1: tl.tensor, means1: tl.tensor, squares1: tl.tensor,
    rate1: float, rest1: float, unbias1: float,
    values2: tl.tensor, grads2: tl.tensor, means2: tl.tensor, squares2: tl.tensor,
    rate2: float, rest2: float, unbias2: float,
    values3: tl.tensor, grads3: tl.tensor, means3: tl.tensor, squares3: tl.tensor,
    rate3: float, rest3: float, unbias3: float,
    values4: tl.tensor, grads4: tl.tensor, means4: tl.tensor, squares4: tl.tensor,
    rate4: float, rest4: float, unbias4: float,
    scale: float, k1: float, t1: float, k2: float, t2: float, eps: float, n: int,
    columns0: tl.constexpr, columns1: tl.constexpr, columns2: tl.constexpr, columns3: tl.constexpr,
    columns4: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    i = tl.program_id(0)
    _move(values0, grads0, means0, squares0, rate0, rest0, unbias0, scale, k1, t1, k2, t2, eps, n, i, columns0, block)
    _move(values1, grads1, means1, squares1, rate1, rest1, unbias1, scale, k1, t1, k2, t2, eps, n, i, columns1, block)
    _move(values2, grads2, means2, squares2, rate2, rest2, unbias2, scale, k1, t1, k2, t2, eps, n, i, columns2, block)
    _move(values3, grads3, means3, squares3, rate3, rest3, unbias3, scale, k1, t1, k2, t2, eps, n, i, columns3, block)
    _move(values4, grads4, means4, squares4, rate4, rest4, unbias4, scale, k1, t1, k2, t2, eps, n, i, columns4, block)


@triton.jit
def _move_own(
    values: tl.tensor, gradients: tl.tensor, means: tl.tensor, squares: tl.tensor, rate: float, unbias: float,
    keep1: float, take1: float, keep2: float, take2: float, eps: float, n: tl.tensor, i: tl.tensor, block: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Step the i-th block of a tensor of n numbers if it has so many; return i less the number of its blocks."""
    count = (n + block - 1) // block
    if (i >= 0) & (i < count):
        _move(
            values, gradients, means, squares, rate, rate, unbias, 1.0, keep1, take1, keep2, take2, eps, n, i, 1, block
        )
    return i - count


@triton.jit(do_not_specialize=[f"n{i}" for i in range(MOST_TENSORS)])
def _tensors_kernel(
    values0: tl.tensor, grads0: tl.tensor, means0: tl.tensor, squares0: tl.tensor,
    rate0: float, unbias0: float, n0: int,
    values1: tl.tensor, grads1: tl.tensor, means1: tl.tensor, squares1: tl.tensor,
    rate1: float, unbias1: float, n1: int,
    values2: tl.tensor, grads2: tl.tensor, means2: tl.tensor, squares2: tl.tensor,
    rate2: float, unbias2: float, n2: int,
    values3: tl.tensor, grads3: tl.tensor, means3: tl.tensor, squares3: tl.tensor,
    rate3: float, unbias3: float, n3: int,
    values4: tl.tensor, grads4: tl.tensor, means4: tl.tensor, squares4: tl.tensor,
    rate4: float, unbias4: float, n4: int,
    values5: tl.tensor, grads5: tl.tensor, means5: tl.tensor, squares5: tl.tensor,
    rate5: float, unbias5: float, n5: int,
    k1: float, t1: float, k2: float, t2: float, eps: float, block: tl.constexpr,
) -> None:  # fmt: skip
    i = tl.program_id(0)
    i = _move_own(values0, grads0, means0, squares0, rate0, unbias0, k1, t1, k2, t2, eps, n0, i, block)
    i = _move_own(values1, grads1, means1, squares1, rate1, unbias1, k1, t1, k2, t2, eps, n1, i, block)
    i = _move_own(values2, grads2, means2, squares2, rate2, unbias2, k1, t1, k2, t2, eps, n2, i, block)
    i = _move_own(values3, grads3, means3, squares3, rate3, unbias3, k1, t1, k2, t2, eps, n3, i, block)
    i = _move_own(values4, grads4, means4, squares4, rate4, unbias4, k1, t1, k2, t2, eps, n4, i, block)
    i = _move_own(values5, grads5, means5, squares5, rate5, unbias5, k1, t1, k2, t2, eps, n5, i, block)


@triton.jit(do_not_specialize=("n",))
def _rows_kernel(
    values: tl.tensor, gradients: tl.tensor, means: tl.tensor, squares: tl.tensor, marked: tl.tensor, rate: float,
    keep1: float, take1: float, keep2: float, take2: float, eps: float, n: tl.tensor, columns: tl.constexpr,
    block: tl.constexpr,
) -> None:  # fmt: skip
    """Step the marked rows of a tensor of `columns` contiguous numbers each; nothing is read of the others."""
    start = tl.program_id(0).to(tl.int64) * block * columns
    for part in range(columns):
        places = start + part * block + tl.arange(0, block)
        here = places < n.to(tl.int64) * columns
        here = here & (tl.load(marked + places // columns, here, 0) != 0)
        gradient = tl.load(gradients + places, here, 0.0)
        mean = keep1 * tl.load(means + places, here, 0.0) + take1 * gradient
        square = keep2 * tl.load(squares + places, here, 0.0) + take2 * gradient * gradient
        moved = tl.load(values + places, here, 0.0) - rate * mean / (tl.sqrt(square) + eps)
        tl.store(means + places, mean, here)
        tl.store(squares + places, square, here)
        tl.store(values + places, moved, here)


def step_rows_triton(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, marked: Tensor, rate: float, eps: float
) -> None:
    """Do `step_rows` for a contiguous float32 tensor on a CUDA device."""
    n, (keep1, keep2) = len(values), BETAS
    numbers = rate, keep1, 1 - keep1, keep2, 1 - keep2, eps, n
    seen = marked.contiguous().view(torch.uint8)
    columns = values.numel() // n
    launch(
        _rows_kernel, (blocks(n, BLOCK),), values, gradient, mean, square, seen, *numbers, columns=columns, block=BLOCK
    )


def step_tensors_triton(slots: Sequence[AdamSlot], betas: tuple[float, float], eps: float) -> None:
    """Do `step_torch` for float32 tensors of any sizes on one CUDA device, `MOST_TENSORS` in a launch.

    All columns of a tensor have one rate. Each has programs of its own, as in a launch for it alone.
    """
    for start in range(0, len(slots), MOST_TENSORS):
        _launch(slots[start : start + MOST_TENSORS], betas, eps)


def _launch(slots: Sequence[AdamSlot], betas: tuple[float, float], eps: float) -> None:
    keep1, keep2 = betas
    arguments: list[Tensor | float] = []
    programs, last = 0, 0.0
    for values, gradient, mean, square, step, rate, _ in slots:
        if step != last:  # of all tensors the same, as a rule
            (unbias1, unbias2), last = _unbiased(step, betas), step
        n = values.numel()
        arguments += values, gradient, mean, square, rate * unbias1, unbias2, n
        programs += blocks(n, BLOCK)
    nothing = *slots[0][:4], 0.0, 0.0, 0
    for _ in range(len(slots), MOST_TENSORS):
        arguments += nothing
    launch(_tensors_kernel, (programs,), *arguments, keep1, 1 - keep1, keep2, 1 - keep2, eps, block=BLOCK)


def _unbiased(step: float, betas: tuple[float, float]) -> tuple[float, float]:
    """Return the factors by which rates have the first moment's bias correction, and roots the second's."""
    first, second = betas
    return 1 / (1 - first**step), math.sqrt(1 / (1 - second**step))


def step_triton(slots: Sequence[AdamSlot], views: int, gradient: float) -> None:
    """Do `step_torch` for the five float32 tensors of a field, n rows each, on one CUDA device."""
    n = slots[0].values.shape[0]
    keep1, keep2 = (beta**views for beta in BETAS)
    arguments: list[Tensor | float] = []
    for slot in slots:
        unbias1, unbias2 = _unbiased(slot.step, BETAS)
        arguments += *slot[:4], slot.rate * unbias1, slot.rest * unbias1, unbias2
    arguments += gradient, keep1, 1 - keep1, keep2, 1 - keep2, ADAM_EPS, n
    columns = {name: slot.values.numel() // n for name, slot in zip(COLUMNS, slots, strict=True)}
    launch(_kernel, (blocks(n, BLOCK),), *arguments, **columns, block=BLOCK)
