"""Sum over pixels, for each Gaussian, how it is blended there; and find the Gaussians that a pixel is made of.

Forks of the 3DGS family score Gaussians by such sums. A launch goes through the tiles that blending went through, and
only where it is asked for.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.records import RECORD, TILE, Blended
from lapgs_plugin.gpu_raster.walk_kernels import (
    LANES,
    LEAST,
    NOT_SPECIALIZED,
    QUEUE,
    SHAPE,
    SPLAT_LANES,
    alphas_of,
    before_and_all,
    fill_queue,
    first_word,
    inverse_of,
    launch_of,
    next_bucket,
    next_pairs,
    pairs_of,
    pixels_of,
    place_region,
    sum_of_pair,
    transmittances_of,
)
from lapgs_plugin.ops.launch import launch

SUMS = 5
"""Of weights, of 1, of shares, of distances; and one without meaning, see `blend_kernels.OTHERS`."""
OF_SUMS = tl.constexpr(0)
"""Add up a Gaussian's `SUMS`."""
SQUARES = tl.constexpr(1)
"""Add up squared gradients."""
REMAINDERS = tl.constexpr(2)
"""Add up weights times shares times the transmittance behind each Gaussian."""
LAST = tl.constexpr(2**31 - 1)
"""Rank behind that of every pair."""


@triton.jit
def _add_sums(
    share: tl.tensor, weight: tl.tensor, distance: tl.tensor, into: tl.tensor, there: tl.tensor
) -> None:  # fmt: skip
    """Add a bucket's sums over pixels to those of all tiles."""
    blended = share > 0.0
    of_weight = tl.sum(tl.where(blended, weight, 0.0), 3, keep_dims=True)
    of_one = tl.sum(tl.where(blended, 1.0, 0.0), 3, keep_dims=True)
    of_share = tl.sum(share, 3, keep_dims=True)
    of_distance = tl.sum(tl.where(blended, distance, 0.0), 3, keep_dims=True)
    # What is left in the thread of column i is the i-th sum.
    total = sum_of_pair(sum_of_pair(of_weight, of_share, 2), sum_of_pair(of_one, of_distance, 2), 1)
    tl.atomic_add(into + tl.arange(0, LANES)[:, None, None, None], total, there, sem="relaxed")


@triton.jit
def _slopes(
    added: tl.tensor, shade: tl.tensor, behind: tl.tensor, inverse: tl.tensor
) -> tuple[tl.tensor, tl.tensor]:  # fmt: skip
    """Return gradients by alphas, see `blend_kernels`, and what reaches the eye from behind the bucket.

    Args:
        added: products of what Gaussians add to the pixels and the pixels' gradients.
        shade: those of transmittances before Gaussians, colours and gradients.
        behind: what reaches the eye from the bucket and behind it, times the gradients.
        inverse: of 1 less alphas.
    """
    second = tl.arange(0, added.shape[2])[None, None, :, None] == 1  # of a thread's Gaussians
    by_both = tl.sum(added, 2, keep_dims=True)
    by_first = tl.sum(tl.where(second, 0.0, added), 2, keep_dims=True)
    added_before, by_all = before_and_all(by_both, True)
    still_behind = (behind - added_before) - tl.where(second, by_both, by_first)
    return shade - still_behind * inverse, behind - by_all


@triton.jit(do_not_specialize=NOT_SPECIALIZED)
def _sum_kernel(
    records: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor, counts: tl.tensor, images: tl.tensor,
    by_images: tl.tensor, weights: tl.tensor, sums: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, known: int, pairs: int,
    rows: tl.constexpr, splats: tl.constexpr, tile: tl.constexpr, record: tl.constexpr, what: tl.constexpr,
    stride: tl.constexpr,
) -> None:  # fmt: skip
    # Axes as in the backward kernel of blending.
    bucket: tl.constexpr = splats * SPLAT_LANES
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    index, image, row, column = place_region(across, tiles, rows, tile)
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    pixel = (row + down) * width + column + along
    transmittance = tl.where(inside, 1.0, 0.0)
    if what == SQUARES:
        at_red, at_green, at_blue = pixels_of(image, pixel, width * height, True)
        by_red = tl.load(by_images + at_red, inside, 0.0)
        by_green, by_blue = tl.load(by_images + at_green, inside, 0.0), tl.load(by_images + at_blue, inside, 0.0)
        behind = by_red * tl.load(images + at_red, inside, 0.0)
        behind += by_green * tl.load(images + at_green, inside, 0.0) + by_blue * tl.load(images + at_blue, inside, 0.0)
    else:
        of_pixel = tl.load(weights + pixel, inside, 0.0)

    count = tl.load(counts + tl.program_id(0))
    begin, stop = pairs_of(index, offsets, known, pairs)
    words += first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = next_pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0
    while head < count:
        begin, words, tail, gaussians, word = fill_queue(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        gaussian, there, x, y, a, b, c, opacity, red, green, blue, _ = next_bucket(
            queue, head, tail, another, records, splats, record
        )
        head += bucket
        x, y = x - (column + 0.5 + along), y - (row + 0.5 + down)
        alpha, _ = alphas_of(x, y, a, b, c, opacity, there, True)
        inverse = inverse_of(1.0 - alpha)
        before, after, transmittance = transmittances_of(alpha, transmittance)
        alpha = tl.where(after > LEAST, alpha, 0.0)  # the pixel ends before
        share = alpha * before
        if what == OF_SUMS:
            _add_sums(share, of_pixel, tl.sqrt(x * x + y * y), sums + stride * gaussian, there)
        else:
            if what == SQUARES:
                shade = red * by_red + green * by_green + blue * by_blue
                slope, behind = _slopes(share * shade, before * shade, behind, inverse)
                value = tl.where(alpha > 0.0, opacity * slope, 0.0)
                value *= value
            else:
                value = share * (1.0 - alpha) * of_pixel
            total = tl.sum(tl.sum(value, 3, keep_dims=True), 0, keep_dims=True)
            first = tl.arange(0, LANES)[:, None, None, None] == 0
            tl.atomic_add(sums + stride * gaussian, tl.where(first, total, 0.0), there & first, sem="relaxed")


@triton.jit(do_not_specialize=NOT_SPECIALIZED)
def _leader_kernel(
    records: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor, counts: tl.tensor,
    leaders: tl.tensor, shares: tl.tensor, orders: tl.tensor, left: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, known: int, pairs: int,
    rows: tl.constexpr, splats: tl.constexpr, tile: tl.constexpr, record: tl.constexpr,
) -> None:  # fmt: skip
    """Find the Gaussian of the next largest share of each pixel after that in `shares` and `orders`, which it replaces.

    Of equal shares, the Gaussian in front comes first. `left` is the transmittance behind all.
    """
    # Axes as in the backward kernel of blending.
    bucket: tl.constexpr = splats * SPLAT_LANES
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    region = place_region(across, tiles, rows, tile)
    index, row, column = region[0], region[2], region[3]
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    pixel = (row + down) * width + column + along
    transmittance = tl.where(inside, 1.0, 0.0)
    cover, best = inside * 0.0, inside * 0.0
    leader, first = tl.where(inside, -1, -1), tl.where(inside, LAST, LAST)
    limit, after_order = tl.load(shares + pixel, inside, 0.0), tl.load(orders + pixel, inside, 0)
    within = tl.arange(0, SPLAT_LANES)[None, :, None, None] * splats + tl.arange(0, splats)[None, None, :, None]

    count = tl.load(counts + tl.program_id(0))
    begin, stop = pairs_of(index, offsets, known, pairs)
    words += first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = next_pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0
    while head < count:
        begin, words, tail, gaussians, word = fill_queue(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        gaussian, there, x, y, a, b, c, opacity, _, _, _, _ = next_bucket(
            queue, head, tail, another, records, splats, record
        )
        alpha, _ = alphas_of(x - (column + 0.5 + along), y - (row + 0.5 + down), a, b, c, opacity, there, True)
        before, after, transmittance = transmittances_of(alpha, transmittance)
        share = tl.where(after > LEAST, alpha * before, 0.0)
        cover += tl.sum(share, 2, keep_dims=True)
        order = tl.broadcast_to(within, share.shape) + head
        open_ = (share < limit) | ((share == limit) & (order > after_order))
        share = tl.where(open_, share, 0.0)
        largest = tl.max(share, 2, keep_dims=True)
        in_front = tl.min(tl.where(share == largest, order, LAST), 2, keep_dims=True)
        which = tl.max(tl.where(order == in_front, gaussian, -1), 2, keep_dims=True)
        better = largest > best
        best, first = tl.where(better, largest, best), tl.where(better, in_front, first)
        leader = tl.where(better, which, leader)
        head += bucket
    # Over the threads that share a pixel.
    largest = tl.max(best, 1, keep_dims=True)
    in_front = tl.min(tl.where(best == largest, first, LAST), 1, keep_dims=True)
    which = tl.max(tl.where((best == largest) & (first == in_front), leader, -1), 1, keep_dims=True)
    wanted = inside & (tl.arange(0, SPLAT_LANES)[None, :, None, None] == 0)
    tl.store(leaders + pixel, tl.broadcast_to(which, inside.shape), wanted)
    tl.store(shares + pixel, tl.broadcast_to(largest, inside.shape), wanted)
    tl.store(orders + pixel, tl.broadcast_to(in_front, inside.shape), wanted)
    tl.store(left + pixel, tl.broadcast_to(1.0 - tl.sum(cover, 1, keep_dims=True), inside.shape), wanted)


def _launch(kernel: object, seen: Blended, *more: Tensor, **constants: int) -> None:
    programs, numbers = launch_of(seen.offsets, seen.flat, seen.size, 1, SHAPE)
    launch(
        kernel, (programs,),
        seen.records, seen.offsets, seen.flat, seen.words, seen.counts, *more,
        seen.flat.new_empty(programs, QUEUE.value), *numbers,
        rows=SHAPE.rows, splats=SHAPE.splats, tile=TILE, record=RECORD, **constants, num_warps=1,
    )  # fmt: skip


def _sum(seen: Blended, weights: Tensor, by_image: Tensor, columns: int, what: int) -> Tensor:
    sums = seen.records.new_zeros(seen.records.numel() // RECORD, columns)
    _launch(_sum_kernel, seen, seen.image, by_image, weights, sums, what=what, stride=columns)
    return sums


def sums_over_pixels(seen: Blended, weights: Tensor) -> Tensor:
    """Return sums of weights, of 1, of shares and of distances in pixels where each Gaussian is blended, (n, SUMS).

    Args:
        weights: (h * w,) of the pixels.
    """
    return _sum(seen, weights, seen.image, SUMS, OF_SUMS.value)


def remainders(seen: Blended, weights: Tensor) -> Tensor:
    """Return the sum over pixels of weight times share times what is left behind the Gaussian's alpha, (n,).

    Args:
        weights: (h * w,) of the pixels.
    """
    return _sum(seen, weights, seen.image, 1, REMAINDERS.value)[:, 0]


def squared_gradients(seen: Blended, by_image: Tensor) -> Tensor:
    """Return the sum over pixels of the squared derivative of a loss by a Gaussian's alpha over opacity there, (n,).

    Args:
        by_image: (1, 3, h, w) derivative of the loss by the image.
    """
    return _sum(seen, seen.image, by_image, 1, SQUARES.value)[:, 0]


def leaders(seen: Blended, ranks: int) -> tuple[Tensor, Tensor]:
    """Return the Gaussians of the largest shares of each pixel, (ranks, h * w) int32, and transmittances (h * w,).

    Where fewer are blended, the others are -1.
    """
    pixels = seen.size[0] * seen.size[1]
    leading = seen.flat.new_empty(ranks, pixels)
    shares, orders = seen.image.new_full((pixels,), torch.inf), seen.flat.new_full((pixels,), -1)
    left = seen.image.new_empty(pixels)
    for rank in leading:
        _launch(_leader_kernel, seen, rank, shares, orders, left)
    return leading, left
