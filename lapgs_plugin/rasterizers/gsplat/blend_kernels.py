"""Blend and compute the gradients of blending in Triton, one program for each region of a tile.

gsplat gives each pixel a thread, which goes through all Gaussians of its tile. In the backward pass the threads of a
warp add up their gradients for each Gaussian by shuffles, which takes most of the time. Here a warp holds a bucket of
Gaussians by all pixels of its region: it skips Gaussians that do not reach the region, and it adds up pixels in
registers first.

The backward pass too takes Gaussians front to back. Let g be a pixel's gradient, c_i the colours, a_i the
alphas, T_i the transmittances before each Gaussian. The colour that reaches the eye from behind Gaussian i, with the
background, is the image less the colours up to i. So only its product with g has to be carried along:

    R_i = image g - sum over j <= i of T_j a_j (c_j g),    gradient by a_i = T_i (c_i g) - R_i / (1 - a_i).

This idea of a pass by Gaussians with the image as its start is from Taming 3DGS (Mallick et al. 2024).
"""

from __future__ import annotations

import os
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.self_check import FUSED

TILE = 16
LOG2_E = tl.constexpr(1.4426950408889634)
FAINTEST = tl.constexpr(1 / 255)
OPAQUEST = tl.constexpr(0.999)
LEAST = tl.constexpr(1e-4)
"""Transmittance that no pixel goes below: it ends before."""
INTERPRETED = tl.constexpr(os.environ.get("TRITON_INTERPRET") == "1")  # Triton's interpreter knows no assembly

# Kernels are not compiled anew for other sizes.
NOT_SPECIALIZED = ("width", "height", "across", "tiles", "all_tiles", "pairs")


class Shape(NamedTuple):
    """Lay out a program's region and its bucket of Gaussians in the threads of its warps; all are powers of 2.

    Attributes:
        lanes: threads side by side, one for each column of the region.
        rows: of the region, in the registers of a thread.
        splat_lanes: threads that hold different Gaussians; `lanes * splat_lanes` is 32 times `warps`.
        splats: Gaussians in the registers of a thread.
        warps: of a program.
        batch: pairs that a program tests at once for whether they reach its region; at least a bucket.
        ahead: whether one launch before finds the regions that each pair reaches. Otherwise each region reads and tests
            all Gaussians of its tile, in both passes.
    """

    lanes: int = 8
    rows: int = 4
    splat_lanes: int = 4
    splats: int = 2
    warps: int = 1
    batch: int = 32
    ahead: bool = False

    @property
    def regions(self) -> int:
        """Number of regions in a tile."""
        return (TILE // self.lanes) * (TILE // self.rows)


SHAPE = Shape()
MOST_REGIONS = 32
"""Regions of a tile that the bits of a number can tell apart."""
REACH_BATCH, REACH_WARPS = 128, 4
"""Pairs that a program of the launch before tests at once, and its warps."""


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _multiply(a: tl.tensor, b: tl.tensor) -> tl.tensor:
    return a * b


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _exp2(x: tl.tensor) -> tl.tensor:
    """Return 2 ** x; where compiled, in one instruction instead of four, with 0 for denormal results."""
    if INTERPRETED:
        return tl.exp2(x)
    return tl.inline_asm_elementwise("ex2.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _inverse(x: tl.tensor) -> tl.tensor:
    """Return 1 / x of numbers that are neither denormal nor huge, to one unit in the last place."""
    if INTERPRETED:
        return 1.0 / x
    return tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _reaches(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor,
    width: tl.constexpr, height: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return whether alpha may reach `FAINTEST` at a pixel; x and y are centres relative to the first pixel's.

    The exponent is convex, so that it is least on a side of the region that faces the centre, or is 0 at the centre.
    """
    near_x = tl.minimum(tl.maximum(x - (width - 1), 0.0), x)  # difference to the nearest column
    near_y = tl.minimum(tl.maximum(y - (height - 1), 0.0), y)
    on_column = tl.minimum(tl.maximum(-b * near_x * _inverse(c), y - (height - 1)), y)
    on_row = tl.minimum(tl.maximum(-b * near_y * _inverse(a), x - (width - 1)), x)
    limit = tl.log(opacity / FAINTEST) + 0.01  # with room for rounding, which grows with the terms of the exponent
    square = 0.5 * (a * near_x * near_x + c * on_column * on_column)
    found = square * 0.99999 + b * near_x * on_column <= limit
    square = 0.5 * (a * on_row * on_row + c * near_y * near_y)
    return found | (square * 0.99999 + b * on_row * near_y <= limit)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _add_gradients(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor,
    by_sigma: tl.tensor, by_red: tl.tensor, by_green: tl.tensor, by_blue: tl.tensor,
    of_sums: tl.tensor, there_of_sums: tl.tensor, conics: tl.tensor, opacities: tl.tensor,
    by_means2d: tl.tensor, by_absolute: tl.tensor, by_conics: tl.tensor, by_colors: tl.tensor, by_opacities: tl.tensor,
    absolute: tl.constexpr,
) -> None:  # fmt: skip
    """Add a bucket's gradients, summed over pixels, to those of all tiles.

    `x` and `y` are a Gaussian's centre less a pixel's, `by_sigma` the gradient by half its squared distance.
    """
    if absolute:
        along_x = tl.sum(tl.sum(tl.abs(by_sigma * (a * x + b * y)), 3), 0)
        along_y = tl.sum(tl.sum(tl.abs(by_sigma * (b * x + c * y)), 3), 0)
        tl.atomic_add(by_absolute + 2 * of_sums, along_x, there_of_sums, sem="relaxed")
        tl.atomic_add(by_absolute + 2 * of_sums + 1, along_y, there_of_sums, sem="relaxed")
    # Sums over rows, with axes (lanes, splat_lanes, splats); x is the same in all rows.
    x = tl.sum(x, 3)
    plain, by_y = tl.sum(by_sigma, 3), tl.sum(by_sigma * y, 3)
    sum_x, sum_y, sum_xy = tl.sum(plain * x, 0), tl.sum(by_y, 0), tl.sum(by_y * x, 0)
    sum_xx, sum_yy = tl.sum(plain * x * x, 0), tl.sum(tl.sum(by_sigma * y * y, 3), 0)
    a, b, c = tl.load(conics + 3 * of_sums), tl.load(conics + 3 * of_sums + 1), tl.load(conics + 3 * of_sums + 2)
    tl.atomic_add(by_means2d + 2 * of_sums, a * sum_x + b * sum_y, there_of_sums, sem="relaxed")
    tl.atomic_add(by_means2d + 2 * of_sums + 1, b * sum_x + c * sum_y, there_of_sums, sem="relaxed")
    tl.atomic_add(by_conics + 3 * of_sums, 0.5 * sum_xx, there_of_sums, sem="relaxed")
    tl.atomic_add(by_conics + 3 * of_sums + 1, sum_xy, there_of_sums, sem="relaxed")
    tl.atomic_add(by_conics + 3 * of_sums + 2, 0.5 * sum_yy, there_of_sums, sem="relaxed")
    by_opacity = -tl.sum(plain, 0) / tl.load(opacities + of_sums)
    tl.atomic_add(by_opacities + of_sums, by_opacity, there_of_sums, sem="relaxed")
    tl.atomic_add(by_colors + 3 * of_sums, tl.sum(tl.sum(by_red, 3), 0), there_of_sums, sem="relaxed")
    tl.atomic_add(by_colors + 3 * of_sums + 1, tl.sum(tl.sum(by_green, 3), 0), there_of_sums, sem="relaxed")
    tl.atomic_add(by_colors + 3 * of_sums + 2, tl.sum(tl.sum(by_blue, 3), 0), there_of_sums, sem="relaxed")


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _region(
    across: int, tiles: int, lanes: tl.constexpr, rows: tl.constexpr, tile: tl.constexpr
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:
    """Return the program's tile over all images, its image, and the first row and column of its region."""
    region = tl.program_id(0)
    regions: tl.constexpr = (tile // lanes) * (tile // rows)
    index = region // regions
    row = (index % tiles) // across * tile + region % regions // (tile // lanes) * rows
    column = (index % tiles) % across * tile + region % (tile // lanes) * lanes
    return index, index // tiles, row, column


@triton.jit(do_not_specialize=("across", "tiles", "all_tiles", "pairs"))  # type: ignore[untyped-decorator]  # no types
def _reach_kernel(
    means2d: tl.tensor, conics: tl.tensor, opacities: tl.tensor, offsets: tl.tensor, flat: tl.tensor,
    reached: tl.tensor, across: int, tiles: int, all_tiles: int, pairs: int,
    lanes: tl.constexpr, rows: tl.constexpr, tile: tl.constexpr, batch: tl.constexpr,
) -> None:  # fmt: skip
    """Set a bit of each pair for each region of its tile that it reaches."""
    index = tl.program_id(0)
    row, column = (index % tiles) // across * tile, (index % tiles) % across * tile
    begin = tl.load(offsets + index)
    stop = tl.load(offsets + index + 1, index + 1 < all_tiles, pairs)
    while begin < stop:
        pair = begin + tl.arange(0, batch)
        there = pair < stop
        gaussian = tl.load(flat + pair, there, 0)
        x = tl.load(means2d + 2 * gaussian) - (column + 0.5)
        y = tl.load(means2d + 2 * gaussian + 1) - (row + 0.5)
        a, b = tl.load(conics + 3 * gaussian), tl.load(conics + 3 * gaussian + 1)
        c, opacity = tl.load(conics + 3 * gaussian + 2), tl.load(opacities + gaussian)
        found = tl.zeros((batch,), tl.int32)
        for region in tl.static_range((tile // lanes) * (tile // rows)):
            left, top = region % (tile // lanes) * lanes, region // (tile // lanes) * rows
            found |= _reaches(x - left, y - top, a, b, c, opacity, lanes, rows).to(tl.int32) << region
        tl.store(reached + pair, found.to(reached.dtype.element_ty), there)
        begin += batch


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _fill(
    queue: tl.tensor, begin: tl.tensor, stop: tl.tensor, head: tl.tensor, tail: tl.tensor,
    flat: tl.tensor, reached: tl.tensor, means2d: tl.tensor, conics: tl.tensor, opacities: tl.tensor,
    row: tl.tensor, column: tl.tensor,
    bucket: tl.constexpr, lanes: tl.constexpr, rows: tl.constexpr, tile: tl.constexpr, batch: tl.constexpr,
    ahead: tl.constexpr,
) -> tuple[tl.tensor, tl.tensor]:  # fmt: skip
    """Put Gaussians that reach the region in the queue, until it has a bucket of them or the pairs end.

    Returns:
        The next pair, and how many Gaussians have entered the queue.
    """
    in_batch = tl.arange(0, batch)
    size: tl.constexpr = 2 * batch
    while (begin < stop) & (tail - head < bucket):
        there = begin + in_batch < stop
        gaussian = tl.load(flat + begin + in_batch, there, 0)
        if ahead:
            region = tl.program_id(0) % ((tile // lanes) * (tile // rows))
            bits = tl.load(reached + begin + in_batch, there, 0).to(tl.int32)
            wanted = (bits >> region) & 1 != 0
        else:
            x = tl.load(means2d + 2 * gaussian) - (column + 0.5)
            y = tl.load(means2d + 2 * gaussian + 1) - (row + 0.5)
            a, b = tl.load(conics + 3 * gaussian), tl.load(conics + 3 * gaussian + 1)
            c, opacity = tl.load(conics + 3 * gaussian + 2), tl.load(opacities + gaussian)
            wanted = there & _reaches(x, y, a, b, c, opacity, lanes, rows)
        slot = (tail + tl.cumsum(wanted.to(tl.int32), 0) - 1) & (size - 1)
        tl.debug_barrier()  # all threads have read the bucket before
        tl.store(queue + slot, gaussian, wanted)
        tl.debug_barrier()  # threads read what others wrote
        tail += tl.sum(wanted.to(tl.int32), 0)
        begin += batch
    return begin, tail


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _alphas(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor, there: tl.tensor
) -> tl.tensor:
    """Return alphas, 0 where they are below `FAINTEST`; `x` and `y` are centres less pixels."""
    # The exponent of 2; most of it is the same in all rows.
    power = (a * (-0.5 * LOG2_E)) * x * x + y * (b * (-LOG2_E) * x + c * (-0.5 * LOG2_E) * y)
    alpha = tl.minimum(opacity * _exp2(power), OPAQUEST)
    return tl.where(there & (power <= 0.0) & (alpha >= FAINTEST), alpha, 0.0)


@triton.jit(do_not_specialize=NOT_SPECIALIZED)  # type: ignore[untyped-decorator]  # Triton ships no types
def _forward_kernel(
    means2d: tl.tensor, conics: tl.tensor, colors: tl.tensor, opacities: tl.tensor, background: tl.tensor,
    offsets: tl.tensor, flat: tl.tensor, reached: tl.tensor, images: tl.tensor, counts: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, all_tiles: int, pairs: int,
    lanes: tl.constexpr, rows: tl.constexpr, splat_lanes: tl.constexpr, splats: tl.constexpr,
    tile: tl.constexpr, batch: tl.constexpr, ahead: tl.constexpr,
) -> None:  # fmt: skip
    # Axes as in the backward kernel.
    bucket: tl.constexpr = splats * splat_lanes
    size: tl.constexpr = 2 * batch  # of the queue: it has room for a batch and almost a bucket
    index, image, row, column = _region(across, tiles, lanes, rows, tile)
    along = tl.broadcast_to(tl.arange(0, lanes)[:, None, None, None], (lanes, splat_lanes, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (lanes, splat_lanes, 1, rows))
    inside = (column + along < width) & (row + down < height)
    transmittance = tl.where(inside, 1.0, 0.0)
    # Sums over the Gaussians of each thread.
    red, green, blue, cover = inside * 0.0, inside * 0.0, inside * 0.0, inside * 0.0

    begin = tl.load(offsets + index)
    stop = tl.load(offsets + index + 1, index + 1 < all_tiles, pairs)
    queue = queues + tl.program_id(0) * size
    order = tl.arange(0, splat_lanes)[None, :, None, None] * splats + tl.arange(0, splats)[None, None, :, None]
    order = tl.broadcast_to(order, (lanes, splat_lanes, splats, 1))
    head, tail = 0, 0
    while (begin < stop) | (head < tail):
        begin, tail = _fill(
            queue, begin, stop, head, tail, flat, reached, means2d, conics, opacities, row, column,
            bucket, lanes, rows, tile, batch, ahead,
        )  # fmt: skip
        there = head + order < tail
        gaussian = tl.load(queue + ((head + order) & (size - 1)), there, 0)
        head += bucket
        x = tl.load(means2d + 2 * gaussian) - (column + 0.5 + along)
        y = tl.load(means2d + 2 * gaussian + 1) - (row + 0.5 + down)
        a, b = tl.load(conics + 3 * gaussian), tl.load(conics + 3 * gaussian + 1)
        c, opacity = tl.load(conics + 3 * gaussian + 2), tl.load(opacities + gaussian)
        color_r, color_g = tl.load(colors + 3 * gaussian, there, 0.0), tl.load(colors + 3 * gaussian + 1, there, 0.0)
        color_b = tl.load(colors + 3 * gaussian + 2, there, 0.0)
        tl.debug_barrier()  # tells the assembler that all threads are here, which saves registers and branches
        alpha = _alphas(x, y, a, b, c, opacity, there)
        left = 1.0 - alpha
        of_lane = tl.reduce(left, 2, _multiply, keep_dims=True)
        upto = tl.cumprod(of_lane, 1)
        after = transmittance * (upto * _inverse(of_lane)) * tl.cumprod(left, 2)
        transmittance *= tl.reduce(of_lane, 1, _multiply, keep_dims=True)
        weight = tl.where(after > LEAST, alpha * after * _inverse(left), 0.0)
        red += tl.sum(weight * color_r, 2, keep_dims=True)
        green += tl.sum(weight * color_g, 2, keep_dims=True)
        blue += tl.sum(weight * color_b, 2, keep_dims=True)
        cover += tl.sum(weight, 2, keep_dims=True)
        if tl.max(tl.max(tl.max(tl.max(transmittance, 3), 2), 1), 0) <= LEAST:  # all pixels ended
            begin, tail = stop, head
    tl.store(counts + tl.program_id(0), tl.minimum(head, tail))

    pixel = images + 3 * (image.to(tl.int64) * (width * height) + (row + down) * width + column + along)
    left = 1.0 - tl.sum(cover, 1, keep_dims=True)
    background += 3 * image
    tl.store(pixel, tl.sum(red, 1, keep_dims=True) + left * tl.load(background), inside)
    tl.store(pixel + 1, tl.sum(green, 1, keep_dims=True) + left * tl.load(background + 1), inside)
    tl.store(pixel + 2, tl.sum(blue, 1, keep_dims=True) + left * tl.load(background + 2), inside)


@triton.jit(do_not_specialize=NOT_SPECIALIZED)  # type: ignore[untyped-decorator]  # Triton ships no types
def _backward_kernel(
    means2d: tl.tensor, conics: tl.tensor, colors: tl.tensor, opacities: tl.tensor,
    offsets: tl.tensor, flat: tl.tensor, reached: tl.tensor, counts: tl.tensor, images: tl.tensor,
    by_images: tl.tensor,
    by_means2d: tl.tensor, by_absolute: tl.tensor, by_conics: tl.tensor, by_colors: tl.tensor, by_opacities: tl.tensor,
    queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, all_tiles: int, pairs: int,
    lanes: tl.constexpr, rows: tl.constexpr, splat_lanes: tl.constexpr, splats: tl.constexpr,
    tile: tl.constexpr, batch: tl.constexpr, ahead: tl.constexpr, absolute: tl.constexpr,
) -> None:  # fmt: skip
    # Tensors have the axes (lanes, splat_lanes, splats, rows). Triton spreads the first axes over threads, because it
    # finds no order in the addresses of Gaussians. So the last two are registers of a thread, and sums over rows and
    # products over splats need no shuffles.
    bucket: tl.constexpr = splats * splat_lanes
    size: tl.constexpr = 2 * batch  # of the queue: it has room for a batch and almost a bucket
    index, image, row, column = _region(across, tiles, lanes, rows, tile)
    along = tl.broadcast_to(tl.arange(0, lanes)[:, None, None, None], (lanes, splat_lanes, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (lanes, splat_lanes, 1, rows))
    inside = (column + along < width) & (row + down < height)
    pixel = 3 * (image.to(tl.int64) * (width * height) + (row + down) * width + column + along)
    red = tl.load(by_images + pixel, inside, 0.0)
    green, blue = tl.load(by_images + pixel + 1, inside, 0.0), tl.load(by_images + pixel + 2, inside, 0.0)
    behind = red * tl.load(images + pixel, inside, 0.0)
    behind += green * tl.load(images + pixel + 1, inside, 0.0) + blue * tl.load(images + pixel + 2, inside, 0.0)
    transmittance = tl.where(inside, 1.0, 0.0)

    begin, count = tl.load(offsets + index), tl.load(counts + tl.program_id(0))
    stop = tl.load(offsets + index + 1, index + 1 < all_tiles, pairs)
    queue = queues + tl.program_id(0) * size
    # Which Gaussian of a bucket an element is; those in one thread are consecutive.
    order_of_sums = tl.arange(0, splat_lanes)[:, None] * splats + tl.arange(0, splats)[None, :]
    order = tl.broadcast_to(order_of_sums[None, :, :, None], (lanes, splat_lanes, splats, 1))
    head, tail = 0, 0  # numbers of Gaussians that left the queue and that entered it
    while head < count:
        begin, tail = _fill(
            queue, begin, stop, head, tail, flat, reached, means2d, conics, opacities, row, column,
            bucket, lanes, rows, tile, batch, ahead,
        )  # fmt: skip
        there = head + order < tail
        gaussian = tl.load(queue + ((head + order) & (size - 1)), there, 0)
        there_of_sums = head + order_of_sums < tail
        of_sums = tl.load(queue + ((head + order_of_sums) & (size - 1)), there_of_sums, 0)
        head += bucket
        x = tl.load(means2d + 2 * gaussian) - (column + 0.5 + along)  # (lanes, splat_lanes, splats, 1)
        y = tl.load(means2d + 2 * gaussian + 1) - (row + 0.5 + down)  # (lanes, splat_lanes, splats, rows)
        a, b = tl.load(conics + 3 * gaussian), tl.load(conics + 3 * gaussian + 1)
        c, opacity = tl.load(conics + 3 * gaussian + 2), tl.load(opacities + gaussian)
        color_r, color_g = tl.load(colors + 3 * gaussian, there, 0.0), tl.load(colors + 3 * gaussian + 1, there, 0.0)
        color_b = tl.load(colors + 3 * gaussian + 2, there, 0.0)
        tl.debug_barrier()  # tells the assembler that all threads are here, which saves registers and branches
        alpha = _alphas(x, y, a, b, c, opacity, there)
        left = 1.0 - alpha
        inverse = _inverse(left)
        # Products up to each Gaussian: of those before in the same thread, and of threads before.
        of_lane = tl.reduce(left, 2, _multiply, keep_dims=True)
        upto = tl.cumprod(of_lane, 1)
        after = transmittance * (upto * _inverse(of_lane)) * tl.cumprod(left, 2)
        transmittance *= tl.reduce(of_lane, 1, _multiply, keep_dims=True)
        alpha = tl.where(after > LEAST, alpha, 0.0)  # the pixel ends before
        before = after * inverse
        weight = alpha * before
        shine = color_r * red + color_g * green + color_b * blue
        added = weight * shine
        of_lane = tl.sum(added, 2, keep_dims=True)
        upto = tl.cumsum(of_lane, 1)
        by_alpha = before * shine - (behind - (upto - of_lane) - tl.cumsum(added, 2)) * inverse
        behind -= tl.sum(of_lane, 1, keep_dims=True)
        by_sigma = tl.where(alpha < OPAQUEST, -alpha * by_alpha, 0.0)
        _add_gradients(
            x, y, a, b, c, by_sigma, weight * red, weight * green, weight * blue, of_sums, there_of_sums, conics,
            opacities, by_means2d, by_absolute, by_conics, by_colors, by_opacities, absolute,
        )  # fmt: skip


def blend_forward(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, background: Tensor,
    offsets: Tensor, flat: Tensor, size: tuple[int, int], shape: Shape = SHAPE,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Blend the Gaussians of each tile; arguments are contiguous.

    Args:
        means2d, conics, colors, opacities: (c, n, 2), (c, n, 3), (c, n, 3) and (c, n) float32 of c cameras.
        background: (c, 3) float32.
        offsets: (c, tiles down, tiles across) int32, the first pair of each tile.
        flat: (p,) int32, the Gaussian of each pair, counted over all cameras; front to back in a tile.
        size: (width, height) of the images.
        shape: of a program's work.

    Returns:
        Images (c, h, w, 3); the number of Gaussians in each region that reach it before all its pixels end; and the
        regions that each pair reaches, empty if the shape does not look `ahead`.
    """
    width, height = size
    programs, numbers = _launch_of(offsets, flat, size, shape)
    reached = flat.new_empty(len(flat) if shape.ahead else 0, dtype=torch.int16 if shape.regions <= 16 else torch.int32)
    if shape.ahead:
        _reach_kernel[(offsets.numel(),)](
            means2d, conics, opacities, offsets, flat, reached, *numbers[2:],
            lanes=shape.lanes, rows=shape.rows, tile=TILE, batch=REACH_BATCH, num_warps=REACH_WARPS, **FUSED,
        )  # fmt: skip
    images = means2d.new_empty(len(offsets), height, width, 3)
    counts = flat.new_empty(programs)
    _forward_kernel[(programs,)](
        means2d, conics, colors, opacities, background, offsets, flat, reached, images, counts,
        flat.new_empty(programs, 2 * shape.batch), *numbers,
        lanes=shape.lanes, rows=shape.rows, splat_lanes=shape.splat_lanes, splats=shape.splats,
        tile=TILE, batch=shape.batch, ahead=shape.ahead, num_warps=shape.warps, **FUSED,
    )  # fmt: skip
    return images, counts, reached


def blend_backward(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, offsets: Tensor, flat: Tensor, images: Tensor,
    counts: Tensor, reached: Tensor, by_images: Tensor, absolute: bool, shape: Shape = SHAPE,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the gradients of blending by centres, conics, colours and opacities; arguments are contiguous.

    Args:
        means2d, conics, colors, opacities, offsets, flat: as `blend_forward` takes them.
        images, counts, reached: its results, made with the same shape.
        by_images: gradient by the images.
        absolute: also sum the absolute values of the gradient by centres.
        shape: of a program's work.

    Returns:
        Sums of absolute values (c, n, 2), meaningless without `absolute`; gradients by `means2d`, `conics`, `colors`
        and `opacities`.
    """
    by_means2d = torch.zeros_like(means2d)
    by_absolute = torch.zeros_like(means2d) if absolute else by_means2d
    by_opacities = torch.zeros_like(opacities)
    # One launch for both; each begins at a multiple of 16 bytes, or Triton would compile for where it begins.
    end = -(-conics.numel() // 4) * 4
    zeros = conics.new_zeros(2 * end)
    by_conics, by_colors = zeros[: conics.numel()].view_as(conics), zeros[end : end + colors.numel()].view_as(colors)
    programs, numbers = _launch_of(offsets, flat, (images.shape[2], images.shape[1]), shape)
    assert len(counts) == programs
    _backward_kernel[(programs,)](
        means2d, conics, colors, opacities, offsets, flat, reached, counts, images, by_images,
        by_means2d, by_absolute, by_conics, by_colors, by_opacities,
        flat.new_empty(programs, 2 * shape.batch), *numbers,
        lanes=shape.lanes, rows=shape.rows, splat_lanes=shape.splat_lanes, splats=shape.splats,
        tile=TILE, batch=shape.batch, ahead=shape.ahead, absolute=absolute, num_warps=shape.warps, **FUSED,
    )  # fmt: skip
    return by_absolute, by_means2d, by_conics, by_colors, by_opacities


def _launch_of(offsets: Tensor, flat: Tensor, size: tuple[int, int], shape: Shape) -> tuple[int, tuple[int, ...]]:
    """Return the number of programs and the arguments named in `NOT_SPECIALIZED`."""
    all_tiles, across = offsets.numel(), offsets.shape[-1]
    numbers = *size, across, offsets[0].numel(), all_tiles, len(flat)
    return all_tiles * shape.regions, numbers
