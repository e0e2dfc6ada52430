"""Up(coarse), with or without + fine, on the CPU: rows are raised across into a buffer in the cache and summed there.

Across, the even and the odd fine samples 2 i and 2 i + 1 are sums over the same few coarse neighbours of i, which makes
vectors of neighbouring i out of both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import (
    WIDTH,
    Floats,
    at,
    borrowed,
    fetch_add,
    fma,
    keep_alive,
    load,
    put,
    splat,
    store,
    store_columns,
)
from lapgs_plugin.jit.threads import parallel

Integers = NDArray[np.int64]

BEFORE, AFTER = 2, 3
"""Coarse neighbours of i on its two sides."""
NEIGHBOURS = BEFORE + 1 + AFTER

_STRIP_ROWS = 32
"""Fine rows of a piece of work: some 20 coarse ones are raised for them, 4 of which its neighbour raises again."""


def across_weights(first: Integers, weights: Floats) -> Floats:
    """Weights of the neighbours, (2, NEIGHBOURS, pitch): of even and of odd samples, for each i from 0 on.

    Args:
        first, weights: `Pyramid.up_taps` of the finer side.
    """
    fine, taps = weights.shape
    pitch = -(-((fine + 1) // 2) // WIDTH) * WIDTH
    found = np.zeros((2, NEIGHBOURS, pitch), weights.dtype)
    i = np.arange(fine)
    for tap in range(taps):
        neighbour = first + tap - i // 2 + BEFORE
        used = weights[:, tap] != 0
        found[i[used] % 2, neighbour[used], i[used] // 2] = weights[used, tap]
    return found


@inline
def _upsample_row(
    coarse: Floats, start: int, length: int, weights: Floats, pitch: int, row: Floats, out: Floats, place: int
) -> None:
    """`length` coarse samples from `start` on at the fine width; `row` has room for them and their neighbours."""
    for x in range(length):
        put(row, BEFORE + x, at(coarse, start + x))
    for i in range(0, pitch, WIDTH):
        even = odd = splat(row, 0.0)
        for k in range(NEIGHBOURS):
            value = load(row, i + k)
            even = fma(value, load(weights, k * pitch + i), even)
            odd = fma(value, load(weights, (NEIGHBOURS + k) * pitch + i), odd)
        store_columns(out, place + 2 * i, even, odd)


@jit
def _kernel(
    counter: Integers,
    coarse: Floats,  # (n, h / 2, w / 2)
    fine: Floats,  # (n, h, w), looked at if it is to be added
    adds: bool,
    first_row: Integers,  # (h,)
    row_weights: Floats,  # (h, taps)
    column_weights: Floats,  # (2, NEIGHBOURS, pitch)
    out: Floats,  # (n, h, w)
) -> None:
    planes, height, width = out.shape
    coarse_height, coarse_width = coarse.shape[1:]
    taps, pitch = row_weights.shape[1], column_weights.shape[2]
    wide, whole, strips = 2 * pitch, width // WIDTH * WIDTH, -(-height // _STRIP_ROWS)
    memory = np.empty((_STRIP_ROWS + NEIGHBOURS) * wide, fine.dtype)
    padded = np.zeros(pitch + NEIGHBOURS + WIDTH, fine.dtype)
    raised, row, below, above = borrowed(memory), borrowed(padded), borrowed(coarse), borrowed(fine)
    across, down, result = borrowed(column_weights), borrowed(row_weights), borrowed(out)
    while True:
        task = fetch_add(counter, 1)
        if task >= planes * strips:
            break
        plane, top = task // strips, task % strips * _STRIP_ROWS
        bottom = min(top + _STRIP_ROWS, height)
        start, stop = first_row[top], first_row[bottom - 1] + taps
        for y in range(start, stop):
            place = (plane * coarse_height + y) * coarse_width
            _upsample_row(below, place, coarse_width, across, pitch, row, raised, (y - start) * wide)
        for y in range(top, bottom):
            place, first = (plane * height + y) * width, (first_row[y] - start) * wide
            for x in range(0, whole, WIDTH):
                total = load(above, place + x) if adds else splat(above, 0.0)
                for tap in range(taps):
                    total = fma(load(raised, first + tap * wide + x), at(down, y * taps + tap), total)
                store(result, place + x, total)
            for x in range(whole, width):
                rest = at(above, place + x) if adds else fine.dtype.type(0)
                for tap in range(taps):
                    rest += at(raised, first + tap * wide + x) * at(down, y * taps + tap)
                put(result, place + x, rest)
    keep_alive(memory)
    keep_alive(padded)


def upsample_add_cpu(
    coarse: Floats, fine: Floats, first_row: Integers, row_weights: Floats, column_weights: Floats
) -> Floats:
    """Up(coarse) + fine, the same bits for any number of threads.

    Args:
        coarse: (n, ceil(h / 2), ceil(w / 2)) contiguous.
        fine: (n, h, w) contiguous, of the same type as all weights.
        first_row, row_weights: `Pyramid.up_taps` of h.
        column_weights: `across_weights` of w.

    Returns:
        (n, h, w).
    """
    out = empty(fine.size, fine.dtype).reshape(fine.shape)
    parallel(_kernel, coarse, fine, True, first_row, row_weights, column_weights, out)
    return out


def upsample_cpu(
    coarse: Floats, size: tuple[int, int], first_row: Integers, row_weights: Floats, column_weights: Floats
) -> Floats:
    """Up(coarse) to (n, *size); the other arguments as `upsample_add_cpu` takes them."""
    out = empty(len(coarse) * size[0] * size[1], coarse.dtype).reshape(len(coarse), *size)
    parallel(_kernel, coarse, out, False, first_row, row_weights, column_weights, out)
    return out
