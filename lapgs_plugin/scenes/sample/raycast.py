"""Render solids: the first hit of each ray, a lamp with shadows, and the average over a pixel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.sample.ray_kernels import nearest_hits
from lapgs_plugin.scenes.sample.solids import Floats, Solid, dot, rotate
from lapgs_plugin.scenes.sample.world import PALETTE

SAMPLES = 8
"""Rays a pixel, in a lattice with one point in each row and each column, the same in every pixel."""
SKEW = 3
"""Columns from a row's point of the lattice to the next row's, modulo `SAMPLES`."""
BLOCK = 40
"""Side in pixels of the blocks traced at once, whose arrays fit into the cache of a core and are below the size from
which malloc asks the system for new pages each time."""

LAMP: Floats = np.array([2.3, -2.6, 4.7], np.float32)
LIGHT: Floats = np.array([0.92, 0.80, 0.62], np.float32)
SKY: Floats = np.array([0.34, 0.38, 0.44], np.float32)  # ambient light from above
GROUND: Floats = np.array([0.20, 0.16, 0.12], np.float32)  # and from below
SHADOW_GAP = 2e-3
"""Metres within which a surface casts no shadow: on itself."""

World = Sequence[Solid]


def render(world: World, camera: Camera) -> Floats:
    """Return the image of a camera, (height, width, 3) in [0, 1], sRGB-encoded."""
    image = np.empty((camera.height, camera.width, 3), np.float32)
    for top in range(0, camera.height, BLOCK):
        for left in range(0, camera.width, BLOCK):
            block = image[top : top + BLOCK, left : left + BLOCK]
            rows, columns = np.mgrid[top : top + block.shape[0], left : left + block.shape[1]]
            pixels = np.stack([columns.ravel(), rows.ravel()]) + 0.5
            block[:] = pixel_colors(world, camera, pixels).T.reshape(block.shape)
    return image


def pixel_colors(world: World, camera: Camera, pixels: NDArray[np.float64]) -> Floats:
    """Return sRGB colours (3, n), averaged over squares of one pixel around image positions (2, n)."""
    order = np.arange(SAMPLES)
    offsets = (np.stack([order, order * SKEW % SAMPLES]) + 0.5) / SAMPLES - 0.5  # (2, SAMPLES), their mean is zero
    positions = pixels[:, None, :] + offsets[:, :, None]  # (2, SAMPLES, n)
    origin, directions = camera_rays(camera, positions.reshape(2, -1))
    linear = np.clip(_radiance(world, origin, directions).reshape(3, SAMPLES, -1).mean(axis=1), 0, 1)
    encoded: Floats = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055)
    return encoded


def camera_rays(camera: Camera, positions: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """Return a camera's centre (3,) and unit directions (3, n) through image positions (2, n), in the world."""
    pose = camera.world_to_camera.double().numpy()
    plane = np.ones((3, positions.shape[1]), np.float32)
    if camera.lens is None:
        plane[0] = (positions[0] - camera.cx) / camera.fx
        plane[1] = (positions[1] - camera.cy) / camera.fy
    else:
        plane[:] = camera.rays(torch.from_numpy(positions.T))[0].T
    directions = rotate(pose[:3, :3].T.astype(np.float32), plane)
    directions /= np.sqrt(dot(plane, plane))
    return (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32), directions


def first_hits(world: World, origin: Floats, directions: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the distance (n,) and the index (n,) of the solid that each ray hits first; inf and 0 if it hits none."""
    distance, index = np.empty(directions.shape[1], np.float32), np.empty(directions.shape[1], np.intp)
    rows = np.stack([solid.row for solid in world])
    near = np.flatnonzero(_meet_cone(rows, origin, directions))
    nearest_hits(rows[near], origin, directions, distance, index)
    return distance, near[index] if near.size else index


def _meet_cone(rows: Floats, origin: Floats, directions: Floats) -> NDArray[np.bool_]:
    """Return which solids (m, `COLUMNS`) a ray of the cone may hit. Nearly all blocks of an image miss most of them."""
    axis = directions.mean(axis=1)
    axis /= np.linalg.norm(axis)
    spread = np.arccos(np.clip(dot(axis, directions).min(), -1, 1))
    half, third, centre = rows[:, :3], rows[:, 6:15].reshape(-1, 3, 3)[:, :, 2], rows[:, 15:18]
    along = np.linspace(-1, 1, 9, dtype=np.float32) * half[:, 2:]  # balls around nine points cover a solid
    offsets = (centre - origin)[:, None] + along[:, :, None] * third[:, None]  # (m, 9, 3)
    radius = np.linalg.norm(half * np.array([1, 1, 1 / 8], np.float32), axis=1)[:, None]
    away = np.linalg.norm(offsets, axis=2)
    angle = np.arccos(np.clip(offsets @ axis / np.maximum(away, 1e-9), -1, 1))
    reach = np.arcsin(np.clip(radius / np.maximum(away, radius), 0, 1)) + 2e-3  # with a margin for rounding
    meets = ((away <= radius) | (angle <= spread + reach)).any(axis=1)
    result: NDArray[np.bool_] = meets | (rows[:, 18] > 0)
    return result


def surfaces(world: World, index: NDArray[np.intp], points: Floats) -> tuple[Floats, Floats]:
    """Return albedo and normals, (3, n) each, at points (3, n) on the solids that `index` (n,) names."""
    codes, normals = np.empty(len(index), np.uint8), np.empty_like(points)
    for number in np.flatnonzero(np.bincount(index)).tolist():
        here = np.flatnonzero(index == number)
        codes[here], normals[:, here] = world[number].surface(points.take(here, axis=1))
    return PALETTE.take(codes, axis=1), normals


def _radiance(world: World, origin: Floats, directions: Floats) -> Floats:
    """Return linear RGB (3, n) that arrives along rays."""
    distance, index = first_hits(world, origin, directions)
    points = origin[:, None] + distance * directions
    albedo, normals = surfaces(world, index, points)
    normals *= -np.sign(dot(normals, directions))  # towards the viewer
    to_lamp = LAMP[:, None] - points
    lamp_distance = np.sqrt(dot(to_lamp, to_lamp))
    to_lamp /= lamp_distance
    facing = np.maximum(dot(normals, to_lamp), 0)
    asked = np.flatnonzero(facing)
    if asked.size:
        objects = [solid for solid in world if not solid.room]
        nearest, _ = first_hits(objects, LAMP, -to_lamp.take(asked, axis=1))
        facing[asked] *= nearest >= lamp_distance.take(asked) - np.float32(SHADOW_GAP)
    upness = (normals[2] + 1) / 2
    light: Floats = GROUND[:, None] * (1 - upness) + SKY[:, None] * upness + LIGHT[:, None] * facing
    return albedo * light
