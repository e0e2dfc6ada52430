"""Blend the Gaussians of tiles along the rays of their pixels, and the gradients of that.

A splat is 22 numbers: six linear forms of a ray's direction, row by row, as `rays.py` makes them, the opacity, and the
colour. Each thread takes tiles from a shared counter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import Floats, fetch_add
from lapgs_plugin.reference_raster.layout import MIN_ALPHA, MIN_TRANSMITTANCE, TILE_PIXELS

FORMS = 18
OPACITY = FORMS
COLOR = FORMS + 1
RAY_SPLAT = FORMS + 4
"""Numbers of a splat, and of its gradient."""
RAY_MAX_ALPHA = 0.999
"""gsplat's, without a gradient there."""


@inline
def _squares(splats: Floats, row: int, rays: Floats, tile: int, crossed: Floats, lengths: Floats) -> None:
    """Fill in the squared lengths of a splat's cross products and directions at the pixels of a tile."""
    for pixel in range(TILE_PIXELS):
        x, y, z = rays[tile, 0, pixel], rays[tile, 1, pixel], rays[tile, 2, pixel]
        a = splats[row, 0] * x + splats[row, 1] * y + splats[row, 2] * z
        b = splats[row, 3] * x + splats[row, 4] * y + splats[row, 5] * z
        c = splats[row, 6] * x + splats[row, 7] * y + splats[row, 8] * z
        crossed[pixel] = a * a + b * b + c * c
        a = splats[row, 9] * x + splats[row, 10] * y + splats[row, 11] * z
        b = splats[row, 12] * x + splats[row, 13] * y + splats[row, 14] * z
        c = splats[row, 15] * x + splats[row, 16] * y + splats[row, 17] * z
        lengths[pixel] = a * a + b * b + c * c


@inline
def _add_forms(
    sums: Floats, splats: Floats, row: int, rays: Floats, tile: int, pixel: int, by_crossed: float, by_lengths: float
) -> None:
    """Add the gradients by a splat's forms, given twice the derivatives by the two squares of a pixel."""
    for form in range(6):
        value = 0.0
        for axis in range(3):
            value += float(splats[row, 3 * form + axis]) * rays[tile, axis, pixel]
        value *= by_crossed if form < 3 else by_lengths
        for axis in range(3):
            sums[3 * form + axis] += value * rays[tile, axis, pixel]


@jit
def blend_rays(
    counter: NDArray[np.int64],  # (1,) zero
    starts: NDArray[np.int64],  # (tiles + 1,)
    members: NDArray[np.int64],  # (pairs,)
    splats: Floats,  # (v, RAY_SPLAT)
    rays: Floats,  # (tiles, 3, 256)
    seen: NDArray[np.bool_],  # (tiles, 256) pixels that have a ray
    blended: Floats,  # (tiles, 4, 256) filled: colours over black, transmittances
) -> None:
    """Blend all tiles front to back."""
    crossed, lengths = np.empty(TILE_PIXELS, splats.dtype), np.empty(TILE_PIXELS, splats.dtype)
    left, color = np.empty(TILE_PIXELS), np.empty((3, TILE_PIXELS))
    going = np.empty(TILE_PIXELS, np.bool_)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= starts.size - 1:
            break
        left[:], color[:] = 1.0, 0.0
        going[:] = seen[tile]
        for pair in range(starts[tile], starts[tile + 1]):
            row = members[pair]
            opacity = splats[row, OPACITY]
            reach = 2.0 * math.log(opacity / MIN_ALPHA)
            _squares(splats, row, rays, tile, crossed, lengths)
            for pixel in range(TILE_PIXELS):
                if crossed[pixel] > reach * lengths[pixel] or not going[pixel]:
                    continue
                alpha = min(opacity * math.exp(-0.5 * crossed[pixel] / lengths[pixel]), RAY_MAX_ALPHA)
                if left[pixel] * (1.0 - alpha) <= MIN_TRANSMITTANCE:
                    going[pixel] = False
                    continue
                for channel in range(3):
                    color[channel, pixel] += splats[row, COLOR + channel] * alpha * left[pixel]
                left[pixel] *= 1.0 - alpha
        blended[tile, :3] = color
        blended[tile, 3] = left


@jit
def ray_gradients(
    counter: NDArray[np.int64],  # (1,) zero
    starts: NDArray[np.int64],  # (tiles + 1,)
    members: NDArray[np.int64],  # (pairs,)
    splats: Floats,  # (v, RAY_SPLAT)
    rays: Floats,  # (tiles, 3, 256)
    seen: NDArray[np.bool_],  # (tiles, 256)
    blended: Floats,  # (tiles, 4, 256) as `blend_rays` fills it
    from_above: Floats,  # (tiles, 4, 256) gradients by them
    slots: Floats,  # (pairs, RAY_SPLAT) filled: gradients by each splat in each tile
) -> None:
    """Compute the gradients of `blend_rays`, front to back again, with what lies behind each splat."""
    crossed, lengths = np.empty(TILE_PIXELS, splats.dtype), np.empty(TILE_PIXELS, splats.dtype)
    left, behind, sums = np.empty(TILE_PIXELS), np.empty(TILE_PIXELS), np.empty(RAY_SPLAT)
    going = np.empty(TILE_PIXELS, np.bool_)
    while True:
        tile = fetch_add(counter, 1)
        if tile >= starts.size - 1:
            break
        left[:] = 1.0
        going[:] = seen[tile]
        for pixel in range(TILE_PIXELS):
            behind[pixel] = 0.0
            for value in range(4):
                behind[pixel] += float(blended[tile, value, pixel]) * from_above[tile, value, pixel]
        for pair in range(starts[tile], starts[tile + 1]):
            row = members[pair]
            opacity = splats[row, OPACITY]
            reach = 2.0 * math.log(opacity / MIN_ALPHA)
            _squares(splats, row, rays, tile, crossed, lengths)
            sums[:] = 0.0
            for pixel in range(TILE_PIXELS):
                if crossed[pixel] > reach * lengths[pixel] or not going[pixel]:
                    continue
                distance = crossed[pixel] / lengths[pixel]
                free = opacity * math.exp(-0.5 * distance)
                alpha = min(free, RAY_MAX_ALPHA)
                if left[pixel] * (1.0 - alpha) <= MIN_TRANSMITTANCE:
                    going[pixel] = False
                    continue
                by_color = 0.0
                for channel in range(3):
                    by_color += float(splats[row, COLOR + channel]) * from_above[tile, channel, pixel]
                    sums[COLOR + channel] += alpha * left[pixel] * from_above[tile, channel, pixel]
                behind[pixel] -= alpha * left[pixel] * by_color
                by_alpha = left[pixel] * by_color - behind[pixel] / (1.0 - alpha)
                left[pixel] *= 1.0 - alpha
                if free > RAY_MAX_ALPHA:
                    continue
                sums[OPACITY] += by_alpha * alpha / opacity
                by_distance = -alpha * by_alpha / lengths[pixel]
                _add_forms(sums, splats, row, rays, tile, pixel, by_distance, -by_distance * distance)
            slots[pair] = sums
