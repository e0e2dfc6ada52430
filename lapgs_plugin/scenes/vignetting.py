"""Measure from the photos of a scene how much a camera darkens them towards their corners.

The same sparse points are compared in all photos of a camera, as `exposure` compares them: one that is in the middle of
one photo and near a corner of another tells the falloff. It is one number a camera, because the corners, which show few
points, do not determine more.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.exposure import (
    BANDWIDTHS,
    BRIGHTEST,
    DARKEST,
    LEAST_VIEWS,
    SparseColors,
    agreement,
    place_in_image,
    solve_gains,
)
from lapgs_plugin.scenes.scene import Scene, View

LEAST_FALLOFF = 0.1
"""Least darkening of the corners in stops that is taken."""
MOST_FALLOFF = 4.0
"""Most darkening that is taken, more than lenses have."""
LEAST_PHOTOS = 16
"""Fewest training photos of a camera that is measured."""
MOST_PHOTOS = 300
"""Most photos of a camera that are compared."""
AGREED = 1.5
"""Most by which parts of the photos may differ from all of them, as a factor."""


def measure_vignetting(scene: Scene, seen: SparseColors | None) -> dict[str, float]:
    """Return the brightness of a photo's corners beside its middle in stops, below 0, by names of views.

    Views have it, held-out ones too, if their camera darkens the corners, and the even and the odd photos, the first
    and the second half of them agree by how much.

    Args:
        scene: whose views are named.
        seen: of its training photos; None if they cannot be compared.
    """
    if seen is None:
        return {}
    falloffs: dict[str, float] = {}
    for views, members in _by_camera(scene):
        squares = torch.stack([_squared_radii(scene.train[index].camera, seen.points) for index in members])
        if (falloff := _agreed(seen.colors[members], squares)) is not None:
            falloffs |= {view.name: falloff for view in views}
    return falloffs


def _by_camera(scene: Scene) -> Iterator[tuple[list[View], list[int]]]:
    """Return the views of each camera, told by size and intrinsics, and the indices of training photos to compare."""
    cameras: dict[tuple[float, ...], list[tuple[int, View]]] = {}
    for index, view in enumerate((*scene.train, *scene.test)):
        camera = view.camera
        key = *camera.size, camera.fx, camera.fy, camera.cx, camera.cy
        cameras.setdefault(key, []).append((index, view))
    for views in cameras.values():
        members = [index for index, _ in views if index < len(scene.train)]
        if len(members) >= LEAST_PHOTOS:
            yield [view for _, view in views], members[:: -(-len(members) // MOST_PHOTOS)]


def _squared_radii(camera: Camera, points: Tensor) -> Tensor:
    """Return the squares (n,) of the points' distances from the middle of an image, 1 at its corners."""
    x, y, _ = place_in_image(camera, points)
    width, height = camera.size
    return (((x - 0.5) * width) ** 2 + ((y - 0.5) * height) ** 2) * 4 / (width**2 + height**2)


def _agreed(colors: Tensor, squares: Tensor) -> float | None:
    """Return the falloff of photos if parts of them agree on it, and it is one."""
    whole = _falloff(colors, squares)
    if not -MOST_FALLOFF <= whole <= -LEAST_FALLOFF:
        return None
    half = len(colors) // 2
    parts = slice(0, None, 2), slice(1, None, 2), slice(0, half), slice(half, None)
    falloffs = [_falloff(colors[part], squares[part]) for part in parts]
    return whole if all(AGREED * whole <= falloff <= whole / AGREED for falloff in falloffs) else None


def _falloff(colors: Tensor, squares: Tensor) -> float:
    """Return the falloff that explains the brightness of points best, beside gains of photos and values of points.

    Args:
        colors: (v, n, 3) of points in photos, 0 where they are not seen.
        squares: (v, n) of their distances from the middle.
    """
    usable = ((colors > DARKEST) & (colors < BRIGHTEST)).all(-1)  # (v, n)
    often = usable.sum(0) >= LEAST_VIEWS
    usable = usable[:, often]
    if not bool(usable.any()):
        return 0.0
    brightness = colors[:, often].clamp(DARKEST, BRIGHTEST).mean(-1).log2()
    squares = torch.where(usable, squares[:, often], 0.0)
    weights, falloff = agreement(brightness, usable), 0.0
    for bandwidth in BANDWIDTHS:
        bright, radial = _unexplained(brightness, weights), _unexplained(squares, weights)
        falloff = float((weights * bright * radial).sum() / (weights * radial.square()).sum().clamp_min(1e-6))
        left = _unexplained(brightness - falloff * squares, weights)
        weights = torch.exp(-((left / bandwidth) ** 2)) * usable
    return falloff


def _unexplained(values: Tensor, weights: Tensor) -> Tensor:
    """Return what is left of values (v, n) without one number of each photo and one of each point."""
    gains, points = solve_gains(values, weights)
    return values - gains[:, None] - points
