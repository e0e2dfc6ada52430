"""Take one Adam step of all tensors of a field in one kernel.

PyTorch's fused Adam launches a kernel for each tensor and has one learning rate for it. With it, SH have to be two
tensors, which are concatenated for every render and split in every backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import triton
import triton.language as tl

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS, AdamSlot
from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512
EPS = tl.constexpr(ADAM_EPS)
LOG_BETA1, LOG_BETA2 = tl.constexpr(math.log(BETAS[0])), tl.constexpr(math.log(BETAS[1]))


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _move(
    values: tl.tensor, gradients: tl.tensor, means: tl.tensor, squares: tl.tensor, step: tl.tensor,
    rate: float, rest: float, scale: float, keep1: float, take1: float, keep2: float, take2: float,
    n: tl.tensor, columns: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Step `block` rows of one tensor, `columns` contiguous numbers each.

    keep1 and take1 are the weights of the first moment and of the gradient in the next moment, keep2 and take2 those of
    the second moment and of the gradient's square.
    """
    t = tl.load(step).to(tl.float64)
    unbias1 = 1.0 / (1.0 - tl.exp(t * LOG_BETA1)).to(tl.float32)
    unbias2 = 1.0 / tl.sqrt(1.0 - tl.exp(t * LOG_BETA2)).to(tl.float32)
    start = tl.program_id(0).to(tl.int64) * block * columns
    for part in range(columns):
        places = start + part * block + tl.arange(0, block)
        here = places < n.to(tl.int64) * columns
        gradient = scale * tl.load(gradients + places, here, 0.0)
        mean = keep1 * tl.load(means + places, here, 0.0) + take1 * gradient
        square = keep2 * tl.load(squares + places, here, 0.0) + take2 * gradient * gradient
        size = rate * unbias1
        if columns > 4:
            size = tl.where(places % columns < 3, rate, rest) * unbias1
        moved = tl.load(values + places, here, 0.0) - size * mean / (tl.sqrt(square) * unbias2 + EPS)
        tl.store(means + places, mean, here)
        tl.store(squares + places, square, here)
        tl.store(values + places, moved, here)


@triton.jit(do_not_specialize=("n",))  # type: ignore[untyped-decorator]  # Triton ships no types
def _kernel(
    values0: tl.tensor, gradients0: tl.tensor, means0: tl.tensor, squares0: tl.tensor, step0: tl.tensor,
    rate0: float, rest0: float,
    values1: tl.tensor, gradients1: tl.tensor, means1: tl.tensor, squares1: tl.tensor, step1: tl.tensor,
    rate1: float, rest1: float,
    values2: tl.tensor, gradients2: tl.tensor, means2: tl.tensor, squares2: tl.tensor, step2: tl.tensor,
    rate2: float, rest2: float,
    values3: tl.tensor, gradients3: tl.tensor, means3: tl.tensor, squares3: tl.tensor, step3: tl.tensor,
    rate3: float, rest3: float,
    values4: tl.tensor, gradients4: tl.tensor, means4: tl.tensor, squares4: tl.tensor, step4: tl.tensor,
    rate4: float, rest4: float,
    scale: float, k1: float, t1: float, k2: float, t2: float, n: int,
    columns0: tl.constexpr, columns1: tl.constexpr, columns2: tl.constexpr, columns3: tl.constexpr,
    columns4: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    _move(values0, gradients0, means0, squares0, step0, rate0, rest0, scale, k1, t1, k2, t2, n, columns0, block)
    _move(values1, gradients1, means1, squares1, step1, rate1, rest1, scale, k1, t1, k2, t2, n, columns1, block)
    _move(values2, gradients2, means2, squares2, step2, rate2, rest2, scale, k1, t1, k2, t2, n, columns2, block)
    _move(values3, gradients3, means3, squares3, step3, rate3, rest3, scale, k1, t1, k2, t2, n, columns3, block)
    _move(values4, gradients4, means4, squares4, step4, rate4, rest4, scale, k1, t1, k2, t2, n, columns4, block)


def step_triton(slots: Sequence[AdamSlot], views: int, gradient: float) -> None:
    """Do `step_torch` for the five float32 tensors of a field, n rows each, on one CUDA device."""
    n = len(slots[0].values)
    keep1, keep2 = (beta**views for beta in BETAS)
    tensors = (value for slot in slots for value in slot)
    columns = {f"columns{i}": slot.values.numel() // n for i, slot in enumerate(slots)}
    numbers = gradient, keep1, 1 - keep1, keep2, 1 - keep2, n
    launch(_kernel, (blocks(n, BLOCK),), *tensors, *numbers, **columns, block=BLOCK)
