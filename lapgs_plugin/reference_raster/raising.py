"""Up(coarse) + fine on the CPU: rows are raised across into a buffer in the cache, and summed from there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.reference_raster._jit import inline, jit
from lapgs_plugin.reference_raster.buffers import empty
from lapgs_plugin.reference_raster.lanes import WIDTH, Floats, fetch_add, fma, load, store
from lapgs_plugin.reference_raster.threads import parallel

Integers = NDArray[np.int64]

_STRIP_ROWS = 32
"""Fine rows of a piece of work: some 20 coarse ones are raised for them, 4 of which its neighbour raises again."""


@inline
def _raise_row(row: Floats, first: Integers, weights: Floats, out: Floats) -> None:
    """One coarse row at the fine width."""
    for x in range(len(first)):
        total = row[0] * 0
        for tap in range(weights.shape[1]):
            total += weights[x, tap] * row[first[x] + tap]
        out[x] = total


@inline
def _add_row(total: Floats, weight: Any, row: Floats, width: int) -> None:
    """total += weight * row."""
    whole = width // WIDTH * WIDTH
    for x in range(0, whole, WIDTH):
        store(total, x, fma(load(row, x), weight, load(total, x)))
    for x in range(whole, width):
        total[x] += weight * row[x]


@jit
def _kernel(
    counter: Integers,
    coarse: Floats,
    fine: Floats,
    first_row: Integers,
    row_weights: Floats,
    first_column: Integers,
    column_weights: Floats,
    out: Floats,
) -> None:
    planes, height, width = fine.shape
    taps = row_weights.shape[1]
    strips = -(-height // _STRIP_ROWS)
    raised = np.empty((_STRIP_ROWS + taps, width), fine.dtype)
    while True:
        task = fetch_add(counter, 1)
        if task >= planes * strips:
            return
        plane, top = task // strips, task % strips * _STRIP_ROWS
        bottom = min(top + _STRIP_ROWS, height)
        start, stop = first_row[top], first_row[bottom - 1] + taps
        for y in range(start, stop):
            _raise_row(coarse[plane, y], first_column, column_weights, raised[y - start])
        for y in range(top, bottom):
            total = out[plane, y]
            total[:] = fine[plane, y]
            for tap in range(taps):
                _add_row(total, row_weights[y, tap], raised[first_row[y] - start + tap], width)


def add_raised_cpu(
    coarse: Floats,
    fine: Floats,
    first_row: Integers,
    row_weights: Floats,
    first_column: Integers,
    column_weights: Floats,
) -> Floats:
    """Up(coarse) + fine, the same bits for any number of threads.

    Args:
        coarse: (n, ceil(h / 2), ceil(w / 2)) contiguous.
        fine: (n, h, w) contiguous, of the same type as all weights.
        first_row, row_weights, first_column, column_weights: `Pyramid.up_taps` of h and w.

    Returns:
        (n, h, w).
    """
    out = empty(fine.size, fine.dtype).reshape(fine.shape)
    parallel(_kernel, coarse, fine, first_row, row_weights, first_column, column_weights, out)
    return out
