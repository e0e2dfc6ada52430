"""Sort splats by depth and list them for the tiles that they cover."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import borrowed, fetch_add, prefetch

DIGIT_BITS = 11
"""Bits that one round of the radix sort sorts by."""
DIGITS = 1 << DIGIT_BITS

AHEAD = 16
"""How many splats ahead of their use data is prefetched."""


@inline
def _box(boxes: NDArray[np.int32], i: int) -> tuple[int, int, int, int]:
    """Return the first tile across and down, and one past the last across and down."""
    return boxes[4 * i], boxes[4 * i + 1], boxes[4 * i + 2], boxes[4 * i + 3]


@jit
def count_pairs(n: int, boxes: NDArray[np.int32], first_pair: NDArray[np.int64]) -> int:
    """Number the pairs of a splat and a tile, splat by splat.

    Args:
        boxes: (m * 4,) tiles covered: first across, first down, one past the last across, down.
        first_pair: (n + 1,) filled with the number of each splat's first pair, then their total.

    Returns:
        The number of splats that cover a tile.
    """
    total, shown, boxes = 0, 0, borrowed(boxes)
    for i in range(n):
        first_pair[i] = total
        left, top, right, bottom = _box(boxes, i)
        area = (right - left) * (bottom - top)
        if area > 0:
            total += area
            shown += 1
    first_pair[n] = total
    return shown


@jit
def sort_by_depth(
    first_pair: NDArray[np.int64],  # (n + 1,)
    keys: NDArray[Any],  # (n,) bits of the depths: positive floats sort as integers
    order: NDArray[np.int32],  # (shown,) filled: splats that cover a tile, nearest first, ties by index
    spare: NDArray[np.int32],  # (shown,)
    sorted_keys: NDArray[Any],  # (shown,)
    spare_keys: NDArray[Any],  # (shown,)
) -> None:
    """Sort splats by depth: a stable radix sort, least significant digit first."""
    rounds = (keys.itemsize * 8 + DIGIT_BITS - 1) // DIGIT_BITS
    counts = np.zeros((rounds, DIGITS), np.int64)
    shown = 0
    for i in range(keys.size):
        if first_pair[i + 1] > first_pair[i]:
            key = keys[i]
            order[shown] = i
            sorted_keys[shown] = key
            shown += 1
            for r in range(rounds):
                counts[r, np.int64(key >> (r * DIGIT_BITS)) & (DIGITS - 1)] += 1
    source, source_keys, target, target_keys = order, sorted_keys, spare, spare_keys
    for r in range(rounds):
        if counts[r].max() == shown:
            continue  # all have the same digit
        total = 0
        for digit in range(DIGITS):
            count = counts[r, digit]
            counts[r, digit] = total
            total += count
        for i in range(shown):
            key = source_keys[i]
            bucket = np.int64(key >> (r * DIGIT_BITS)) & (DIGITS - 1)
            target[counts[r, bucket]] = source[i]
            target_keys[counts[r, bucket]] = key
            counts[r, bucket] += 1
        source, source_keys, target, target_keys = target, target_keys, source, source_keys
    if source is not order:
        order[:] = source


@jit
def count_tiles(
    counter: NDArray[np.int64],  # (1,) zero
    order: NDArray[np.int32],  # (shown,)
    boxes: NDArray[np.int32],  # (m * 4,)
    tiles_x: int,
    counts: NDArray[np.int64],  # (chunks, tiles) zero
) -> None:
    """Count the splats of each chunk of the order that cover each tile."""
    chunks, shown, order, boxes = counts.shape[0], order.size, borrowed(order), borrowed(boxes)
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = counts[chunk]
        for rank in range(shown * chunk // chunks, shown * (chunk + 1) // chunks):
            prefetch(boxes, 4 * order[min(rank + AHEAD, shown - 1)])
            left, top, right, bottom = _box(boxes, order[rank])
            for y in range(top, bottom):
                for x in range(left, right):
                    row[y * tiles_x + x] += 1


@jit
def start_tiles(counts: NDArray[np.int64], tile_start: NDArray[np.int64]) -> None:
    """Turn counts of (chunk, tile) into the start of each chunk's part of each tile's list.

    Args:
        counts: (chunks, tiles), replaced by the starts.
        tile_start: (tiles + 1,) filled with the starts of the tiles' lists, then the length of all.
    """
    total = 0
    for tile in range(counts.shape[1]):
        tile_start[tile] = total
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = total
            total += count
    tile_start[counts.shape[1]] = total


@jit
def list_by_tile(
    counter: NDArray[np.int64],  # (1,) zero
    order: NDArray[np.int32],  # (shown,)
    boxes: NDArray[np.int32],  # (m * 4,)
    tiles_x: int,
    starts: NDArray[np.int64],  # (chunks, tiles), overwritten
    first_pair: NDArray[np.int64],  # (n + 1,)
    members: NDArray[np.int32],  # (pairs,) filled: splats, tile after tile, nearest first
    places: NDArray[np.int32],  # (pairs,) filled: where in `members` each splat's pairs are, splat after splat
) -> None:
    """Sort the pairs by tile: a stable counting sort."""
    chunks, shown, order, boxes = starts.shape[0], order.size, borrowed(order), borrowed(boxes)
    first_pair = borrowed(first_pair)
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = starts[chunk]
        for rank in range(shown * chunk // chunks, shown * (chunk + 1) // chunks):
            coming = order[min(rank + AHEAD, shown - 1)]
            prefetch(boxes, 4 * coming)
            prefetch(first_pair, coming)
            i = order[rank]
            pair = first_pair[i]
            left, top, right, bottom = _box(boxes, i)
            for y in range(top, bottom):
                for x in range(left, right):
                    position = row[y * tiles_x + x]
                    row[y * tiles_x + x] = position + 1
                    members[position] = i
                    places[pair] = position
                    pair += 1
