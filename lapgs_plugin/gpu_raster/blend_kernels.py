"""Blend and compute the gradients of blending in Triton, one warp for each region of a tile.

gsplat gives each pixel a thread, which goes through all Gaussians of its tile. In the backward pass the threads of a
warp add up their gradients for each Gaussian by shuffles, which takes most of the time. Here a warp holds a bucket of
Gaussians by all pixels of its region. A launch before finds which regions of its tile each Gaussian reaches, so that a
region skips the others. What blending reads of a Gaussian lies together in memory, and so do its gradients.

The backward pass too takes Gaussians front to back. Let g be a pixel's gradient, c_i the colours, a_i the
alphas, T_i the transmittances before each Gaussian. The colour that reaches the eye from behind Gaussian i, with the
background, is the image less the colours up to i. So only its product with g has to be carried along:

    R_i = image g - sum over j <= i of T_j a_j (c_j g),    gradient by a_i = T_i (c_i g) - R_i / (1 - a_i).

This idea of a pass by Gaussians with the image as its start is from Taming 3DGS (Mallick et al. 2024).
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.memory_kernels import at_most
from lapgs_plugin.gpu_raster.records import GRADIENT, OTHERS, RECORD, TILE
from lapgs_plugin.gpu_raster.rules import GSPLAT, Rules
from lapgs_plugin.gpu_raster.walk_kernels import (
    COLUMNS,
    LANES,
    LEAST,
    NOT_SPECIALIZED,
    OPAQUEST,
    OPAQUEST_OF_FAMILY,
    QUEUE,
    REACH_WARPS,
    SHAPE,
    SPLAT_LANES,
    WARP,
    Shape,
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
    reach_kernel,
    sum_of_pair,
    transmittances_of,
)
from lapgs_plugin.ops.launch import launch

OF_GRADIENT = tl.constexpr(GRADIENT)
"""Numbers of a Gaussian's gradients that lie together."""
FORWARD_REGISTERS = 72
"""Most registers of a forward kernel's thread.

With fewer an H200 runs more warps beside each other, until the registers do not suffice.
"""
BACKWARD_REGISTERS = 80
"""The same of a backward kernel's thread."""


@triton.jit(do_not_specialize=(*NOT_SPECIALIZED, "of_background"))
def _forward_kernel(
    records: tl.tensor, background: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor,
    images: tl.tensor, inverse_depths: tl.tensor, counts: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, known: int, pairs: int, of_background: int,
    rows: tl.constexpr, splats: tl.constexpr, tile: tl.constexpr, record: tl.constexpr, family: tl.constexpr,
    depth: tl.constexpr,
) -> None:  # fmt: skip
    # Axes as in the backward kernel.
    bucket: tl.constexpr = splats * SPLAT_LANES
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    index, image, row, column = place_region(across, tiles, rows, tile)
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    transmittance = tl.where(inside, 1.0, 0.0)
    # Sums over the Gaussians of each thread.
    red, green, blue, cover = inside * 0.0, inside * 0.0, inside * 0.0, inside * 0.0
    near = inside * 0.0

    begin, stop = pairs_of(index, offsets, known, pairs)
    words += first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = next_pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0
    begin, words, tail, gaussians, word = fill_queue(
        queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
    )
    _, there, x, y, a, b, c, opacity, color_r, color_g, color_b, inverse_z = next_bucket(
        queue, head, tail, another, records, splats, record
    )
    while head < tail:
        # The next bucket is loaded before this one is blended, because loading takes as long.
        head += bucket
        begin, words, tail, gaussians, word = fill_queue(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        following = next_bucket(queue, head, tail, another, records, splats, record)
        alpha, _ = alphas_of(x - (column + 0.5 + along), y - (row + 0.5 + down), a, b, c, opacity, there, family)
        before, after, transmittance = transmittances_of(alpha, transmittance)
        weight = tl.where(after > LEAST, alpha * before, 0.0)
        red += tl.sum(weight * color_r, 2, keep_dims=True)
        green += tl.sum(weight * color_g, 2, keep_dims=True)
        blue += tl.sum(weight * color_b, 2, keep_dims=True)
        cover += tl.sum(weight, 2, keep_dims=True)
        if depth:
            near += tl.sum(weight * inverse_z, 2, keep_dims=True)
        if tl.max((transmittance > LEAST).to(tl.int32)) == 0:  # all pixels ended
            begin, tail = stop, head
        _, there, x, y, a, b, c, opacity, color_r, color_g, color_b, inverse_z = following
    tl.store(counts + tl.program_id(0), tl.minimum(head, tail))

    pixel = (row + down) * width + column + along
    at_red, at_green, at_blue = pixels_of(image, pixel, width * height, family)
    left = 1.0 - tl.sum(cover, 1, keep_dims=True)
    background += of_background * image
    tl.store(images + at_red, tl.sum(red, 1, keep_dims=True) + left * tl.load(background), inside)
    tl.store(images + at_green, tl.sum(green, 1, keep_dims=True) + left * tl.load(background + 1), inside)
    tl.store(images + at_blue, tl.sum(blue, 1, keep_dims=True) + left * tl.load(background + 2), inside)
    if depth:
        inverse_depths += image.to(tl.int64) * (width * height)
        tl.store(inverse_depths + pixel, tl.sum(near, 1, keep_dims=True), inside)


@triton.jit
def _add_gradients(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor,
    by_sigma: tl.tensor, by_red: tl.tensor, by_green: tl.tensor, by_blue: tl.tensor,
    by_inverse_z: tl.tensor, gaussian: tl.tensor, there: tl.tensor, gradients: tl.tensor, others: tl.tensor,
    absolute: tl.constexpr, depth: tl.constexpr, stride: tl.constexpr,
) -> None:  # fmt: skip
    """Add a bucket's gradients, summed over pixels, to those of all tiles.

    `x` and `y` are a Gaussian's centre less a pixel's, `by_sigma` the gradient by half its squared distance.
    """
    # Sums over rows; x is the same in all of them.
    plain, by_y = tl.sum(by_sigma, 3, keep_dims=True), tl.sum(by_sigma * y, 3, keep_dims=True)
    by_yy, by_x = tl.sum(by_sigma * y * y, 3, keep_dims=True), plain * x
    red, green = tl.sum(by_red, 3, keep_dims=True), tl.sum(by_green, 3, keep_dims=True)
    blue, faint = tl.sum(by_blue, 3, keep_dims=True), -plain * inverse_of(opacity)
    # Sums over columns: of a pair of threads each keeps four of eight values, and then two, instead of all in each.
    # What is left in the thread of column i are the numbers 2 i and 2 i + 1 of a Gaussian's `GRADIENT` ones.
    of_red = sum_of_pair(red, a * by_x + b * by_y, 2)
    of_green = sum_of_pair(green, b * by_x + c * by_y, 2)
    of_blue = sum_of_pair(blue, 0.5 * by_x * x, 2)
    of_opacity = sum_of_pair(faint, by_y * x, 2)
    first = sum_of_pair(of_red, of_blue, 1)
    second = sum_of_pair(of_green, of_opacity, 1)
    lane = tl.arange(0, LANES)[:, None, None, None]
    start = gradients + OF_GRADIENT * gaussian
    tl.atomic_add(start + 2 * lane, first, there, sem="relaxed")
    tl.atomic_add(start + 2 * lane + 1, second, there, sem="relaxed")
    value, wanted = tl.sum(0.5 * by_yy, 0, keep_dims=True), lane == 0
    if absolute:
        along_x = tl.sum(tl.sum(tl.abs(by_sigma * (a * x + b * y)), 3, keep_dims=True), 0, keep_dims=True)
        along_y = tl.sum(tl.sum(tl.abs(by_sigma * (b * x + c * y)), 3, keep_dims=True), 0, keep_dims=True)
        value = tl.where(lane == 0, value, tl.where(lane == 1, along_x, along_y))
        wanted = lane < 3
    if depth:
        total = tl.sum(tl.sum(by_inverse_z, 3, keep_dims=True), 0, keep_dims=True)
        value = tl.where(lane == stride // 2 + 1, total, value)
        wanted = wanted | (lane == stride // 2 + 1)
    tl.atomic_add(others + stride * gaussian + lane, tl.where(wanted, value, 0.0), there & wanted, sem="relaxed")


@triton.jit(do_not_specialize=NOT_SPECIALIZED)
def _backward_kernel(
    records: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor,
    counts: tl.tensor, images: tl.tensor, by_images: tl.tensor, inverse_depths: tl.tensor, by_depths: tl.tensor,
    gradients: tl.tensor, others: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, known: int, pairs: int,
    rows: tl.constexpr, splats: tl.constexpr, tile: tl.constexpr, record: tl.constexpr,
    absolute: tl.constexpr, family: tl.constexpr, depth: tl.constexpr, stride: tl.constexpr,
) -> None:  # fmt: skip
    # Tensors have the axes (LANES, SPLAT_LANES, splats, rows). Triton spreads the first axes over threads, because it
    # finds no order in the addresses of Gaussians. So the last two are registers of a thread, and sums over rows and
    # products over splats need no shuffles. `_swapped` relies on it; a layout of another release fails the self-check.
    bucket: tl.constexpr = splats * SPLAT_LANES
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    index, image, row, column = place_region(across, tiles, rows, tile)
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    pixel = (row + down) * width + column + along
    at_red, at_green, at_blue = pixels_of(image, pixel, width * height, family)
    red = tl.load(by_images + at_red, inside, 0.0)
    green, blue = tl.load(by_images + at_green, inside, 0.0), tl.load(by_images + at_blue, inside, 0.0)
    behind = red * tl.load(images + at_red, inside, 0.0)
    behind += green * tl.load(images + at_green, inside, 0.0) + blue * tl.load(images + at_blue, inside, 0.0)
    near = inside * 0.0
    if depth:
        near = tl.load(by_depths + image.to(tl.int64) * (width * height) + pixel, inside, 0.0)
        behind += near * tl.load(inverse_depths + image.to(tl.int64) * (width * height) + pixel, inside, 0.0)
    transmittance = tl.where(inside, 1.0, 0.0)
    second = tl.arange(0, splats)[None, None, :, None] == 1  # of a thread's Gaussians

    count = tl.load(counts + tl.program_id(0))
    begin, stop = pairs_of(index, offsets, known, pairs)
    words += first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = next_pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0  # numbers of Gaussians that left the queue and that entered it
    while head < count:
        begin, words, tail, gaussians, word = fill_queue(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        gaussian, there, x, y, a, b, c, opacity, color_r, color_g, color_b, inverse_z = next_bucket(
            queue, head, tail, another, records, splats, record
        )
        head += bucket
        x = x - (column + 0.5 + along)  # (LANES, SPLAT_LANES, splats, 1)
        y = y - (row + 0.5 + down)  # (LANES, SPLAT_LANES, splats, rows)
        alpha, density = alphas_of(x, y, a, b, c, opacity, there, family)
        inverse = inverse_of(1.0 - alpha)
        before, after, transmittance = transmittances_of(alpha, transmittance)
        alpha = tl.where(after > LEAST, alpha, 0.0)  # the pixel ends before
        weight = alpha * before
        shade = color_r * red + color_g * green + color_b * blue
        if depth:
            shade += inverse_z * near
        added = weight * shade
        by_both = tl.sum(added, 2, keep_dims=True)
        by_first = tl.sum(tl.where(second, 0.0, added), 2, keep_dims=True)
        added_before, by_all = before_and_all(by_both, adds=True)
        still_behind = (behind - added_before) - tl.where(second, by_both, by_first)
        behind -= by_all
        # The gradient by alpha, times -alpha.
        by_sigma = still_behind * (alpha * inverse) - added
        if family:  # the gradient passes the limit
            by_sigma *= tl.maximum(density * (1.0 / OPAQUEST_OF_FAMILY), 1.0)
        else:
            by_sigma = tl.where(alpha < OPAQUEST, by_sigma, 0.0)
        _add_gradients(
            x, y, a, b, c, opacity, by_sigma, weight * red, weight * green, weight * blue, weight * near,
            gaussian, there, gradients, others, absolute, depth, stride,
        )  # fmt: skip


def blend_forward(
    records: Tensor, background: Tensor, offsets: Tensor, flat: Tensor, size: tuple[int, int], count: int,
    shape: Shape = SHAPE, alphas: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Blend the Gaussians of each tile by gsplat's rules; arguments are contiguous.

    Args:
        records: (c, n, RECORD) float32 of c cameras, or (n, RECORD) of several images' Gaussians in one list; numbers
            of Gaussians in no tile are never read.
        background: (3,) float32, or (c, 3) with one of each image.
        offsets: (c · tiles down · tiles across,) int32, the first pair of each tile; or one more, the number of pairs.
        flat: (p,) int32, the Gaussian of each pair, counted over all cameras; front to back in a tile. With the number
            of pairs it may be longer.
        size: (width, height) of the images.
        count: of images.
        shape: of a program's work.
        alphas: (c, h, w), to be filled with the opacities of records by `Rules.alpha`.

    Returns:
        Images (c, h, w, 3); the number of Gaussians in each region that reach it before all its pixels end; and
        words whose bits say which pairs reach a region.
    """
    images = records.new_empty(count, size[1], size[0], 3)
    rules, beside = (GSPLAT, images) if alphas is None else (GSPLAT._replace(depth=True), alphas)
    return images, *_blend(records, background, offsets, flat, images, beside, rules, 1.0, shape)


def blend_family(
    records: Tensor, background: Tensor, offsets: Tensor, flat: Tensor, size: tuple[int, int], rules: Rules,
    mult: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Blend the Gaussians of each tile by the family's rules; arguments are contiguous.

    Args:
        records, background, offsets, flat, size: as `blend_forward` takes them; of one camera.
        mult: as in `kernels.Numbers`.

    Returns:
        Image (1, 3, h, w); 1 / depth (1, h, w), empty without `rules.depth`; and counts and words as `blend_forward`.
    """
    image = records.new_empty(1, 3, size[1], size[0])
    inverse_depths = records.new_empty(1, *((size[1], size[0]) if rules.depth else (0, 0)))
    return image, inverse_depths, *_blend(records, background, offsets, flat, image, inverse_depths, rules, mult, SHAPE)


def _blend(
    records: Tensor, background: Tensor, offsets: Tensor, flat: Tensor, images: Tensor, inverse_depths: Tensor,
    rules: Rules, mult: float, shape: Shape,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    programs, numbers = launch_of(offsets, flat, _size_of(images, rules), images.shape[0], shape)
    words = flat.new_empty((flat.numel() // WARP + offsets.numel()) * shape.regions)
    launch(
        reach_kernel, (programs // shape.regions,),
        records, offsets, flat, words, *numbers[2:], mult,
        columns=COLUMNS, rows=shape.rows, tile=TILE, record=RECORD, threads=WARP * REACH_WARPS, snug=rules.snug,
        num_warps=REACH_WARPS,
    )  # fmt: skip
    counts = flat.new_empty(programs)
    launch(
        _forward_kernel, (programs,),
        records, background, offsets, flat, words, images, inverse_depths, counts,
        flat.new_empty(programs, QUEUE.value),
        *numbers, 3 if background.ndim == 2 else 0, rows=shape.rows, splats=shape.splats, tile=TILE, record=RECORD,
        family=rules.family, depth=rules.depth, num_warps=1, **at_most(FORWARD_REGISTERS),
    )  # fmt: skip
    return counts, words


def blend_backward(
    records: Tensor, offsets: Tensor, flat: Tensor, images: Tensor, counts: Tensor, words: Tensor,
    by_images: Tensor, absolute: bool, shape: Shape = SHAPE, rules: Rules = GSPLAT,
    inverse_depths: tuple[Tensor, Tensor] | None = None, zeros: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the gradients of blending by what it read of each Gaussian; arguments are contiguous.

    Args:
        records: (c, n, RECORD).
        offsets, flat: as `blend_forward` takes them.
        images, counts, words: its results, or those of `blend_family`, made with the same shape.
        by_images: as many numbers, the gradient by the images.
        absolute: also sum the absolute values of the gradient by centres.
        shape: of a program's work.
        rules: those that the images were made by.
        inverse_depths: with `rules.depth`, those of `blend_family`, or opacities, and the gradient by them.
        zeros: (c * n * (GRADIENT + OTHERS),) or more, to be used for the result; None for new ones.

    Returns:
        Gradients (c, n, GRADIENT) by red, green, blue, opacity, x, y, a and b; and the others (c, n, OTHERS).
    """
    programs, numbers = launch_of(offsets, flat, _size_of(images, rules), images.shape[0], shape)
    assert counts.numel() == programs
    count, stride = records.numel() // RECORD, OTHERS[absolute, rules.depth]
    if zeros is None:
        zeros = records.new_zeros((GRADIENT + stride) * count)  # in one launch
    first, leading = GRADIENT * count, records.shape[:-1]
    gradients = zeros[:first].view(*leading, GRADIENT)
    others = zeros[first : first + stride * count].view(*leading, stride)
    launch(
        _backward_kernel, (programs,),
        records, offsets, flat, words, counts, images, by_images, *(inverse_depths or (images, images)),
        gradients, others, flat.new_empty(programs, QUEUE.value), *numbers,
        rows=shape.rows, splats=shape.splats, tile=TILE, record=RECORD,
        absolute=absolute, family=rules.family, depth=rules.depth, stride=stride, num_warps=1,
        **at_most(BACKWARD_REGISTERS),
    )  # fmt: skip
    return gradients, others


def _size_of(images: Tensor, rules: Rules) -> tuple[int, int]:
    """Return (width, height)."""
    return (images.shape[3], images.shape[2]) if rules.family else (images.shape[2], images.shape[1])
