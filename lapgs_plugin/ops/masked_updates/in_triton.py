"""Update rows in one kernel for up to five tensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.launch import blocks, launch
from lapgs_plugin.ops.masked_updates.in_torch import Update, read_columns

BLOCK = 512
NUMBER, ROWS = tl.constexpr(-1), tl.constexpr(0)
"""Strides of sources that are a number, or a value of each row."""
MOST = 5
"""Updates of a launch: each has three tensors among the arguments."""


@triton.jit
def _update(
    target: tl.tensor, source: tl.tensor, factor: tl.tensor, rows: tl.tensor, shown: tl.tensor, zero: tl.tensor,
    takes_largest: tl.constexpr, number: tl.constexpr, first: tl.constexpr, last: tl.constexpr, stride: tl.constexpr,
    times: tl.constexpr,
) -> None:  # fmt: skip
    """Update the rows that are shown; rounding is that of PyTorch's single operations."""
    before = tl.load(target + rows, shown, 0.0)
    if stride == NUMBER:
        value = tl.full(rows.shape, number, tl.float32)
    elif stride == ROWS:
        value = tl.load(source + rows, shown, 0).to(tl.float32)
    elif first == last:
        value = tl.abs(tl.load(source + stride * rows.to(tl.int64) + first, shown, 0.0))
    else:
        x = tl.load(source + stride * rows.to(tl.int64) + first, shown, 0.0)
        y = tl.load(source + stride * rows.to(tl.int64) + last, shown, 0.0)
        value = tl.sqrt_rn(_product(x, x, zero) + _product(y, y, zero))
    if times:
        value = _product(value, tl.load(factor + rows, shown, 0).to(tl.float32), zero)
    after = tl.maximum(before, value, propagate_nan=tl.PropagateNan.ALL) if takes_largest else before + value
    tl.store(target + rows, after, shown)


@triton.jit
def _product(x: tl.tensor, y: tl.tensor, zero: tl.tensor) -> tl.tensor:
    """Return a product that is rounded before it is added to something.

    Compilers join a product and a sum, also across a float64. They do not across a sum of integers whose value they do
    not know.
    """
    return ((x * y).to(tl.int32, bitcast=True) + zero).to(tl.float32, bitcast=True)


@triton.jit(do_not_specialize=("n", "zero"))  # no types
def _one_kernel(
    mask: tl.tensor, target0: tl.tensor, source0: tl.tensor, factor0: tl.tensor, n: int, zero: int,
    largest0: tl.constexpr, number0: tl.constexpr, first0: tl.constexpr, last0: tl.constexpr,
    stride0: tl.constexpr, times0: tl.constexpr,
    block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    shown = (rows < n) & (tl.load(mask + rows, rows < n, 0) != 0)
    _update(target0, source0, factor0, rows, shown, zero, largest0, number0, first0, last0, stride0, times0)


@triton.jit(do_not_specialize=("n", "zero"))  # no types
def _kernel(
    mask: tl.tensor,
    target0: tl.tensor, source0: tl.tensor, factor0: tl.tensor,
    target1: tl.tensor, source1: tl.tensor, factor1: tl.tensor,
    target2: tl.tensor, source2: tl.tensor, factor2: tl.tensor,
    target3: tl.tensor, source3: tl.tensor, factor3: tl.tensor,
    target4: tl.tensor, source4: tl.tensor, factor4: tl.tensor,
    n: int, zero: int,
    largest0: tl.constexpr, number0: tl.constexpr, first0: tl.constexpr, last0: tl.constexpr,
    stride0: tl.constexpr, times0: tl.constexpr,
    largest1: tl.constexpr, number1: tl.constexpr, first1: tl.constexpr, last1: tl.constexpr,
    stride1: tl.constexpr, times1: tl.constexpr,
    largest2: tl.constexpr, number2: tl.constexpr, first2: tl.constexpr, last2: tl.constexpr,
    stride2: tl.constexpr, times2: tl.constexpr,
    largest3: tl.constexpr, number3: tl.constexpr, first3: tl.constexpr, last3: tl.constexpr,
    stride3: tl.constexpr, times3: tl.constexpr,
    largest4: tl.constexpr, number4: tl.constexpr, first4: tl.constexpr, last4: tl.constexpr,
    stride4: tl.constexpr, times4: tl.constexpr,
    count: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    shown = (rows < n) & (tl.load(mask + rows, rows < n, 0) != 0)
    _update(target0, source0, factor0, rows, shown, zero, largest0, number0, first0, last0, stride0, times0)
    _update(target1, source1, factor1, rows, shown, zero, largest1, number1, first1, last1, stride1, times1)
    if count > 2:
        _update(target2, source2, factor2, rows, shown, zero, largest2, number2, first2, last2, stride2, times2)
    if count > 3:
        _update(target3, source3, factor3, rows, shown, zero, largest3, number3, first3, last3, stride3, times3)
    if count > 4:
        _update(target4, source4, factor4, rows, shown, zero, largest4, number4, first4, last4, stride4, times4)


def update_rows_triton(mask: Tensor, updates: Sequence[Update]) -> None:
    """Do `update_rows_torch` for updates that fit, on one CUDA device."""
    for start in range(0, len(updates), MOST):
        _launch(mask, updates[start : start + MOST])


def _launch(mask: Tensor, updates: Sequence[Update]) -> None:
    tensors: list[Tensor] = [mask]
    kinds = []
    for target, takes_largest, source, columns, factor in updates:
        number = None if isinstance(source, Tensor) else source
        width = 0 if columns is None else source.shape[1]
        kinds.append((takes_largest, number, columns, width, factor is not None))
        # What a kernel does not read is any tensor.
        tensors += target, target if number is not None else source, target if factor is None else factor
    n, kernel = mask.shape[0], _one_kernel
    if len(updates) > 1:
        kernel = _kernel
        tensors += [mask] * 3 * (MOST - len(updates))
    launch(kernel, (blocks(n, BLOCK),), *tensors, n, 0, **_constants(tuple(kinds)))


@cache
def _constants(kinds: tuple[tuple[Any, ...], ...]) -> dict[str, Any]:
    """Return the constants of a kernel by name, for updates by what is larger, number, columns, width and factor."""
    several = len(kinds) > 1
    constants: dict[str, Any] = {"block": BLOCK, **({"count": len(kinds)} if several else {})}
    for i in range(MOST if several else 1):
        takes_largest, number, columns, width, times = kinds[i] if i < len(kinds) else (False, None, None, 0, False)
        read = range(1) if columns is None else read_columns(columns, width)
        constants |= {
            f"largest{i}": takes_largest,
            f"number{i}": 0.0 if number is None else float(number),
            f"first{i}": read[0],
            f"last{i}": read[-1],
            f"stride{i}": width if number is None else NUMBER.value,
            f"times{i}": times,
        }
    return constants
