"""Go through the Gaussians of a tile in Triton, one warp for each region of it.

A warp holds a bucket of Gaussians by all pixels of its region. A launch before finds which regions of its tile each
Gaussian reaches, so that a region skips the others. What is read of a Gaussian lies together in memory. Blending, its
gradients and sums over pixels go this way.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.memory_kernels import PLAIN, load_four
from lapgs_plugin.gpu_raster.records import TILE, grid_of
from lapgs_plugin.reference_raster.layout import MAX_ALPHA

WARP = 32
"""Threads of a warp."""
COLUMNS = 4
"""Columns of pixels of a warp's region."""
LANES = tl.constexpr(COLUMNS)
"""Threads of a warp along columns of pixels."""
SPLAT_LANES = tl.constexpr(WARP // COLUMNS)
"""Threads of a warp along Gaussians."""
AT_ONCE = tl.constexpr(2 * WARP)
"""Pairs that a warp reads at once."""
QUEUE = tl.constexpr(4 * WARP)
"""Places in a warp's queue of pairs: for as many as it reads at once, and almost a bucket."""
LOG2_E = tl.constexpr(1.4426950408889634)
"""Logarithm of e to base 2."""
FAINTEST = tl.constexpr(1 / 255)
"""Alpha below which a Gaussian does not blend into a pixel."""
OPAQUEST = tl.constexpr(0.999)
"""Largest alpha of a Gaussian in a pixel by gsplat's rules."""
OPAQUEST_OF_FAMILY = tl.constexpr(MAX_ALPHA)
"""Largest alpha of a Gaussian in a pixel by the 3DGS family's rules."""
LEAST = tl.constexpr(1e-4)
"""Transmittance that no pixel goes below: it ends before."""

NOT_SPECIALIZED = ("width", "height", "across", "tiles", "known", "pairs")
"""Arguments for whose values no kernel is compiled anew: they follow the image's size and the field's."""


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
"""Layout of launches that name no other."""
REACH_WARPS = 4
"""Warps of a program of `reach_kernel`; each thread tests a pair."""


@triton.jit
def _multiply(a: tl.tensor, b: tl.tensor) -> tl.tensor:
    return a * b


@triton.jit
def _exp2(x: tl.tensor) -> tl.tensor:
    """Return 2 ** x; on NVIDIA's, in one instruction instead of four, with 0 for denormal results."""
    if PLAIN:
        return tl.exp2(x)
    return tl.inline_asm_elementwise("ex2.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit
def inverse_of(x: tl.tensor) -> tl.tensor:
    """Return 1 / x of numbers that are neither denormal nor huge, to one unit in the last place."""
    if PLAIN:
        return 1.0 / x
    return tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [x], tl.float32, True, 1)


@triton.jit
def _swapped(x: tl.tensor, axis: tl.constexpr, bit: tl.constexpr) -> tl.tensor:
    """Return, in each thread, `x` of the thread whose index along `axis`, 0 or 1, differs in one bit.

    The index along axis 1 is a thread's number divided by `LANES`, that along axis 0 the remainder. Triton gives
    threads to axes in that order, because it finds no order in the addresses of Gaussians.
    """
    if PLAIN:
        size: tl.constexpr = LANES if axis == 0 else SPLAT_LANES
        others = tl.arange(0, size)[:, None] == (tl.arange(0, size) ^ bit)[None, :]
        if axis == 0:  # with an else: Triton compiles what follows a return in a branch, too
            moved = tl.sum(tl.where(others[:, :, None, None, None], x[None], 0.0), 1)
        else:
            moved = tl.sum(tl.where(others[None, :, :, None, None], x[:, None], 0.0), 2)
        return moved
    step: tl.constexpr = bit if axis == 0 else bit * LANES
    return tl.inline_asm_elementwise(
        "shfl.sync.bfly.b32 $0, $1, $2, 0x1f, 0xffffffff;", "=f,f,r", [x, step], tl.float32, False, 1
    )


@triton.jit
def _ballot(wanted: tl.tensor) -> tl.tensor:
    """Return, in all threads of a warp, a bit for each of them; `wanted` is (threads,)."""
    if PLAIN:
        bits = tl.reshape(wanted.to(tl.int32) << (tl.arange(0, wanted.shape[0]) % 32), (wanted.shape[0] // 32, 32))
        return tl.reshape(tl.broadcast_to(tl.sum(bits, 1)[:, None], bits.shape), wanted.shape)
    return tl.inline_asm_elementwise(
        "{ .reg .pred wanted; setp.ne.s32 wanted, $1, 0; vote.sync.ballot.b32 $0, wanted, 0xffffffff; }", "=r,r",
        [wanted.to(tl.int32)], tl.int32, False, 1,
    )  # fmt: skip


@triton.jit
def _count_bits(x: tl.tensor) -> tl.tensor:
    """Return how many bits of each number are set."""
    if PLAIN:
        count = tl.zeros_like(x)
        for i in tl.static_range(32):
            count += (x >> i) & 1
        return count
    return tl.inline_asm_elementwise("popc.b32 $0, $1;", "=r,r", [x], tl.int32, True, 1)


@triton.jit
def before_and_all(x: tl.tensor, adds: tl.constexpr) -> tuple[tl.tensor, tl.tensor]:
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
def sum_of_pair(one: tl.tensor, other: tl.tensor, bit: tl.constexpr) -> tl.tensor:
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
    on_column = tl.minimum(tl.maximum(-b * near_x * inverse_of(c), y - height), y)
    on_row = tl.minimum(tl.maximum(-b * near_y * inverse_of(a), x - width), x)
    square = 0.5 * (a * near_x * near_x + c * on_column * on_column)
    crosses = square * share + b * near_x * on_column <= limit
    square = 0.5 * (a * on_row * on_row + c * near_y * near_y)
    return crosses | (square * share + b * on_row * near_y <= limit)


@triton.jit
def _reaches(
    x: tl.tensor, y: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, opacity: tl.tensor,
    width: tl.constexpr, height: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return whether alpha may reach `FAINTEST` at a pixel; x and y are centres relative to the first pixel's."""
    limit = tl.log(opacity / FAINTEST) + 0.01  # with room for rounding, which grows with the terms of the exponent
    return meets(x, y, a, b, c, limit, 0.99999, width - 1, height - 1)


@triton.jit
def place_region(
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
def pairs_of(index: tl.tensor, offsets: tl.tensor, known: int, pairs: int) -> tuple[tl.tensor, tl.tensor]:
    """Return the first pair of a tile, and the one after its last; `known` offsets are in memory."""
    return tl.load(offsets + index), tl.load(offsets + index + 1, index + 1 < known, pairs)


@triton.jit(do_not_specialize=("across", "tiles", "known", "pairs"))
def reach_kernel(
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
    begin, stop = pairs_of(index, offsets, known, pairs)
    block = first_word(index, begin, regions)
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
def first_word(index: tl.tensor, begin: tl.tensor, regions: tl.constexpr) -> tl.tensor:
    """Return where the words of a tile begin: they have 32 pairs each, the last one of a tile maybe fewer."""
    return (begin // 32 + index) * regions


@triton.jit
def next_pairs(
    begin: tl.tensor, stop: tl.tensor, flat: tl.tensor, words: tl.tensor, regions: tl.constexpr
) -> tuple[tl.tensor, tl.tensor]:
    """Load the next `AT_ONCE` pairs: their Gaussians, and the words that say for each 32 which reach the region."""
    pair = tl.arange(0, AT_ONCE)
    gaussian = tl.load(flat + begin + pair, begin + pair < stop, 0)
    return gaussian, tl.load(words + pair // 32 * regions, begin + pair // 32 * 32 < stop, 0)


@triton.jit
def fill_queue(
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
        gaussian, word = next_pairs(begin, stop, flat, words, regions)
        tl.debug_barrier()  # threads read what others wrote
    return begin, words, tail, gaussian, word


@triton.jit
def next_bucket(
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
def alphas_of(
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
def pixels_of(
    image: tl.tensor, pixel: tl.tensor, size: tl.tensor, planar: tl.constexpr
) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Return where red, green and blue of pixels are in images (c, h, w, 3), or (c, 3, h, w) if `planar`."""
    start = 3 * (image.to(tl.int64) * size)
    if planar:
        return start + pixel, start + size + pixel, start + 2 * size + pixel
    return start + 3 * pixel, start + 3 * pixel + 1, start + 3 * pixel + 2


@triton.jit
def transmittances_of(alpha: tl.tensor, transmittance: tl.tensor) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Return the transmittances before and after each Gaussian, and after the bucket."""
    left = 1.0 - alpha
    second = tl.arange(0, alpha.shape[2])[None, None, :, None] == 1  # of a thread's Gaussians
    by_both = tl.reduce(left, 2, _multiply, keep_dims=True)
    by_first = tl.reduce(tl.where(second, 1.0, left), 2, _multiply, keep_dims=True)
    before, by_all = before_and_all(by_both, adds=False)
    before *= transmittance
    after = before * tl.where(second, by_both, by_first)
    return before * tl.where(second, by_first, 1.0), after, transmittance * by_all


def launch_of(
    offsets: Tensor, flat: Tensor, size: tuple[int, int], count: int, shape: Shape
) -> tuple[int, tuple[int, ...]]:
    """Return the number of programs and the arguments named in `NOT_SPECIALIZED`."""
    across, down = grid_of(size)
    return count * across * down * shape.regions, (*size, across, across * down, offsets.numel(), flat.numel())
