"""Blend splats in tiles, forward and backward.

One thread processes a tile, in 16 blocks of 4x4 pixels, each one vector. A block skips the splats of the tile's list
that none of its pixels sees. This test is exact: the minimum of u^2 + v^2 over a rectangle has a closed form, which one
vector evaluates for all blocks of a tile. Square blocks waste fewer lanes than rows of 16 pixels.

The forward pass goes block by block, so that the pixels stay in registers while a batch of splats is blended. The
backward pass goes splat by splat from the last one, so that a splat's gradient stays in registers over all blocks. Its
state has two numbers for each pixel: the transmittance behind the splat, and the loss's derivative by it times it.

Both passes evaluate alpha by the same expression. They therefore agree, bit by bit, on which splats are blended.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import (
    WIDTH,
    Floats,
    Lanes,
    absolute,
    any_lane,
    bits,
    borrowed,
    exp2,
    fetch_add,
    fma,
    keep_alive,
    load,
    lowest_bit,
    maximum,
    minimum,
    prefetch,
    select,
    splat,
    store,
    store_sums,
)
from lapgs_plugin.reference_raster.layout import (
    BLOCK,
    BLOCKS,
    BLUE,
    CENTRE_X,
    CENTRE_Y,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    GREEN,
    LOG2_MIN_ALPHA,
    LOG2_OPACITY,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    REACH,
    RED,
    RIDGE_X,
    RIDGE_Y,
    SLOT,
    SPLAT,
    TILE,
    TILE_PIXELS,
)

BATCH = 256
"""Splats that are listed for the blocks of a tile at a time; the lists stay in the level-1 cache."""

AHEAD = 8
"""How many splats ahead of their use they are prefetched."""

# Vectors of a block's state, forward: transmittance (negative for pixels that are opaque or outside of the image),
# colour, and the position of the last blended splat in the tile's list, counted from 1.
_T, _R, _G, _B, _LAST, _FORWARD = range(6)
# Backward: transmittance behind the splat, derivative by it times it, derivatives by the colour, last blended splat.
_T_BEHIND, _REST, _GRAD_R, _GRAD_G, _GRAD_B, _FINAL, _BACKWARD = range(7)

FINAL = 2 * TILE_PIXELS
"""Floats of a tile that the backward pass needs: for each block the transmittance, then the last splat."""


def pixel_offsets(dtype: type[np.floating]) -> Floats:
    """Return coordinates in the tile: of each block's pixels (x, then y), then of all blocks' corners (x, y)."""
    corner_y, corner_x = (axis.ravel() * BLOCK for axis in np.indices((TILE // BLOCK, TILE // BLOCK)))  # (16,) each
    y, x = (axis.ravel() for axis in np.indices((BLOCK, BLOCK)))  # (16,) each
    pixels = np.stack([corner_x[:, None] + x, corner_y[:, None] + y], axis=1)  # (16, 2, 16)
    return np.concatenate([pixels.ravel(), corner_x, corner_y]).astype(dtype)


_CORNERS = 2 * TILE_PIXELS


@inline
def _aligned(size: int, like: Floats) -> Floats:
    """Return uninitialised floats whose vectors do not straddle cache lines."""
    memory = np.empty(size + WIDTH, like.dtype)
    start = -memory.ctypes.data % (WIDTH * memory.itemsize) // memory.itemsize
    return memory[start : start + size]


@inline
def pixels_x(offsets: Floats, block: int, tile_x: int) -> Lanes:
    return load(offsets, 2 * block * WIDTH) + tile_x * TILE


@inline
def pixels_y(offsets: Floats, block: int, tile_y: int) -> Lanes:
    return load(offsets, (2 * block + 1) * WIDTH) + tile_y * TILE


@inline
def _blocks_reached(splats: Floats, s: int, left: Lanes, top: Lanes) -> int:
    """Return the blocks, as bits, in which the splat at `s` has an alpha of 1/255 or more anywhere.

    The minimum of u^2 + v^2 over a rectangle is at the splat's centre or on one of the two sides that face it: on the
    side nearest in x at the best y for that x, or on the side nearest in y at the best x for that y.

    Args:
        left, top: pixel coordinates of the blocks' first pixels.
    """
    x0, y0 = left - splats[s + CENTRE_X], top - splats[s + CENTRE_Y]
    x1, y1 = x0 + (BLOCK - 1.0), y0 + (BLOCK - 1.0)
    near_x, near_y = minimum(maximum(x0, 0.0), x1), minimum(maximum(y0, 0.0), y1)
    best_x = minimum(maximum(near_y * splats[s + RIDGE_X], x0), x1)
    best_y = minimum(maximum(near_x * splats[s + RIDGE_Y], y0), y1)
    least = minimum(_distance(splats, s, near_x, best_y), _distance(splats, s, best_x, near_y))
    return bits(least <= splats[s + REACH])


@inline
def _distance(splats: Floats, s: int, dx: Lanes, dy: Lanes) -> Lanes:
    """Return u^2 + v^2."""
    u, v, _ = falloff(splats, s, dx, dy)
    return fma(u, u, v * v)


@inline
def falloff(splats: Floats, s: int, dx: Lanes, dy: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """Return u, v, and the logarithm of alpha before the cap, to base 2, at offsets from a splat's centre."""
    u = fma(dx, splats[s + FACTOR_XX], dy * splats[s + FACTOR_XY])
    v = dy * splats[s + FACTOR_YY]
    return u, v, fma(-u, u, fma(-v, v, splats[s + LOG2_OPACITY]))


# ------------------------------------------------------------------------------------------------ forward


@jit
def blend(
    counter: NDArray[np.int64],  # (1,) zero
    width: int,
    height: int,
    tiles_x: int,
    tile_start: NDArray[np.int64],  # (tiles + 1,) start of each tile's splats in `members`
    members: NDArray[np.int32],  # (pairs,) splats, tile by tile, nearest first
    splats: Floats,  # (n * SPLAT,)
    background: Floats,  # (3,)
    offsets: Floats,  # see `pixel_offsets`
    image: Floats,  # (3 * height * width,)
    transmittance: Floats,  # (height * width,)
    keep: bool,  # whether to fill the following arrays, for the backward pass
    hits: NDArray[np.uint16],  # (pairs,) the blocks, as bits, in which a pair may be blended
    reached: NDArray[np.int64],  # (tiles,) pairs processed before the tile was opaque
    final: Floats,  # (tiles * FINAL,)
) -> None:
    """Blend all splats front to back over the background."""
    tiles = reached.size
    scratch, integers = _aligned(_FORWARD * TILE_PIXELS, splats), np.empty(BLOCKS * (BATCH + 1), np.int64)
    state, lists, counts = borrowed(scratch), borrowed(integers), borrowed(integers[BLOCKS * BATCH :])
    splats, background, offsets, members = borrowed(splats), borrowed(background), borrowed(offsets), borrowed(members)
    tile_start, reached = borrowed(tile_start), borrowed(reached)
    image, transmittance, hits, final = borrowed(image), borrowed(transmittance), borrowed(hits), borrowed(final)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tiles:
            break
        tile_y, tile_x = divmod(tile, tiles_x)
        alive = _open_tile(state, offsets, tile_x, tile_y, width, height)
        start, end = tile_start[tile], tile_start[tile + 1]
        batch = start
        while batch < end and alive != 0:
            size = min(end - batch, BATCH)
            _list_by_block(batch, size, members, splats, offsets, tile_x, tile_y, alive, lists, counts, keep, hits)
            pending = alive
            while pending != 0:
                block = lowest_bit(pending)
                pending &= pending - 1
                done = _blend_block(block, start, members, splats, offsets, tile_x, tile_y, lists, counts, state)
                if done >= 0:
                    alive &= ~(1 << block)
                    if keep:
                        for j in range(done, counts[block]):
                            pair = lists[block * BATCH + j]
                            hits[pair] = hits[pair] & ~(1 << block)
            batch += size
        if keep:
            reached[tile] = batch - start
            for block in range(BLOCKS):
                base = tile * FINAL + 2 * block * WIDTH
                store(final, base, absolute(load(state, (_FORWARD * block + _T) * WIDTH)))
                store(final, base + WIDTH, load(state, (_FORWARD * block + _LAST) * WIDTH))
        _close_tile(state, background, tile_x, tile_y, width, height, image, transmittance)
    keep_alive(scratch)
    keep_alive(integers)


@inline
def _open_tile(state: Floats, offsets: Floats, tile_x: int, tile_y: int, width: int, height: int) -> int:
    """Start blending a tile: set its pixels to black with transmittance 1; return the blocks with pixels, as bits.

    Lanes outside of the image get transmittance -1, which counts as opaque.
    """
    alive = 0
    for block in range(BLOCKS):
        inside = (pixels_x(offsets, block, tile_x) < width) & (pixels_y(offsets, block, tile_y) < height)
        one, zero = splat(state, 1.0), splat(state, 0.0)
        store(state, (_FORWARD * block + _T) * WIDTH, select(inside, one, -one))
        for quantity in range(_R, _FORWARD):
            store(state, (_FORWARD * block + quantity) * WIDTH, zero)
        if any_lane(inside):
            alive |= 1 << block
    return alive


@inline
def _list_by_block(
    batch: int, size: int, members: NDArray[np.int32], splats: Floats, offsets: Floats, tile_x: int, tile_y: int,
    alive: int, lists: NDArray[np.int64], counts: NDArray[np.int64], keep: bool, hits: NDArray[np.uint16],
) -> None:  # fmt: skip
    """List the pairs from `batch` on for each block that they reach."""
    left, top = load(offsets, _CORNERS) + tile_x * TILE, load(offsets, _CORNERS + WIDTH) + tile_y * TILE
    for block in range(BLOCKS):
        counts[block] = 0
    last = batch + size - 1
    for pair in range(batch, batch + size):
        prefetch(splats, members[min(pair + AHEAD, last)] * SPLAT)
        reached = _blocks_reached(splats, members[pair] * SPLAT, left, top) & alive
        if keep:
            hits[pair] = reached
        while reached != 0:
            block = lowest_bit(reached)
            reached &= reached - 1
            count = counts[block]
            lists[block * BATCH + count] = pair
            counts[block] = count + 1


@inline
def _blend_block(
    block: int, start: int, members: NDArray[np.int32], splats: Floats, offsets: Floats, tile_x: int, tile_y: int,
    lists: NDArray[np.int64], counts: NDArray[np.int64], state: Floats,
) -> int:  # fmt: skip
    """Blend a block's list into its pixels.

    Returns:
        The number of splats processed when all pixels were opaque, or -1 if some are not.
    """
    base = _FORWARD * block * WIDTH
    t, last = load(state, base + _T * WIDTH), load(state, base + _LAST * WIDTH)
    red, green, blue = (
        load(state, base + _R * WIDTH), load(state, base + _G * WIDTH), load(state, base + _B * WIDTH)
    )  # fmt: skip
    x, y = pixels_x(offsets, block, tile_x), pixels_y(offsets, block, tile_y)
    done = -1
    for j in range(counts[block]):
        pair = lists[block * BATCH + j]
        s = members[pair] * SPLAT
        dx, dy = x - splats[s + CENTRE_X], y - splats[s + CENTRE_Y]
        _, _, exponent = falloff(splats, s, dx, dy)
        alpha = minimum(exp2(exponent), MAX_ALPHA)
        visible = exponent >= LOG2_MIN_ALPHA
        behind = fma(-alpha, t, t)
        blended = visible & (behind >= MIN_TRANSMITTANCE)
        weight = select(blended, alpha * t, 0.0)
        red = fma(weight, splats[s + RED], red)
        green = fma(weight, splats[s + GREEN], green)
        blue = fma(weight, splats[s + BLUE], blue)
        last = select(blended, splat(splats, pair - start + 1), last)
        t = select(blended, behind, select(visible, minimum(t, -t), t))
        if not any_lane(t > 0.0):
            done = j + 1
            break
    store(state, base + _T * WIDTH, t)
    store(state, base + _R * WIDTH, red)
    store(state, base + _G * WIDTH, green)
    store(state, base + _B * WIDTH, blue)
    store(state, base + _LAST * WIDTH, last)
    return done


@inline
def _close_tile(
    state: Floats, background: Floats, tile_x: int, tile_y: int, width: int, height: int, image: Floats,
    transmittance: Floats,
) -> None:  # fmt: skip
    """Blend the background and store the pixels that are inside of the image."""
    pixels = width * height
    for block in range(BLOCKS):
        base = _FORWARD * block * WIDTH
        t = absolute(load(state, base + _T * WIDTH))
        store(state, base + _T * WIDTH, t)
        for channel in range(3):
            color = load(state, base + (_R + channel) * WIDTH)
            store(state, base + (_R + channel) * WIDTH, fma(t, background[channel], color))
        block_y, block_x = divmod(block, TILE // BLOCK)
        first_x = tile_x * TILE + block_x * BLOCK
        first_y = tile_y * TILE + block_y * BLOCK
        for row in range(min(BLOCK, height - first_y)):
            for column in range(min(BLOCK, width - first_x)):
                pixel = (first_y + row) * width + first_x + column
                lane = base + row * BLOCK + column
                transmittance[pixel] = state[lane + _T * WIDTH]
                image[pixel] = state[lane + _R * WIDTH]
                image[pixels + pixel] = state[lane + _G * WIDTH]
                image[2 * pixels + pixel] = state[lane + _B * WIDTH]


# ------------------------------------------------------------------------------------------------ backward


@jit
def blend_backward(
    counter: NDArray[np.int64],  # (1,) zero
    width: int,
    height: int,
    tiles_x: int,
    tile_start: NDArray[np.int64],  # (tiles + 1,)
    members: NDArray[np.int32],  # (pairs,)
    splats: Floats,  # (n * SPLAT,)
    background: Floats,  # (3,)
    offsets: Floats,  # see `pixel_offsets`
    hits: NDArray[np.uint16],  # (pairs,)
    reached: NDArray[np.int64],  # (tiles,)
    final: Floats,  # (tiles * FINAL,)
    grad_image: Floats,  # (3 * height * width,)
    grad_transmittance: Floats,  # (height * width,), or empty for zeros
    slots: Floats,  # (pairs * SLOT,) filled: see `layout.SLOT`
) -> None:
    """Compute the gradient of each splat in each tile."""
    tiles, by_transmittance = reached.size, grad_transmittance.size > 0
    scratch = _aligned(_BACKWARD * TILE_PIXELS, splats)
    state, splats, background, offsets = borrowed(scratch), borrowed(splats), borrowed(background), borrowed(offsets)
    members, hits, final, slots = borrowed(members), borrowed(hits), borrowed(final), borrowed(slots)
    tile_start, reached = borrowed(tile_start), borrowed(reached)
    grad_image, grad_transmittance = borrowed(grad_image), borrowed(grad_transmittance)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tiles:
            break
        tile_y, tile_x = divmod(tile, tiles_x)
        _reopen_tile(
            state, tile, tile_x, tile_y, width, height, background, final, grad_image, grad_transmittance,
            by_transmittance,
        )  # fmt: skip
        start = tile_start[tile]
        end = start + reached[tile]
        none = splat(slots, 0.0)
        for pair in range(end, tile_start[tile + 1]):
            store(slots, pair * SLOT, none)
        for pair in range(end - 1, start - 1, -1):
            prefetch(splats, members[max(pair - AHEAD, start)] * SPLAT)
            blocks = int(hits[pair])
            if blocks == 0:
                store(slots, pair * SLOT, none)
            else:
                _splat_backward(pair, start, members, splats, offsets, tile_x, tile_y, blocks, state, slots)
    keep_alive(scratch)


@inline
def _reopen_tile(
    state: Floats, tile: int, tile_x: int, tile_y: int, width: int, height: int, background: Floats, final: Floats,
    grad_image: Floats, grad_transmittance: Floats, by_transmittance: bool,
) -> None:  # fmt: skip
    """Set the state behind the last splat; pixels outside of the image have no gradient."""
    pixels = width * height
    for block in range(BLOCKS):
        base = _BACKWARD * block * WIDTH
        for quantity in range(_REST, _FINAL):
            store(state, base + quantity * WIDTH, splat(state, 0.0))
        block_y, block_x = divmod(block, TILE // BLOCK)
        first_x = tile_x * TILE + block_x * BLOCK
        first_y = tile_y * TILE + block_y * BLOCK
        for row in range(min(BLOCK, height - first_y)):
            for column in range(min(BLOCK, width - first_x)):
                pixel = (first_y + row) * width + first_x + column
                lane = base + row * BLOCK + column
                state[lane + _GRAD_R * WIDTH] = grad_image[pixel]
                state[lane + _GRAD_G * WIDTH] = grad_image[pixels + pixel]
                state[lane + _GRAD_B * WIDTH] = grad_image[2 * pixels + pixel]
                if by_transmittance:
                    state[lane + _REST * WIDTH] = grad_transmittance[pixel]
        t = load(final, tile * FINAL + 2 * block * WIDTH)
        rest = load(state, base + _REST * WIDTH)
        for channel in range(3):
            rest = fma(load(state, base + (_GRAD_R + channel) * WIDTH), background[channel], rest)
        store(state, base + _T_BEHIND * WIDTH, t)
        store(state, base + _REST * WIDTH, t * rest)
        store(state, base + _FINAL * WIDTH, load(final, tile * FINAL + (2 * block + 1) * WIDTH))


@inline
def _splat_backward(
    pair: int, start: int, members: NDArray[np.int32], splats: Floats, offsets: Floats, tile_x: int, tile_y: int,
    blocks: int, state: Floats, slots: Floats,
) -> None:  # fmt: skip
    """Step in front of one splat in the given blocks of a tile, and sum up its gradient.

    Let T be the transmittance in front of the splat, c its colour times the pixel's gradient, and R the loss's
    derivative by the transmittance behind it times that transmittance. The derivative by alpha is
    T c - R / (1 - alpha). In front of the splat, R is larger by alpha T c.
    """
    s = members[pair] * SPLAT
    xy, yy = splats[s + FACTOR_XY], splats[s + FACTOR_YY]
    position = splat(splats, pair - start + 1)
    none = splat(splats, 0.0)
    sum_red, sum_green, sum_blue = none, none, none
    sum_1, sum_u, sum_v, sum_uu, sum_uv, sum_vv = none, none, none, none, none, none
    sum_abs_x, sum_abs_y = none, none
    while blocks != 0:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        base = _BACKWARD * block * WIDTH
        # As `falloff`, with xy and yy in registers. The others are loaded again in each block; they would be spilled.
        dx = pixels_x(offsets, block, tile_x) - splats[s + CENTRE_X]
        dy = pixels_y(offsets, block, tile_y) - splats[s + CENTRE_Y]
        u = fma(dx, splats[s + FACTOR_XX], dy * xy)
        v = dy * yy
        exponent = fma(-u, u, fma(-v, v, splats[s + LOG2_OPACITY]))
        density = exp2(exponent)
        alpha = minimum(density, MAX_ALPHA)
        blended = (exponent >= LOG2_MIN_ALPHA) & (load(state, base + _FINAL * WIDTH) >= position)
        t, rest = load(state, base + _T_BEHIND * WIDTH), load(state, base + _REST * WIDTH)
        grad_red, grad_green, grad_blue = (
            load(state, base + _GRAD_R * WIDTH),
            load(state, base + _GRAD_G * WIDTH),
            load(state, base + _GRAD_B * WIDTH),
        )
        inverse = select(blended, 1.0 / (1.0 - alpha), 1.0)
        in_front = t * inverse
        shade = grad_blue * splats[s + BLUE]
        shade = fma(grad_red, splats[s + RED], fma(grad_green, splats[s + GREEN], shade))
        weight = select(blended, alpha * in_front, 0.0)
        store(state, base + _T_BEHIND * WIDTH, in_front)
        store(state, base + _REST * WIDTH, fma(weight, shade, rest))
        # The cap at 0.99 passes the gradient as if it were not there, as the CUDA code does.
        d = select(blended, density * (fma(t, shade, -rest) * inverse), 0.0)
        d_u, d_v = d * u, d * v
        sum_red = fma(weight, grad_red, sum_red)
        sum_green = fma(weight, grad_green, sum_green)
        sum_blue = fma(weight, grad_blue, sum_blue)
        sum_1 = sum_1 + d
        sum_u = sum_u + d_u
        sum_v = sum_v + d_v
        sum_uu = fma(d_u, u, sum_uu)
        sum_uv = fma(d_u, v, sum_uv)
        sum_vv = fma(d_v, v, sum_vv)
        sum_abs_x = sum_abs_x + absolute(d_u)
        sum_abs_y = sum_abs_y + absolute(fma(d_u, xy, d_v * yy))
    store_sums(
        slots, pair * SLOT,
        sum_red, sum_green, sum_blue, sum_1, sum_u, sum_v, sum_uu, sum_uv, sum_vv, sum_abs_x, sum_abs_y,
    )  # fmt: skip
