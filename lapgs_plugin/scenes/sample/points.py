"""Sparse points as structure from motion would give them: on visible surfaces, a little off, seen by several views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.sample.raycast import camera_rays, first_hits, pixel_colors, surfaces
from lapgs_plugin.scenes.sample.shapes import Floats, dot
from lapgs_plugin.scenes.sample.world import World

NOISE = 0.006
"""Standard deviation of a point's coordinates in metres: an eighth of a percent of the cameras' distance."""

MIN_FACING = 0.15
"""Cosine between a surface's normal and the ray to a camera below which the camera cannot match the point."""

OCCLUSION_GAP = 5e-3
"""A point counts as seen when the first hit on the way to it is nearer by no more than this, in metres."""

ROUNDS = 50


@dataclass(frozen=True)
class SparsePoints:
    """Points and where the views see them.

    Attributes:
        positions: (n, 3) float64 in the world, noisy.
        colors: (n, 3) uint8, what the pixel around the point shows in one of its views.
        observations: for each point the indices of its views (at least two) and the exact image positions of the
            surface point in them, (k,) and (k, 2).
    """

    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    observations: list[tuple[NDArray[np.intp], NDArray[np.float64]]]


def sample_points(world: World, cameras: Sequence[Camera], count: int, seed: int) -> SparsePoints:
    """Points on what the cameras see, evenly over their images, that at least two cameras see.

    Raises:
        UserInputError: the cameras share too little for so many points.
    """
    random = np.random.default_rng([seed, 3])
    batch = max(256, count + count // 8)
    parts: list[SparsePoints] = []
    found = 0
    for _ in range(ROUNDS):
        parts.append(_sample_batch(world, cameras, batch, random))
        found += len(parts[-1].positions)
        if found >= count:
            break
    else:
        raise UserInputError(
            f"--points {count}: found only {found} that two of {len(cameras)} views see, expected fewer points or more "
            "--views"
        )
    return SparsePoints(
        np.concatenate([part.positions for part in parts])[:count],
        np.concatenate([part.colors for part in parts])[:count],
        [observation for part in parts for observation in part.observations][:count],
    )


def _sample_batch(world: World, cameras: Sequence[Camera], count: int, random: np.random.Generator) -> SparsePoints:
    owners = random.integers(len(cameras), size=count)
    places = random.random((2, count))  # in the image, 0 to 1
    noise = random.normal(scale=NOISE, size=(count, 3))
    surface, normals, colors = np.empty((3, count), np.float32), np.empty((3, count), np.float32), np.empty((count, 3))
    for view in np.unique(owners):
        here = np.flatnonzero(owners == view)
        camera = cameras[view]
        pixels = places[:, here] * np.array([[camera.width], [camera.height]])
        origin, directions = camera_rays(camera, pixels)
        distance, index = first_hits(world, origin, directions)
        surface[:, here] = origin[:, None] + distance * directions
        normals[:, here] = surfaces(world, index, surface[:, here])[1]
        colors[here] = pixel_colors(world, camera, pixels).T
    seen, pixels = _visibility(world, cameras, surface, normals)
    kept = np.flatnonzero(seen.sum(axis=0) >= 2)
    views = [np.flatnonzero(seen[:, point]) for point in kept]
    return SparsePoints(
        surface.T[kept].astype(np.float64) + noise[kept],
        np.round(colors[kept] * 255).astype(np.uint8),
        [(which, pixels[which, :, point]) for which, point in zip(views, kept, strict=True)],
    )


def _visibility(
    world: World, cameras: Sequence[Camera], points: Floats, normals: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which views see surface points (3, n), (views, n), and where they project, (views, 2, n)."""
    seen = np.zeros((len(cameras), points.shape[1]), np.bool_)
    pixels = np.empty((len(cameras), 2, points.shape[1]))
    for view, camera in enumerate(cameras):
        pose = camera.world_to_camera.numpy()
        local = pose[:3, :3] @ points + pose[:3, 3:]  # (3, n)
        pixels[view] = local[:2] / local[2] * [[camera.fx], [camera.fy]] + [[camera.cx], [camera.cy]]
        inside = (pixels[view] > 0).all(axis=0) & (pixels[view] < [[camera.width], [camera.height]]).all(axis=0)
        asked = np.flatnonzero(inside & (local[2] > 0))
        if asked.size == 0:
            continue
        origin = camera.position.numpy().astype(np.float32)
        rays = points.take(asked, axis=1) - origin[:, None]
        length = np.sqrt(dot(rays, rays))
        rays /= length
        nearest, _ = first_hits(world, origin, rays)
        facing = np.abs(dot(rays, normals.take(asked, axis=1))) > MIN_FACING
        seen[view, asked] = facing & (nearest > length - np.float32(OCCLUSION_GAP))
    return seen, pixels
