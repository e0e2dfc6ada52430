"""Assign tiles as FastGS does: those that an ellipse of constant alpha meets, instead of a three-sigma square.

A Gaussian of opacity o reaches alpha = 1/255 where its squared Mahalanobis distance is 2 ln(255 o). FastGS multiplies
this distance by `mult` ("compact box", 0.5 by default) and blends the Gaussian in all pixels of the tiles that this
ellipse meets: with mult < 1 the image depends on it. Source: the FastGS paper, and Speedy-Splat, whose exact
ellipse-tile test FastGS uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import Floats
from lapgs_plugin.reference_raster import ordering_kernels
from lapgs_plugin.reference_raster.layout import (
    CENTRE_X,
    CENTRE_Y,
    FACTOR_SCALE,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    LOG2_MIN_ALPHA,
    LOG2_OPACITY,
    MIN_ROOT,
    NEAR_DEPTH,
    RADIUS_SIGMAS,
    SPLAT,
    TILE,
)
from lapgs_plugin.reference_raster.pipeline import TileLists
from lapgs_plugin.reference_raster.projection_kernels import HUGE

Assign = Callable[[Floats, NDArray[np.int32]], TileLists]


def snug_tiles(depths: Floats, mult: float, tiles_x: int, tiles_y: int) -> Assign:
    """Make the argument `assign` of `pipeline.render` for FastGS's tiles.

    Args:
        depths: (n,) float32 camera-space z.
        mult: factor on the squared distance at which alpha reaches 1/255.
    """

    def assign(splats: Floats, radii: NDArray[np.int32]) -> TileLists:
        n = len(radii)
        # The ellipse of a nearly opaque Gaussian may reach the image although its three-sigma square does not. At the
        # near plane itself the decision is left to the projection, which rounds differently.
        candidates = (radii > 0) | (depths > NEAR_DEPTH * (1 + 1e-5))
        first_pair = np.empty(n + 1, np.int64)
        starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
        shown = _count(n, splats, candidates, float(mult), tiles_x, tiles_y, radii, first_pair, starts)
        keys = np.ascontiguousarray(depths).view(np.uint32)
        order, spare = np.empty(shown, np.int32), np.empty(shown, np.int32)
        sorted_keys, spare_keys = np.empty(shown, np.uint32), np.empty(shown, np.uint32)
        ordering_kernels.sort_by_depth(first_pair, keys, order, spare, sorted_keys, spare_keys)
        members, places = np.empty(first_pair[n], np.int32), np.empty(first_pair[n], np.int32)
        _list_by_tile(order, splats, float(mult), tiles_x, tiles_y, first_pair, starts.copy(), members, places)
        return first_pair, places, starts, members

    return assign


@inline
def _clip(value: float, last: int) -> int:
    return int(min(max(math.floor(value), 0.0), float(last)))


@inline
def _rows(splats: Floats, s: int, mult: float, tiles_y: int) -> tuple[float, float, int, int]:
    """Return the ellipse's squared size in the splat's units, half its height in pixels, its first tile row and the
    row past its last."""
    reach = mult * (splats[s + LOG2_OPACITY] - LOG2_MIN_ALPHA)
    if not (reach > 0.0 and splats[s + FACTOR_XX] > 0.0 and splats[s + FACTOR_YY] > 0.0):
        return 0.0, 0.0, 0, 0
    if not (abs(splats[s + CENTRE_X]) < HUGE and abs(splats[s + CENTRE_Y]) < HUGE):
        return 0.0, 0.0, 0, 0
    half, centre = math.sqrt(reach) / splats[s + FACTOR_YY], splats[s + CENTRE_Y]
    return reach, half, _clip((centre - half) / TILE, tiles_y), _clip((centre + half) / TILE + 1.0, tiles_y)


@inline
def _span(splats: Floats, s: int, reach: float, half: float, row: int, tiles_x: int) -> tuple[int, int]:
    """Return the first tile that the ellipse meets in a row of tiles, and one past the last.

    The ellipse is u^2 + v^2 <= reach with u = xx dx + xy dy, v = yy dy. Its border on either side is monotone in dy
    except at the leftmost and the rightmost point, which mirror each other.
    """
    xx, xy, yy = float(splats[s + FACTOR_XX]), float(splats[s + FACTOR_XY]), float(splats[s + FACTOR_YY])
    top = min(max(row * TILE - splats[s + CENTRE_Y], -half), half)
    bottom = min(max((row + 1) * TILE - splats[s + CENTRE_Y], -half), half)
    widest = math.sqrt(reach * (xy * xy + yy * yy)) / (xx * yy)
    extreme = -xy * widest * xx / (xy * xy + yy * yy)  # dy of the rightmost point
    slope = -xy / xx
    half_top = math.sqrt(max(reach - (yy * top) ** 2, 0.0)) / xx
    half_bottom = math.sqrt(max(reach - (yy * bottom) ** 2, 0.0)) / xx
    right = widest if top <= extreme <= bottom else max(slope * top + half_top, slope * bottom + half_bottom)
    left = -widest if top <= -extreme <= bottom else min(slope * top - half_top, slope * bottom - half_bottom)
    centre = splats[s + CENTRE_X]
    return _clip((centre + left) / TILE, tiles_x), _clip((centre + right) / TILE + 1.0, tiles_x)


@inline
def _radius(splats: Floats, s: int) -> int:
    """Return the three-sigma radius in pixels, from the inverse covariance."""
    xx, xy = float(splats[s + FACTOR_XX]) / FACTOR_SCALE, float(splats[s + FACTOR_XY]) / FACTOR_SCALE
    yy = float(splats[s + FACTOR_YY]) / FACTOR_SCALE
    scale = 1.0 / (xx * yy) ** 2
    middle = 0.5 * (xy * xy + yy * yy + xx * xx) * scale
    root = math.sqrt(max(middle * middle - scale, MIN_ROOT))
    return math.ceil(RADIUS_SIGMAS * math.sqrt(middle + root))


@jit
def _count(
    n: int,
    splats: Floats,  # (m * SPLAT,)
    candidates: NDArray[np.bool_],  # (n,)
    mult: float,
    tiles_x: int,
    tiles_y: int,
    radii: NDArray[np.int32],  # (n,) set to 0 where no tile is met
    first_pair: NDArray[np.int64],  # (n + 1,) filled: see `ordering_kernels.count_pairs`
    starts: NDArray[np.int64],  # (tiles + 1,) zero, filled with the starts of the tiles' lists
) -> int:
    """Count the pairs of a Gaussian and a tile; return the number of Gaussians with any."""
    total, shown = 0, 0
    for i in range(n):
        first_pair[i] = total
        s = i * SPLAT
        reach, half, first, end = _rows(splats, s, mult, tiles_y) if candidates[i] else (0.0, 0.0, 0, 0)
        for row in range(first, end):
            left, right = _span(splats, s, reach, half, row, tiles_x)
            for column in range(left, right):
                starts[row * tiles_x + column] += 1
            total += max(right - left, 0)
        if total == first_pair[i]:
            radii[i] = 0
        else:
            shown += 1
            if radii[i] == 0:
                radii[i] = _radius(splats, s)
    first_pair[n] = total
    before = 0
    for tile in range(starts.size):
        before, starts[tile] = before + starts[tile], before
    return shown


@jit
def _list_by_tile(
    order: NDArray[np.int32],  # (shown,) nearest first
    splats: Floats,
    mult: float,
    tiles_x: int,
    tiles_y: int,
    first_pair: NDArray[np.int64],
    starts: NDArray[np.int64],  # (tiles + 1,) overwritten
    members: NDArray[np.int32],  # (pairs,) filled: see `ordering_kernels.list_by_tile`
    places: NDArray[np.int32],  # (pairs,) filled: as above
) -> None:
    """Write each pair to its tile's list."""
    for i in order:
        pair = first_pair[i]
        reach, half, first, end = _rows(splats, i * SPLAT, mult, tiles_y)
        for row in range(first, end):
            left, right = _span(splats, i * SPLAT, reach, half, row, tiles_x)
            for column in range(left, right):
                slot = starts[row * tiles_x + column]
                starts[row * tiles_x + column] = slot + 1
                members[slot] = i
                places[pair] = slot
                pair += 1
