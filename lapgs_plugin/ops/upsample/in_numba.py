"""Upsample on the CPU: first along rows, into a buffer that stays in the cache, then along columns.

The fine samples 2 i and 2 i + 1 of a row are sums over the same few coarse neighbours of i. A vector holds one of these
sums for neighbouring i.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import (
    WIDTH,
    Floats,
    borrowed,
    fetch_add,
    fma,
    keep_alive,
    load,
    splat,
    store,
    store_columns,
)
from lapgs_plugin.jit.threads import parallel

Integers = NDArray[np.int64]

BEFORE, AFTER = 2, 3  # coarse neighbours of i
NEIGHBOURS = BEFORE + 1 + AFTER

_STRIP_ROWS = 32
"""Fine rows of a task. Adjacent tasks upsample a few coarse rows twice."""


def across_weights(first: Integers, weights: Floats) -> Floats:
    """Return weights of the neighbours of each i, (2, NEIGHBOURS, pitch), for even and odd fine samples, from taps."""
    fine, taps = weights.shape
    pitch = -(-((fine + 1) // 2) // WIDTH) * WIDTH
    across = np.zeros((2, NEIGHBOURS, pitch), weights.dtype)
    i = np.arange(fine)
    for tap in range(taps):
        neighbour = first + tap - i // 2 + BEFORE
        used = weights[:, tap] != 0
        across[i[used] % 2, neighbour[used], i[used] // 2] = weights[used, tap]
    return across


@inline
def _upsample_row(
    coarse: Floats, start: int, length: int, weights: Floats, pitch: int, row: Floats, out: Floats, to: int
) -> None:
    """Upsample a row of `length` coarse samples; `row` is scratch space for them and their neighbours."""
    for x in range(length):
        row[BEFORE + x] = coarse[start + x]
    for i in range(0, pitch, WIDTH):
        even = odd = splat(row, 0.0)
        for k in range(NEIGHBOURS):
            value = load(row, i + k)
            even = fma(value, load(weights, k * pitch + i), even)
            odd = fma(value, load(weights, (NEIGHBOURS + k) * pitch + i), odd)
        store_columns(out, to + 2 * i, even, odd)


@jit
def _kernel(
    counter: Integers,
    coarse: Floats,  # (n, h / 2, w / 2)
    fine: Floats,  # (n, h, w), read if `adds`
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
    upsampled, row, below, above = borrowed(memory), borrowed(padded), borrowed(coarse), borrowed(fine)
    across, down, result = borrowed(column_weights), borrowed(row_weights), borrowed(out)
    while True:
        task = fetch_add(counter, 1)
        if task >= planes * strips:
            break
        plane, top = task // strips, task % strips * _STRIP_ROWS
        bottom = min(top + _STRIP_ROWS, height)
        start, stop = first_row[top], first_row[bottom - 1] + taps
        for y in range(start, stop):
            offset = (plane * coarse_height + y) * coarse_width
            _upsample_row(below, offset, coarse_width, across, pitch, row, upsampled, (y - start) * wide)
        for y in range(top, bottom):
            offset, first = (plane * height + y) * width, (first_row[y] - start) * wide
            for x in range(0, whole, WIDTH):
                total = load(above, offset + x) if adds else splat(above, 0.0)
                for tap in range(taps):
                    total = fma(load(upsampled, first + tap * wide + x), down[y * taps + tap], total)
                store(result, offset + x, total)
            for x in range(whole, width):
                rest = above[offset + x] if adds else fine.dtype.type(0)
                for tap in range(taps):
                    rest += upsampled[first + tap * wide + x] * down[y * taps + tap]
                result[offset + x] = rest
    keep_alive(memory)
    keep_alive(padded)


def upsample_cpu(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int], fine: Tensor | None = None) -> Tensor:
    """Do `upsample`, or `upsample_add` given `fine`, without gradient; the same bits for any number of threads."""
    source = _planes(coarse)
    out = empty(len(source) * size[0] * size[1], source.dtype).reshape(len(source), *size)
    added = out if fine is None else _planes(fine)
    rows, columns = (_taps(pyramid.grid, side, coarse.dtype) for side in size)
    parallel(_kernel, source, added, fine is not None, rows.first, rows.weights, columns.across, out)
    return torch.from_numpy(out).view(*coarse.shape[:-2], *size)


def _planes(image: Tensor) -> Floats:
    """Return all channels as (n, h, w), contiguous."""
    return image.detach().reshape(-1, *image.shape[-2:]).contiguous().numpy()


class _Taps(NamedTuple):
    """Hold `Pyramid.up_taps` of a side, and `across_weights` of them."""

    first: Integers
    weights: Floats
    across: Floats


@lru_cache(maxsize=64)
def _taps(grid: str, size: int, dtype: torch.dtype) -> _Taps:
    first, weights = Pyramid(grid).up_taps(size)
    values = weights.to(dtype).numpy()
    return _Taps(first.numpy(), values, across_weights(first.numpy(), values))
