"""Kernels of Adam's steps on the CPU."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import WIDTH, Floats, Lanes, fetch_add, load, sqrt, store

_TASK_ELEMENTS = 16384

Value = TypeVar("Value", Lanes, float)


@inline
def _moments(gradient: Value, mean: Value, square: Value, rates: Floats) -> tuple[Value, Value]:
    """Return both moments after this step."""
    blend, decay, square_blend = rates[0], rates[1], rates[2]
    return mean + blend * (gradient - mean), decay * square + square_blend * (gradient * gradient)


@inline
def _moved(parameter: Value, scale: Value, mean: Value, root: Value, rates: Floats) -> Value:
    """Return the parameter after this step; `root` is the square root of the second moment."""
    step_size, correction, eps = rates[3], rates[4], rates[5]
    moved: Value = parameter - step_size * scale * mean / (correction * root + eps)
    return moved


@jit
def adam_kernel(
    counter: NDArray[np.int64], p: Floats, g: Floats, m: Floats, v: Floats, columns: int, active: int, scale: Floats,
    rates: Floats,
) -> None:  # fmt: skip
    """Update the first `active` elements of each row of `columns`; all arrays flat, `scale` for one row.

    No multiplication is fused with an addition, so that vector and scalar code give the same bits.
    """
    rows = (len(p) + columns - 1) // columns
    rows_of_task = max(_TASK_ELEMENTS // columns, 1)
    while True:
        first = fetch_add(counter, rows_of_task)
        if first >= rows:
            return
        for row in range(first, min(first + rows_of_task, rows)):
            start = row * columns
            count = min(active, len(p) - start)
            whole = count // WIDTH * WIDTH
            for x in range(0, whole, WIDTH):
                i = start + x
                mean, square = _moments(load(g, i), load(m, i), load(v, i), rates)
                store(m, i, mean)
                store(v, i, square)
                store(p, i, _moved(load(p, i), load(scale, x), mean, sqrt(square), rates))
            for x in range(whole, count):
                i = start + x
                m[i], v[i] = _moments(g[i], m[i], v[i], rates)
                p[i] = _moved(p[i], scale[x], m[i], np.sqrt(v[i]), rates)
