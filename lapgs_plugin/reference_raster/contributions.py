"""Sum up, over pixels, how much each Gaussian contributes: Taming-3DGS and FastGS score Gaussians by this."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.jit.compiler import jit
from lapgs_plugin.jit.lanes import (
    WIDTH,
    Floats,
    borrowed,
    exp2,
    fetch_add,
    fma,
    load,
    lowest_bit,
    minimum,
    select,
    splat,
    sqrt,
    store,
    store_sums,
)
from lapgs_plugin.jit.threads import parallel
from lapgs_plugin.reference_raster.layout import (
    BLOCK,
    BLOCKS,
    CENTRE_X,
    CENTRE_Y,
    LOG2_MIN_ALPHA,
    MAX_ALPHA,
    SLOT,
    SPLAT,
    TILE,
    TILE_PIXELS,
)
from lapgs_plugin.reference_raster.pipeline import Kept, View, offsets
from lapgs_plugin.reference_raster.tile_kernels import FINAL, falloff, pixels_x, pixels_y


def sums_of(n: int, view: View, kept: Kept, weights: Floats) -> tuple[NDArray[np.float64], ...]:
    """Sum over the pixels of an image that `pipeline.render` made of n Gaussians with `keep`.

    Args:
        weights: (height * width,) float32 weight of each pixel.

    Returns:
        (n,) each: sums over the pixels in which a Gaussian is blended of their weights, of 1, of transmittance times
        alpha, of the distance from the projected centre in pixels.
    """
    slots = empty(len(kept.members) * SLOT, np.float32)
    parallel(
        _accumulate, view.width, view.height, view.tiles[0], kept.tile_start, kept.members, kept.splats,
        offsets(np.dtype(np.float32)), kept.hits, kept.reached, kept.final, weights, slots,
    )  # fmt: skip
    return tuple(np.bincount(kept.members, slots[column::SLOT], n).astype(np.float64) for column in range(4))


@jit
def _accumulate(
    counter: NDArray[np.int64],  # (1,) zero
    width: int,
    height: int,
    tiles_x: int,
    tile_start: NDArray[np.int64],  # (tiles + 1,)
    members: NDArray[np.int32],  # (pairs,)
    splats: Floats,  # (m * SPLAT,)
    offsets: Floats,  # see `tile_kernels.pixel_offsets`
    hits: NDArray[np.uint16],  # (pairs,)
    reached: NDArray[np.int64],  # (tiles,)
    final: Floats,  # (tiles * FINAL,)
    weights: Floats,  # (height * width,)
    slots: Floats,  # (pairs * SLOT,) filled: sums of weights, of 1, of shares, of distances
) -> None:
    """Sum up each splat in each tile; alpha has the bits of `tile_kernels.blend`."""
    transmittance, weight = np.empty(TILE_PIXELS, splats.dtype), np.zeros(TILE_PIXELS, splats.dtype)
    none, one, tiles = splat(splats, 0.0), splat(splats, 1.0), reached.size
    tile_start, members, hits, reached = borrowed(tile_start), borrowed(members), borrowed(hits), borrowed(reached)
    splats, weights = borrowed(splats), borrowed(weights)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= tiles:
            break
        tile_y, tile_x = divmod(tile, tiles_x)
        for block in range(BLOCKS):
            store(transmittance, block * WIDTH, one)
            block_y, block_x = divmod(block, TILE // BLOCK)
            first_x, first_y = tile_x * TILE + block_x * BLOCK, tile_y * TILE + block_y * BLOCK
            for row in range(min(BLOCK, height - first_y)):
                for column in range(min(BLOCK, width - first_x)):
                    pixel = (first_y + row) * width + first_x + column
                    weight[block * WIDTH + row * BLOCK + column] = weights[pixel]
        start = tile_start[tile]
        for pair in range(start + reached[tile], tile_start[tile + 1]):
            store(slots, pair * SLOT, none)
        for pair in range(start, start + reached[tile]):
            s = int(members[pair]) * SPLAT
            position = splat(splats, float(pair - start + 1))
            sum_weight, sum_one, sum_share, sum_distance = none, none, none, none
            blocks = int(hits[pair])
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - 1
                dx = pixels_x(offsets, block, tile_x) - splats[s + CENTRE_X]
                dy = pixels_y(offsets, block, tile_y) - splats[s + CENTRE_Y]
                _, _, exponent = falloff(splats, s, dx, dy)
                alpha = minimum(exp2(exponent), MAX_ALPHA)
                last = load(final, tile * FINAL + (2 * block + 1) * WIDTH)
                blended = (exponent >= LOG2_MIN_ALPHA) & (last >= position)
                t = load(transmittance, block * WIDTH)
                store(transmittance, block * WIDTH, select(blended, fma(-alpha, t, t), t))
                sum_weight = sum_weight + select(blended, load(weight, block * WIDTH), 0.0)
                sum_one = sum_one + select(blended, one, 0.0)
                sum_share = sum_share + select(blended, alpha * t, 0.0)
                sum_distance = sum_distance + select(blended, sqrt(fma(dx, dx, dy * dy)), 0.0)
            store_sums(slots, pair * SLOT, sum_weight, sum_one, sum_share, sum_distance)
