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

import os
from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.records import GRADIENT, RECORD, TILE, grid_of
from lapgs_plugin.gpu_raster.rules import GSPLAT, Rules
from lapgs_plugin.ops.launch import launch
from lapgs_plugin.reference_raster.layout import MAX_ALPHA

WARP = 32
COLUMNS = 4
LANES, SPLAT_LANES = tl.constexpr(COLUMNS), tl.constexpr(WARP // COLUMNS)
"""A warp's threads: this many columns of pixels by this many Gaussians."""
AT_ONCE, QUEUE = tl.constexpr(2 * WARP), tl.constexpr(4 * WARP)
"""Pairs that a warp reads at once, and places in its queue: for as many and almost a bucket."""
OF_GRADIENT = tl.constexpr(GRADIENT)
LOG2_E = tl.constexpr(1.4426950408889634)
FAINTEST = tl.constexpr(1 / 255)
OPAQUEST, OPAQUEST_OF_FAMILY = tl.constexpr(0.999), tl.constexpr(MAX_ALPHA)
LEAST = tl.constexpr(1e-4)
"""Transmittance that no pixel goes below: it ends before."""
INTERPRETED = tl.constexpr(os.environ.get("TRITON_INTERPRET") == "1")  # Triton's interpreter knows no assembly

# Kernels are not compiled anew for other sizes.
NOT_SPECIALIZED = ("width", "height", "across", "tiles", "known", "pairs")


class Shape(NamedTuple):
    """Lay out a warp's region and its bucket of Gaussians in its threads; both are powers of 2.

    Attributes:
        rows: of the region, which has `COLUMNS` columns; they are in the registers of a thread.
        splats: Gaussians in the registers of a thread, 1 or 2.
    """

    rows: int = 4
    splats: int = 2

    @property
    def regions(self) -> int:
        """Number of regions in a tile."""
        return (TILE // COLUMNS) * (TILE // self.rows)


SHAPE = Shape()
REACH_WARPS = 4
"""Of a program of the launch before; each thread tests a pair at once."""
FORWARD_REGISTERS, BACKWARD_REGISTERS = 72, 80
"""At most for a thread: with fewer for each, an H200 runs more warps beside each other, until they do not suffice."""


@triton.jit
def _multiply(a: tl.tensor, b: tl.tensor) -> tl.tensor:
    return a * b


@triton.jit
def _exp2(x: tl.tensor) -> tl.tensor:
    """Return 2 ** x; where compiled, in one instruction instead of four, with 0 for denormal results."""
    if INTERPRETED:
        return tl.exp2(x)
    return tl.inline_asm_elementwise("ex2.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit
def _inverse(x: tl.tensor) -> tl.tensor:
    """Return 1 / x of numbers that are neither denormal nor huge, to one unit in the last place."""
    if INTERPRETED:
        return 1.0 / x
    return tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit
def load_four(start: tl.tensor) -> tl.tensor:
    """Load four numbers that begin at a multiple of 16 bytes; where compiled, in one instruction."""
    if INTERPRETED:
        return tl.load(start), tl.load(start + 1), tl.load(start + 2), tl.load(start + 3)
    return tl.inline_asm_elementwise(
        "ld.global.nc.v4.f32 {$0, $1, $2, $3}, [$4];", "=f,=f,=f,=f,l", [start],
        (tl.float32, tl.float32, tl.float32, tl.float32), True, 1,
    )  # fmt: skip


@triton.jit
def _swapped(x: tl.tensor, axis: tl.constexpr, bit: tl.constexpr) -> tl.tensor:
    """Return, in each thread, `x` of the thread whose index along `axis`, 0 or 1, differs in one bit.

    The index along axis 1 is a thread's number divided by `LANES`, that along axis 0 the remainder. Triton gives
    threads to axes in that order, because it finds no order in the addresses of Gaussians.
    """
    if INTERPRETED:
        size: tl.constexpr = LANES if axis == 0 else SPLAT_LANES
        others = tl.arange(0, size)[:, None] == (tl.arange(0, size) ^ bit)[None, :]
        if axis == 0:
            return tl.sum(tl.where(others[:, :, None, None, None], x[None], 0.0), 1)
        return tl.sum(tl.where(others[None, :, :, None, None], x[:, None], 0.0), 2)
    step: tl.constexpr = bit if axis == 0 else bit * LANES
    return tl.inline_asm_elementwise(
        "shfl.sync.bfly.b32 $0, $1, $2, 0x1f, 0xffffffff;", "=f,f,r", [x, step], tl.float32, False, 1
    )


@triton.jit
def _ballot(wanted: tl.tensor) -> tl.tensor:
    """Return, in all threads of a warp, a bit for each of them; `wanted` is (threads,)."""
    if INTERPRETED:
        bits = tl.reshape(wanted.to(tl.int32) << (tl.arange(0, wanted.shape[0]) % 32), (wanted.shape[0] // 32, 32))
        return tl.reshape(tl.broadcast_to(tl.sum(bits, 1)[:, None], bits.shape), wanted.shape)
    return tl.inline_asm_elementwise(
        "{ .reg .pred wanted; setp.ne.s32 wanted, $1, 0; vote.sync.ballot.b32 $0, wanted, 0xffffffff; }", "=r,r",
        [wanted.to(tl.int32)], tl.int32, False, 1,
    )  # fmt: skip


@triton.jit
def _count_bits(x: tl.tensor) -> tl.tensor:
    """Return how many bits of each number are set."""
    if INTERPRETED:
        count = tl.zeros_like(x)
        for i in tl.static_range(32):
            count += (x >> i) & 1
        return count
    return tl.inline_asm_elementwise("popc.b32 $0, $1;", "=r,r", [x], tl.int32, True, 1)


@triton.jit
def _before(x: tl.tensor, adds: tl.constexpr) -> tuple[tl.tensor, tl.tensor]:
    """Return the sum, or else the product, of `x` over the Gaussians before each along axis 1, and over all."""
    index = tl.arange(0, SPLAT_LANES)[None, :, None, None]
    before = tl.zeros_like(x) if adds else tl.zeros_like(x) + 1.0
    for i in tl.static_range(5):
        if (1 << i) < SPLAT_LANES:
            other = _swapped(x, 1, 1 << i)
            before = tl.where(index & (1 << i) != 0, before + other if adds else before * other, before)
            x = x + other if adds else x * other
    return before, x


@triton.jit
def _sum_of_pair(one: tl.tensor, other: tl.tensor, bit: tl.constexpr) -> tl.tensor:
    """Add up two threads' values along axis 0: those of `one` in the thread without the bit, of `other` in that with.

    Tensors have the axes (LANES, SPLAT_LANES, splats, 1).
    """
    has = (tl.arange(0, LANES) & bit != 0)[:, None, None, None]
    return tl.where(has, other, one) + _swapped(tl.where(has, one, other), 0, bit)


@triton.jit
def meets(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, limit: tl.tensor, share: tl.constexpr,
    width: tl.constexpr, height: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return whether half the squared distance from a centre is within a limit at some point of [0, w] x [0, h].

    The distance is convex, so that it is least on a side that faces the centre, or is 0 at the centre. Of its terms
    that are squares only a share counts.
    """
    near_x = tl.minimum(tl.maximum(x - width, 0.0), x)  # difference to the nearest column
    near_y = tl.minimum(tl.maximum(y - height, 0.0), y)
    on_column = tl.minimum(tl.maximum(-b * near_x * _inverse(c), y - height), y)
    on_row = tl.minimum(tl.maximum(-b * near_y * _inverse(a), x - width), x)
    square = 0.5 * (a * near_x * near_x + c * on_column * on_column)
    found = square * share + b * near_x * on_column <= limit
    square = 0.5 * (a * on_row * on_row + c * near_y * near_y)
    return found | (square * share + b * on_row * near_y <= limit)


@triton.jit
def _reaches(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor,
    width: tl.constexpr, height: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return whether alpha may reach `FAINTEST` at a pixel; x and y are centres relative to the first pixel's."""
    limit = tl.log(opacity / FAINTEST) + 0.01  # with room for rounding, which grows with the terms of the exponent
    return meets(x, y, a, b, c, limit, 0.99999, width - 1, height - 1)


@triton.jit
def _region(
    across: int, tiles: int, rows: tl.constexpr, tile: tl.constexpr
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:
    """Return the program's tile over all images, its image, and the first row and column of its region."""
    region = tl.program_id(0)
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    index = region // regions
    row = (index % tiles) // across * tile + region % regions // (tile // LANES) * rows
    column = (index % tiles) % across * tile + region % (tile // LANES) * LANES
    return index, index // tiles, row, column


@triton.jit
def _pairs_of(index: tl.tensor, offsets: tl.tensor, known: int, pairs: int) -> tuple[tl.tensor, tl.tensor]:
    """Return the first pair of a tile, and the one after its last; `known` offsets are in memory."""
    return tl.load(offsets + index), tl.load(offsets + index + 1, index + 1 < known, pairs)


@triton.jit(do_not_specialize=("across", "tiles", "known", "pairs"))
def _reach_kernel(
    records: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor,
    across: int, tiles: int, known: int, pairs: int, mult: float,
    columns: tl.constexpr, rows: tl.constexpr, tile: tl.constexpr, record: tl.constexpr, threads: tl.constexpr,
    snug: tl.constexpr,
) -> None:  # fmt: skip
    """Write which of the tile's pairs reach each of its regions, a bit for each pair.

    `snug` leaves out those whose ellipse, which `mult` shrinks, does not meet the tile.
    """
    index = tl.program_id(0)
    row, column = (index % tiles) // across * tile, (index % tiles) % across * tile
    regions: tl.constexpr = (tile // columns) * (tile // rows)
    begin, stop = _pairs_of(index, offsets, known, pairs)
    block = _first_word(index, begin, regions)
    thread = tl.arange(0, threads)
    while begin < stop:
        there = begin + thread < stop
        gaussian = tl.load(flat + begin + thread, there, tl.load(flat + begin))
        x, y, a, b = load_four(records + record * gaussian)
        c, opacity, _, _ = load_four(records + record * gaussian + 4)
        x, y = x - (column + 0.5), y - (row + 0.5)
        if snug:
            there = there & meets(x, y, a, b, c, mult * tl.log(opacity / FAINTEST), 1.0, tile, tile)
        word = tl.zeros((threads,), tl.int32)  # of the region that has a thread's number in its warp
        for region in tl.static_range(regions):
            left, top = region % (tile // columns) * columns, region // (tile // columns) * rows
            reaches = there & _reaches(x - left, y - top, a, b, c, opacity, columns, rows)
            word = tl.where(thread % 32 == region, _ballot(reaches), word)
        wanted = (thread % 32 < regions) & (begin + thread // 32 * 32 < stop)
        tl.store(words + block + thread // 32 * regions + thread % 32, word, wanted)
        begin += threads
        block += threads // 32 * regions


@triton.jit
def _first_word(index: tl.tensor, begin: tl.tensor, regions: tl.constexpr) -> tl.tensor:
    """Return where the words of a tile begin: they have 32 pairs each, the last one of a tile maybe fewer."""
    return (begin // 32 + index) * regions


@triton.jit
def _pairs(
    begin: tl.tensor, stop: tl.tensor, flat: tl.tensor, words: tl.tensor, regions: tl.constexpr
) -> tuple[tl.tensor, tl.tensor]:
    """Load the next `AT_ONCE` pairs: their Gaussians, and the words that say for each 32 which reach the region."""
    pair = tl.arange(0, AT_ONCE)
    gaussian = tl.load(flat + begin + pair, begin + pair < stop, 0)
    return gaussian, tl.load(words + pair // 32 * regions, begin + pair // 32 * 32 < stop, 0)


@triton.jit
def _fill(
    queue: tl.tensor, begin: tl.tensor, stop: tl.tensor, head: tl.tensor, tail: tl.tensor,
    gaussian: tl.tensor, word: tl.tensor, flat: tl.tensor, words: tl.tensor,
    regions: tl.constexpr, bucket: tl.constexpr,
) -> tuple[tl.tensor, ...]:  # fmt: skip
    """Put Gaussians that reach the region in the queue, until it has a bucket of them or the pairs end.

    Args:
        gaussian, word: of the next `AT_ONCE` pairs. Those after are loaded before they are needed, because loading
            takes as long as blending many Gaussians.

    Returns:
        The next pair and its word, how many Gaussians have entered the queue, and the next `gaussian` and `word`.
    """
    pair = tl.arange(0, AT_ONCE)
    while (begin < stop) & (tail - head < bucket):
        wanted = (word >> (pair % 32)) & 1
        before = _count_bits(word & ((1 << (pair % 32)) - 1))
        before += tl.where(pair < 32, 0, tl.sum(tl.where(pair < 32, wanted, 0), 0))
        slot = (tail + before) & (QUEUE - 1)
        tl.debug_barrier()  # all threads have read the bucket before
        tl.store(queue + slot, gaussian, wanted != 0)
        tail += tl.sum(wanted, 0)
        begin += AT_ONCE
        words += AT_ONCE // 32 * regions
        gaussian, word = _pairs(begin, stop, flat, words, regions)
        tl.debug_barrier()  # threads read what others wrote
    return begin, words, tail, gaussian, word


@triton.jit
def _bucket(
    queue: tl.tensor, head: tl.tensor, tail: tl.tensor, another: tl.tensor, records: tl.tensor,
    splats: tl.constexpr, record: tl.constexpr,
) -> tuple[tl.tensor, ...]:  # fmt: skip
    """Load the queue's next bucket: Gaussians, whether they are there, x, y, a, b, c, opacity, colours and 1 / depth.

    Those that are not there have the numbers of the last Gaussian, or of `another`, which are finite.
    """
    # Which Gaussian of a bucket an element is; those in one thread are consecutive.
    order = tl.arange(0, SPLAT_LANES)[None, :, None, None] * splats + tl.arange(0, splats)[None, None, :, None]
    order = tl.broadcast_to(order, (LANES, SPLAT_LANES, splats, 1)) + head
    gaussian = tl.load(queue + (tl.minimum(order, tail - 1) & (QUEUE - 1)), tail > 0, another)
    x, y, a, b = load_four(records + record * gaussian)
    c, opacity, _, _ = load_four(records + record * gaussian + 4)
    red, green, blue, inverse_z = load_four(records + record * gaussian + 8)
    tl.debug_barrier()  # tells the assembler that all threads are here, which saves registers and branches
    return gaussian, order < tail, x, y, a, b, c, opacity, red, green, blue, inverse_z


@triton.jit
def _alphas(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor, there: tl.tensor,
    family: tl.constexpr,
) -> tuple[tl.tensor, tl.tensor]:  # fmt: skip
    """Return alphas, 0 where they are below `FAINTEST`, and as they were; `x` and `y` are centres less pixels."""
    # The exponent of 2; most of it is the same in all rows.
    power = (a * (-0.5 * LOG2_E)) * x * x + y * (b * (-LOG2_E) * x + c * (-0.5 * LOG2_E) * y)
    density = opacity * _exp2(power)
    alpha = tl.minimum(density, OPAQUEST_OF_FAMILY if family else OPAQUEST)
    return tl.where(there & (power <= 0.0) & (alpha >= FAINTEST), alpha, 0.0), density


@triton.jit
def _pixels(
    image: tl.tensor, place: tl.tensor, size: tl.tensor, planar: tl.constexpr
) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Return where red, green and blue of pixels are in images (c, h, w, 3), or (c, 3, h, w) if `planar`."""
    start = 3 * (image.to(tl.int64) * size)
    if planar:
        return start + place, start + size + place, start + 2 * size + place
    return start + 3 * place, start + 3 * place + 1, start + 3 * place + 2


@triton.jit
def _transmittances(alpha: tl.tensor, transmittance: tl.tensor) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Return the transmittances before and after each Gaussian, and after the bucket."""
    left = 1.0 - alpha
    second = tl.arange(0, alpha.shape[2])[None, None, :, None] == 1  # of a thread's Gaussians
    by_both = tl.reduce(left, 2, _multiply, keep_dims=True)
    by_first = tl.reduce(tl.where(second, 1.0, left), 2, _multiply, keep_dims=True)
    before, by_all = _before(by_both, adds=False)
    before *= transmittance
    after = before * tl.where(second, by_both, by_first)
    return before * tl.where(second, by_first, 1.0), after, transmittance * by_all


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
    index, image, row, column = _region(across, tiles, rows, tile)
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    transmittance = tl.where(inside, 1.0, 0.0)
    # Sums over the Gaussians of each thread.
    red, green, blue, cover = inside * 0.0, inside * 0.0, inside * 0.0, inside * 0.0
    near = inside * 0.0

    begin, stop = _pairs_of(index, offsets, known, pairs)
    words += _first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = _pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0
    begin, words, tail, gaussians, word = _fill(
        queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
    )
    _, there, x, y, a, b, c, opacity, color_r, color_g, color_b, inverse_z = _bucket(
        queue, head, tail, another, records, splats, record
    )
    while head < tail:
        # The next bucket is loaded before this one is blended, because loading takes as long.
        head += bucket
        begin, words, tail, gaussians, word = _fill(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        following = _bucket(queue, head, tail, another, records, splats, record)
        alpha, _ = _alphas(x - (column + 0.5 + along), y - (row + 0.5 + down), a, b, c, opacity, there, family)
        before, after, transmittance = _transmittances(alpha, transmittance)
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

    place = (row + down) * width + column + along
    at_red, at_green, at_blue = _pixels(image, place, width * height, family)
    left = 1.0 - tl.sum(cover, 1, keep_dims=True)
    background += of_background * image
    tl.store(images + at_red, tl.sum(red, 1, keep_dims=True) + left * tl.load(background), inside)
    tl.store(images + at_green, tl.sum(green, 1, keep_dims=True) + left * tl.load(background + 1), inside)
    tl.store(images + at_blue, tl.sum(blue, 1, keep_dims=True) + left * tl.load(background + 2), inside)
    if depth:
        tl.store(inverse_depths + place, tl.sum(near, 1, keep_dims=True), inside)


@triton.jit
def _add_gradients(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor,
    by_sigma: tl.tensor, by_red: tl.tensor, by_green: tl.tensor, by_blue: tl.tensor,
    by_inverse_z: tl.tensor, gaussian: tl.tensor, there: tl.tensor, gradients: tl.tensor, others: tl.tensor,
    absolute: tl.constexpr, depth: tl.constexpr,
) -> None:  # fmt: skip
    """Add a bucket's gradients, summed over pixels, to those of all tiles.

    `x` and `y` are a Gaussian's centre less a pixel's, `by_sigma` the gradient by half its squared distance.
    """
    # Sums over rows; x is the same in all of them.
    plain, by_y = tl.sum(by_sigma, 3, keep_dims=True), tl.sum(by_sigma * y, 3, keep_dims=True)
    by_yy, by_x = tl.sum(by_sigma * y * y, 3, keep_dims=True), plain * x
    red, green = tl.sum(by_red, 3, keep_dims=True), tl.sum(by_green, 3, keep_dims=True)
    blue, faint = tl.sum(by_blue, 3, keep_dims=True), -plain * _inverse(opacity)
    # Sums over columns: of a pair of threads each keeps four of eight values, and then two, instead of all in each.
    # What is left in the thread of column i are the numbers 2 i and 2 i + 1 of a Gaussian's `GRADIENT` ones.
    of_red = _sum_of_pair(red, a * by_x + b * by_y, 2)
    of_green = _sum_of_pair(green, b * by_x + c * by_y, 2)
    of_blue = _sum_of_pair(blue, 0.5 * by_x * x, 2)
    of_opacity = _sum_of_pair(faint, by_y * x, 2)
    first = _sum_of_pair(of_red, of_blue, 1)
    second = _sum_of_pair(of_green, of_opacity, 1)
    lane = tl.arange(0, LANES)[:, None, None, None]
    start = gradients + OF_GRADIENT * gaussian
    tl.atomic_add(start + 2 * lane, first, there, sem="relaxed")
    tl.atomic_add(start + 2 * lane + 1, second, there, sem="relaxed")
    # The others: by c, two absolute sums, by 1 / depth.
    each: tl.constexpr = 1 + (2 if absolute else 0) + (1 if depth else 0)
    value = tl.where(lane == 0, tl.sum(0.5 * by_yy, 0, keep_dims=True), 0.0)
    if absolute:
        along_x = tl.sum(tl.sum(tl.abs(by_sigma * (a * x + b * y)), 3, keep_dims=True), 0, keep_dims=True)
        along_y = tl.sum(tl.sum(tl.abs(by_sigma * (b * x + c * y)), 3, keep_dims=True), 0, keep_dims=True)
        value = tl.where(lane == 1, along_x, tl.where(lane == 2, along_y, value))
    if depth:
        total = tl.sum(tl.sum(by_inverse_z, 3, keep_dims=True), 0, keep_dims=True)
        value = tl.where(lane == each - 1, total, value)
    tl.atomic_add(others + each * gaussian + lane, value, there & (lane < each), sem="relaxed")


@triton.jit(do_not_specialize=NOT_SPECIALIZED)
def _backward_kernel(
    records: tl.tensor, offsets: tl.tensor, flat: tl.tensor, words: tl.tensor,
    counts: tl.tensor, images: tl.tensor, by_images: tl.tensor, inverse_depths: tl.tensor, by_depths: tl.tensor,
    gradients: tl.tensor, others: tl.tensor, queues: tl.tensor,
    width: int, height: int, across: int, tiles: int, known: int, pairs: int,
    rows: tl.constexpr, splats: tl.constexpr, tile: tl.constexpr, record: tl.constexpr,
    absolute: tl.constexpr, family: tl.constexpr, depth: tl.constexpr,
) -> None:  # fmt: skip
    # Tensors have the axes (LANES, SPLAT_LANES, splats, rows). Triton spreads the first axes over threads, because it
    # finds no order in the addresses of Gaussians. So the last two are registers of a thread, and sums over rows and
    # products over splats need no shuffles. `_swapped` relies on it; a layout of another release fails the self-check.
    bucket: tl.constexpr = splats * SPLAT_LANES
    regions: tl.constexpr = (tile // LANES) * (tile // rows)
    index, image, row, column = _region(across, tiles, rows, tile)
    along = tl.broadcast_to(tl.arange(0, LANES)[:, None, None, None], (LANES, SPLAT_LANES, 1, 1))
    down = tl.broadcast_to(tl.arange(0, rows)[None, None, None, :], (LANES, SPLAT_LANES, 1, rows))
    inside = (column + along < width) & (row + down < height)
    place = (row + down) * width + column + along
    at_red, at_green, at_blue = _pixels(image, place, width * height, family)
    red = tl.load(by_images + at_red, inside, 0.0)
    green, blue = tl.load(by_images + at_green, inside, 0.0), tl.load(by_images + at_blue, inside, 0.0)
    behind = red * tl.load(images + at_red, inside, 0.0)
    behind += green * tl.load(images + at_green, inside, 0.0) + blue * tl.load(images + at_blue, inside, 0.0)
    near = inside * 0.0
    if depth:
        near = tl.load(by_depths + place, inside, 0.0)
        behind += near * tl.load(inverse_depths + place, inside, 0.0)
    transmittance = tl.where(inside, 1.0, 0.0)
    second = tl.arange(0, splats)[None, None, :, None] == 1  # of a thread's Gaussians

    count = tl.load(counts + tl.program_id(0))
    begin, stop = _pairs_of(index, offsets, known, pairs)
    words += _first_word(index, begin, regions) + tl.program_id(0) % regions
    another, queue = tl.load(flat + begin, begin < stop, 0), queues + tl.program_id(0) * QUEUE
    gaussians, word = _pairs(begin, stop, flat, words, regions)
    head, tail = 0, 0  # numbers of Gaussians that left the queue and that entered it
    while head < count:
        begin, words, tail, gaussians, word = _fill(
            queue, begin, stop, head, tail, gaussians, word, flat, words, regions, bucket
        )
        gaussian, there, x, y, a, b, c, opacity, color_r, color_g, color_b, inverse_z = _bucket(
            queue, head, tail, another, records, splats, record
        )
        head += bucket
        x = x - (column + 0.5 + along)  # (LANES, SPLAT_LANES, splats, 1)
        y = y - (row + 0.5 + down)  # (LANES, SPLAT_LANES, splats, rows)
        alpha, density = _alphas(x, y, a, b, c, opacity, there, family)
        inverse = _inverse(1.0 - alpha)
        before, after, transmittance = _transmittances(alpha, transmittance)
        alpha = tl.where(after > LEAST, alpha, 0.0)  # the pixel ends before
        weight = alpha * before
        shade = color_r * red + color_g * green + color_b * blue
        if depth:
            shade += inverse_z * near
        added = weight * shade
        by_both = tl.sum(added, 2, keep_dims=True)
        by_first = tl.sum(tl.where(second, 0.0, added), 2, keep_dims=True)
        added_before, by_all = _before(by_both, adds=True)
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
            gaussian, there, gradients, others, absolute, depth,
        )  # fmt: skip


def blend_forward(
    records: Tensor, background: Tensor, offsets: Tensor, flat: Tensor, size: tuple[int, int], count: int,
    shape: Shape = SHAPE,
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

    Returns:
        Images (c, h, w, 3); the number of Gaussians in each region that reach it before all its pixels end; and
        words whose bits say which pairs reach a region.
    """
    images = records.new_empty(count, size[1], size[0], 3)
    return images, *_blend(records, background, offsets, flat, images, images, GSPLAT, 1.0, shape)


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
    programs, numbers = _launch_of(offsets, flat, _size_of(images, rules), len(images), shape)
    words = flat.new_empty((len(flat) // WARP + len(offsets)) * shape.regions)
    launch(
        _reach_kernel, (programs // shape.regions,),
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
        family=rules.family, depth=rules.depth, num_warps=1, maxnreg=FORWARD_REGISTERS,
    )  # fmt: skip
    return counts, words


def blend_backward(
    records: Tensor, offsets: Tensor, flat: Tensor, images: Tensor, counts: Tensor, words: Tensor,
    by_images: Tensor, absolute: bool, shape: Shape = SHAPE, rules: Rules = GSPLAT,
    inverse_depths: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the gradients of blending by what it read of each Gaussian; arguments are contiguous.

    Args:
        records: (c, n, RECORD).
        offsets, flat: as `blend_forward` takes them.
        images, counts, words: its results, or those of `blend_family`, made with the same shape.
        by_images: gradient by the images.
        absolute: also sum the absolute values of the gradient by centres.
        shape: of a program's work.
        rules: those that the images were made by.
        inverse_depths: with `rules.depth`, the result of `blend_family` and the gradient by it.

    Returns:
        Gradients (c, n, GRADIENT) by red, green, blue, opacity, x, y, a and b; and (c, n, 1 to 4) by c, the absolute
        sums of those by x and y if asked for, and that by 1 / depth with `rules.depth`.
    """
    programs, numbers = _launch_of(offsets, flat, _size_of(images, rules), len(images), shape)
    assert len(counts) == programs
    count, each = records.numel() // RECORD, 1 + 2 * absolute + rules.depth
    zeros = records.new_zeros((GRADIENT + each) * count)  # in one launch
    found, others = zeros[: GRADIENT * count], zeros[GRADIENT * count :]
    launch(
        _backward_kernel, (programs,),
        records, offsets, flat, words, counts, images, by_images, *(inverse_depths or (images, images)), found, others,
        flat.new_empty(programs, QUEUE.value), *numbers,
        rows=shape.rows, splats=shape.splats, tile=TILE, record=RECORD,
        absolute=absolute, family=rules.family, depth=rules.depth, num_warps=1, maxnreg=BACKWARD_REGISTERS,
    )  # fmt: skip
    leading = records.shape[:-1]
    return found.view(*leading, GRADIENT), others.view(*leading, each)


def _size_of(images: Tensor, rules: Rules) -> tuple[int, int]:
    """Return (width, height)."""
    return (images.shape[3], images.shape[2]) if rules.family else (images.shape[2], images.shape[1])


def _launch_of(
    offsets: Tensor, flat: Tensor, size: tuple[int, int], count: int, shape: Shape
) -> tuple[int, tuple[int, ...]]:
    """Return the number of programs and the arguments named in `NOT_SPECIALIZED`."""
    across, down = grid_of(size)
    return count * across * down * shape.regions, (*size, across, across * down, len(offsets), len(flat))
