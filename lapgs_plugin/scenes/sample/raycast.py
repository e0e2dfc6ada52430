"""Pictures of a world: the first hit of each ray, light and shadow, and the average over a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.sample.shapes import Floats, Mask, dot, rotate
from lapgs_plugin.scenes.sample.textures import linear_rgb
from lapgs_plugin.scenes.sample.world import PALETTE, World

SAMPLES, SKEW = 10, 3
"""Rays a pixel: a lattice of 10 points, each in a row and a column of its own, the same in every pixel. There is no
noise, and the error is that of about 13 points of Hammersley's set."""

BLOCK = 64
"""Side in pixels of the blocks traced at once: the arrays of one step then stay in a core's cache."""

LAMP: Floats = np.array([2.3, -2.6, 4.6], np.float32)
LIGHT = linear_rgb("#fff0d8")
SKY = linear_rgb("#93a3b5")  # ambient light from above
GROUND = linear_rgb("#6b5f54")  # and from below
SHININESS = 48

SHADOW_GAP = 2e-3
"""A surface throws no shadow on what is nearer than this, in metres: itself."""


def render(world: World, camera: Camera) -> Floats:
    """The picture a camera takes, (height, width, 3) in [0, 1], sRGB-encoded."""
    image = np.empty((camera.height, camera.width, 3), np.float32)
    for top in range(0, camera.height, BLOCK):
        for left in range(0, camera.width, BLOCK):
            block = image[top : top + BLOCK, left : left + BLOCK]
            rows, columns = np.mgrid[top : top + block.shape[0], left : left + block.shape[1]]
            pixels = np.stack([columns.ravel(), rows.ravel()]) + 0.5
            block[:] = pixel_colors(world, camera, pixels).T.reshape(block.shape)
    return image


def pixel_colors(world: World, camera: Camera, pixels: NDArray[np.float64]) -> Floats:
    """Average colour (3, n), sRGB-encoded, over the squares of one pixel around image positions (2, n)."""
    positions = pixels[:, None, :] + _sample_offsets()[:, :, None]  # (2, SAMPLES, n)
    origin, directions = camera_rays(camera, positions.reshape(2, -1))
    colors = _radiance(world, origin, directions).reshape(3, SAMPLES, -1).mean(axis=1)
    return _encode(colors)


def camera_rays(camera: Camera, positions: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """Centre (3,) of a camera and unit directions (3, n) through image positions (2, n) in pixels, in the world."""
    pose = camera.world_to_camera.double().numpy()
    plane = np.ones((3, positions.shape[1]), np.float32)
    plane[0] = (positions[0] - camera.cx) * (1 / camera.fx)
    plane[1] = (positions[1] - camera.cy) * (1 / camera.fy)
    directions = rotate(pose[:3, :3].T.astype(np.float32), plane)
    directions *= 1 / np.sqrt(dot(plane, plane))
    return (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32), directions


def first_hits(
    world: World, origin: Floats, directions: Floats, *, hall: bool = True
) -> tuple[Floats, NDArray[np.uint8]]:
    """Distance (n,) and index of the shape (n,) that rays from `origin` (3,) along `directions` (3, n) hit first.

    Without the hall rays can miss everything; their distance is then inf.
    """
    distance = np.full(directions.shape[1], np.inf, np.float32)
    index = np.zeros(directions.shape[1], np.uint8)
    for number in (*(world.unbounded if hall else ()), *_near_rays(world, origin, directions)):
        which, candidate = world.shapes[number].hit(origin, directions)
        if which.size:
            closer = np.flatnonzero(candidate < distance.take(which))
            which = which.take(closer)
            distance[which] = candidate.take(closer)
            index[which] = number
    return distance, index


def surfaces(world: World, index: NDArray[np.uint8], points: Floats) -> tuple[Floats, Floats]:
    """Albedo and normals of either side, (3, n) each, at points (3, n) on the shapes that `index` (n,) names."""
    codes, normals = np.empty_like(index), np.empty_like(points)
    for number in np.flatnonzero(np.bincount(index)):
        here = np.flatnonzero(index == number)
        codes[here], part = world.shapes[number].surface(points.take(here, axis=1))
        for axis in range(3):  # row by row: several times faster than [:, here]
            normals[axis][here] = part[axis]
    return PALETTE.take(codes, axis=1), normals


def _radiance(world: World, origin: Floats, directions: Floats) -> Floats:
    """Linear RGB (3, n) that arrives along rays."""
    distance, index = first_hits(world, origin, directions)
    points = origin[:, None] + distance * directions
    albedo, normals = surfaces(world, index, points)
    normals *= -np.sign(dot(normals, directions))  # towards the viewer
    to_lamp = LAMP[:, None] - points
    lamp_distance = np.sqrt(dot(to_lamp, to_lamp))
    to_lamp /= lamp_distance
    facing = np.maximum(dot(normals, to_lamp), 0)
    glows = np.array([shape.glows for shape in world.shapes], np.float32).take(index)
    facing *= (1 - glows) * _lit(world, to_lamp, lamp_distance, facing > 0)
    upness = (normals[2] + 1) / 2
    ambient = SKY[:, None] * upness + GROUND[:, None] * (1 - upness)
    ambient += (1 - ambient) * glows
    light: Floats = albedo * (ambient + LIGHT[:, None] * facing)
    gloss = np.array([shape.gloss for shape in world.shapes], np.float32).take(index) * (facing > 0)
    shiny = np.flatnonzero(gloss)
    half = to_lamp.take(shiny, axis=1) - directions.take(shiny, axis=1)
    cosine = np.maximum(dot(normals.take(shiny, axis=1), half) / np.sqrt(dot(half, half)), 0)
    light[:, shiny] += LIGHT[:, None] * (gloss.take(shiny) * cosine**SHININESS)
    return light


def _lit(world: World, to_lamp: Floats, lamp_distance: Floats, asked: Mask) -> Floats:
    """1 where the lamp sees the point, else 0, (n,); points that are not asked about count as lit."""
    lit = np.ones_like(lamp_distance)
    which = np.flatnonzero(asked)
    if which.size:
        nearest, _ = first_hits(world, LAMP, -to_lamp.take(which, axis=1), hall=False)
        lit[which] = nearest >= lamp_distance.take(which) - np.float32(SHADOW_GAP)
    return lit


def _near_rays(world: World, origin: Floats, directions: Floats) -> NDArray[np.intp]:
    """Indices of the bounded shapes that a ball of meets the cone around all rays."""
    axis = directions.mean(axis=1)
    axis /= np.linalg.norm(axis)
    spread = np.arccos(np.clip(dot(axis, directions).min(), -1, 1))
    centres, radii, owners = world.balls
    offsets = centres - origin[:, None]
    away = np.maximum(np.sqrt(dot(offsets, offsets)), 1e-9)
    angle = np.arccos(np.clip(dot(axis, offsets) / away, -1, 1))
    reach = np.arcsin(np.minimum(radii / away, 1)) + 2e-3  # a margin against rounding
    return np.unique(owners[(radii >= away) | (angle <= spread + reach)])


def _sample_offsets() -> NDArray[np.float64]:
    """Positions of the rays relative to the pixel's centre, (2, SAMPLES); their mean is zero."""
    order = np.arange(SAMPLES)
    return (np.stack([order, order * SKEW % SAMPLES]) + 0.5) / SAMPLES - 0.5


def _encode(linear: Floats) -> Floats:
    """sRGB in [0, 1] from linear light."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - np.float32(0.055))
