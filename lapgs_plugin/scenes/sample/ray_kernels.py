"""Intersect many rays with many solids in one compiled loop: as NumPy arrays every step would go through memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import jit

Floats = NDArray[np.float32]

COLUMNS = 19
"""Numbers of a solid: half its sides (3), 1 / its semi-axes (3), rotation by rows (9), centre (3), 1 for a room."""

# Constants, because float literals are doubles and promote results to doubles.
_ZERO, _ONE = np.float32(0), np.float32(1)
_INF = np.float32(np.inf)


@jit
def nearest_hits(solids: Floats, origin: Floats, directions: Floats, distance: Floats, index: NDArray[Any]) -> None:
    """Write the first solid that each ray hits, and its distance.

    Args:
        solids: (m, COLUMNS), see `Solid`.
        origin: (3,) where all rays start.
        directions: (3, n) unit vectors.
        distance: (n,) written: along the ray; inf where it hits nothing.
        index: (n,) written: row of the solid that it hits; 0 where it hits nothing.
    """
    count = directions.shape[1]
    for ray in range(count):
        distance[ray], index[ray] = _INF, 0
    for row in range(solids.shape[0]):
        hx, hy, hz, sx, sy, sz = solids[row, :6]
        xx, xy, xz, yx, yy, yz, zx, zy, zz = solids[row, 6:15]
        x, y, z = origin[0] - solids[row, 15], origin[1] - solids[row, 16], origin[2] - solids[row, 17]
        px, py, pz = xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z
        ux, uy, uz = sx * px, sy * py, sz * pz
        room, curved = solids[row, 18] > _ZERO, sx + sy + sz > _ZERO
        for ray in range(count):
            x, y, z = directions[0, ray], directions[1, ray], directions[2, ray]
            wx, wy, wz = xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z
            enter, leave = -_INF, _INF
            if curved:
                vx, vy, vz = sx * wx, sy * wy, sz * wz
                # The discriminant from the moment u x v does not cancel: thin wires far away keep their digits.
                mx, my, mz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                square = vx * vx + vy * vy + vz * vz
                free = square - (mx * mx + my * my + mz * mz)
                if not free > _ZERO:
                    continue
                root, middle = np.sqrt(free), -(ux * vx + uy * vy + uz * vz)
                enter, leave = (middle - root) / square, (middle + root) / square
            for half, start, way in ((hx, px, wx), (hy, py, wy), (hz, pz, wz)):
                inverse = _ONE / way
                low, high = (-half - start) * inverse, (half - start) * inverse
                enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
            hit = leave if room else enter
            if (room or (enter <= leave and enter > _ZERO)) and hit < distance[ray]:
                distance[ray], index[ray] = hit, row
