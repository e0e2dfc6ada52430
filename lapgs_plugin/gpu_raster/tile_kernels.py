"""Sort Gaussians into tiles, front to back, in Triton and PyTorch.

Gaussians are sorted by depth first, all cameras' together. Then their pairs with tiles are made in that order, and
sorted stably by tile: a number of 8 or 16 bits instead of tile and depth, which have up to 64.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.records import TILE
from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 256
"""Gaussians, pairs or tiles of a program."""
KEYS = (torch.uint8, 0), (torch.int16, -(2**15)), (torch.int32, 0)
"""Types of tile numbers in the sort, the shortest first, and the value that stands for tile 0."""


@triton.jit
def _rectangle(
    radii: tl.tensor, means2d: tl.tensor, gaussian: tl.tensor, across: int, down: int, tile: tl.constexpr,
    boxed: tl.constexpr,
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:  # fmt: skip
    """Return the first tile across and down that a footprint touches, and how many; none where it is culled."""
    wide, high = tl.load(radii + 2 * gaussian), tl.load(radii + 2 * gaussian + 1)
    if boxed:
        return wide & 0xFFFF, high & 0xFFFF, (wide >> 16) - (wide & 0xFFFF), (high >> 16) - (high & 0xFFFF)
    visible = (wide > 0) & (high > 0)
    # Memory of culled Gaussians was never written.
    x = tl.where(visible, tl.load(means2d + 2 * gaussian), 0.0)
    y = tl.where(visible, tl.load(means2d + 2 * gaussian + 1), 0.0)
    wide, high = wide.to(tl.float32), high.to(tl.float32)
    # Limited before they are integers: a footprint may reach further than these count.
    left = tl.minimum(tl.maximum(tl.floor((x - wide) / tile), 0.0), across * 1.0).to(tl.int32)
    top = tl.minimum(tl.maximum(tl.floor((y - high) / tile), 0.0), down * 1.0).to(tl.int32)
    right = tl.minimum(tl.maximum(tl.ceil((x + wide) / tile), 0.0), across * 1.0).to(tl.int32)
    bottom = tl.minimum(tl.maximum(tl.ceil((y + high) / tile), 0.0), down * 1.0).to(tl.int32)
    return left, top, tl.where(visible, right - left, 0), tl.where(visible, bottom - top, 0)


@triton.jit(do_not_specialize=("n", "across", "down"))
def _count_kernel(
    radii: tl.tensor, means2d: tl.tensor, order: tl.tensor, counts: tl.tensor,
    n: int, across: int, down: int, tile: tl.constexpr, block: tl.constexpr, boxed: tl.constexpr,
) -> None:  # fmt: skip
    rank = tl.program_id(0) * block + tl.arange(0, block)
    gaussian = tl.load(order + rank, rank < n, 0)
    _, _, wide, high = _rectangle(radii, means2d, gaussian, across, down, tile, boxed)
    tl.store(counts + rank, wide * high, rank < n)


@triton.jit(do_not_specialize=("n", "of_each", "room", "across", "down", "all_tiles", "least"))
def _pair_kernel(
    radii: tl.tensor, means2d: tl.tensor, order: tl.tensor, ends: tl.tensor, images: tl.tensor,
    keys: tl.tensor, gaussians: tl.tensor,
    n: int, of_each: int, room: int, across: int, down: int, all_tiles: int, least: int,
    listed: tl.constexpr, tile: tl.constexpr, block: tl.constexpr, boxed: tl.constexpr,
) -> None:  # fmt: skip
    """Write tile and Gaussian of each pair, and a tile after the last in the places that remain.

    Each thread has a pair and looks for its Gaussian, so that one with many tiles does not keep others waiting.
    """
    pair = tl.program_id(0) * block + tl.arange(0, block)
    there = pair < tl.minimum(tl.load(ends + n - 1), room)
    low, high = tl.zeros((block,), tl.int32), tl.zeros((block,), tl.int32) + (n - 1)
    steps = n
    while steps > 0:
        middle = (low + high) // 2
        before = tl.load(ends + middle, there, 0) <= pair
        low, high = tl.where(before & (low < high), middle + 1, low), tl.where(before, high, middle)
        steps //= 2
    gaussian = tl.load(order + low, there, 0)
    left, top, wide, _ = _rectangle(radii, means2d, gaussian, across, down, tile, boxed)
    inside = (pair - tl.load(ends + low - 1, there & (low > 0), 0)).to(tl.int32)
    wide = tl.maximum(wide, 1)
    image = tl.load(images + gaussian, there, 0) if listed else gaussian // of_each
    number = (image.to(tl.int32) * down + top + inside // wide) * across + left + inside % wide
    tl.store(keys + pair, (tl.where(there, number, all_tiles) + least).to(keys.dtype.element_ty), pair < room)
    tl.store(gaussians + pair, gaussian.to(tl.int32), there)


@triton.jit(do_not_specialize=("room", "all_tiles", "least"))
def _finish_kernel(
    keys: tl.tensor, places: tl.tensor, gaussians: tl.tensor, offsets: tl.tensor, flat: tl.tensor,
    room: int, all_tiles: int, least: int, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write where each tile begins in sorted pairs, in the first programs; and the Gaussian of each, in the others."""
    of_tiles = all_tiles // block + 1
    if tl.program_id(0) < of_tiles:
        number = tl.program_id(0) * block + tl.arange(0, block)
        low, high = tl.zeros((block,), tl.int32), tl.zeros((block,), tl.int32) + room
        steps = room
        while steps > 0:
            middle = (low + high) // 2
            before = tl.load(keys + middle, middle < room, 0).to(tl.int32) - least < number
            low, high = tl.where(before & (low < high), middle + 1, low), tl.where(before, high, middle)
            steps //= 2
        tl.store(offsets + number, low, number <= all_tiles)
    else:
        position = (tl.program_id(0) - of_tiles) * block + tl.arange(0, block)
        there = position < room
        there = there & (tl.load(keys + position, there, 0).to(tl.int32) - least < all_tiles)
        tl.store(flat + position, tl.load(gaussians + tl.load(places + position, there, 0), there), there)


def sort_by_depth(
    radii: Tensor, means2d: Tensor, depths: Tensor, grid: tuple[int, int], boxed: bool = False
) -> tuple[Tensor, Tensor]:
    """Sort Gaussians front to back, ties by index, and add up how many tiles they touch.

    Args:
        radii: (..., 2) int32, half sides of the footprints in pixels; 0 where culled. Or what `records.Projected` has
            of the family.
        means2d: (..., 2) in pixels.
        depths: (...) of the Gaussians; any number where culled.
        grid: tiles across and down.
        boxed: whether radii are the family's.

    Returns:
        Their order, (n,) int64 over all cameras, and the sum of tiles of each and those before it, (n,) int64.
    """
    order = torch.sort(depths.view(-1), stable=True)[1]
    counts = torch.empty_like(order)
    launch(
        _count_kernel, (blocks(len(order), BLOCK),),
        radii, means2d, order, counts, len(order), *grid, tile=TILE, block=BLOCK, boxed=boxed,
    )  # fmt: skip
    return order, counts.cumsum_(0)


def sort_by_tile(
    radii: Tensor, means2d: Tensor, order: Tensor, ends: Tensor, images: Tensor | None, count: int,
    grid: tuple[int, int], room: int, boxed: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Make the first `room` pairs of Gaussians and tiles, and sort them by tile. Nothing waits for the GPU.

    Args:
        radii, means2d, grid, boxed: as `sort_by_depth` takes them.
        order, ends: its results.
        images: (n,) int64, the image of each Gaussian; None for as many Gaussians in each.
        count: number of images.
        room: number of pairs, at least 1.

    Returns:
        The first pair of each tile and the number of pairs, (count · down · across + 1,) int32; and the Gaussian of
        each pair, (room,) int32.
    """
    n, all_tiles = len(order), count * grid[0] * grid[1]
    dtype, least = next(key for key in KEYS if all_tiles <= torch.iinfo(key[0]).max - key[1])
    keys = torch.empty(room, dtype=dtype, device=order.device)
    gaussians = torch.empty(room, dtype=torch.int32, device=order.device)
    launch(
        _pair_kernel, (blocks(room, BLOCK),),
        radii, means2d, order, ends, order if images is None else images, keys, gaussians,
        n, n // count, room, *grid, all_tiles, least, listed=images is not None, tile=TILE, block=BLOCK,
        boxed=boxed,
    )  # fmt: skip
    keys, places = torch.sort(keys, stable=True)
    flat = torch.empty_like(gaussians)
    offsets = torch.empty(all_tiles + 1, dtype=torch.int32, device=order.device)
    launch(
        _finish_kernel, (all_tiles // BLOCK + 1 + blocks(room, BLOCK),),
        keys, places, gaussians, offsets, flat, room, all_tiles, least, block=BLOCK,
    )  # fmt: skip
    return offsets, flat
