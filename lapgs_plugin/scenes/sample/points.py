"""Sample sparse points as structure from motion would give them: on visible surfaces, a little off, with tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.sample.raycast import World, camera_rays, first_hits, pixel_colors, surfaces
from lapgs_plugin.scenes.sample.solids import Floats, dot

NOISE = 0.006
"""Standard deviation of a point's coordinates in metres."""
MIN_FACING = 0.15
"""Smallest cosine between the normal and the ray at which a camera can match a point."""
OCCLUSION_GAP = 5e-3
"""Metres by which another surface must be nearer to the camera to hide a point."""
ROUNDS = 50


class SparsePoints(NamedTuple):
    """Points and the views that see them.

    Attributes:
        positions: (n, 3) in the world, noisy.
        colors: (n, 3) RGB in [0, 1] of the pixel around the point in one of its views.
        seen: (n, views) whether a view sees the point; at least two do.
        pixels: (n, views, 2) exact image positions of the surface point.
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.float64]
    seen: NDArray[np.bool_]
    pixels: NDArray[np.float64]


def sample_points(world: World, cameras: Sequence[Camera], count: int, seed: int) -> SparsePoints:
    """Sample points evenly over the images, each seen by at least two cameras.

    Raises:
        UserInputError: the cameras share too little for so many points.
    """
    random = np.random.default_rng([seed, 3])
    parts: list[SparsePoints] = []
    while (visible := sum(len(part.positions) for part in parts)) < count:
        if len(parts) == ROUNDS:
            raise UserInputError(
                f"--points {count}: found only {visible} that two of {len(cameras)} views see, expected fewer points "
                "or more --views"
            )
        parts.append(_sample_batch(world, cameras, max(256, count + count // 8), random))
    return SparsePoints(*(np.concatenate(arrays)[:count] for arrays in zip(*parts, strict=True)))


def _sample_batch(world: World, cameras: Sequence[Camera], count: int, random: np.random.Generator) -> SparsePoints:
    owners = random.integers(len(cameras), size=count)
    places = random.random((2, count))  # in the image, 0 to 1
    noise = random.normal(scale=NOISE, size=(count, 3))
    surface, normals, colors = np.empty((3, 3, count), np.float32)
    for view in np.unique(owners):
        here = np.flatnonzero(owners == view)
        camera = cameras[view]
        pixels = places[:, here] * np.array([[camera.width], [camera.height]])
        origin, directions = camera_rays(camera, pixels)
        distance, index = first_hits(world, origin, directions)
        surface[:, here] = origin[:, None] + distance * directions
        normals[:, here] = surfaces(world, index, surface[:, here])[1]
        colors[:, here] = pixel_colors(world, camera, pixels)
    visible = [_visibility(world, camera, surface, normals) for camera in cameras]
    seen, positions = (np.stack(arrays, axis=1) for arrays in zip(*visible, strict=True))
    kept = seen.sum(axis=1) >= 2
    return SparsePoints(surface.T[kept] + noise[kept], colors.T[kept].astype(np.float64), seen[kept], positions[kept])


def _visibility(
    world: World, camera: Camera, points: Floats, normals: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which surface points (3, n) a camera sees, (n,), and where they project, (n, 2)."""
    pose = camera.world_to_camera.numpy()
    local = pose[:3, :3] @ points + pose[:3, 3:]  # (3, n)
    pixels = (local[:2] / local[2]).T * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    seen = (local[2] > 0) & ((pixels > 0) & (pixels < camera.size)).all(axis=1)
    asked = np.flatnonzero(seen)
    if asked.size:
        origin = camera.position.numpy().astype(np.float32)
        rays = points.take(asked, axis=1) - origin[:, None]
        length = np.sqrt(dot(rays, rays))
        rays /= length
        nearest, _ = first_hits(world, origin, rays)
        facing = np.abs(dot(rays, normals.take(asked, axis=1))) > MIN_FACING
        seen[asked] = facing & (nearest > length - np.float32(OCCLUSION_GAP))
    return seen, pixels
