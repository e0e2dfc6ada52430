"""Define solids: boxes, balls, cylinders and wires, which are one shape with different numbers.

Vectors are float32 (3, n), so that each coordinate is contiguous.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce  # `reduce` is several times faster along the first axis than numpy's

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Codes = NDArray[np.uint8]
Paint = Callable[[Floats, Floats], Codes]
"""Colours of a surface as indices into the palette (n,), from points and normals in the solid's frame, (3, n) each."""


def dot(a: Floats | list[Floats], b: Floats | list[Floats]) -> Floats:
    """Return the dot products (n,) of vectors (3, n) or (3,)."""
    result: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return result


def rotate(rotation: Floats, vectors: Floats) -> Floats:
    """Return rotation (3, 3) @ vectors (3, n), without BLAS, whose last bits depend on its number of threads."""
    return np.stack([dot(row, vectors) for row in rotation])


@dataclass(frozen=True)
class Solid:
    """A painted box whose corners may be cut off by an ellipsoid or a cylinder.

    A point p of the solid's frame is inside if |p| <= half on every axis and the sum of (p / axes)**2 is at most 1. An
    infinite semi-axis means straight: a box has three of them, a cylinder one, a ball none.

    Attributes:
        half: half the box's sides (3,).
        axes: semi-axes (3,).
        rotation: from the solid's frame to the world (3, 3).
        origin: centre in the world (3,).
        paint: colours of the surface.
        room: whether the rays are inside, so that they hit the surface where they leave the solid.
    """

    half: Floats
    axes: Floats
    rotation: Floats
    origin: Floats
    paint: Paint
    room: bool = False

    @cached_property
    def row(self) -> Floats:
        """The numbers that `ray_kernels.nearest_hits` takes."""
        return np.concatenate(
            [self.half, np.float32(1) / self.axes, self.rotation.ravel(), self.origin, [np.float32(self.room)]]
        ).astype(np.float32)

    def surface(self, points: Floats) -> tuple[Codes, Floats]:
        """Return palette indices (n,) and outward unit normals (3, n) at world points (3, n) on the surface."""
        local = rotate(self.rotation.T, points - self.origin[:, None])
        scaled = local / self.axes[:, None]
        reach = np.abs(local) / self.half[:, None]
        face = reduce(np.maximum, reach)
        curved = np.abs(np.sqrt(dot(scaled, scaled)) - 1) < np.abs(face - 1)
        normals = np.where(curved, scaled / self.axes[:, None], np.sign(local) * (reach == face))
        normals /= np.sqrt(dot(normals, normals))
        return self.paint(local, normals), rotate(self.rotation, normals)


UPRIGHT: Floats = np.eye(3, dtype=np.float32)
Place = tuple[float, float, float]


def box(centre: Place, size: Place, paint: Paint, turn: float = 0.0) -> Solid:
    """Make a box with sides `size`, turned about the vertical by `turn` radians."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], np.float32)
    half, straight = np.array(size, np.float32) * np.float32(0.5), np.full(3, np.inf, np.float32)
    return Solid(half, straight, rotation, np.array(centre, np.float32), paint)


def ball(centre: Place, radius: float, paint: Paint) -> Solid:
    """Make a ball."""
    half = np.full(3, radius, np.float32)
    return Solid(half, half, UPRIGHT, np.array(centre, np.float32), paint)


def rod(start: Place, end: Place, radius: float, paint: Paint, room: bool = False) -> Solid:
    """Make a cylinder whose third axis goes from `start` to `end`."""
    way = np.subtract(end, start)
    length = np.linalg.norm(way)
    axis = way / length
    first = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    first /= np.linalg.norm(first)
    half, axes = np.array([[radius, radius, length / 2], [radius, radius, np.inf]], np.float32)
    rotation = np.stack([first, np.cross(axis, first), axis], axis=1).astype(np.float32)
    centre = (np.add(start, end) / 2).astype(np.float32)
    return Solid(half, axes, rotation, centre, paint, room)
